"""Which points of the CAD the photos can see."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from arview.cad.model import Model
from arview.geometry import Array, apply
from arview.raster import rasterise
from arview.reconstruction.types import PosedPhoto

_SIDE_PX = 800
"""Longer side of the depth pictures: a pixel is under a millimetre where a photo resolves a tenth of one."""
_LEAST_COSINE = 0.15
"""Surfaces that lean away more are seen too flat to be reconstructed."""


def seen_by(
    points: Array, normals: Array, model: Model, photos: Sequence[PosedPhoto], slack_mm: float = 0.5
) -> NDArray[np.int64]:
    """(N,) number of photos that see points of the model with their normals, by z-buffer at nominal.

    ``cam_from_scan`` of the photos is taken for ``cam_from_model``.
    """
    seen = np.zeros(len(points), dtype=np.int64)
    vertices, faces, _ = model.mesh
    for photo in photos:
        scale = min(1.0, _SIDE_PX / max(photo.camera.width, photo.camera.height))
        camera = photo.camera.without_distortion().scaled(
            round(scale * photo.camera.width), round(scale * photo.camera.height)
        )
        w, h = camera.width, camera.height
        inverse_depth, _ = rasterise(
            apply(photo.cam_from_scan, vertices), faces, camera.fx, camera.fy, camera.cx, camera.cy, w, h
        )
        in_cam = apply(photo.cam_from_scan, points)
        towards = photo.centre_in_scan - points
        facing = np.sum(normals * towards, axis=1) > _LEAST_COSINE * np.linalg.norm(towards, axis=1)
        pixels = np.nan_to_num(camera.project(in_cam), nan=-1.0)
        inside = facing & np.all((pixels >= 0) & (pixels <= [w - 1, h - 1]), axis=1)
        u, v = np.round(pixels[inside]).astype(int).T
        # Within a pixel the surface may be as much farther as it leans: the farthest of 3 × 3 pixels counts.
        around = np.stack([inverse_depth[np.clip(v + dv, 0, h - 1), np.clip(u + du, 0, w - 1)]
                           for dv in (-1, 0, 1) for du in (-1, 0, 1)])  # fmt: skip
        farthest = 1.0 / np.where(around > 0, around, np.inf).min(axis=0)
        seen[inside] += in_cam[inside, 2] <= farthest + slack_mm
    return seen
