"""Accuracy and completeness of a point cloud against the true surface.

Accuracy is the distance from each point of the cloud to the mesh. Completeness is the share of the surface visible in
the photos that has a point of the cloud nearby (Seitz et al. 2006; Knapitsch et al. 2017).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from arview.camera import Camera
from arview.errors import InputError
from arview.geometry import Array, apply
from arview.rendering.rasterizer import rasterise

_SPACING_MM = 0.5
"""Spacing of the mesh samples on which completeness is measured; distances are measured to the triangles."""
_CANDIDATES = 6
"""Triangles to which the distance of a point is measured: those of its nearest samples."""


@dataclass(frozen=True)
class CloudScore:
    """Distances in mm.

    Attributes:
        points: points of the cloud that were measured.
        median_mm, p90_mm: median and 90th percentile of the distances to the mesh.
        far: share of the points farther than ``far_mm`` from the mesh: outliers, or another object.
        complete: share of the visible surface within ``near_mm`` of a point.
        visible_mm2: area of the surface that enough photos show, mm².
    """

    points: int
    median_mm: float
    p90_mm: float
    far: float
    complete: float
    visible_mm2: float


def distances_to_mesh(points: Array, vertices: Array, faces: NDArray[np.int32]) -> Array:
    """(N,) distances of points (N,3) to a triangle mesh, in the same unit and frame.

    Exact where the nearest triangle is among those of the six nearest samples (0.5 apart), elsewhere too large by no
    more than a few micrometres.
    """
    from scipy.spatial import cKDTree

    samples, of_face = sample_mesh(vertices, faces, _SPACING_MM, at_least=1)
    _, nearest = cKDTree(samples).query(points, k=min(_CANDIDATES, len(samples)))
    triangles = vertices[faces]
    distance = np.full(len(points), np.inf)
    for near in np.reshape(nearest, (len(points), -1)).T:
        distance = np.minimum(distance, _distance_to_triangle(points, triangles[of_face[near]]))
    return distance


def _distance_to_triangle(points: Array, triangles: Array) -> Array:
    """(N,) distance of each point to its triangle (N,3,3): to the plane if its foot is inside, else to a side."""
    normal = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    length = np.maximum(np.linalg.norm(normal, axis=1), 1e-30)
    above = np.abs(np.sum(normal * (points - triangles[:, 0]), axis=1)) / length
    inside = np.ones(len(points), dtype=bool)
    to_side = np.full(len(points), np.inf)
    for k in range(3):
        start, side = triangles[:, k], triangles[:, (k + 1) % 3] - triangles[:, k]
        away = points - start
        inside &= np.sum(np.cross(normal, side) * away, axis=1) >= 0.0
        along = np.sum(away * side, axis=1) / np.maximum(np.sum(side * side, axis=1), 1e-30)
        to_side = np.minimum(to_side, np.linalg.norm(away - np.clip(along, 0.0, 1.0)[:, None] * side, axis=1))
    return np.where(inside & (length > 1e-20), above, to_side)


def sample_mesh(
    vertices: Array, faces: NDArray[np.int32], spacing: float, at_least: int = 0, seed: int = 0
) -> tuple[Array, NDArray[np.int64]]:
    """Random points (N,3) on a mesh, about one per ``spacing``², and the triangle (N,) of each.

    ``at_least`` further points are placed on every triangle, however small.
    """
    triangles = vertices[faces]
    area = 0.5 * np.linalg.norm(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=1)
    rng = np.random.default_rng(seed)
    counts = at_least + rng.poisson(area / spacing**2)
    of_face = np.repeat(np.arange(len(faces)), counts)
    a, b = rng.random((2, len(of_face)))
    outside = a + b > 1.0
    a[outside], b[outside] = 1.0 - a[outside], 1.0 - b[outside]
    corner = triangles[of_face]
    points = corner[:, 0] + a[:, None] * (corner[:, 1] - corner[:, 0]) + b[:, None] * (corner[:, 2] - corner[:, 0])
    return points, of_face


def views_of(
    points: Array,
    vertices: Array,
    faces: NDArray[np.int32],
    cameras: Sequence[tuple[Camera, Array]],
    tolerance_mm: float = 0.3,
) -> NDArray[np.int64]:
    """(N,) number of cameras, each with its ``cam_from_mesh`` (4,4), that see points of a mesh, by z-buffer."""
    seen = np.zeros(len(points), dtype=np.int64)
    for camera, cam_from_mesh in cameras:
        inverse_depth, _ = rasterise(
            apply(cam_from_mesh, vertices), faces, camera.fx, camera.fy, camera.cx, camera.cy,
            camera.width, camera.height,
        )  # fmt: skip
        in_cam = apply(cam_from_mesh, points)
        pixels = camera.without_distortion().project(in_cam)
        inside = np.all((pixels >= 0) & (pixels <= [camera.width - 1, camera.height - 1]), axis=1)
        u, v = np.round(pixels[inside]).astype(int).T
        # A slanted surface has several depths within a pixel: the farthest of 3 × 3 pixels counts.
        around = np.stack([
            inverse_depth[np.clip(v + dv, 0, camera.height - 1), np.clip(u + du, 0, camera.width - 1)]
            for dv in (-1, 0, 1) for du in (-1, 0, 1)
        ])  # fmt: skip
        farthest = 1.0 / np.where(around > 0, around, np.inf).min(axis=0)
        seen[inside] += in_cam[inside, 2] <= farthest + tolerance_mm
    return seen


def score_cloud(
    points: Array,
    vertices: Array,
    faces: NDArray[np.int32],
    cameras: Sequence[tuple[Camera, Array]],
    box: Array | None = None,
    min_views: int = 2,
    near_mm: float = 0.5,
    far_mm: float = 2.0,
) -> CloudScore:
    """Accuracy and completeness of a cloud against the true mesh, in one frame, mm.

    Args:
        points: (N,3) of the cloud.
        vertices, faces: the true mesh.
        cameras: of the photos, with their true ``cam_from_mesh`` (4,4); completeness refers to the surface they see.
        box: (2,3) lowest and highest corner; points (such as the table's) and surface outside are ignored.
        min_views: photos that must see a piece of the surface for it to count as visible.
        near_mm: distance of completeness.
        far_mm: distance of ``CloudScore.far``.

    Raises:
        InputError: no points, or no surface visible in the photos.
    """
    from scipy.spatial import cKDTree

    samples, _ = sample_mesh(vertices, faces, _SPACING_MM)
    if box is not None:
        points, samples = (p[np.all((p >= box[0]) & (p <= box[1]), axis=1)] for p in (points, samples))
    if len(points) == 0:
        raise InputError("cloud: has no points to evaluate")
    distance = distances_to_mesh(points, vertices, faces)
    visible = samples[views_of(samples, vertices, faces, cameras) >= min_views]
    if len(visible) == 0:
        raise InputError(f"cloud: no surface of the mesh is seen by {min_views} photos; do the poses belong to it?")
    reach, _ = cKDTree(points).query(visible, distance_upper_bound=near_mm)
    return CloudScore(
        points=len(points),
        median_mm=float(np.median(distance)),
        p90_mm=float(np.percentile(distance, 90.0)),
        far=float(np.mean(distance > far_mm)),
        complete=float(np.mean(reach <= near_mm)),
        visible_mm2=float(len(visible) * _SPACING_MM**2),
    )
