"""Robust fit of one datum by itself: outliers, noise, correlation of neighbours, and whether it is covered."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from arview.core.fits import robust_sigma, tukey_weights
from arview.geometry import Array
from arview.measurement.datums.directions import shift_origin
from arview.measurement.datums.equations import DatumEquations, DatumNotMeasuredError

MIN_POINTS = 12
"""Agreeing offsets that a datum needs; with fewer, outliers cannot be recognised."""
MIN_SHARE = 0.3
"""Share of a datum that must be found; a rim seen on one side only is no circle."""
MAX_STD_MM = 0.2
"""Largest standard deviation of any direction that a datum locks."""


@dataclass(frozen=True)
class DatumFit:
    """Robust fit of one datum by itself.

    Attributes:
        weights: (N,) of its offsets, 1/mm².
        variances: (N,) effective variances of the offsets, including the correlation of neighbours, mm².
        sigma_mm: robust standard deviation of the residuals.
        correlation: factor by which correlation increases the variance of a mean.
        radius_mm: fitted change of the radius of a round feature; None for others.
        inliers: (N,) offsets that are no outliers.
    """

    weights: Array
    variances: Array
    sigma_mm: float
    correlation: float
    radius_mm: float | None
    inliers: NDArray[np.bool_]


def fit_datum(one: DatumEquations, is_exact: bool) -> DatumFit:
    """Fit everything that the offsets determine, robustly, to find their noise and outliers; not if ``is_exact``."""
    count = len(one.offsets_mm)
    if is_exact or one.feature == "fit" or count < 7:
        sigma = float(np.sqrt(one.variances.mean())) if count else 0.0
        return DatumFit(1.0 / one.variances, one.variances, sigma, 1.0, None, np.ones(count, dtype=bool))
    center = one.points.mean(axis=0)
    local = one.rows[:, :6] - one.rows[:, 3:6] @ shift_origin(center)[:, :6]
    if one.feature in ("hole", "pin"):  # a small circle does not determine its tilt
        local = one.rows[:, 3:6]
    if one.by_radius is not None:
        local = np.concatenate([local, one.by_radius[:, None]], axis=1)
    share, residuals = robust_weights(local, one.offsets_mm, one.variances)
    inliers = share > 0.1
    noise = residuals / np.sqrt(one.variances)
    rank = np.linalg.matrix_rank(local.T @ local, tol=1e-9 * float(np.square(local).sum()), hermitian=True)
    freedom = max(1.0, share.sum() - rank)
    # The scale of the noise is estimated from the residuals; the given variances only set its ratios.
    factor = float((share * noise**2).sum() / freedom) if freedom > 20 else max(1.0, float(np.mean(noise**2)))
    correlation = max(
        correlation_factor(one.points[inliers], noise[inliers]),
        block_factor(one.points[inliers], noise[inliers], rank),
    )
    weights, radius = share / one.variances, None
    if one.by_radius is not None:
        weighted = local * weights[:, None]
        normal = np.linalg.pinv(weighted.T @ local, rcond=1e-12, hermitian=True)
        radius = float((normal @ (weighted.T @ one.offsets_mm))[-1])
    sigma = robust_sigma(residuals[inliers]) if inliers.any() else float("inf")
    return DatumFit(weights, one.variances * factor * correlation, sigma, correlation, radius, inliers)


def robust_weights(design: Array, values: Array, variances: Array) -> tuple[Array, Array]:
    """Robust fit of a linear model by iteratively reweighted least squares.

    The first steps use Cauchy weights, which do not depend on a good start; Tukey's biweight follows. The scale is that
    of the median residual.

    Args:
        design: (N,K) linear model.
        values: (N,) measured.
        variances: (N,) of the values; only their ratios count.

    Returns:
        weights (N,) in 0–1, and residuals (N,).
    """
    root, share = 1.0 / np.sqrt(variances), np.ones(len(values))
    residuals, unit = values, np.maximum(np.sqrt(np.mean(design**2, axis=0)), 1e-12)
    design = design / unit
    for step in range(40):
        weighted = design * (share * root**2)[:, None]
        normal = np.linalg.pinv(weighted.T @ design, rcond=1e-9, hermitian=True)
        residuals = values - design @ (normal @ (weighted.T @ values))
        noise = residuals * root
        scale = max(robust_sigma(noise), 1e-9)
        if step < 10:
            share = 1.0 / (1.0 + (noise / (2.385 * scale)) ** 2)
            continue
        new = tukey_weights(noise / scale)
        if np.abs(new - share).max() < 1e-4:
            break
        share = new
    return share, residuals


def correlation_factor(points: Array, residuals: Array, max_points: int = 600) -> float:
    """Factor, at least 1, by which correlation of neighbouring residuals increases the variance of their mean.

    It is 1 plus the sum of a residual's correlations with all others, estimated from products of pairs binned by
    distance, up to the first distance at which they are uncorrelated.

    Args:
        points: (N,3) where the residuals are.
        residuals: (N,).
        max_points: number of points whose pairs are used.
    """
    count = len(points)
    if count < 20:
        return 1.0
    step = max(1, count // max_points)
    points, residuals = points[::step], residuals[::step] - residuals.mean()
    distance = np.linalg.norm(points[:, None] - points[None], axis=2)
    product = np.outer(residuals, residuals) / float(np.mean(residuals**2))
    pairs = np.triu_indices(len(points), 1)
    distance, product = distance[pairs], product[pairs]
    edges = np.linspace(0.0, 0.5 * float(distance.max()) + 1e-9, 13)
    bins, factor = np.digitize(distance, edges) - 1, 1.0
    for index in range(len(edges) - 1):
        of_bin = product[bins == index]
        if len(of_bin) < 10:
            continue
        correlation = float(of_bin.mean())
        if correlation <= 2.0 / np.sqrt(len(of_bin)):
            break
        factor += correlation * 2.0 * len(of_bin) / len(points) * step
    return factor


def block_factor(points: Array, residuals: Array, rank: int, blocks: int = 12) -> float:
    """The same factor as `correlation_factor`, from the means of residuals (N,) in blocks of neighbouring points (N,3).

    It captures errors that are correlated over a large part of a feature, most of which the fit has absorbed; ``rank``
    is the number of parameters fitted. Blocks hold equal numbers of points: around a rim they are arcs, on a face
    cells.
    """
    count = len(points)
    if count < 8 * blocks or rank >= blocks - 2:
        return 1.0
    from_middle = points - points.mean(axis=0)
    _, vectors = np.linalg.eigh(from_middle.T @ from_middle)
    x, y = from_middle @ vectors[:, 2], from_middle @ vectors[:, 1]
    if np.std(np.hypot(x, y)) < 0.1 * np.mean(np.hypot(x, y)):
        order = np.argsort(np.arctan2(y, x))
    else:
        interval = np.digitize(x, np.quantile(x, [0.25, 0.5, 0.75]))
        order = np.lexsort((y, interval))
    parts = np.array_split(residuals[order], blocks)
    means = np.array([part.mean() for part in parts])
    between = float(np.sum(means**2)) / (blocks - rank)
    return max(1.0, between * count / blocks / float(np.mean(residuals**2)))


def check_covered(one: DatumEquations) -> None:
    """Check that enough of a datum was measured. Raises DatumNotMeasuredError, which names the datum."""
    check_fit_covered(one, fit_datum(one, is_exact=False))


def check_fit_covered(one: DatumEquations, fit: DatumFit) -> None:
    """Check coverage and accuracy of a fitted datum. Raises DatumNotMeasuredError, which names the datum."""
    used, name = int(fit.inliers.sum()), f"datum {one.label} ({one.feature})"
    if one.feature == "fit":
        return
    needed = {"point": 1, "edge": 4}.get(one.feature, MIN_POINTS)
    if used < max(needed, round(MIN_SHARE * one.of)):
        raise DatumNotMeasuredError(
            f"{name}: only {used} of {one.of} points on it could be measured; photograph it from more sides, in better"
            " light, or name another feature in the part file"
        )
    if one.feature in ("hole", "pin") and one.by_radius is not None:
        # Only its centre matters, which a short arc does not determine.
        local, watched = np.concatenate([one.rows[:, 3:6], one.by_radius[:, None]], axis=1), np.eye(3, 4)
    else:
        local = one.rows[:, :6] - one.rows[:, 3:6] @ shift_origin(one.points.mean(axis=0))[:, :6]
        watched = local[fit.inliers]
        if one.by_radius is not None:
            local = np.concatenate([local, one.by_radius[:, None]], axis=1)
            watched = np.concatenate([watched, np.zeros((len(watched), 1))], axis=1)
    information = (local / fit.variances[:, None] * fit.inliers[:, None]).T @ local
    values, vectors = np.linalg.eigh(information)
    kept = values > 1e-9 * values[-1]
    worst = float(np.sqrt((((watched @ vectors[:, kept]) ** 2) / values[kept]).sum(axis=1).max()))
    if worst > MAX_STD_MM:
        raise DatumNotMeasuredError(
            f"{name}: its position is uncertain by {worst:.2f} mm; photograph it from more sides, or in better light"
        )
