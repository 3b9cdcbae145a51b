"""The surface of a model, reduced for small drawings of it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from arview.cad import Model
from arview.core.kernel import kernel
from arview.geometry import Array
from arview.rendering import fill_buffers

MAX_FACES = 20_000
"""Largest number of faces; a mesh with more is reduced."""
CELL = 1.0 / 150.0
"""Size of the cells whose vertices are merged, in diameters; it grows until the faces are few enough."""


NEAR_SHARE = 0.05
"""Depth of the near plane, as a share of the diameter."""


class Surface(NamedTuple):
    """A triangle mesh, as the kernels take it.

    Attributes:
        points: (V,3) float32, mm.
        faces: (F,3) int32 vertex indices.
        normals: (F,3) float32 unit normals of the faces.
        component: (F,) int16 component index of each face.
    """

    points: NDArray[np.float32]
    faces: NDArray[np.int32]
    normals: NDArray[np.float32]
    component: NDArray[np.int16]


def surface_about(
    points: NDArray[np.float32], faces: NDArray[np.int32], component: NDArray[np.int16], center: Array
) -> Surface:
    """A surface from the arrays of `reduced_surface`, relative to a point (3,) of the model frame."""
    about = (points.astype(np.float64) - center).astype(np.float32)
    a, b, c = about[faces].transpose(1, 0, 2)
    normals = np.cross(b - a, c - a)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    return Surface(about, faces, normals.astype(np.float32), component)


@kernel
def draw_surface(
    surface: Surface,
    pose: NDArray[np.float64],
    focal_px: NDArray[np.float64],
    center_px: NDArray[np.float64],
    diameter_mm: float,
    drawn: NDArray[np.float32],
    face_ids: NDArray[np.int32],
) -> None:
    """Draw normals and depth of a surface in the view of an ideal camera.

    Args:
        surface: a `Surface`.
        pose: (4,4) ``cam_from_body``; nothing is drawn unless the origin of the surface is in front of the camera.
        focal_px: (2,) focal lengths.
        center_px: (2,) projection of the surface's origin in the drawing.
        diameter_mm: of the part.
        drawn: (4,H,W) float32, becomes the normal, right, down and towards the camera, and the depth relative to the
            origin in half diameters, -1 to 1; 0 off the surface. The third channel is never 0 on it.
        face_ids: (H,W) int32, becomes the index of the visible face; -1 off the surface.
    """
    points, faces, normals, _ = surface
    height, width = face_ids.shape
    drawn[:] = 0.0
    face_ids[:] = -1
    place = pose[:3, 3]
    if place[2] <= 0.0:
        return
    seen = np.empty((points.shape[0], 3))
    for i in range(points.shape[0]):
        for a in range(3):
            seen[i, a] = place[a]
            for b in range(3):
                seen[i, a] += pose[a, b] * points[i, b]
    cx, cy = center_px[0] - focal_px[0] * place[0] / place[2], center_px[1] - focal_px[1] * place[1] / place[2]
    inverse_depth = np.zeros((height, width))
    fill_buffers(
        seen,
        faces,
        focal_px[0],
        fy=focal_px[1],
        cx=cx,
        cy=cy,
        near=NEAR_SHARE * diameter_mm,
        x_low=0,
        y_low=0,
        inverse_depth=inverse_depth,
        face_ids=face_ids,
    )
    half_mm = 0.5 * diameter_mm
    for v in range(height):
        for u in range(width):
            face = face_ids[v, u]
            if face < 0:
                continue
            x, y, z = 0.0, 0.0, 0.0
            for b in range(3):
                x += pose[0, b] * normals[face, b]
                y += pose[1, b] * normals[face, b]
                z += pose[2, b] * normals[face, b]
            away = (u - cx) / focal_px[0] * x + (v - cy) / focal_px[1] * y + z
            sign = -1.0 if away > 0.0 else 1.0
            drawn[0, v, u], drawn[1, v, u] = sign * x, sign * y
            drawn[2, v, u] = min(-sign * z, -0.01) if sign * z > 0.0 else max(-sign * z, 0.01)
            drawn[3, v, u] = min(max((1.0 / inverse_depth[v, u] - place[2]) / half_mm, -1.0), 1.0)


def reduced_surface(model: Model) -> tuple[NDArray[np.float32], NDArray[np.int32], NDArray[np.int16]]:
    """The mesh of a model, reduced to at most MAX_FACES faces by merging the vertices of each cell into their mean.

    Source: Rossignac and Borrel, "Multi-resolution 3D approximations for rendering complex scenes", 1993.

    Returns:
        points (V,3) in the model frame, mm, faces (F,3), and component index of each face (F,).
    """
    points, faces, owners = model.mesh
    reduced, kept, component = points, faces.astype(np.int64), owners
    cell_mm = CELL * model.diameter_mm
    while len(kept) > MAX_FACES:
        cells = np.floor((points - points.min(axis=0)) / cell_mm).astype(np.int64)
        _, cell_of, counts = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
        cell_of = cell_of.ravel()
        sums = [np.bincount(cell_of, weights=points[:, axis]) for axis in range(3)]
        reduced = np.stack(sums, axis=1) / counts[:, None]
        kept = cell_of[faces]
        a, b, c = kept.T
        is_left = (a != b) & (b != c) & (c != a)
        kept, component = kept[is_left], owners[is_left]
        _, first = np.unique(np.sort(kept, axis=1), axis=0, return_index=True)
        kept, component = kept[np.sort(first)], component[np.sort(first)]
        cell_mm *= 1.5
    used, kept = np.unique(kept, return_inverse=True)
    return reduced[used].astype(np.float32), kept.reshape(-1, 3).astype(np.int32), component.astype(np.int16)
