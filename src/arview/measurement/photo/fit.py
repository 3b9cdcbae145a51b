"""Robust rigid fit to measurements along single directions, with its covariance and its undetermined directions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from arview.core.fits import TUKEY_SIGMAS, orthogonal_complement, robust_sigma
from arview.core.kernel import kernel
from arview.geometry import Array

_MAX_ITERATIONS = 20
"""Iterations of reweighting; most fits converge in less than ten."""
_CORRELATION_EDGES = np.array([0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0])
"""Upper ends of the distance bins, in correlation lengths, in which the correlation of residuals is estimated."""
_MIN_PAIRS = 50
"""Pairs that a distance bin needs for an estimate of its correlation."""


@dataclass(frozen=True)
class RigidFit:
    """Result of `fit_rigid`.

    Attributes:
        twist: (6,) rotation vector (rad) and translation (mm) about the centre.
        covariance: (6,6) of the twist, zero along ``undetermined``.
        undetermined: (K,6), see `Move`.
        weights: (N,) robust weights 0–1.
        residual_mm: robust standard deviation of the inliers' residuals.
        gain: (6,N) derivative of the twist with respect to each measurement.
    """

    twist: Array
    covariance: Array
    undetermined: Array
    weights: Array
    residual_mm: float
    gain: Array


def move_rows(points: Array, directions: Array, center: Array) -> Array:
    """(N,6) derivative of the shift of points along unit directions by a small twist (rad, mm) about a centre."""
    return np.concatenate([np.cross(points - center, directions), directions], axis=1)


def fit_rigid(
    rows: Array,
    offsets: Array,
    sigmas: Array,
    free: Array,
    radius_mm: float,
    undetermined_mm: float,
    places: Array,
    min_sigma: float,
    searched_rows: Array | None = None,
    min_support: float = 0.0,
    max_pairs: int = 1_000_000,
) -> RigidFit:
    """Weighted least squares with Tukey's biweight (Holland & Welsch 1977) on ``offsets ≈ rows @ twist``.

    Directions that cannot be determined are excluded: those of the shape's symmetry (``free``), and those whose
    standard deviation would exceed ``undetermined_mm``. The covariance includes the correlation of neighbouring
    residuals, which is estimated from the residuals themselves.

    Args:
        rows: (N,6) of `move_rows`.
        offsets: (N,) measured displacements, mm.
        sigmas: (N,) predicted standard deviations of the offsets, mm.
        free: (K,6) orthonormal directions that the shape leaves free, rotations multiplied by ``radius_mm``.
        radius_mm: length that converts rotations to mm.
        undetermined_mm: largest standard deviation of a direction that counts as determined.
        places: (N,D) coordinates of the measurements in units of about one correlation length.
        min_sigma: lower bound of the robust standard deviation of the normalised residuals.
        searched_rows: (L,6) rows of all places searched, whether they gave an offset or not; default ``rows``.
        min_support: share of the information of ``searched_rows`` that must agree for a direction to be determined;
            below twice this share its uncertainty is increased.
        max_pairs: points whose pairs are used to estimate the correlation; of more points every n-th is taken.
    """
    scale = np.repeat([1.0 / radius_mm, 1.0], 3)
    scaled = rows * scale
    white = scaled / sigmas[:, None]
    basis = _observable_directions(white, orthogonal_complement(free).T, undetermined_mm)
    solution, residuals, weights = _reweighted(white, offsets / sigmas, np.ascontiguousarray(basis), min_sigma)
    weighted = white @ basis * weights[:, None]
    inverse = np.linalg.pinv(weighted.T @ (white @ basis), hermitian=True)
    gain = (basis @ inverse @ weighted.T) / sigmas  # of the scaled twist
    is_in = weights > 0.0
    some = np.flatnonzero(is_in)
    stride = max(1, -(-len(some) // max_pairs))
    some = some[::stride]
    middle = stride * _correlated(np.ascontiguousarray(weighted[some]), residuals[some], places[some], stride)
    covariance = basis @ inverse @ middle @ inverse @ basis.T
    shares, modes = _support(scaled, weights, scaled if searched_rows is None else searched_rows * scale, basis)
    # Where only few of many measurements agree, some of these may be wrong too: their scatter understates the error.
    inflation = np.maximum(2.0 * min_support / np.maximum(shares, 1e-9), 1.0)
    own = np.linalg.pinv(modes)
    inner = own @ covariance @ own.T
    covariance = covariance + modes @ np.diag(np.diag(inner) * (inflation**2 - 1.0)) @ modes.T
    # Directions whose covariance is too large, or whose support is too small, are undetermined as well.
    values, vectors = np.linalg.eigh(basis.T @ covariance @ basis)
    is_open = np.concatenate([(basis @ vectors[:, values > undetermined_mm**2]).T, modes[:, shares < min_support].T])
    held = basis @ orthogonal_complement(is_open @ basis).T
    project, inliers_mm = held @ held.T, residuals[is_in] * sigmas[is_in]
    return RigidFit(
        twist=project @ solution * scale,
        covariance=project @ covariance @ project * np.outer(scale, scale),
        undetermined=orthogonal_complement(held.T),
        weights=weights,
        residual_mm=robust_sigma(inliers_mm) if is_in.any() else float("inf"),
        gain=scale[:, None] * (project @ gain),
    )


def _observable_directions(white: Array, allowed: Array, undetermined_mm: float) -> Array:
    """(6,B) orthonormal directions within ``allowed`` (6,F) that whitened rows (N,6) determine.

    The limit is four times the information of one independent measurement of that accuracy, because neighbouring
    measurements are correlated.
    """
    information = allowed.T @ white.T @ white @ allowed
    values, vectors = np.linalg.eigh(information)
    is_held = values > max(4.0 / undetermined_mm**2, 1e-7 * values[-1] if len(values) else 0.0)
    return allowed @ vectors[:, is_held]


@kernel
def _reweighted(
    white: NDArray[np.float64], target: NDArray[np.float64], basis: NDArray[np.float64], min_sigma: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Iteratively reweighted least squares: solution (6,), normalised residuals (N,) and weights (N,)."""
    count, free = len(white), basis.shape[1]
    inner = np.zeros((count, free))
    for i in range(count):
        for a in range(free):
            for k in range(6):
                inner[i, a] += white[i, k] * basis[k, a]
    weights, residuals, sizes = np.ones(count), target.copy(), np.empty(count)
    solution = np.zeros(free)
    for _ in range(_MAX_ITERATIONS):
        normal, right = np.zeros((free, free)), np.zeros(free)
        for i in range(count):
            if weights[i] == 0.0:
                continue
            for a in range(free):
                weighted = weights[i] * inner[i, a]
                right[a] += weighted * target[i]
                for b in range(a + 1):
                    normal[a, b] += weighted * inner[i, b]
        for a in range(free):
            for b in range(a):
                normal[b, a] = normal[a, b]
        step_square = 0.0
        if free > 0:
            moved = np.linalg.pinv(normal) @ right
            step_square = np.sum((moved - solution) ** 2)
            solution = moved
        for i in range(count):
            left = target[i]
            for a in range(free):
                left -= inner[i, a] * solution[a]
            residuals[i], sizes[i] = left, abs(left)
        limit = TUKEY_SIGMAS * max(min_sigma, 1.4826 * np.median(sizes))
        for i in range(count):
            weights[i] = max(0.0, 1.0 - (sizes[i] / limit) ** 2) ** 2
        if step_square < 1e-12:
            break
    whole = np.zeros(6)
    for a in range(free):
        whole += basis[:, a] * solution[a]
    return whole, residuals, weights


def _support(rows: Array, weights: Array, searched: Array, basis: Array) -> tuple[Array, Array]:
    """Share of the information searched for that agrees, ascending, and the directions (6,B) that it belongs to."""
    from scipy.linalg import eigh

    inner, outer = rows @ basis, searched @ basis
    if not basis.shape[1]:
        return np.zeros(0), basis
    wanted = outer.T @ outer
    wanted += 1e-9 * np.trace(wanted) * np.eye(len(wanted))
    shares, modes = eigh((inner * weights[:, None]).T @ inner, wanted)
    modes = basis @ modes
    return shares, modes / np.linalg.norm(modes, axis=0)


def _correlated(rows: Array, residuals: Array, places: Array, stride: int = 1) -> Array:
    """(B,B) covariance of ``rows.T @ errors``, with errors correlated by distance as the residuals are.

    ``rows`` are every ``stride``-th of all; each represents that many neighbours.
    """
    edges = _CORRELATION_EDGES
    if len(residuals) < 2:
        return rows.T @ rows
    bins = _distance_bins(np.ascontiguousarray(places), edges)
    products, counts = _binned_products(bins, residuals, len(edges) + 1)
    variance = float(np.mean(residuals**2)) * len(residuals) / max(len(residuals) - rows.shape[1], 1)
    correlation = np.where(counts > _MIN_PAIRS, products / np.maximum(counts, 1) / max(variance, 1e-300), 0.0)
    correlation = np.clip(correlation, 0.0, 1.0)
    # Correlation may only fall with distance: a rise in bins of few distant pairs is noise.
    correlation = np.minimum.accumulate(correlation)
    correlation[-1] = 0.0
    return np.asarray(variance * (rows.T @ rows + stride * _correlated_sum(bins, correlation, rows)))


@kernel
def _distance_bins(places: NDArray[np.float64], edges: NDArray[np.float64]) -> NDArray[np.uint8]:
    """(N,N) index of the distance bin of each pair; the last bin is for distances beyond all edges."""
    n, d = places.shape
    bins = np.empty((n, n), dtype=np.uint8)
    for i in range(n):
        bins[i, i] = len(edges)
        for j in range(i):
            square = 0.0
            for k in range(d):
                square += (places[i, k] - places[j, k]) ** 2
            b = len(edges)  # from the farthest, because most pairs are far apart
            while b > 0 and square <= edges[b - 1] * edges[b - 1]:
                b -= 1
            bins[i, j] = bins[j, i] = b
    return bins


@kernel
def _binned_products(
    bins: NDArray[np.uint8], residuals: NDArray[np.float64], size: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Sum of the products of pairs of residuals, and number of pairs, in each bin."""
    products, counts = np.zeros(size), np.zeros(size)
    for i in range(bins.shape[0]):
        for j in range(i):
            products[bins[i, j]] += residuals[i] * residuals[j]
            counts[bins[i, j]] += 1
    return products, counts


@kernel
def _correlated_sum(
    bins: NDArray[np.uint8], correlation: NDArray[np.float64], rows: NDArray[np.float64]
) -> NDArray[np.float64]:
    """(B,B) sum over pairs i ≠ j of ``correlation`` times the outer product of rows i and j."""
    n, b = rows.shape
    result = np.zeros((b, b))
    for i in range(n):
        mixed = np.zeros(b)
        for j in range(i):
            share = correlation[bins[i, j]]
            if share > 0.0:
                for k in range(b):
                    mixed[k] += share * rows[j, k]
        for a in range(b):
            for k in range(b):
                result[a, k] += rows[i, a] * mixed[k]
    return result + result.T
