"""Checks of a photo before any matching: blur, texture, exposure, and duplicates."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.core.kernel import kernel
from arview.reconstruction.intake.reading import Pixels

_FINE, _COARSE = 1.0, 2.0  # px, smoothing at the two scales whose gradients are compared
_DIRECTIONS = 6  # bins of edge direction, because motion blurs only the edges across it
_MIN_EDGES = 60  # edge points that a direction needs for an estimate of its blur
_MIN_GRADIENT, _MAX_GRADIENT = 4.0, 12.0  # range of the gradient, grey levels per px, that an edge needs
_TILES = (12, 16)  # rows and columns of the tiles in which texture is measured
_TILE_EDGES = 0.002  # share of edge pixels in a textured tile: an edge across a quarter of it
_THUMB = (24, 18)  # px, size of the pictures on which candidates for duplicates are found
_COMPARED_PX = 400  # longest side of the pictures on which duplicates are confirmed
_COMPARED_TILES = (6, 8)  # rows and columns of the tiles in which these are compared


SAME_THUMBS = 0.95
"""Correlation above which two pictures are compared in detail."""
SAME_SHIFT = 0.00125
"""Of the longer side; pictures that differ by less than this shift show the same view."""


@dataclass(frozen=True)
class PhotoCheck:
    """Measures of one photo.

    Attributes:
        name: of the photo.
        blur_px: spread of its edges (Gaussian sigma in px of a picture of 1000 to 2000 px); NaN without edges.
        textured: share of its tiles that contain edges, 0–1.
        clipped: share of white pixels, 0–1.
        level_95: grey level that 95 % of the pixels do not exceed, 0–255.
    """

    name: str
    blur_px: float
    textured: float
    clipped: float
    level_95: float


def check_photo(name: str, gray: Pixels) -> PhotoCheck:
    """Measures of an upright grey picture (H,W) uint8."""
    blur_px, textured = blur_and_texture(gray)
    sample = gray[::3, ::3]
    return PhotoCheck(name, blur_px, textured, float(np.mean(sample >= 250)), float(np.percentile(sample, 95)))


def blur_and_texture(gray: Pixels) -> tuple[float, float]:
    """Edge spread in px (NaN without edges) and share of tiles with edges of a (H,W) uint8 picture.

    An edge of spread s has a gradient of 1 / sqrt(s² + t²) after smoothing with t. The ratio of the gradients at two
    scales gives s independently of contrast, so that a sharp photo with little texture counts as sharp (Zhuo and Sim
    2011, Defocus map estimation from a single image). The result is the median over the strongest quarter of the edge
    points, in the direction where it is largest.
    """
    fine = cv2.GaussianBlur(gray.astype(np.float32), (0, 0), _FINE)
    coarse = cv2.GaussianBlur(fine, (0, 0), float(np.sqrt(_COARSE**2 - _FINE**2)))
    # White noise of sigma n leaves gradients of 0.2 n at the fine scale; n follows from what the smoothing removed.
    noise = float(np.percentile(np.abs(gray[::4, ::4] - fine[::4, ::4]), 20)) / 0.22
    floor = min(max(_MIN_GRADIENT, 1.2 * noise), _MAX_GRADIENT)
    rows, columns, direction, strength, spread = _edge_points(fine, coarse, floor)
    tile = rows * _TILES[0] // gray.shape[0] * _TILES[1] + columns * _TILES[1] // gray.shape[1]
    enough = max(3.0, _TILE_EDGES * gray.size / (_TILES[0] * _TILES[1]))
    textured = float(np.mean(np.bincount(tile, minlength=_TILES[0] * _TILES[1]) >= enough))
    worst = float("nan")
    for k in range(_DIRECTIONS):
        mine = np.flatnonzero(direction == k)
        if len(mine) >= _MIN_EDGES:
            count = max(_MIN_EDGES, len(mine) // 4)
            strongest = mine[np.argpartition(strength[mine], -count)[-count:]]
            worst = float(np.fmax(worst, np.median(spread[strongest])))
    return worst, textured


@kernel
def _edge_points(
    fine: NDArray[np.float32], coarse: NDArray[np.float32], floor: float
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.uint8], NDArray[np.float32], NDArray[np.float32]]:
    """Row, column, direction bin, squared gradient and spread (px) of the points at which the gradient has a ridge."""
    height, width = fine.shape
    squared = np.zeros((height, width), np.float32)
    for y in range(1, height - 1):
        for x in range(1, width - 1):
            gx = fine[y, x + 1] - fine[y, x - 1]
            gy = fine[y + 1, x] - fine[y - 1, x]
            squared[y, x] = 0.25 * (gx * gx + gy * gy)
    capacity = height * width // 2
    row, column = np.empty(capacity, np.int64), np.empty(capacity, np.int64)
    direction = np.empty(capacity, np.uint8)
    strength, spread = np.empty(capacity, np.float32), np.empty(capacity, np.float32)
    count = 0
    for y in range(2, height - 2):
        for x in range(2, width - 2):
            here = squared[y, x]
            if here <= floor * floor:
                continue
            gx = fine[y, x + 1] - fine[y, x - 1]
            gy = fine[y + 1, x] - fine[y - 1, x]
            if abs(gx) >= abs(gy):
                ridge = here >= squared[y, x - 1] and here > squared[y, x + 1]
            else:
                ridge = here >= squared[y - 1, x] and here > squared[y + 1, x]
            if not ridge or count == capacity:
                continue
            cx = 0.5 * (coarse[y, x + 1] - coarse[y, x - 1])
            cy = 0.5 * (coarse[y + 1, x] - coarse[y - 1, x])
            ratio = here / max(cx * cx + cy * cy, 1e-6)
            s2 = (_COARSE * _COARSE - ratio * _FINE * _FINE) / max(ratio - 1.0, 1e-3)
            row[count], column[count] = y, x
            direction[count] = int((np.arctan2(gy, gx) / np.pi % 1.0) * _DIRECTIONS) % _DIRECTIONS
            strength[count] = here
            spread[count] = np.sqrt(min(max(s2, 0.0), 100.0))
            count += 1
    return row[:count], column[:count], direction[:count], strength[:count], spread[:count]


def thumbnail(gray: Pixels) -> Pixels:
    """The picture reduced to a longest side of 400 px, for the search for duplicates."""
    scale = _COMPARED_PX / max(gray.shape)
    size = max(1, round(gray.shape[1] * scale)), max(1, round(gray.shape[0] * scale))
    return np.asarray(cv2.resize(gray, size, interpolation=cv2.INTER_AREA))


def same_views(thumbnails: list[Pixels]) -> list[tuple[int, int]]:
    """Pairs (i < j) of pictures taken from the same place in the same direction, whatever their size and exposure.

    Candidates are found by correlation of tiny pictures. In every tile of a candidate pair the difference, after
    fitting brightness and contrast, must be smaller than that of the picture to itself displaced by ``same_shift``.
    """
    if len(thumbnails) < 2:
        return []
    tiny = np.stack([cv2.resize(t, _THUMB, interpolation=cv2.INTER_AREA).ravel() for t in thumbnails]).astype(float)
    tiny -= tiny.mean(axis=1, keepdims=True)
    tiny /= np.maximum(np.linalg.norm(tiny, axis=1, keepdims=True), 1e-9)
    candidates = np.argwhere(np.triu(tiny @ tiny.T > SAME_THUMBS, 1))
    return [(int(i), int(j)) for i, j in candidates if _is_same_view(thumbnails[i], thumbnails[j])]


def _is_same_view(first: Pixels, second: Pixels) -> bool:
    """Whether two pictures show the same view."""
    if np.abs(np.subtract(first.shape, second.shape)).max() > 2:  # a rotated or cropped picture; 2 px are rounding
        return False
    size = first.shape[1], first.shape[0]
    a = cv2.GaussianBlur(first.astype(np.float32), (0, 0), 1.0)
    b = cv2.GaussianBlur(cv2.resize(second, size).astype(np.float32), (0, 0), 1.0)
    gain, offset = np.polyfit(b.ravel(), a.ravel(), 1) if b.std() > 0 else (1.0, 0.0)
    shift_px = SAME_SHIFT * max(size)
    moved = shift_px * np.hypot(np.gradient(a, axis=0), np.gradient(a, axis=1))

    def tile_rms(values: NDArray[np.float32]) -> NDArray[np.float32]:
        return np.sqrt(cv2.resize(values.astype(np.float32) ** 2, _COMPARED_TILES[::-1], interpolation=cv2.INTER_AREA))

    noise = 2.0  # grey levels: JPEG, and differences that a single gain does not explain
    return bool(np.all(tile_rms(a - gain * b - offset) <= tile_rms(moved) + noise))
