"""Scale from tags whose corners are known in one frame: one similarity for all corners of all tags.

The tags are as far apart as the layout is large, so the scale is known far better than from their sides. A start from
two tags (least median of squares, Rousseeuw 1984) is improved without corners that do not fit. The uncertainty is that
of the residuals, but not smaller than the scatter from tag to tag (clustered as in `arview.calibration`): corners of a
tag that is not where the layout has it err together.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np

from arview.errors import InputError
from arview.geometry import Array
from arview.reconstruction.scale.similarity import PointFit, fit_points
from arview.reconstruction.scale.specs import TagLayout
from arview.reconstruction.scale.triangulation import TriangulatedCorners
from arview.reconstruction.scale.types import ScaleEvidence

MAX_STARTS = 150
"""Pairs of tags from which the fit is started; half of them fit even if a quarter of the tags are wrong."""
MAX_SIGMAS = 8.0
"""Corners whose residual exceeds this many robust standard deviations are left out; depth is less exact."""
ROUNDS = 10
"""Rounds of fitting and leaving out."""
MIN_SHARE = 0.6
"""Share of the corners that must fit; the rest may be tags that were moved or misread."""
MIN_FIT_SIDES = 0.1
"""Median residual, in sides of a tag, above which the corners do not fit the layout at all."""
ORDERS = [np.roll(np.arange(4)[::way], shift) for way in (1, -1) for shift in range(4)]
"""Orders in which the four corners of a tag may be listed; OpenCV's, the first, is clockwise from the upper left."""


def scale_from_layout(
    layout: TagLayout, corners: TriangulatedCorners, edge_sides: float
) -> tuple[ScaleEvidence | None, str]:
    """Scale of the similarity from triangulated corners to known ones, or None, and what is to be said about it.

    Args:
        layout: the known corners.
        corners: those found in the photos.
        edge_sides: standard deviation of a common shift of all sides of tags outwards, in sides of a tag.
    """
    what = f"layout of {len(layout.corners_mm)} tags {layout.dictionary.removeprefix('DICT_')}"
    seen = {
        index: np.array([corners.points[layout.dictionary, index, corner] for corner in range(4)])
        for index in layout.corners_mm
        if all((layout.dictionary, index, corner) in corners.points for corner in range(4))
    }
    if not seen:
        return None, f"{what}: no tag of it was seen from two sides in the photos"
    in_scan = np.array(list(seen.values()))
    listed = np.array([layout.corners_mm[index] for index in seen])
    side_mm = float(np.median(np.linalg.norm(listed - np.roll(listed, 1, axis=1), axis=2)))
    starts = [(_start(in_scan, listed[:, order]), k) for k, order in enumerate(ORDERS)]
    (median_mm, fit), best = min(starts, key=lambda one: one[0][0])
    if fit is None or median_mm > MIN_FIT_SIDES * side_mm:
        return None, f"{what}: the {len(seen)} tags found are not arranged as it says; check ids, corners and unit (mm)"
    in_mm = listed[:, ORDERS[best]]
    fit, fits = _without_outliers(fit, in_scan.reshape(-1, 3), in_mm.reshape(-1, 3))
    whole = fits.reshape(-1, 4).all(axis=1)
    if np.mean(fits) < MIN_SHARE:
        return None, f"{what}: only {int(whole.sum())} of the {len(seen)} tags found are where it says; check it"
    points, keep = in_mm.reshape(-1, 3)[fits], np.repeat(np.arange(len(seen)), 4)[fits]
    from_mean = points - points.mean(axis=0)
    size = float(np.sum(from_mean**2))
    left = points - fit.similarity.points_in_model(in_scan.reshape(-1, 3)[fits])
    scores = np.bincount(keep, weights=np.sum(from_mean * left, axis=1))
    used = len(np.unique(keep))
    between = float(np.sqrt(np.sum(scores**2) * used / max(1, used - 2))) / size
    # Sides that all seem farther out stretch each tag, and the layout by little.
    outwards = in_mm - in_mm.mean(axis=1, keepdims=True)
    edges = float(2.0 * edge_sides * np.sum(outwards.reshape(-1, 3)[fits] * from_mean)) / size
    extent_mm = max(float(np.linalg.norm(points - one, axis=1).max()) for one in points)
    std = float(np.linalg.norm([max(fit.scale_std, between), edges, layout.std_mm / extent_mm]))
    detail = (
        f"{what}: {len(points)} corners of {used} tags over {extent_mm:.0f} mm, {fit.rms_mm:.3f} mm rms,"
        f" {corners.sigma_px:.2f} px"
    )
    ids = list(seen)
    wrong = [str(ids[k]) for k in np.flatnonzero(~whole)]
    said = f"{what}: not where it says, and left out: corners of {', '.join(wrong[:8])}" if wrong else ""
    return ScaleEvidence("tag_layout", fit.similarity.scale, std, detail), said


def _start(in_scan: Array, in_mm: Array) -> tuple[float, PointFit | None]:
    """The fit of two tags (one, if there is only one) that fits all (N,4,3) best, and its median residual in mm."""
    pairs: list[tuple[int, ...]] = [*combinations(range(len(in_scan)), 2)] or [(0,)]
    pairs = [pairs[k] for k in np.unique(np.linspace(0, len(pairs) - 1, MAX_STARTS).astype(int))]
    best: tuple[float, PointFit | None] = (np.inf, None)
    for pair in pairs:
        try:
            fit = fit_points(in_scan[list(pair)].reshape(-1, 3), in_mm[list(pair)].reshape(-1, 3))
        except InputError:
            continue
        median = float(np.median(_residuals(fit, in_scan.reshape(-1, 3), in_mm.reshape(-1, 3))))
        if median < best[0]:
            best = (median, fit)
    return best


def _residuals(fit: PointFit, in_scan: Array, in_mm: Array) -> Array:
    return np.asarray(np.linalg.norm(in_mm - fit.similarity.points_in_model(in_scan), axis=1))


def _without_outliers(fit: PointFit, in_scan: Array, in_mm: Array) -> tuple[PointFit, Array]:
    """The fit of the corners (N,3) that fit, and which of them (N,) do."""
    fits = np.zeros(len(in_mm), dtype=bool)
    for _ in range(ROUNDS):
        before, away = fits, _residuals(fit, in_scan, in_mm)
        # The median length of a three-dimensional normal error is 1.5382 σ.
        fits = away <= max(MAX_SIGMAS * float(np.median(away)) / 1.5382, 1e-9)
        if np.array_equal(before, fits):
            break
        fit = fit_points(in_scan[fits], in_mm[fits])
    return fit, fits
