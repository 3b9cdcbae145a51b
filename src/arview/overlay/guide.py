"""The outline with which the user aligns the part, in two tones to be visible on bright and dark pictures."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.geometry import Array
from arview.overlay.edges import Edges
from arview.overlay.ghost import Ghost
from arview.overlay.options import PANEL_RGB, Rgb
from arview.overlay.paint import Image

GUIDE_RGB: Rgb = (255, 221, 87)
"""Colour of the outline."""
_INNER_ALPHA, _HALO_ALPHA = 0.75, 0.7
"""Opacity of the inner edges, and of the dark halo around all lines."""


class GuideOutline:
    """Draws a model's outline and its visible edges at a guide pose; the last drawing is cached."""

    def __init__(self, ghost: Ghost, edges: Edges, line_px: float) -> None:
        self._ghost, self._edges, self._line_px = ghost, edges, line_px
        self._pose: Array | None = None
        self._place: tuple[slice, slice] | None = None
        self._line = self._halo = np.zeros((0, 0, 1), dtype=np.float32)

    def draw(self, image: Image, guide_cam_from_model: Array) -> None:
        """Blend the outline over the image in place; draws nothing if the part is outside the image."""
        if self._pose is None or not np.array_equal(self._pose, guide_cam_from_model):
            self._make(guide_cam_from_model)
        if self._place is None:
            return
        below = image[self._place].astype(np.float32)
        below += self._halo * (np.array(PANEL_RGB, dtype=np.float32) - below)
        below += self._line * (np.array(GUIDE_RGB, dtype=np.float32) - below)
        image[self._place] = np.round(below).astype(np.uint8)

    def _make(self, guide_cam_from_model: Array) -> None:
        self._pose, self._place = guide_cam_from_model.copy(), None
        view = self._ghost.view(guide_cam_from_model)
        if view is None:
            return
        inner, _ = self._edges.draw(self._ghost, view, guide_cam_from_model, self._line_px, False)
        outer = _rim(view.face_ids >= 0, 2.0 * self._line_px)
        width = 2 * round(self._line_px) + 1
        ring = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (width, width))
        line = np.maximum(_INNER_ALPHA / 255.0 * inner, outer)
        self._line = line.astype(np.float32)[..., None]
        self._halo = (_HALO_ALPHA * cv2.dilate(line, ring)).astype(np.float32)[..., None]
        height, width = view.face_ids.shape
        self._place = np.s_[view.v0 : view.v0 + height, view.u0 : view.u0 + width]


def _rim(mask: NDArray[np.bool_], width_px: float) -> Array:
    """Coverage (h,w) 0–1 of a line along the border of a mask (h,w), on its inside."""
    inside = np.pad(mask, 1).astype(np.uint8)
    depth_px = cv2.distanceTransform(inside, cv2.DIST_L2, 5)[1:-1, 1:-1]
    rim = np.where(mask, np.clip(width_px + 0.5 - depth_px, 0.0, 1.0), 0.0)
    # A slight blur smooths the steps of the mask.
    return np.asarray(cv2.GaussianBlur(rim, (3, 3), 0.6), dtype=np.float64)
