"""One move of the sweep's and the edges', weighed by their covariances, and whether the methods agree."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from arview.errors import InputError
from arview.geometry import Array
from arview.measurement.types import Method, Move

_PARTS = (slice(0, 3), slice(3, 6))


@dataclass(frozen=True)
class Agreement:
    """How two methods compare.

    Attributes:
        first, second: the methods.
        difference_mm: length of the difference of their displacements, along what both determine.
        joint_mm: 95 % of such differences are shorter if both covariances hold.
    """

    first: Method
    second: Method
    difference_mm: float
    joint_mm: float

    @property
    def ratio(self) -> float:
        """Normalised difference; above 1 the methods contradict each other."""
        return self.difference_mm / self.joint_mm if self.joint_mm > 0 else 0.0


@dataclass(frozen=True)
class CombinedMove:
    """The move that methods give together.

    Attributes:
        twist: (6,), see ``Move``; zero along ``undetermined``.
        covariances: by method, (6,6) share of its noise in the twist.
        disagreement: (6,6) share of what the methods contradict each other by, beyond their covariances.
        undetermined: (K,6) orthonormal, scaled directions that no method determines.
        radius_mm: rotations are scaled with it.
        center_in_model: (3,) mm.
    """

    twist: Array
    covariances: Mapping[Method, Array]
    disagreement: Array
    undetermined: Array
    radius_mm: float
    center_in_model: Array


def combine(moves: Sequence[Move], undetermined_mm: float = 0.3) -> CombinedMove:
    """Weighted mean of moves of one component by independent methods.

    Methods that differ by more than their covariances allow have an error that neither knows. Rotations and shifts for
    themselves, the covariance is then inflated until the difference is explained (Birge 1932), and the scatter of the
    methods about the mean is added along the difference: who claims little gets a small weight, and still a say.
    What only one determines is its alone.

    Args:
        moves: at least one, about the same centre.
        undetermined_mm: a direction that stays more uncertain than this, rotations scaled by the radius, is free.

    Raises:
        InputError: no moves, or of different components.
    """
    if not moves or any(move.component != moves[0].component for move in moves):
        raise InputError("combine: expected at least one move, and all of one component")
    radius = moves[0].radius_mm
    unit = np.array([radius] * 3 + [1.0] * 3)
    scaled = np.outer(unit, unit)
    twists = [move.twist * unit for move in moves]
    bases = [_determined(move.undetermined) for move in moves]
    noise = [move.covariance * scaled for move in moves]
    weights = []
    for covariance, basis in zip(noise, bases, strict=True):
        inside = basis.T @ covariance @ basis
        weights.append(basis @ np.linalg.pinv(inside, rcond=1e-12, hermitian=True) @ basis.T)
    values, vectors = np.linalg.eigh(np.sum(weights, axis=0))
    known = values > 1.0 / undetermined_mm**2
    inverse = (vectors[:, known] / values[known]) @ vectors[:, known].T
    gains = [inverse @ weight for weight in weights]
    twist = np.sum([gain @ one for gain, one in zip(gains, twists, strict=True)], axis=0)
    disagreement = np.zeros((6, 6))
    for i, j in combinations(range(len(moves)), 2):
        for part in _PARTS:
            axes = _common(_common(bases[i], bases[j]), np.eye(6)[:, part])
            disagreement += _beyond_chance(
                twists[i] - twists[j], noise[i] + noise[j], gains[i], gains[j], inverse, axes
            )
    shares = [gain @ one @ gain.T / scaled for gain, one in zip(gains, noise, strict=True)]
    return CombinedMove(
        twist / unit, {move.method: share for move, share in zip(moves, shares, strict=True)},
        disagreement / scaled, vectors[:, ~known].T, radius, moves[0].center_in_model,
    )  # fmt: skip


def _beyond_chance(
    difference: Array, joint: Array, gain: Array, other_gain: Array, combined: Array, axes: Array
) -> Array:
    """(6,6) variance to add along axes (6,K) for a difference that its covariance does not explain."""
    if axes.shape[1] == 0:
        return np.zeros((6, 6))
    seen = axes.T @ difference
    squares = float(seen @ np.linalg.pinv(axes.T @ joint @ axes, hermitian=True) @ seen) / len(seen)
    if squares <= 1.0:
        return np.zeros((6, 6))
    along = axes @ seen
    unit = along / np.linalg.norm(along)
    shares = np.clip([unit @ gain @ unit, unit @ other_gain @ unit], 0.0, 1.0)
    # Axis by axis: that two methods differ along an oblique direction ties no axes to each other.
    scatter = float(shares.prod()) * (1.0 - 1.0 / squares) * np.diag(along**2)
    project = axes @ axes.T
    return np.asarray(scatter + (squares - 1.0) * project @ combined @ project)


def agreements(moves: Sequence[Move]) -> tuple[Agreement, ...]:
    """Each pair of methods compared where both determine the displacement."""
    found = []
    for a, b in combinations(moves, 2):
        basis = _common(_determined(a.undetermined), _determined(b.undetermined))
        project = basis @ basis.T
        difference = (project @ (a.twist - b.twist))[3:]
        joint = (project @ (a.covariance + b.covariance) @ project)[3:, 3:]
        if np.trace(joint) > 0:
            length = float(np.linalg.norm(difference))
            found.append(Agreement(a.method, b.method, length, quantile_of_length(joint)))
    return tuple(found)


def quantile_of_length(covariance: Array, probability: float = 0.95) -> float:
    """Length that a normal vector of zero mean stays below; its square is taken as scaled χ² (Satterthwaite 1946)."""
    from scipy.special import gammaincinv

    trace, square = float(np.trace(covariance)), float(np.sum(covariance * covariance.T))
    if trace <= 0 or square <= 0:
        return 0.0
    return float(np.sqrt(2.0 * square / trace * gammaincinv(0.5 * trace**2 / square, probability)))


def _determined(undetermined: Array) -> Array:
    """(6,6-K) orthonormal columns across (K,6) rows."""
    if len(undetermined) == 0:
        return np.eye(6)
    return np.linalg.svd(undetermined)[2][len(undetermined) :].T


def _common(a: Array, b: Array) -> Array:
    """Orthonormal basis of what two subspaces (6,K), (6,L) share, to 3°."""
    if a.shape[1] == 0 or b.shape[1] == 0:
        return np.zeros((6, 0))
    left, values, _ = np.linalg.svd(a.T @ b, full_matrices=False)
    return a @ left[:, values > 0.9986]
