"""SIFT features of the photos, by OpenCV, or by the same method on a GPU."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.core.progress import StepProgress
from arview.reconstruction.gpu.sift import KeyPoints, sift
from arview.reconstruction.types import Photo

Descriptors = NDArray[np.float32]


MAX_SIDE_PX = 2000
"""Larger photos are reduced to this, because SIFT's time grows with the area."""
CONTRAST_THRESHOLD = 0.02
"""OpenCV's default of 0.04 finds little on mill scale and brushed metal."""


@dataclass(frozen=True)
class FeatureOptions:
    """Options of feature detection."""

    max_features: int = 6000  # per photo; more cost time and add mainly short tracks


@dataclass(frozen=True)
class Features:
    """Features of one photo, the strongest of every region first.

    Attributes:
        points_px: (N,2) float32 in the photo at full size; integers are pixel centres.
        descriptors: (N,128) float32 unit vectors, RootSIFT (Arandjelović and Zisserman 2012).
        sizes_px: (N,) float32 diameter of the described neighbourhood.
        colors: (N,3) uint8 RGB at the points.
    """

    points_px: NDArray[np.float32]
    descriptors: Descriptors
    sizes_px: NDArray[np.float32]
    colors: NDArray[np.uint8]

    def __len__(self) -> int:
        return len(self.points_px)

    def taken(self, which: NDArray[Any]) -> Features:
        """Some of the features, by indices or a mask."""
        return Features(
            self.points_px[which],
            np.ascontiguousarray(self.descriptors[which]),
            self.sizes_px[which],
            self.colors[which],
        )


_NONE = Features(
    np.zeros((0, 2), np.float32), np.zeros((0, 128), np.float32), np.zeros(0, np.float32), np.zeros((0, 3), np.uint8)
)


@dataclass(frozen=True)
class DetectedFeatures:
    """Features of one photo as SIFT detects them.

    Attributes:
        points_px, sizes_px, colors: see `Features`.
        sums: (N,128) float32 sums of gradients, SIFT's own descriptor; whole numbers from 0 to 255 in OpenCV.
    """

    points_px: NDArray[np.float32]
    sums: NDArray[np.float32]
    sizes_px: NDArray[np.float32]
    colors: NDArray[np.uint8]


def find_features(
    image: NDArray[np.uint8],
    options: FeatureOptions | None = None,
    mask: NDArray[np.bool_] | None = None,
    device: str | None = None,
) -> Features:
    """SIFT features of an (H,W,3) RGB picture, spread over it, where the ``mask`` (H,W) is True."""
    return features_of(detect_features(image, options or FeatureOptions(), mask, device))


def detect_features(
    image: NDArray[np.uint8],
    options: FeatureOptions,
    mask: NDArray[np.bool_] | None = None,
    device: str | None = None,
) -> DetectedFeatures:
    """What SIFT detects in an (H,W,3) RGB picture, see `find_features`.

    They are found by OpenCV, or on a torch ``device``; both find the same but for rounding.
    """
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    height, width = grey.shape
    reduction = max(1.0, max(height, width) / MAX_SIDE_PX)
    if reduction > 1.0:
        size = (round(width / reduction), round(height / reduction))
        grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    scale = np.array([width / grey.shape[1], height / grey.shape[0]], dtype=np.float32)
    size = (grey.shape[1], grey.shape[0])
    allowed = None if mask is None else cv2.resize(mask.astype(np.uint8) * 255, size, interpolation=cv2.INTER_NEAREST)
    if device is None:
        points, sizes, strength, sums = _opencv_sift(grey, options, allowed)
    else:
        points, sizes, strength, sums = sift(grey, options.max_features, CONTRAST_THRESHOLD, allowed, device)
    if len(points) == 0:
        return DetectedFeatures(_NONE.points_px, _NONE.descriptors, _NONE.sizes_px, _NONE.colors)
    order = _spread(points, strength, grey.shape)[: options.max_features]
    points_px = (points[order] + 0.5) * scale - 0.5
    columns, rows = np.clip(np.rint(points_px), 0, (width - 1, height - 1)).astype(int).T
    return DetectedFeatures(
        points_px=points_px,
        sums=np.asarray(sums[order], dtype=np.float32),
        sizes_px=sizes[order] * scale.mean(),
        colors=image[rows, columns],
    )


def _opencv_sift(grey: NDArray[np.uint8], options: FeatureOptions, allowed: NDArray[np.uint8] | None) -> KeyPoints:
    """Key points of OpenCV.

    ``enable_precise_upscale`` is required: without it OpenCV's key points are shifted by a quarter of a pixel.
    """
    detector = cv2.SIFT_create(  # type: ignore[attr-defined]
        nfeatures=options.max_features,
        contrastThreshold=CONTRAST_THRESHOLD,
        enable_precise_upscale=True,
    )
    keys, sums = detector.detectAndCompute(grey, allowed)
    points = np.array([key.pt for key in keys], dtype=np.float32).reshape(-1, 2)
    sizes = np.array([key.size for key in keys], dtype=np.float32)
    return KeyPoints(points, sizes, np.array([key.response for key in keys]), sums)


def features_of(found: DetectedFeatures) -> Features:
    """The features with RootSIFT descriptors."""
    roots = np.sqrt(found.sums / np.maximum(found.sums.sum(axis=1, keepdims=True), 1e-9))
    roots /= np.maximum(np.linalg.norm(roots, axis=1, keepdims=True), 1e-9)
    return Features(found.points_px, np.ascontiguousarray(roots, dtype=np.float32), found.sizes_px, found.colors)


def _spread(points: NDArray[np.float32], strength: NDArray[np.float64], shape: tuple[int, ...]) -> NDArray[np.intp]:
    """Order in which, for any n, the first n features are strong and spread over an 8×8 grid of the picture."""
    cells = np.minimum((points / (shape[1], shape[0]) * 8).astype(int), 7)
    cell = np.maximum(cells, 0) @ (1, 8)
    by_cell = np.lexsort((-strength, cell))
    starts = np.searchsorted(cell[by_cell], np.arange(64))
    rank = np.empty(len(points))
    rank[by_cell] = np.arange(len(points)) - starts[cell[by_cell]]
    return np.lexsort((-strength, rank))


def find_all_features(
    photos: Sequence[Photo], find: Callable[[Photo], Features], threads: int, progress: StepProgress | None = None
) -> list[Features]:
    """Features of every photo, in their order, outside of what its mask leaves out; ``threads`` photos at a time.

    Args:
        photos: the photos.
        find: gives the features of one photo.
        threads: photos at a time.
        progress: called with the number of photos done and in all.

    Raises:
        InputError: a photo cannot be read.
    """
    found: list[Features] = []
    with ThreadPoolExecutor(threads) as pool:
        for features in pool.map(find, photos):
            found.append(features)
            if progress:
                progress(len(found), len(photos))
    return found
