"""How many photos saw each piece of the CAD's surface, and which pieces no two photos saw."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from arview.cad import Model
from arview.camera import Camera
from arview.errors import InputError
from arview.geometry import Array, apply
from arview.rendering import rasterise

PIECES_ACROSS = 60
"""Pieces along the part's diameter: fine enough for a boundary of a face half seen."""
MAX_PIECES = 200_000
"""Pieces of the surface; larger models are divided less."""
MAX_SIDE_PX = 800
"""Longer side of the rendered depth, in which hidden pieces are found."""
MAX_INCIDENCE_DEG = 80.0
"""Largest angle between the normal and the ray; beyond it a surface is a line in the photo."""
DEPTH_TOLERANCE = 0.004
"""Relative depth by which a piece may lie behind the rendered surface."""
NEEDED_PHOTOS = 2
"""Photos that determine a depth."""


@dataclass(frozen=True)
class SeenSurface:
    """The CAD's surface in small pieces.

    Attributes:
        corners: (P,3,3) corners of each triangle in the model frame, mm.
        owner: (P,) component index.
        photos: (P,) number of photos that saw it.
        needed_photos: number of photos from which a piece counts as seen.
    """

    corners: Array
    owner: NDArray[np.int32]
    photos: NDArray[np.int32]
    needed_photos: int

    @property
    def is_seen(self) -> NDArray[np.bool_]:
        """(P,) whether enough photos saw each piece."""
        return np.asarray(self.photos >= self.needed_photos)

    @property
    def areas(self) -> Array:
        """(P,) areas in mm²."""
        edges = self.corners[:, 1:] - self.corners[:, :1]
        return np.asarray(0.5 * np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1))

    def share_of(self, component: int) -> float:
        """Share of a component's surface that enough photos saw."""
        mine, areas = self.owner == component, self.areas
        total = float(areas[mine].sum())
        return float(areas[mine & self.is_seen].sum()) / total if total > 0.0 else 0.0


def seen_surface(model: Model, views: Sequence[tuple[Camera, Array]]) -> SeenSurface:
    """By geometry alone: pieces in the picture, towards the camera, and not hidden by others at their nominal places.

    Args:
        model: the nominal CAD.
        views: (camera, ``cam_from_model`` (4,4)) of each photo.

    Raises:
        InputError: there are no views.
    """
    if not views:
        raise InputError("seen surface: no camera poses given; place the photos first")
    vertices, faces, owner = model.mesh
    corners, parents = _pieces(vertices[faces], model.diameter_mm / PIECES_ACROSS, MAX_PIECES)
    middles = corners.mean(axis=1)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    photos = np.zeros(len(corners), dtype=np.int32)
    for camera, pose in views:
        photos += _sees(camera, pose, vertices, faces, middles, normals)
    return SeenSurface(corners, owner[parents].astype(np.int32), photos, NEEDED_PHOTOS)


def _pieces(corners: Array, size_mm: float, max_pieces: int) -> tuple[Array, NDArray[np.int64]]:
    """Triangles (F,3,3) halved at their longest edge until it is at most ``size_mm``; and the parent of each piece."""
    parents = np.arange(len(corners))
    while len(corners) < max_pieces:
        lengths = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2)  # edge k joins corners k and k + 1
        longest = lengths.argmax(axis=1)
        long = np.flatnonzero(lengths.max(axis=1) > size_mm)
        if len(long) == 0:
            break
        first, rows = longest[long], np.arange(len(long))
        old = corners[long]
        a, b, c = old[rows, first], old[rows, (first + 1) % 3], old[rows, (first + 2) % 3]
        middle = 0.5 * (a + b)
        rest = np.ones(len(corners), dtype=bool)
        rest[long] = False
        halves = [np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)]
        corners = np.concatenate([corners[rest], *halves])
        parents = np.concatenate([parents[rest], parents[long], parents[long]])
    return corners, parents


def _sees(
    camera: Camera,
    cam_from_model: Array,
    vertices: Array,
    faces: NDArray[np.int32],
    middles: Array,
    normals: Array,
) -> NDArray[np.bool_]:
    """(P,) whether a photo shows the middle of each piece."""
    scale = min(1.0, MAX_SIDE_PX / max(camera.width, camera.height))
    ideal = camera.without_distortion()
    small = ideal.scaled(max(1, round(camera.width * scale)), max(1, round(camera.height * scale)))
    inverse_depth, _ = rasterise(
        apply(cam_from_model, vertices),
        faces,
        small.fx,
        fy=small.fy,
        cx=small.cx,
        cy=small.cy,
        width=small.width,
        height=small.height,
    )
    in_cam = apply(cam_from_model, middles)
    depth = in_cam[:, 2]
    in_front = depth > 1e-6
    safe = np.where(in_front, depth, 1.0)
    cosine = -np.einsum("ij,ij->i", normals @ cam_from_model[:3, :3].T, in_cam) / np.linalg.norm(in_cam, axis=1)
    seen = in_front & (cosine > math.cos(math.radians(MAX_INCIDENCE_DEG)))
    column = np.rint(small.fx * in_cam[:, 0] / safe + small.cx)
    row = np.rint(small.fy * in_cam[:, 1] / safe + small.cy)
    seen &= (column >= 0) & (column < small.width) & (row >= 0) & (row < small.height)
    column, row = np.where(seen, column, 0).astype(int), np.where(seen, row, 0).astype(int)
    # A surface at a grazing angle changes its depth within the pixel that its middle falls into.
    slope = np.sqrt(1.0 - np.minimum(cosine, 1.0) ** 2) / np.maximum(cosine, 0.05)
    tolerance = DEPTH_TOLERANCE + slope / small.fx
    return np.asarray(seen & (depth * inverse_depth[row, column] < 1.0 + tolerance))
