"""Datum planes in the CAD: the largest flat face of a component, and points on the faces of a plane."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from arview.cad import Component, Datum
from arview.geometry import Array
from arview.measurement.photo.patches import tangents_of


def base_plane(component: Component, toward: Array) -> Datum | None:
    """The largest flat face that faces ``toward`` (3,), as a datum; None if it is below a fifth of the component."""
    corners = component.vertices_in_model[component.faces]
    doubled = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.linalg.norm(doubled, axis=1)
    normals = doubled / np.maximum(areas, 1e-12)[:, None]
    heights = np.einsum("nx,nx->n", normals, corners.mean(axis=1))
    is_facing = normals @ (toward / np.linalg.norm(toward)) > 0.5
    if not is_facing.any():
        return None
    keys = np.round(np.concatenate([normals * 500.0, heights[:, None] * 20.0], axis=1)[is_facing])
    groups, owner = np.unique(keys, axis=0, return_inverse=True)
    of_group = np.bincount(owner.ravel(), weights=areas[is_facing], minlength=len(groups))
    if of_group.max() < 0.2 * areas.sum():
        return None
    face = np.flatnonzero(is_facing)[np.flatnonzero(owner.ravel() == np.argmax(of_group))[0]]
    point, normal = corners[face].mean(axis=0), normals[face]
    x, y, z = point.tolist()
    a, b, c = normal.tolist()
    return Datum("plane", "plane", component.name, (x, y, z), (a, b, c))


def plane_samples(component: Component, datum: Datum, count: int, radius_mm: float | None = None) -> Array:
    """Points on a grid on the faces of a component that lie in a datum plane.

    Args:
        component: the datum's component.
        datum: a plane or point.
        count: approximate number of points.
        radius_mm: take only points of a disc around the datum's point.

    Returns:
        (N,3) points; none if no face lies in the plane.
    """
    normal, point = np.array(datum.direction_in_model), np.array(datum.point_in_model)
    corners = component.vertices_in_model[component.faces]
    doubled = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas, heights = np.linalg.norm(doubled, axis=1), (corners - point) @ normal
    flat = (doubled @ normal > 0.999 * areas) & (np.abs(heights).max(axis=1) < 0.05) & (areas > 1e-9)
    if not flat.any():
        return np.zeros((0, 3))
    first, second = (axis[0] for axis in tangents_of(normal[None]))
    triangles = np.stack([(corners[flat] - point) @ first, (corners[flat] - point) @ second], axis=2)
    low, high = triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))
    area = 0.5 * float(areas[flat].sum())
    if radius_mm is not None:
        low, high, area = np.maximum(low, -radius_mm), np.minimum(high, radius_mm), min(area, np.pi * radius_mm**2)
        count = min(count, 40)
    if not (high > low).all():
        return np.zeros((0, 3))
    step = float(np.sqrt(area / count))
    grid = np.stack(np.meshgrid(*(np.arange(a + 0.5 * step, b, step) for a, b in zip(low, high, strict=True))), -1)
    places = grid.reshape(-1, 2)
    if radius_mm is not None:
        places = places[np.linalg.norm(places, axis=1) <= radius_mm]
    places = places[inside_triangles(places, triangles)]
    return np.asarray(point + places[:, :1] * first + places[:, 1:] * second)


def inside_triangles(places: Array, triangles: Array) -> NDArray[np.bool_]:
    """(N,) which points (N,2) lie in any of the triangles (T,3,2)."""
    result = np.zeros(len(places), dtype=bool)
    for a, b, c in triangles:
        sides = [
            (q[0] - p[0]) * (places[:, 1] - p[1]) - (q[1] - p[1]) * (places[:, 0] - p[0])
            for p, q in ((a, b), (b, c), (c, a))
        ]
        result |= (np.min(sides, axis=0) >= 0) | (np.max(sides, axis=0) <= 0)
    return result


def plane_neighbours(points: Array, normal: Array, distance_mm: float) -> Array:
    """(N,8,3) points in the plane at ``distance_mm`` around each of (N,3)."""
    first, second = (axis[0] for axis in tangents_of(normal[None]))
    angle = np.arange(8) * np.pi / 4
    ring = distance_mm * (np.cos(angle)[:, None] * first + np.sin(angle)[:, None] * second)
    return np.asarray(points[:, None] + ring)
