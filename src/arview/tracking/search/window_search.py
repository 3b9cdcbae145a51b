"""First search for remembered views: very small grey templates at all positions of a picture.

Templates at several rolls are correlated with all windows of a picture at once, as a product of two matrices.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.geometry import Array
from arview.tracking.search.view_crops import CROP_PX, PART_PX

WINDOW_PX, WINDOW_PART_PX = 8, 8.0
"""Side of the windows, and diameter of the part in them."""
FINE_PART_PX = 20.0
"""Diameter of the part in the pictures searched, which are reduced further for the windows."""
NOISE = 4.0
"""Standard deviation of the grey levels below which a picture is taken for plain."""


class WindowSearch:
    """First search: grey templates at all positions of small pictures.

    Args:
        templates: (T,W²) of zero mean and unit norm under their weights.
        weights: (T,W²) weights.
        views: (T,) views of the templates, ascending.
        max_windows: windows returned for a picture.
        views_per_window: views returned for a window.
    """

    def __init__(
        self,
        templates: NDArray[np.float32],
        weights: NDArray[np.float32],
        views: NDArray[np.intp],
        max_windows: int,
        views_per_window: int,
    ) -> None:
        self._max_windows = max_windows
        self._views_per_window = views_per_window
        self._firsts = np.flatnonzero(np.diff(views, prepend=-1))
        self._templates = np.ascontiguousarray(templates.T)
        self._weights = np.ascontiguousarray(weights.T)
        self._sums = self._weights.sum(axis=0)

    def find(self, picture: NDArray[np.float32]) -> list[tuple[Array, int]]:
        """Best windows of a picture (H,W,3): centre (2,) px in the picture and template, for each of a few views."""
        shrink = WINDOW_PART_PX / FINE_PART_PX
        width, height = round(picture.shape[1] * shrink), round(picture.shape[0] * shrink)
        if min(height, width) < WINDOW_PX:
            return []
        small = cv2.resize(picture.mean(axis=2), (width, height), interpolation=cv2.INTER_AREA) - 128.0
        cut = np.lib.stride_tricks.sliding_window_view(small, (WINDOW_PX, WINDOW_PX))
        rows, columns = cut.shape[:2]
        windows = cut.reshape(rows * columns, -1)
        # Weighted sum of squares about the weighted mean, for each window and each template's weights.
        totals = windows @ self._weights
        squares = (windows * windows) @ self._weights
        totals *= totals
        totals /= self._sums
        squares -= totals
        np.maximum(squares, NOISE * NOISE * self._sums, out=squares)
        scores = windows @ self._templates
        scores /= np.sqrt(squares, out=squares)
        values = scores.max(axis=1).reshape(rows, columns)
        peaks = values >= cv2.dilate(values, np.ones((3, 3), dtype=np.uint8))
        order = np.argsort(-np.where(peaks, values, -1.0), axis=None)[: self._max_windows]
        centers = np.stack([order % columns, order // columns], axis=1) + 0.5 * WINDOW_PX
        centers = centers * (np.array(picture.shape[1::-1]) / (width, height)) - 0.5
        found = []
        for center, row in zip(centers, scores[order], strict=True):
            of_views = np.maximum.reduceat(row, self._firsts)
            for view in np.argsort(-of_views)[: self._views_per_window]:
                first = self._firsts[view]
                found.append((center, int(first + np.argmax(row[first:] == of_views[view]))))
        return found


def rolled_templates(
    picture: NDArray[np.uint8], mask: NDArray[np.uint8], steps: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Templates of a view for the first search, rolled by equal steps of a full turn.

    Args:
        picture: (CROP_PX,CROP_PX,3) uint8 RGB.
        mask: (CROP_PX,CROP_PX) uint8, not 0 on the part.
        steps: number of rolls.

    Returns:
        Grey templates (steps,W²), weighted, of zero mean and unit norm; their weights (steps,W²).
    """
    shrink = PART_PX / WINDOW_PART_PX
    on_part = (mask > 0).astype(np.float32)
    # Averages over the part only, so that no background leaks in; the second channel is the weight.
    layers = cv2.GaussianBlur(np.dstack([picture.mean(axis=2) * on_part, on_part]), (0, 0), 0.4 * shrink)
    layers = layers.astype(np.float32)
    middle, small = 0.5 * (CROP_PX - 1), 0.5 * (WINDOW_PX - 1)
    turned = np.empty((steps, WINDOW_PX, WINDOW_PX, 2), dtype=np.float32)
    for step in range(steps):
        roll = 2.0 * np.pi * step / steps
        c, s = shrink * np.cos(roll), shrink * np.sin(roll)
        # Maps a position in the window to one in the crop: the window is the crop turned by the roll.
        warp = np.array([[c, s, middle - (c + s) * small], [-s, c, middle + (s - c) * small]])
        cv2.warpAffine(layers, warp, (WINDOW_PX, WINDOW_PX), turned[step], cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    sums, weights = turned.reshape(steps, -1, 2).transpose(2, 0, 1)
    values = sums / np.maximum(weights, 1e-3) - 128.0
    weights[weights < 0.5] = 0.0
    total = np.maximum(weights.sum(axis=1, keepdims=True), 1e-3)
    values -= (values * weights).sum(axis=1, keepdims=True) / total
    square = (values * values * weights).sum(axis=1, keepdims=True)
    return values * weights / np.sqrt(np.maximum(square, NOISE * NOISE * total)), weights
