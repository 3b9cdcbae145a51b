"""Uncertainty budget of a displacement, combined as a sum of covariances and by Monte Carlo.

After the GUM (JCGM 100:2008) and its supplement 1 (JCGM 101:2008). Every contribution is a (6,6) covariance of a
component's twist about its centre *relative to the datum frame*: an error that moves component and datums alike does
not count.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from arview.core.fits import covariance_root
from arview.errors import InputError
from arview.geometry import Array, exp_so3
from arview.measurement.datums.alignment import Alignment
from arview.measurement.uncertainty.combine import CombinedMove, quantile_of_length
from arview.measurement.uncertainty.rice import rice_estimate

_BOUND = float(np.sqrt(3.0))
"""Half the width of a rectangular distribution of unit variance."""


FORM_MM = 0.005
"""Standard uncertainty of a component's position by its own form; machined, not cast."""
MIN_POSES_MM = 0.004
"""Error of the poses that bundle adjustment does not see: lens model, tracks."""
K = 2.0
"""Coverage factor of a single direction; 2 is 95 % of a normal distribution."""
PROBABILITY = 0.95
"""Coverage of intervals."""


@dataclass(frozen=True)
class UncertaintyOptions:
    """How the uncertainty of the result is computed."""

    draws: int = 20_000  # JCGM 101 asks for 1e4 / (1 - p) for two digits; 20,000 give U with 0.7 % of noise
    seed: int = 0
    monte_carlo: bool = True

    def __post_init__(self) -> None:
        if not 0.5 <= PROBABILITY < 1 or self.draws < 100 or K <= 0:
            raise InputError("uncertainty: expected probability from 0.5 to 1, at least 100 draws, k above 0")


@dataclass(frozen=True)
class Contribution:
    """One line of the budget.

    Attributes:
        name: what it comes from.
        covariance: (6,6) of the twist.
        is_bounded: type B with a rectangular distribution; otherwise normal.
    """

    name: str
    covariance: Array
    is_bounded: bool = False


@dataclass(frozen=True)
class Length:
    """A length (mm or rad) with its uncertainty.

    Attributes:
        value: as measured.
        uncertainty: expanded uncertainty U.
        k: U divided by the standard uncertainty along the measured direction.
        low, high: ends of the coverage interval.
        corrected: most likely true length, without the bias that noise adds (Rice).
    """

    value: float
    uncertainty: float
    k: float
    low: float
    high: float
    corrected: float

    @property
    def bias(self) -> float:
        """Estimated amount by which noise makes the measured length too large."""
        return self.value - self.corrected


@dataclass(frozen=True)
class MeasuredPlacement:
    """Position of a component in the datum frame.

    Attributes:
        twist: (6,) about its centre, rad and mm; zero along undetermined directions.
        covariance: (6,6) sum of all contributions.
        contributions: the budget.
        undetermined: (K,6) scaled directions.
        observable: (6,) which of rx ry rz tx ty tz, about the axes of the model, are determined.
        axes: (3,3) rows: the component's own axes.
        own_observable: (6,) the same about the own axes.
        distance: of the stated point from nominal, along the own axes that are determined; None without any.
        angle: of the rotation about the own axes that are determined, rad; None without any.
    """

    twist: Array
    covariance: Array
    contributions: tuple[Contribution, ...]
    undetermined: Array
    observable: NDArray[np.bool_]
    axes: Array
    own_observable: NDArray[np.bool_]
    distance: Length | None
    angle: Length | None

    def budget(self) -> tuple[tuple[str, float], ...]:
        """(name, standard uncertainty of the distance in mm), largest first; the squares add up to the total's."""
        held = projector(self.axes, self.own_observable[3:])
        direction = _direction(held @ self.twist[3:], held @ self.covariance[3:, 3:] @ held)
        parts = [(c.name, _along(c.covariance[3:, 3:], direction)) for c in self.contributions]
        return tuple(sorted(parts, key=lambda part: -part[1]))


# --- placing ---------------------------------------------------------------------------------------------


def place(
    combined: CombinedMove,
    alignment: Alignment,
    poses: Array | None = None,
    options: UncertaintyOptions | None = None,
    axes: Array | None = None,
) -> MeasuredPlacement:
    """Position of a component relative to the datum frame, with every contribution to its uncertainty.

    Args:
        combined: its move in the rough frame.
        alignment: the datum frame.
        poses: (6,6) covariance of the twist relative to the datums due to the camera poses, see `PosePropagation`.
        options: see `UncertaintyOptions`.
        axes: (3,3) rows: the component's own axes; default: those of the model.
    """
    options = options or UncertaintyOptions()
    axes = np.eye(3) if axes is None else axes
    from_frame = alignment.twist_from_move(combined.center_in_model)
    unit = np.array([combined.radius_mm] * 3 + [1.0] * 3)
    project = np.eye(6) - combined.undetermined.T @ combined.undetermined
    project = project / unit[:, None] * unit
    own = [Contribution(f"noise of {method}", share) for method, share in combined.covariances.items()]
    own.append(Contribution("methods disagree", combined.disagreement))
    own.append(Contribution("form", np.diag((FORM_MM / unit) ** 2), is_bounded=True))
    minimum = np.diag((MIN_POSES_MM / unit) ** 2)
    own.append(Contribution("camera poses", minimum if poses is None else poses + minimum))
    frame = [Contribution(f"datum {one.label}", one.covariance) for one in alignment.datums]
    frame.append(Contribution("scale", alignment.scale_covariance))
    twist = project @ relative_twists(combined.twist[None], alignment.move[None], combined, alignment)[0]
    contributions = tuple(
        Contribution(c.name, project @ c.covariance @ project.T, c.is_bounded)
        for c in [*own, *(Contribution(f.name, from_frame @ f.covariance @ from_frame.T) for f in frame)]
    )
    covariance = np.sum([c.covariance for c in contributions], axis=0)
    # What is undetermined is stated at nominal by some methods, and by others where they measured the component.
    turned = axes @ exp_so3(combined.twist[:3]).T
    own_observable = observable_axes(combined.undetermined, axes) | observable_axes(combined.undetermined, turned)
    deviations = None
    if options.monte_carlo:
        moves = combined.twist + _draw(own, options)
        frames = alignment.move + _draw(frame, options, salt=1)
        deviations = relative_twists(moves, frames, combined, alignment) @ project.T - twist
    lengths: list[Length | None] = []
    for part in (slice(3, 6), slice(0, 3)):
        seen = own_observable[part]
        if not seen.any():
            lengths.append(None)
            continue
        held = projector(axes, seen)
        some = None if deviations is None else deviations[:, part] @ held
        block = held @ covariance[part, part] @ held
        lengths.append(length_of(held @ twist[part], block, some, int(seen.sum())))
    return MeasuredPlacement(
        twist,
        covariance,
        contributions,
        undetermined=combined.undetermined,
        observable=observable_axes(combined.undetermined, np.eye(3)),
        axes=axes,
        own_observable=own_observable,
        distance=lengths[0],
        angle=lengths[1],
    )


def observable_axes(undetermined: Array, axes: Array, tolerance: float = 0.05) -> NDArray[np.bool_]:
    """(6,) for rotation about and translation along each of the axes (3,3): is it orthogonal to what is undetermined.

    Args:
        undetermined: (K,6) orthonormal, scaled directions.
        axes: rows are unit vectors.
        tolerance: sine of the largest angle that counts as none.
    """
    both = np.zeros((6, 6))
    both[:3, :3] = both[3:, 3:] = axes
    return np.asarray((np.abs(undetermined @ both.T) <= tolerance).all(axis=0))


def projector(axes: Array, seen: NDArray[np.bool_]) -> Array:
    """(3,3) projection onto those of the axes (3,3) that are seen."""
    return np.asarray(axes[seen].T @ axes[seen])


def relative_twists(moves: Array, frames: Array, combined: CombinedMove, alignment: Alignment) -> Array:
    """(D,6) twists of a component in the datum frame, from its twists (D,6) and the frame's moves (D,7)."""
    center, origin = combined.center_in_model, alignment.origin_in_model
    arm = center - origin
    turned = rotate(-frames[:, :3], arm + moves[:, 3:] - frames[:, 3:6]) / (1.0 + frames[:, 6:])
    # The frame rotates by arc minutes only, so the difference of rotations is exact to second order with this term.
    rotation = moves[:, :3] - frames[:, :3] + 0.5 * np.cross(moves[:, :3], frames[:, :3])
    return np.concatenate([rotation, turned - arm], axis=1)


def rotate(rotation_vectors: Array, vectors: Array) -> Array:
    """(D,3) vectors rotated by rotation vectors (D,3) in rad (Rodrigues)."""
    angle = np.linalg.norm(rotation_vectors, axis=1, keepdims=True)
    axis = rotation_vectors / np.maximum(angle, 1e-12)
    along = axis * np.sum(axis * vectors, axis=1, keepdims=True)
    return along + np.cos(angle) * (vectors - along) + np.sin(angle) * np.cross(axis, vectors)


def length_of(vector: Array, covariance: Array, deviations: Array | None, axes: int) -> Length:
    """Length of a measured vector, with its uncertainty.

    U is at least k standard uncertainties along the vector. A length that pure noise stays below with the given
    probability is compatible with zero: there U is at least the length, so that the interval reaches zero, as a unified
    interval does (Feldman & Cousins 1998). A longer one may be too long by the bias of noise.

    Args:
        vector: (3,) measured.
        covariance: (3,3) of its error.
        deviations: (D,3) Monte Carlo draws of the error, or None.
        axes: number of determined axes.
    """
    value, direction = float(np.linalg.norm(vector)), _direction(vector, covariance)
    along = _along(covariance, direction)
    sigma = float(np.sqrt(max(0.0, np.trace(covariance)) / axes))
    corrected = rice_estimate(value, sigma, axes) if sigma > 0 else value
    if deviations is None:
        by_noise = quantile_of_length(covariance, PROBABILITY)
    else:
        by_noise = float(np.quantile(np.linalg.norm(deviations, axis=1), PROBABILITY))
    uncertainty = K * along
    if value <= by_noise:
        uncertainty = max(uncertainty, value)
    elif deviations is None:
        uncertainty += value - corrected
    else:
        lengths = np.linalg.norm(corrected * direction + deviations, axis=1)
        uncertainty = max(uncertainty, float(np.quantile(np.abs(lengths - corrected), PROBABILITY)))
    k = uncertainty / along if along > 0 else K
    return Length(value, uncertainty, k, max(0.0, value - uncertainty), value + uncertainty, corrected)


def _direction(vector: Array, covariance: Array) -> Array:
    """Unit vector along a displacement; where noise explains it, the direction of largest uncertainty."""
    length = float(np.linalg.norm(vector))
    values, vectors = np.linalg.eigh(covariance)
    if length**2 > 4.0 * max(0.0, values[-1]) and length > 0:
        return vector / length
    return np.asarray(vectors[:, -1])


def _along(covariance: Array, direction: Array) -> float:
    """Standard deviation along a unit direction."""
    return float(np.sqrt(np.maximum(direction @ covariance @ direction, 0.0)))


def _draw(contributions: Sequence[Contribution], options: UncertaintyOptions, salt: int = 0) -> Array:
    """(D,K) sums of draws of all contributions: normal, or rectangular along the principal axes."""
    normal = np.sum([one.covariance for one in contributions if not one.is_bounded], axis=0)
    bounded = [one.covariance for one in contributions if one.is_bounded]
    draws = _standard_draws(options.seed, salt, (options.draws, len(normal)), 1 + len(bounded))
    return np.asarray(sum(noise @ covariance_root(one).T for noise, one in zip(draws, [normal, *bounded], strict=True)))


@lru_cache(maxsize=4)
def _standard_draws(seed: int, salt: int, shape: tuple[int, int], count: int) -> tuple[Array, ...]:
    """Normal draws with unit variance, then ``count - 1`` times rectangular ones: the same for all components."""
    rng = np.random.default_rng([seed, salt])
    return (rng.standard_normal(shape), *(rng.uniform(-_BOUND, _BOUND, shape) for _ in range(count - 1)))
