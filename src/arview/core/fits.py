"""Least squares: subspaces of directions, robust scale and weights, fits of motions and circles, covariances.

A subspace of (D,) directions is given by orthonormal rows (K,D); K may be 0.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from arview.geometry import Array, rigid

TUKEY_SIGMAS = 4.685
"""Cut-off of Tukey's biweight in standard deviations: 95 % efficiency for normal errors (Holland & Welsch 1977)."""
MIN_RANK_SIZE = 1e-6
"""Directions with a smaller singular value are noise of rounding."""
MIN_SINE = 0.5
"""Directions are outside a subspace if the sine of their angle with it is larger; inside and outside are 0 and 1."""


# --- subspaces -----------------------------------------------------------------------------------------------


def row_space(rows: Array, min_size: float = MIN_RANK_SIZE) -> Array:
    """Orthonormal basis (R,D) of what rows (K,D) span with singular values above a size."""
    if not len(rows):
        return rows
    _, sizes, basis = np.linalg.svd(rows, full_matrices=False)
    return np.asarray(basis[sizes > min_size])


def orthogonal_complement(rows: Array, within: Array | None = None) -> Array:
    """Basis (M,D) of the directions orthogonal to rows (K,D), which may be linearly dependent.

    Args:
        rows: any directions.
        within: (F,D) orthonormal basis of the space in which the complement is taken; default: all directions.
    """
    space = np.eye(rows.shape[1]) if within is None else within
    taken = row_space(rows)
    if not len(taken):
        return space
    _, sines, basis = np.linalg.svd(space - space @ taken.T @ taken, full_matrices=False)
    return np.asarray(basis[sines > MIN_SINE])


def intersection(a: Array, b: Array, max_angle_deg: float = 0.0026) -> Array:
    """Basis of the directions of a subspace (K,D) that are within an angle of another one (L,D)."""
    if not len(a) or not len(b):
        return a[:0]
    left, cosines, _ = np.linalg.svd(a @ b.T, full_matrices=False)
    return np.asarray(left[:, cosines > np.cos(np.deg2rad(max_angle_deg))].T @ a)


def without_span(columns: Array, values: Array) -> Array:
    """What is left of values (N,) or (N,V) after their least-squares fit by columns (N,K)."""
    basis = np.linalg.qr(columns)[0]
    return np.asarray(values - basis @ (basis.T @ values))


# --- robust estimates ----------------------------------------------------------------------------------------


def robust_sigma(residuals: NDArray[np.floating]) -> float:
    """Standard deviation of normal residuals about 0, by the median of their size; about any middle, subtract it."""
    return 1.4826 * float(np.median(np.abs(residuals)))


def tukey_weights(sigmas: Array) -> Array:
    """Weights 0-1 of residuals in standard deviations: Tukey's biweight."""
    return np.asarray(np.clip(1.0 - (sigmas / TUKEY_SIGMAS) ** 2, 0.0, None) ** 2)


# --- covariances ---------------------------------------------------------------------------------------------


def covariance_root(covariance: Array) -> Array:
    """(D,D) factor F with F Fᵀ the nearest covariance without negative variances."""
    values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
    return np.asarray(np.sqrt(np.maximum(values, 0.0)) * vectors)


def nearest_covariance(covariance: Array) -> Array:
    """The nearest symmetric matrix (D,D) without negative variances."""
    root = covariance_root(covariance)
    return np.asarray(root @ root.T)


# --- fits ----------------------------------------------------------------------------------------------------


def fit_similarity(points_in_a: Array, points_in_b: Array, scale: float | None = None) -> tuple[float, Array]:
    """Least-squares scale and rigid motion (4,4): ``b ≈ b_from_a @ (scale * a)`` for paired points (N,3).

    Umeyama, "Least-squares estimation of transformation parameters between two point patterns" (PAMI 1991). With
    ``scale`` given, only the motion is fitted.
    """
    middle_a, middle_b = points_in_a.mean(axis=0), points_in_b.mean(axis=0)
    a = points_in_a - middle_a
    u, sizes, vt = np.linalg.svd((points_in_b - middle_b).T @ a)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = (u * signs) @ vt
    scale = float(np.sum(sizes * signs) / np.sum(a * a)) if scale is None else scale
    return scale, rigid(rotation, middle_b - scale * rotation @ middle_a)


def fit_circle(points: Array) -> tuple[Array, float]:
    """Centre (2,) and radius of the circle of least squares through points (N,2) (Kåsa 1976)."""
    system = np.column_stack([2.0 * points, np.ones(len(points))])
    x, y, rest = np.linalg.lstsq(system, (points**2).sum(axis=1), rcond=None)[0]
    return np.array([x, y]), float(np.sqrt(max(rest + x * x + y * y, 0.0)))
