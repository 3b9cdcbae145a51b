"""Correlated noise of the residuals of a registration, and its effect on results computed from them.

Besides the noise of each point, the surface of a reconstruction has a smooth field of errors. It is modelled as a
vector field e(x) with covariance s² exp(−|x − x'| / ℓ) I, whose component along the normal enters a residual, so that
Cov(rᵢ, rⱼ) = s² exp(−hᵢⱼ/ℓ) nᵢ·nⱼ + noise² δᵢⱼ. The three parameters are estimated by restricted maximum likelihood
(Patterson & Thompson, Biometrika 1971): the fitted motions are projected out of the residuals first, because a
long-ranged error would otherwise be absorbed by them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from arview.core.fits import nearest_covariance
from arview.geometry import Array

_SHARES = np.array([0.0, 0.03, 0.1, 0.2, 0.35, 0.5, 0.7, 0.85, 0.95])
"""Candidates for the shared part of the variance."""
_LENGTHS = 6
"""Number of correlation lengths tried."""
_DOUBT = 2.0
"""Gain in log-likelihood that the two parameters of the shared part must bring (Akaike 1974)."""
_NEIGHBOURS = 4
"""The sample consists of groups of this many neighbouring points, so that short correlation lengths are visible."""
_SUM_POINTS = 1000
"""Points whose pairs represent all in the covariance of a sum."""


@dataclass(frozen=True)
class NoiseModel:
    """Noise of the residuals of a fit.

    Attributes:
        sigma_mm: standard deviation of a residual.
        shared: 0–1, part of its variance that is correlated with its neighbours.
        length_mm: distance at which the correlation has dropped to 1/e.
        effective_points: number of independent points with the same variance of the mean; all points if ``shared`` is
            0.
    """

    sigma_mm: float
    shared: float
    length_mm: float
    effective_points: float


def estimate_noise(points: Array, normals: Array, residuals: Array, rows: Array, count: int, seed: int) -> NoiseModel:
    """Estimate the noise of residuals after a fit.

    Args:
        points: (N,3) where the residuals are.
        normals: (N,3) surface normals there.
        residuals: (N,) mm.
        rows: (N,K) Jacobian of the fit.
        count: number of points used; 0 assumes independent residuals.
        seed: of the choice of points.
    """
    total = float(np.sqrt(np.mean(residuals**2)))
    if count == 0 or len(points) < 60 or total < 1e-7:
        return NoiseModel(total, 0.0, 0.0, float(len(points)))
    chosen = _sample(points, count, seed)
    x, n, r, jacobian = points[chosen], normals[chosen], residuals[chosen] / total, rows[chosen]
    rest = np.linalg.qr(jacobian, mode="complete")[0][:, jacobian.shape[1] :]
    seen, apart = rest.T @ r, _apart(x, x)
    facing, size = n @ n.T, float(np.linalg.norm(np.ptp(points, axis=0)))
    best, likelihood = NoiseModel(total, 0.0, 0.0, float(len(points))), -np.inf
    for length in np.geomspace(0.02 * size, 0.5 * size, _LENGTHS):
        values, vectors = np.linalg.eigh(rest.T @ (np.exp(-apart / length) * facing) @ rest)
        variances = _SHARES * values[:, None] + (1.0 - _SHARES)
        scales = np.mean((vectors.T @ seen)[:, None] ** 2 / variances, axis=0)
        likelihoods = -0.5 * (len(seen) * np.log(scales) + np.log(variances).sum(axis=0))
        likelihoods -= _DOUBT * (_SHARES > 0)
        k = int(np.argmax(likelihoods))
        if likelihoods[k] > likelihood:
            likelihood = float(likelihoods[k])
            best = NoiseModel(total * float(np.sqrt(scales[k])), float(_SHARES[k]), float(length), 0.0)
    mean_correlation = best.shared * float(np.mean(np.exp(-apart / max(best.length_mm, 1e-9)) * np.abs(facing)))
    effective = 1.0 / ((1.0 - best.shared) / len(points) + mean_correlation) if best.shared else float(len(points))
    return NoiseModel(best.sigma_mm, best.shared, best.length_mm, min(effective, float(len(points))))


def spread_of_sum(points: Array, normals: Array, pull: Array, noise: NoiseModel, seed: int) -> Array:
    """(K,K) covariance of Σ pull[:, i] rᵢ for residuals r with this noise; ``pull`` is (K,N).

    The shared part is summed over pairs of a subset of the points, which represents all.
    """
    own = (1.0 - noise.shared) * pull @ pull.T
    if noise.shared == 0.0:
        return np.asarray(noise.sigma_mm**2 * own)
    rng = np.random.default_rng(seed)
    few = rng.permutation(len(points))[:_SUM_POINTS]
    x, n, p = points[few], normals[few], pull[:, few]
    correlation = np.exp(-_apart(x, x) / noise.length_mm) * (n @ n.T)
    diagonal = np.arange(len(few))
    correlation[diagonal, diagonal] = 0.0
    pairs = len(points) * (len(points) - 1) / max(len(few) * (len(few) - 1), 1)
    shared = noise.shared * (pull @ pull.T + pairs * p @ correlation @ p.T)
    total = noise.sigma_mm**2 * (own + shared)
    return nearest_covariance(total)


def _apart(a: Array, b: Array) -> Array:
    """(N,M) distances between two sets of points."""
    squared = np.sum(a**2, axis=1)[:, None] + np.sum(b**2, axis=1) - 2.0 * a @ b.T
    return np.sqrt(np.maximum(squared, 0.0))


def _sample(points: Array, count: int, seed: int) -> NDArray[np.int64]:
    """Indices of at most ``count`` points: random ones, most of them with some of their neighbours."""
    from scipy.spatial import cKDTree

    rng = np.random.default_rng(seed)
    if len(points) <= count:
        return np.arange(len(points))
    seeds = rng.permutation(len(points))[: count // _NEIGHBOURS]
    _, near = cKDTree(points).query(points[seeds], k=_NEIGHBOURS)
    chosen = np.unique(near)
    more = np.setdiff1d(rng.permutation(len(points))[: 2 * count], chosen)
    return np.concatenate([chosen, more[: count - len(chosen)]]).astype(np.int64)
