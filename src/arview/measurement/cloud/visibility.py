"""Visibility of CAD surface points in the photos."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.cad import Model
from arview.camera import Camera
from arview.geometry import Array, apply
from arview.reconstruction import PosedPhoto
from arview.rendering import rasterise

_SIDE_PX = 800
"""Longer side of the depth pictures: a pixel is below a millimetre where a photo resolves a tenth of one."""
_MIN_COSINE = 0.15
"""Surfaces at a larger angle to the view are seen too obliquely to be reconstructed."""


class SurfaceVisibility:
    """Visibility in photos of points of a model at nominal, from depth pictures that are rendered once.

    ``cam_from_scan`` of the photos is used as ``cam_from_model``.
    """

    def __init__(self, model: Model, photos: Sequence[PosedPhoto]) -> None:
        self._photos = photos
        self._drawn: list[tuple[Camera, Array]] = []
        vertices, faces, _ = model.mesh
        for photo in photos:
            scale = min(1.0, _SIDE_PX / max(photo.camera.width, photo.camera.height))
            camera = photo.camera.without_distortion().scaled(
                round(scale * photo.camera.width), round(scale * photo.camera.height)
            )
            inverse_depth, _ = rasterise(
                apply(photo.cam_from_scan, vertices),
                faces,
                camera.fx,
                fy=camera.fy,
                cx=camera.cx,
                cy=camera.cy,
                width=camera.width,
                height=camera.height,
            )
            # The depth of an inclined surface varies within a pixel: the farthest of 3 × 3 pixels is used.
            self._drawn.append((camera, cv2.erode(np.where(inverse_depth > 0, inverse_depth, np.inf), np.ones((3, 3)))))

    def count(self, points: Array, normals: Array, slack_mm: float = 0.5) -> NDArray[np.int64]:
        """(N,) number of photos that show points (N,3) of the model with normals (N,3)."""
        seen = np.zeros(len(points), dtype=np.int64)
        for photo, (camera, nearness) in zip(self._photos, self._drawn, strict=True):
            in_cam = apply(photo.cam_from_scan, points)
            towards = photo.centre_in_scan - points
            facing = np.sum(normals * towards, axis=1) > _MIN_COSINE * np.linalg.norm(towards, axis=1)
            pixels = np.nan_to_num(camera.project(in_cam), nan=-1.0)
            inside = facing & np.all((pixels >= 0) & (pixels <= [camera.width - 1, camera.height - 1]), axis=1)
            u, v = np.round(pixels[inside]).astype(int).T
            seen[inside] += in_cam[inside, 2] <= 1.0 / nearness[v, u] + slack_mm
        return seen
