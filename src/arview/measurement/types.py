"""Results that the methods of measurement share.

The position of a component is a *move*: the twist (rotation vector in rad, translation in mm), in the axes of the model
frame and about the component's centre, that takes its nominal position to the measured one. Small moves add like
vectors, and the translation is the displacement of the centre, which is the position error.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from arview.core.fits import row_space
from arview.errors import InputError
from arview.geometry import Array, exp_so3, invert, rigid

Method = Literal["sweep", "edges", "cloud"]
"""Methods of measurement: the object-space sweep, edges in photos, and registration of the cloud."""


@dataclass(frozen=True)
class Move:
    """Move of a component, measured by one method.

    Attributes:
        component: its name.
        method: method of measurement.
        center_in_model: (3,) mm, point about which it rotates, at nominal: the centre of mass unless moved by `at`.
        twist: (6,) rotation vector (rad) and translation (mm) in model axes; zero along ``undetermined``.
        covariance: (6,6) of ``twist``, zero along ``undetermined``.
        undetermined: (K,6) orthonormal directions, rotations multiplied by ``radius_mm``, that the data or the
            component's symmetry leave free; (0,6) if everything is determined.
        radius_mm: length that converts rotations to mm: half the diagonal of the component's bounding box.
        used: number of measurements (samples, edge points, cloud points) that agree with the fit.
        residual_mm: robust standard deviation of their residuals.
        support: 0–1, share of the expected measurements that were found.
        notes: messages about what may be wrong.
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
        """(3,) measured minus nominal position of the centre, in model axes."""
        return self.twist[3:]

    @property
    def measured_from_nominal(self) -> Array:
        """(4,4) in the model frame."""
        rotation = exp_so3(self.twist[:3])
        return rigid(rotation, self.center_in_model - rotation @ self.center_in_model + self.twist[3:])

    @property
    def nominal_from_measured(self) -> Array:
        """(4,4) the inverse: the motion that would bring the component to its nominal position."""
        return invert(self.measured_from_nominal)

    def at(self, point_in_model: Array) -> Move:
        """The same move, stated for another point (3,) of the component."""
        twist, covariance, undetermined = moved_to(
            self.twist, (self.covariance,), self.undetermined, self.radius_mm, point_in_model - self.center_in_model
        )
        return replace(
            self, center_in_model=point_in_model, twist=twist, covariance=covariance[0], undetermined=undetermined
        )

    @property
    def observable(self) -> NDArray[np.bool_]:
        """(6,) which of rx ry rz tx ty tz, in model axes, are orthogonal to all undetermined directions."""
        return np.asarray(~(np.abs(self.undetermined) > 0.05).any(axis=0))


def moved_to(
    twist: Array, covariances: Sequence[Array], undetermined: Array, radius_mm: float, arm: Array
) -> tuple[Array, list[Array], Array]:
    """A twist (6,), covariances (6,6) and undetermined directions (K,6) for a point at ``arm`` (3,) from the centre.

    The displacement of the new point has a part of the rotation. Where that is undetermined, so is the part.
    """
    x, y, z = arm
    change = np.eye(6)
    change[3:, :3] = [[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]
    unit = np.array([radius_mm] * 3 + [1.0] * 3)
    moved = np.concatenate([twist[:3], twist[3:] + exp_so3(twist[:3]) @ arm - arm])
    project, free = np.eye(6), undetermined
    if len(undetermined):
        free = row_space((undetermined / unit) @ change.T * unit)
        project = (np.eye(6) - free.T @ free) / unit[:, None] * unit
    both = project @ change
    return project @ moved, [both @ one @ both.T for one in covariances], free


@dataclass(frozen=True)
class NotMeasured:
    """A component that a method could not measure or found missing.

    Attributes:
        component: its name.
        method: method of measurement.
        reason: as a message.
        is_missing: what it would hide is seen, or nothing of it is.
        is_unseen: too few photos show its place, so that nothing is known of it.
        support: share of its predicted edges that were found beyond chance, where this is the reason; else None.
    """

    component: str
    method: Method
    reason: str
    is_missing: bool = False
    is_unseen: bool = False
    support: float | None = None
