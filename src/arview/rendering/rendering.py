"""`Rendering`: what a renderer draws of a model: depth, component ids, and the silhouette and normals that follow."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from arview.camera import Camera

LIGHT_IN_CAM = np.array([-0.4, -0.6, -0.7]) / np.linalg.norm([0.4, 0.6, 0.7])
"""(3,) unit vector to the light of shaded pictures: from above, left of and behind the camera."""


@dataclass(frozen=True)
class Rendering:
    """A rendered view of a model.

    Attributes:
        depth_mm: (H,W) float32, along the optical axis; 0 where there is no part.
        component_ids: (H,W) int16, index into ``model.components``; -1 where there is no part.
    """

    depth_mm: NDArray[np.float32]
    component_ids: NDArray[np.int16]

    @cached_property
    def silhouette(self) -> NDArray[np.uint8]:
        """(H,W) uint8, 255 on the part."""
        return np.where(self.component_ids >= 0, np.uint8(255), np.uint8(0))

    def shaded(self, camera: Camera) -> NDArray[np.uint8]:
        """(H,W) grey picture under a light from above and behind the camera; white off the part."""
        shade = np.clip(self.normals_in_cam(camera) @ LIGHT_IN_CAM, 0.0, 1.0)
        return np.where(self.component_ids >= 0, 140.0 + 105.0 * shade, 255.0).astype(np.uint8)

    def normals_in_cam(self, camera: Camera) -> NDArray[np.float32]:
        """(H,W,3) unit surface normals facing the camera, from the gradients of the depth; 0 off the part."""
        v, u = np.mgrid[0 : camera.height, 0 : camera.width]
        z = self.depth_mm.astype(np.float64)
        points = np.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z], axis=-1)
        same = self.component_ids >= 0
        forward_u, backward_u = np.roll(points, -1, axis=1) - points, points - np.roll(points, 1, axis=1)
        forward_v, backward_v = np.roll(points, -1, axis=0) - points, points - np.roll(points, 1, axis=0)
        # Of the two one-sided differences, the one with the smaller jump in depth stays on the surface.
        du = np.where((np.abs(forward_u[..., 2]) < np.abs(backward_u[..., 2]))[..., None], forward_u, backward_u)
        dv = np.where((np.abs(forward_v[..., 2]) < np.abs(backward_v[..., 2]))[..., None], forward_v, backward_v)
        normals = np.cross(dv, du)
        length = np.linalg.norm(normals, axis=-1, keepdims=True)
        normals = np.where(same[..., None] & (length > 0), normals / np.maximum(length, 1e-12), 0.0)
        return normals.astype(np.float32)
