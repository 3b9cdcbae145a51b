"""Evenly spread directions on a sphere, and poses of cameras that look from them."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from arview.cad import ViewRange
from arview.geometry import Array, look_at

ASSESSED_SUBDIVISIONS = 2
"""Subdivisions of the icosphere of the views by which a part is assessed: 162 on the full sphere, in a few seconds."""
MIN_ASSESSED_VIEWS = 40
"""Number of such views in a range below which the next finer icosphere is taken."""


def icosphere_directions(subdivisions: int) -> Array:
    """(10 · 4^n + 2, 3) unit vectors of an icosahedron subdivided n times: 4 gives 2,562, about 4° apart."""
    golden = (1.0 + 5.0**0.5) / 2.0
    vertices = [(s1 * a, s2 * b, 0.0) for s1 in (1, -1) for s2 in (1, -1) for a, b in ((1.0, golden),)]
    points = np.array([np.roll(v, k) for v in vertices for k in range(3)], dtype=np.float64)
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    distances = np.linalg.norm(points[:, None] - points[None], axis=-1)
    side = np.min(distances[distances > 1e-9])
    near = np.abs(distances - side) < 1e-6
    faces = [
        (i, j, k)
        for i in range(12)
        for j in range(i + 1, 12)
        for k in range(j + 1, 12)
        if near[i, j] and near[j, k] and near[i, k]
    ]
    triangles = np.array(faces)
    for _ in range(subdivisions):
        edges = np.sort(np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]), axis=1)
        unique, inverse = np.unique(edges, axis=0, return_inverse=True)
        middles = points[unique].sum(axis=1)
        middles /= np.linalg.norm(middles, axis=1, keepdims=True)
        ab, bc, ca = np.split(inverse.ravel() + len(points), 3)
        a, b, c = triangles.T
        triangles = np.concatenate([np.stack(t, axis=1) for t in ((a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca))])
        points = np.concatenate([points, middles])
    return points


def view_poses(
    directions: Array, distance_mm: float, center_in_model: Array, up_in_model: ArrayLike = (0.0, 0.0, 1.0)
) -> Array:
    """(N,4,4) ``cam_from_model`` of cameras on a sphere around the centre, looking at it with an axis up."""
    up = np.asarray(up_in_model, dtype=np.float64)
    return np.stack([look_at(center_in_model + distance_mm * d, center_in_model, up) for d in directions])


def directions_in_range(view_range: ViewRange, subdivisions: int, margin_deg: float) -> Array:
    """Directions (N,3) of the icosphere inside a range widened by a margin; its middle if there are none."""
    directions = icosphere_directions(subdivisions)
    inside = view_range.contains_direction(directions, margin_deg)
    if inside.any():
        return directions[inside]
    return view_range.direction(0.5 * sum(view_range.azimuth_deg), 0.5 * sum(view_range.elevation_deg))[None]


def assessed_directions(view_range: ViewRange) -> Array:
    """Directions (N,3) of the views by which a part is assessed: 16° apart in the declared range, 8° in a narrow one.

    They are vertices of the finer icospheres, too, so that a set of guide views contains them, and the same shares of
    weak views are found however many views there are beside.
    """
    directions = directions_in_range(view_range, ASSESSED_SUBDIVISIONS, 0.0)
    if len(directions) >= MIN_ASSESSED_VIEWS:
        return directions
    return directions_in_range(view_range, ASSESSED_SUBDIVISIONS + 1, 0.0)
