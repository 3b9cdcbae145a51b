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
class Combined:
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


def combine(moves: Sequence[Move], undetermined_mm: float = 0.3) -> Combined:
    """Weighted mean of moves of one component by independent methods.

    Methods that differ by more than their covariances allow have an error that neither knows: a variance common to
    both is added, of rotations and of shifts for themselves, just large enough to explain the difference (Mandel &
    Paule 1970, where Birge 1932 inflates both alike: the better method on paper does not win by its own word alone).
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
    twists = [move.twist * unit for move in moves]
    bases = [_determined(move.undetermined) for move in moves]
    noise = [move.covariance * np.outer(unit, unit) for move in moves]
    extra = np.zeros(6)
    for part in _PARTS:
        extra[part] = _between(twists, noise, bases, part)
    weights = []
    for covariance, basis in zip(noise, bases, strict=True):
        inside = basis.T @ (covariance + np.diag(extra)) @ basis
        weights.append(basis @ np.linalg.pinv(inside, rcond=1e-12, hermitian=True) @ basis.T)
    values, vectors = np.linalg.eigh(np.sum(weights, axis=0))
    known = values > 1.0 / undetermined_mm**2
    inverse = (vectors[:, known] / values[known]) @ vectors[:, known].T
    gains = [inverse @ weight for weight in weights]
    twist = np.sum([gain @ one for gain, one in zip(gains, twists, strict=True)], axis=0)
    shares = [gain @ one @ gain.T / np.outer(unit, unit) for gain, one in zip(gains, noise, strict=True)]
    disagreement = np.sum([gain @ np.diag(extra) @ gain.T for gain in gains], axis=0) / np.outer(unit, unit)
    return Combined(
        twist / unit, {move.method: share for move, share in zip(moves, shares, strict=True)}, disagreement,
        vectors[:, ~known].T, radius, moves[0].center_in_model,
    )  # fmt: skip


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
    from scipy.stats import chi2

    trace, square = float(np.trace(covariance)), float(np.sum(covariance * covariance.T))
    if trace <= 0 or square <= 0:
        return 0.0
    return float(np.sqrt(square / trace * chi2.ppf(probability, trace**2 / square)))


def _between(twists: Sequence[Array], noise: Sequence[Array], bases: Sequence[Array], part: slice) -> float:
    """Common variance that explains the largest contradiction of two methods in rotations or in shifts."""
    largest = 0.0
    for i, j in combinations(range(len(twists)), 2):
        axes = _common(_common(bases[i], bases[j]), np.eye(6)[:, part])
        if axes.shape[1] == 0:
            continue
        difference = axes.T @ (twists[i] - twists[j])
        values, vectors = np.linalg.eigh(axes.T @ (noise[i] + noise[j]) @ axes)
        squares, values = (vectors.T @ difference) ** 2, np.maximum(values, 1e-12)
        low, high = 0.0, float(squares.sum())
        if float((squares / values).sum()) <= len(squares):
            continue
        for _ in range(60):  # the excess falls steadily with the variance
            middle = 0.5 * (low + high)
            is_low = float((squares / (values + 2.0 * middle)).sum()) > len(squares)
            low, high = (middle, high) if is_low else (low, middle)
        largest = max(largest, high)
    return largest


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
