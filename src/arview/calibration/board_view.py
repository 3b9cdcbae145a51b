"""The corners of a board in one picture, with the accuracy to expect of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from arview.geometry import Array

MIN_CORNERS = 8
"""Pictures with fewer corners contain little information and are easily wrong."""
_SHUTTER_S = 0.02
"""Readout time of a phone's sensor (rolling shutter), which distorts moving objects."""


@dataclass(frozen=True)
class BoardView:
    """The corners of the board in one picture.

    Attributes:
        name: of the photo, or ``frame N``.
        ids: (N,) numbers of the corners.
        points_in_board: (N,3) mm, z = 0.
        pixels: (N,2) in the sensor's picture, integers at pixel centres.
        blur_px: spread of edges on the board (Gaussian sigma), NaN when unknown.
        speed_px_s: speed of the board in the picture; 0 for photos.
        radius_mm: of the circles of which ``pixels`` are the centroids; 0 for corners.
    """

    name: str
    ids: NDArray[np.int64]
    points_in_board: Array
    pixels: Array
    blur_px: float = float("nan")
    speed_px_s: float = 0.0
    radius_mm: float = 0.0

    @property
    def sigma_px(self) -> float:
        """Expected standard deviation of its corners: noise, blur beyond the usual, and motion during readout."""
        blur = max(0.0, (1.0 if np.isnan(self.blur_px) else self.blur_px) - 1.0)
        return float(np.linalg.norm([0.1, 0.1 * blur, 0.05 * _SHUTTER_S * self.speed_px_s]))


def blur_of(gray: NDArray[np.uint8], pixels: Array) -> float:
    """Edge spread of the part of the picture that contains the corners; NaN if it is small."""
    from arview.reconstruction import blur_and_texture

    height, width = gray.shape
    low = np.maximum(np.floor(pixels.min(axis=0)).astype(int), 0)
    high = np.minimum(np.ceil(pixels.max(axis=0)).astype(int) + 1, (width, height))
    if min(high - low) < 40:
        return float("nan")
    return blur_and_texture(np.ascontiguousarray(gray[low[1] : high[1], low[0] : high[0]]))[0]
