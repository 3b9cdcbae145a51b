"""The rigid move that measurements along single directions agree on, what it leaves open, and how sure it is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from arview.core.kernel import kernel
from arview.geometry import Array

TUKEY = 4.685


@dataclass(frozen=True)
class RigidFit:
    """Result of `fit_rigid`.

    Attributes:
        twist: (6,) rad and mm about the centre.
        covariance: (6,6), zero along ``undetermined``.
        undetermined: (K,6), see ``Move``.
        weights: (N,) robust weights 0–1.
        residual_mm: robust standard deviation of the inliers' residuals.
        gain: (6,N) change of the twist by a change of each measurement.
    """

    twist: Array
    covariance: Array
    undetermined: Array
    weights: Array
    residual_mm: float
    gain: Array


def move_rows(points: Array, directions: Array, center: Array) -> Array:
    """(N,6) how far points go along unit directions by a small move (rad, mm) about a centre."""
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
    looked_rows: Array | None = None,
    min_support: float = 0.0,
    max_pairs: int = 1_000_000,
) -> RigidFit:
    """Weighted least squares with Tukey's biweight (Holland & Welsch 1977) on ``offsets ≈ rows @ twist``.

    Directions that leave less than the data can tell are left out: those of the shape's symmetry (``free``) and those
    whose standard deviation would exceed ``undetermined_mm``. The covariance takes residuals of neighbours to be as
    alike as they are found to be.

    Args:
        rows: (N,6) of `move_rows`.
        offsets, sigmas: (N,) measured, and its predicted standard deviation.
        free: (K,6) orthonormal, rotations times ``radius_mm``.
        radius_mm: length that rotations are weighed with.
        undetermined_mm: limit of a direction's standard deviation.
        places: (N,D) coordinates in which neighbours are near each other, in correlation lengths or so.
        min_sigma: robust standard deviation of normalised residuals is not taken to be less.
        looked_rows: (L,6) of all that was looked at, whether it gave an offset or not; default ``rows``.
        min_support: share of the information of ``looked_rows`` that must agree for a direction to be stated; below
            twice as much its uncertainty grows.
        max_pairs: points whose pairs say how alike residuals are; fewer take the covariance from every so manieth.
    """
    scale = np.repeat([1.0 / radius_mm, 1.0], 3)
    scaled = rows * scale
    white = scaled / sigmas[:, None]
    target = offsets / sigmas
    basis = _across(free)
    weights = np.ones(len(rows))
    spread = 1.0
    # A direction is open when the data cannot hold it; neighbours are alike, so that few are independent.
    information = basis.T @ white.T @ white @ basis
    values, vectors = np.linalg.eigh(information)
    is_held = values > max(4.0 / undetermined_mm**2, 1e-7 * values[-1] if len(values) else 0.0)
    basis = basis @ vectors[:, is_held]
    solution = np.zeros(6)
    for _ in range(20):
        weighted = white @ basis * weights[:, None]
        normal = weighted.T @ (white @ basis)
        solution, last = basis @ np.linalg.pinv(normal, hermitian=True) @ (weighted.T @ target), solution
        left = target - white @ solution
        spread = max(min_sigma, 1.4826 * float(np.median(np.abs(left))))
        weights = np.clip(1.0 - (left / (TUKEY * spread)) ** 2, 0.0, None) ** 2
        if np.abs(solution - last).max() < 1e-6:
            break
    weighted = white @ basis * weights[:, None]
    inverse = np.linalg.pinv(weighted.T @ (white @ basis), hermitian=True)
    gain = (basis @ inverse @ weighted.T) / sigmas  # scaled twist by offset
    is_in = weights > 0.0
    some = np.flatnonzero(is_in)
    stride = max(1, -(-len(some) // max_pairs))
    some = some[::stride]
    middle = stride * _correlated(np.ascontiguousarray(weighted[some]), left[some], places[some], stride)
    covariance = basis @ inverse @ middle @ inverse @ basis.T
    shares, modes = _support(scaled, weights, scaled if looked_rows is None else looked_rows * scale, basis)
    # Few of many agreeing is a sign of a wrong place among them: worse than their scatter shows.
    grown = np.maximum(2.0 * min_support / np.maximum(shares, 1e-9), 1.0)
    own = np.linalg.pinv(modes)
    inner = own @ covariance @ own.T
    covariance = covariance + modes @ np.diag(np.diag(inner) * (grown**2 - 1.0)) @ modes.T
    # What the covariance shows to be too poor to state is open as well.
    values, vectors = np.linalg.eigh(basis.T @ covariance @ basis)
    is_open = np.concatenate([(basis @ vectors[:, values > undetermined_mm**2]).T, modes[:, shares < min_support].T])
    held = basis @ _across(is_open @ basis)
    project = held @ held.T
    return RigidFit(
        twist=project @ solution * scale,
        covariance=project @ covariance @ project * np.outer(scale, scale),
        undetermined=_across(held.T).T,
        weights=weights,
        residual_mm=1.4826 * float(np.median(np.abs(left[is_in] * sigmas[is_in]))) if is_in.any() else float("inf"),
        gain=scale[:, None] * (project @ gain),
    )


def _support(rows: Array, weights: Array, looked: Array, basis: Array) -> tuple[Array, Array]:
    """Share of the information looked for that agrees, ascending, and the moves (6,B) it belongs to."""
    from scipy.linalg import eigh

    inner, outer = rows @ basis, looked @ basis
    if not basis.shape[1]:
        return np.zeros(0), basis
    wanted = outer.T @ outer
    wanted += 1e-9 * np.trace(wanted) * np.eye(len(wanted))
    shares, modes = eigh((inner * weights[:, None]).T @ inner, wanted)
    modes = basis @ modes
    return shares, modes / np.linalg.norm(modes, axis=0)


def _across(directions: Array) -> Array:
    """Orthonormal columns across all rows, which may depend on each other."""
    size = directions.shape[1]
    if not len(directions):
        return np.eye(size)
    _, values, vectors = np.linalg.svd(directions)
    rank = int(np.count_nonzero(values > 1e-9))
    return np.asarray(vectors[rank:].T)


def _correlated(rows: Array, residuals: Array, places: Array, stride: int = 1) -> Array:
    """(B,B) covariance of ``rows.T @ errors`` when errors are as alike as residuals at the same distance are.

    Of every ``stride``-th row it is the share: each stands for so many neighbours.
    """
    edges = np.array([0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0])
    if len(residuals) < 2:
        return rows.T @ rows
    bins = _distance_bins(np.ascontiguousarray(places), edges)
    products, counts = _binned_products(bins, residuals, len(edges) + 1)
    variance = float(np.mean(residuals**2)) * len(residuals) / max(len(residuals) - rows.shape[1], 1)
    alike = np.where(counts > 50, products / np.maximum(counts, 1) / max(variance, 1e-300), 0.0)
    alike = np.clip(alike, 0.0, 1.0)
    # Once they are unlike they stay so: what a few pairs far apart show is chance.
    alike = np.minimum.accumulate(alike)
    alike[-1] = 0.0
    return np.asarray(variance * (rows.T @ rows + stride * _spread(bins, alike, rows)))


@kernel
def _distance_bins(places, edges):  # type: ignore[no-untyped-def]
    n, d = places.shape
    bins = np.empty((n, n), dtype=np.uint8)
    for i in range(n):
        bins[i, i] = len(edges)
        for j in range(i):
            square = 0.0
            for k in range(d):
                square += (places[i, k] - places[j, k]) ** 2
            b = 0
            while b < len(edges) and square > edges[b] * edges[b]:
                b += 1
            bins[i, j] = bins[j, i] = b
    return bins


@kernel
def _binned_products(bins, residuals, size):  # type: ignore[no-untyped-def]
    products, counts = np.zeros(size), np.zeros(size)
    for i in range(bins.shape[0]):
        for j in range(i):
            products[bins[i, j]] += residuals[i] * residuals[j]
            counts[bins[i, j]] += 1
    return products, counts


@kernel
def _spread(bins, alike, rows):  # type: ignore[no-untyped-def]
    n, b = rows.shape
    result = np.zeros((b, b))
    for i in range(n):
        mixed = np.zeros(b)
        for j in range(n):
            if j != i and alike[bins[i, j]] > 0.0:
                for k in range(b):
                    mixed[k] += alike[bins[i, j]] * rows[j, k]
        for a in range(b):
            for k in range(b):
                result[a, k] += rows[i, a] * mixed[k]
    return result
