"""How the residuals of a registration err together, and what that does to a result made of them.

The surface of a reconstruction is off by a smooth field of errors besides the noise of each point. It is taken for a
vector field e(x) with covariance s² exp(−|x − x'| / ℓ) I, of which a residual sees the part along its normal, so that
Cov(rᵢ, rⱼ) = s² exp(−hᵢⱼ/ℓ) nᵢ·nⱼ + noise² δᵢⱼ. The three numbers are estimated by restricted maximum likelihood
(Patterson & Thompson, Biometrika 1971): the moves that were fitted are projected out of the residuals first, or a
long-ranged error would hide in them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from arview.geometry import Array

_SHARES = np.array([0.0, 0.03, 0.1, 0.2, 0.35, 0.5, 0.7, 0.85, 0.95])
_LENGTHS = 6
_DOUBT = 2.0
"""What the log-likelihood must gain by the two numbers of the shared part (Akaike 1974)."""
_NEIGHBOURS = 4
"""Points of the sample come in groups of this size, near each other, so that short ranges are seen too."""
_SUM_POINTS = 1000


@dataclass(frozen=True)
class NoiseModel:
    """Of the residuals of a fit.

    Attributes:
        sigma_mm: standard deviation of a residual.
        shared: 0–1, part of its variance that it shares with its neighbours.
        length_mm: distance at which the shared part has dropped to 1/e.
        effective_points: number of independent points that would average as well; all when ``shared`` is 0.
    """

    sigma_mm: float
    shared: float
    length_mm: float
    effective_points: float


def estimate_noise(points: Array, normals: Array, residuals: Array, rows: Array, count: int, seed: int) -> NoiseModel:
    """Noise of residuals (N,) at points (N,3) with surface normals (N,3), after a fit with Jacobian rows (N,K).

    ``count`` points are looked at; 0 takes the residuals to be independent.
    """
    total = float(np.sqrt(np.mean(residuals**2)))
    if count == 0 or len(points) < 60 or total < 1e-7:
        return NoiseModel(total, 0.0, 0.0, float(len(points)))
    chosen = _sample(points, count, seed)
    x, n, r, jacobian = points[chosen], normals[chosen], residuals[chosen] / total, rows[chosen]
    rest = np.linalg.qr(jacobian, mode="complete")[0][:, jacobian.shape[1] :]
    seen = rest.T @ r
    apart = _apart(x, x)
    facing = n @ n.T
    size = float(np.linalg.norm(np.ptp(points, axis=0)))
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
    """(K,K) covariance of Σ pull[:, i] rᵢ over residuals r with this noise; ``pull`` is (K,N).

    The shared part is summed over pairs of some points that stand for all.
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
    values, vectors = np.linalg.eigh(total)
    floor = np.maximum(values, 0.0)
    return np.asarray((vectors * floor) @ vectors.T)


def _apart(a: Array, b: Array) -> Array:
    """(N,M) distances between points."""
    squared = np.sum(a**2, axis=1)[:, None] + np.sum(b**2, axis=1) - 2.0 * a @ b.T
    return np.sqrt(np.maximum(squared, 0.0))


def _sample(points: Array, count: int, seed: int) -> NDArray[np.int64]:
    """Indices of at most ``count`` points: some at random, each with some of its neighbours."""
    from scipy.spatial import cKDTree

    rng = np.random.default_rng(seed)
    if len(points) <= count:
        return np.arange(len(points))
    seeds = rng.permutation(len(points))[: count // _NEIGHBOURS]
    _, near = cKDTree(points).query(points[seeds], k=_NEIGHBOURS)
    chosen = np.unique(near)
    more = np.setdiff1d(rng.permutation(len(points))[: 2 * count], chosen)
    return np.concatenate([chosen, more[: count - len(chosen)]]).astype(np.int64)
