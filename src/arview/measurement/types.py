"""What the ways of measuring hand to each other.

Where a component stands is a *move*: the twist (rotation vector in rad, shift in mm), in the axes of the model frame
and about the component's centre, that takes its nominal place to the measured one. Small moves add like vectors, and
the shift is the displacement of the centre, which is the position error.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from arview.errors import InputError
from arview.geometry import Array, exp_so3, invert, rigid

Method = Literal["sweep", "edges", "cloud"]


@dataclass(frozen=True)
class Move:
    """Move of a component by one method.

    Attributes:
        component: its name.
        method: which way of measuring.
        center_in_model: (3,) mm, the point the move is about: centre of the component's bounding box at nominal.
        twist: (6,) rotation vector (rad) and shift (mm) in model axes; components along ``undetermined`` are zero.
        covariance: (6,6) of ``twist``; along ``undetermined`` it holds nothing (zero).
        undetermined: (K,6) orthonormal directions, after scaling rotations by ``radius_mm``, that the data or the
            component's symmetry leave free; (0,6) when all is determined.
        radius_mm: length that rotations are weighed with: half the diagonal of the component's bounding box.
        used: number of measurements (samples, edge points, cloud points) that the fit rests on.
        residual_mm: robust standard deviation of their residuals.
        support: 0–1, share of what should be seen that was.
        notes: in words, what speaks against it.
    """

    component: str
    method: Method
    center_in_model: Array
    twist: Array
    covariance: Array
    undetermined: Array
    radius_mm: float
    used: int
    residual_mm: float
    support: float
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.twist.shape != (6,) or self.covariance.shape != (6, 6) or self.undetermined.shape[1:] != (6,):
            raise InputError(f"move of {self.component}: wrong shapes")

    @property
    def displacement_mm(self) -> Array:
        """(3,) measured minus nominal place of the centre, model axes."""
        return self.twist[3:]

    @property
    def measured_from_nominal(self) -> Array:
        """(4,4) in the model frame."""
        rotation = exp_so3(self.twist[:3])
        return rigid(rotation, self.center_in_model - rotation @ self.center_in_model + self.twist[3:])

    @property
    def nominal_from_measured(self) -> Array:
        """(4,4), the inverse: what would bring the component to its place."""
        return invert(self.measured_from_nominal)

    @property
    def observable(self) -> NDArray[np.bool_]:
        """(6,) which of rx ry rz tx ty tz, in model axes, no undetermined direction touches."""
        return np.asarray(~(np.abs(self.undetermined) > 0.05).any(axis=0))


@dataclass(frozen=True)
class NotMeasured:
    """A component that a method could not measure, or found missing, and why in words."""

    component: str
    method: Method
    reason: str
    is_missing: bool = False
