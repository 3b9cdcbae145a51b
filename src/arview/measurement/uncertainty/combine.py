"""Combination of a component's moves by several methods, weighted by covariance, and agreement of the methods."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from arview.core.fits import intersection, orthogonal_complement
from arview.errors import InputError
from arview.geometry import Array
from arview.measurement.types import Method, Move, moved_to

_PARTS = (slice(0, 3), slice(3, 6))


@dataclass(frozen=True)
class Agreement:
    """Comparison of two methods.

    Attributes:
        first, second: the methods.
        difference_mm: length of the difference of their displacements, along directions that both determine.
        joint_mm: length that 95 % of such differences do not exceed if both covariances are right.
        turn_deg: angle of the difference of their rotations, along directions that both determine.
        mixed_ratio: length of the difference of shift and turn together in all directions that both determine, in units
            of their joint covariance, divided by that which 95 % of such differences do not exceed.
        is_contradiction: whether that length is beyond what chance explains.
    """

    first: Method
    second: Method
    difference_mm: float
    joint_mm: float
    turn_deg: float = 0.0
    mixed_ratio: float = 0.0
    is_contradiction: bool = False

    @property
    def ratio(self) -> float:
        """Normalised difference of the displacements; above 1 the methods differ."""
        return self.difference_mm / self.joint_mm if self.joint_mm > 0 else 0.0


UNDETERMINED_MM = 0.3
"""Largest standard deviation of a determined direction; rotations at the radius."""
SAME_DEG = 3.03
"""Directions that two methods determine are shared where they differ by less."""
CONTRADICTION = 0.99
"""Share of differences that chance keeps below a contradiction."""


@dataclass(frozen=True)
class CombinedMove:
    """Weighted mean of the moves of several methods.

    Attributes:
        twist: (6,), see `Move`; zero along ``undetermined``.
        covariances: (6,6) contribution of each method's noise.
        disagreement: (6,6) contribution of differences that the methods' covariances do not explain.
        undetermined: (K,6) orthonormal, scaled directions that no method determines.
        radius_mm: length that converts rotations to mm.
        center_in_model: (3,) mm.
    """

    twist: Array
    covariances: Mapping[Method, Array]
    disagreement: Array
    undetermined: Array
    radius_mm: float
    center_in_model: Array

    def at(self, point_in_model: Array) -> CombinedMove:
        """The same move, stated for another point (3,) of the component."""
        names = tuple(self.covariances)
        twist, parts, undetermined = moved_to(
            self.twist,
            [*self.covariances.values(), self.disagreement],
            self.undetermined,
            self.radius_mm,
            point_in_model - self.center_in_model,
        )
        covariances = dict(zip(names, parts[:-1], strict=True))
        return CombinedMove(twist, covariances, parts[-1], undetermined, self.radius_mm, point_in_model)


def combine(moves: Sequence[Move]) -> CombinedMove:
    """Weighted mean of moves of one component by independent methods.

    Methods that differ by more than their covariances allow have an error that neither of them knows. For rotations and
    translations separately, the covariance is then inflated until it explains the difference (Birge 1932), and the
    scatter of the methods about the mean is added along the difference. Where shift and turn together differ by more
    than chance explains, in any mixed direction, the truth may be anywhere between the two methods: a rectangular
    distribution between them is added. A direction that only one method determines is taken from that method.

    Args:
        moves: at least one, all about the same centre.

    Raises:
        InputError: there are no moves, or they are of different components.
    """
    if not moves or any(move.component != moves[0].component for move in moves):
        raise InputError("combine: expected at least one move, and all of one component")
    radius = moves[0].radius_mm
    unit = np.array([radius] * 3 + [1.0] * 3)
    scaled, twists = np.outer(unit, unit), [move.twist * unit for move in moves]
    bases = [orthogonal_complement(move.undetermined) for move in moves]
    noise, weights = [move.covariance * scaled for move in moves], []
    for covariance, basis in zip(noise, bases, strict=True):
        inside = basis @ covariance @ basis.T
        weights.append(basis.T @ np.linalg.pinv(inside, rcond=1e-12, hermitian=True) @ basis)
    values, vectors = np.linalg.eigh(np.sum(weights, axis=0))
    known = values > 1.0 / UNDETERMINED_MM**2
    inverse = (vectors[:, known] / values[known]) @ vectors[:, known].T
    gains = [inverse @ weight for weight in weights]
    twist = np.sum([gain @ one for gain, one in zip(gains, twists, strict=True)], axis=0)
    disagreement = np.zeros((6, 6))
    for i, j in combinations(range(len(moves)), 2):
        common = intersection(bases[i], bases[j], SAME_DEG)
        for part in _PARTS:
            axes = intersection(common, np.eye(6)[part], SAME_DEG).T
            disagreement += _beyond_chance(
                twists[i] - twists[j], noise[i] + noise[j], gains[i], gains[j], inverse, axes
            )
        axes = common.T
        squares = _squared_difference(axes.T @ (twists[i] - twists[j]), axes.T @ (noise[i] + noise[j]) @ axes)
        if squares > chi2_quantile(axes.shape[1], CONTRADICTION):
            disagreement += axes @ _between(axes.T @ twists[i], axes.T @ twists[j], axes.T @ twist) @ axes.T
    shares = [gain @ one @ gain.T / scaled for gain, one in zip(gains, noise, strict=True)]
    return CombinedMove(
        twist / unit,
        {move.method: share for move, share in zip(moves, shares, strict=True)},
        disagreement / scaled,
        vectors[:, ~known].T,
        radius,
        moves[0].center_in_model,
    )


def _beyond_chance(
    difference: Array, joint: Array, gain: Array, other_gain: Array, combined: Array, axes: Array
) -> Array:
    """(6,6) covariance to add along axes (6,K) for a difference that the joint covariance does not explain."""
    if axes.shape[1] == 0:
        return np.zeros((6, 6))
    seen = axes.T @ difference
    squares = float(seen @ np.linalg.pinv(axes.T @ joint @ axes, hermitian=True) @ seen) / len(seen)
    if squares <= 1.0:
        return np.zeros((6, 6))
    along = axes @ seen
    unit = along / np.linalg.norm(along)
    shares = np.clip([unit @ gain @ unit, unit @ other_gain @ unit], 0.0, 1.0)
    # Axis by axis: a difference along an oblique direction does not imply that the axes are correlated.
    scatter = float(shares.prod()) * (1.0 - 1.0 / squares) * np.diag(along**2)
    project = axes @ axes.T
    return np.asarray(scatter + (squares - 1.0) * project @ combined @ project)


def _between(first: Array, second: Array, mean: Array) -> Array:
    """(K,K) second moment about a mean (K,) of a rectangular distribution between two values (K,)."""
    off = mean - 0.5 * (first + second)
    return np.outer(first - second, first - second) / 12.0 + np.outer(off, off)


def _squared_difference(difference: Array, joint: Array) -> float:
    """Square of a difference (K,) in units of its covariance (K,K)."""
    if not len(difference):
        return 0.0
    return float(difference @ np.linalg.pinv(joint, rcond=1e-12, hermitian=True) @ difference)


def chi2_quantile(freedom: int, probability: float) -> float:
    """Quantile of the χ² distribution."""
    from scipy.special import gammaincinv

    return float(2.0 * gammaincinv(0.5 * freedom, probability)) if freedom else float("inf")


def agreements(moves: Sequence[Move]) -> tuple[Agreement, ...]:
    """Compare each pair of methods in the directions that both determine."""
    found = []
    for a, b in combinations(moves, 2):
        unit = np.array([a.radius_mm] * 3 + [1.0] * 3)
        known = [orthogonal_complement(move.undetermined) for move in (a, b)]
        shared = intersection(known[0], known[1], SAME_DEG).T
        apart = shared.T @ ((a.twist - b.twist) * unit)
        joint = shared.T @ ((a.covariance + b.covariance) * np.outer(unit, unit)) @ shared
        squares, freedom = _squared_difference(apart, joint), shared.shape[1]
        if squares > 0:
            turn, shift = np.split(shared @ apart, 2)
            found.append(
                Agreement(
                    a.method,
                    b.method,
                    float(np.linalg.norm(shift)),
                    quantile_of_length((shared @ joint @ shared.T)[3:, 3:]),
                    float(np.rad2deg(np.linalg.norm(turn) / a.radius_mm)),
                    float(np.sqrt(squares / chi2_quantile(freedom, 0.95))),
                    squares > chi2_quantile(freedom, CONTRADICTION),
                )
            )
    return tuple(found)


def quantile_of_length(covariance: Array, probability: float = 0.95) -> float:
    """Quantile of the length of a normal vector of zero mean, whose square is a scaled χ² (Satterthwaite 1946)."""
    from scipy.special import gammaincinv

    trace, square = float(np.trace(covariance)), float(np.sum(covariance * covariance.T))
    if trace <= 0 or square <= 0:
        return 0.0
    return float(np.sqrt(2.0 * square / trace * gammaincinv(0.5 * trace**2 / square, probability)))
