"""Matching of features between photos: by appearance, and then along epipolar lines."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.core.kernel import kernel
from arview.geometry import Array
from arview.reconstruction.features import Descriptors, Features
from arview.reconstruction.gpu.matching import MatchLimits, Side, match_by_appearance, match_on_lines

Matches = NDArray[np.uint32]

MAX_RATIO = 0.8  # of the angles to the best and the second best descriptor; Lowe 2004
MAX_ANGLE_RAD = 0.7  # between descriptors of the same place
MAX_SIZE_RATIO = 2.5  # of two key points along epipolar lines
_LIMITS = MatchLimits(MAX_RATIO, MAX_ANGLE_RAD, MAX_SIZE_RATIO)
_BLOCK = 512  # rows of similarities computed at a time, which fit into the processor's cache


@kernel
def _best(
    similarity: NDArray[np.float32],
    first_row: int,
    partner: NDArray[np.int32],
    best: NDArray[np.float32],
    second: NDArray[np.float32],
    column_best: NDArray[np.float32],
    column_row: NDArray[np.int32],
) -> None:
    """Best and second best column of each row, and best row of each column; rows start at ``first_row``."""
    for i in range(similarity.shape[0]):
        row = i + first_row
        high, next_high, at = np.float32(-2.0), np.float32(-2.0), 0
        for j in range(similarity.shape[1]):
            value = similarity[i, j]
            if value > next_high:
                if value > high:
                    next_high, high, at = high, value, j
                else:
                    next_high = value
            if value > column_best[j]:
                column_best[j] = value
                column_row[j] = row
        partner[row], best[row], second[row] = at, high, next_high


def match_descriptors(ones: Descriptors, others: Descriptors, device: str | None = None) -> Matches:
    """(M,2) rows of ``ones`` and ``others`` that are mutual nearest neighbours and pass the ratio test.

    On the processor, or on a torch ``device``.
    """
    if len(ones) < 2 or len(others) < 2:
        return np.zeros((0, 2), np.uint32)
    if device is not None:
        return match_by_appearance(ones, others, _LIMITS, device)
    partner = np.empty(len(ones), np.int32)
    best, second = np.empty(len(ones), np.float32), np.empty(len(ones), np.float32)
    column_best, column_row = np.full(len(others), -2.0, np.float32), np.zeros(len(others), np.int32)
    for start in range(0, len(ones), _BLOCK):
        similarity = ones[start : start + _BLOCK] @ others.T
        _best(similarity, start, partner, best, second, column_best, column_row)
    rows = np.arange(len(ones))
    angle, next_angle = np.arccos(np.clip(best, -1, 1)), np.arccos(np.clip(second, -1, 1))
    good = (angle < MAX_RATIO * next_angle) & (angle < MAX_ANGLE_RAD) & (column_row[partner] == rows)
    return np.stack([rows[good], partner[good]], axis=1).astype(np.uint32)


def epipolar_inliers(ones: Features, others: Features, matches: Matches, max_error_px: float) -> Matches:
    """The matches near epipolar lines of one fundamental matrix (MAGSAC++, Barath 2020)."""
    if len(matches) < 8:
        return matches[:0]
    points = ones.points_px[matches[:, 0]].astype(np.float64)
    partners = others.points_px[matches[:, 1]].astype(np.float64)
    # OpenCV's USAC has a fixed seed, so the same matches give the same inliers.
    try:
        matrix, mask = cv2.findFundamentalMat(points, partners, cv2.USAC_MAGSAC, max_error_px, 0.999, 5000)
    except cv2.error:  # OpenCV 5 raises where none of its samples gave a matrix
        return matches[:0]
    if matrix is None or mask is None:
        return matches[:0]
    return matches[mask.ravel() > 0]


@kernel(fastmath=True)
def _match_along(
    rays: NDArray[np.float64],
    other_px: NDArray[np.float64],
    descriptors: NDArray[np.float32],
    others: NDArray[np.float32],
    sizes: NDArray[np.float32],
    other_sizes: NDArray[np.float32],
    essential: NDArray[np.float64],
    focal: float,
    band_px: float,
    cells: NDArray[np.int32],
    starts: NDArray[np.int32],
    cell_px: NDArray[np.float64],
    columns: int,
    rows: int,
    partner: NDArray[np.int32],
    best: NDArray[np.float32],
    second: NDArray[np.float32],
) -> None:
    """Best and second best of ``others`` within ``band_px`` of each ray's epipolar line.

    ``rays`` are ideal directions (N,2), ``other_px`` ideal pixels about the principal point; ``cells`` lists the
    features of each cell of a grid over ``other_px``, from ``starts``.
    """
    low_x, low_y = cell_px[1], cell_px[2]
    step = cell_px[0]
    for i in range(rays.shape[0]):
        x, y = rays[i, 0], rays[i, 1]
        a = essential[0, 0] * x + essential[0, 1] * y + essential[0, 2]
        b = essential[1, 0] * x + essential[1, 1] * y + essential[1, 2]
        c = (essential[2, 0] * x + essential[2, 1] * y + essential[2, 2]) * focal
        norm = np.sqrt(a * a + b * b)
        if norm < 1e-12:
            continue
        a, b, c = a / norm, b / norm, c / norm
        is_flat = abs(b) > abs(a)
        high, next_high, at = np.float32(-2.0), np.float32(-2.0), -1
        for along in range(columns if is_flat else rows):
            # The cells within the band around the line in this column (row) of cells.
            if is_flat:
                u0, u1 = low_x + along * step, low_x + (along + 1) * step
                v0, v1 = -(a * u0 + c) / b, -(a * u1 + c) / b
                first = int(np.floor((min(v0, v1) - 1.5 * band_px - low_y) / step))
                last = int(np.floor((max(v0, v1) + 1.5 * band_px - low_y) / step))
                first, last = max(first, 0), min(last, rows - 1)
            else:
                v0, v1 = low_y + along * step, low_y + (along + 1) * step
                u0, u1 = -(b * v0 + c) / a, -(b * v1 + c) / a
                first = int(np.floor((min(u0, u1) - 1.5 * band_px - low_x) / step))
                last = int(np.floor((max(u0, u1) + 1.5 * band_px - low_x) / step))
                first, last = max(first, 0), min(last, columns - 1)
            for across in range(first, last + 1):
                cell = across * columns + along if is_flat else along * columns + across
                for k in range(starts[cell], starts[cell + 1]):
                    j = cells[k]
                    if abs(a * other_px[j, 0] + b * other_px[j, 1] + c) > band_px:
                        continue
                    if sizes[i] > MAX_SIZE_RATIO * other_sizes[j] or other_sizes[j] > MAX_SIZE_RATIO * sizes[i]:
                        continue
                    value = np.float32(0.0)
                    for d in range(descriptors.shape[1]):
                        value += descriptors[i, d] * others[j, d]
                    # A key point may occur twice, with two orientations; it does not compete with itself.
                    is_same = at >= 0 and (
                        abs(other_px[j, 0] - other_px[at, 0]) + abs(other_px[j, 1] - other_px[at, 1]) < band_px
                    )
                    if value > high:
                        if not is_same:
                            next_high = high
                        high, at = value, j
                    elif value > next_high and not is_same:
                        next_high = value
        partner[i], best[i], second[i] = at, high, next_high


def match_along_lines(
    rays: tuple[Array, Array],
    focal_px: float,
    features: tuple[Features, Features],
    essential: Array,
    band_px: float,
    device: str | None = None,
) -> Matches:
    """Match two photos whose relative pose is known, along the epipolar lines only.

    So few candidates are compared that weak features, and features that occur many times in a photo, are matched too.

    Args:
        rays: ideal directions (N,2) at z = 1 of the features of both photos.
        focal_px: focal length of the photos.
        features: of both photos.
        essential: (3,3) maps a ray of the first photo to its line in the second.
        band_px: half width of the band around the line.
        device: torch device; None for the processor's kernel.
    """
    if device is not None and min(len(one) for one in features) > 0:
        one, other = (Side(side.descriptors, side.sizes_px, ray) for side, ray in zip(features, rays, strict=True))
        return match_on_lines((one, other), focal_px, essential, band_px, _LIMITS, device)
    there = _along_one_way(rays, focal_px, features, essential, band_px)
    rows = np.flatnonzero(there >= 0)
    # Only features that are somebody's partner are matched back.
    wanted, place = np.unique(there[rows], return_inverse=True)
    others = features[1].taken(wanted)
    back = _along_one_way((rays[1][wanted], rays[0]), focal_px, (others, features[0]), essential.T.copy(), band_px)
    mutual = rows[back[place] == rows]
    return np.stack([mutual, there[mutual]], axis=1).astype(np.uint32)


def _along_one_way(
    rays: tuple[Array, ...], focal_px: float, features: tuple[Features, ...], essential: Array, band_px: float
) -> NDArray[np.int32]:
    """(N,) partner in the second photo of each feature of the first, or −1."""
    ones, others = features
    partner = np.full(len(ones), -1, np.int32)
    if len(ones) == 0 or len(others) == 0:
        return partner
    best, second = np.full(len(ones), -2.0, np.float32), np.full(len(ones), -2.0, np.float32)
    other_px = rays[1] * focal_px
    step = 8.0
    low = other_px.min(axis=0)
    at = ((other_px - low) / step).astype(np.int32)
    columns, rows = (at.max(axis=0) + 1).tolist()
    cell = at[:, 1] * columns + at[:, 0]
    cells = np.argsort(cell, kind="stable").astype(np.int32)
    starts = np.searchsorted(cell[cells], np.arange(columns * rows + 1)).astype(np.int32)
    grid = np.array([step, low[0], low[1]])
    _match_along(
        rays[0],
        other_px,
        ones.descriptors,
        others=others.descriptors,
        sizes=ones.sizes_px,
        other_sizes=others.sizes_px,
        essential=essential,
        focal=focal_px,
        band_px=band_px,
        cells=cells,
        starts=starts,
        cell_px=grid,
        columns=columns,
        rows=rows,
        partner=partner,
        best=best,
        second=second,
    )
    angle, next_angle = np.arccos(np.clip(best, -1, 1)), np.arccos(np.clip(second, -1, 1))
    partner[(angle > MAX_RATIO * next_angle) | (angle > MAX_ANGLE_RAD)] = -1
    return partner
