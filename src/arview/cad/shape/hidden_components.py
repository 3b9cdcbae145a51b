"""Components that no view can show: a body that is there twice at one place, or wholly inside another."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from arview.cad.fitness import face_areas, face_bodies, signed_volumes, surface_moments
from arview.cad.model import Component
from arview.geometry import Array

SAME_SHARE, SAME_MOMENTS = 1e-3, 0.01
"""Largest distance of equal bodies, as a share of their diameter, and difference of their areas and moments."""
MAX_POINTS = 128
"""Points of a component that are searched for in another."""
MIN_WINDING = 0.99
"""Least winding number of a surface about a point inside it: 1, or a little less where the surface has gaps."""
MAX_WORK = 30_000_000
"""Points times triangles that are computed for a part, which takes some seconds."""


def hidden_components(components: Sequence[Component]) -> tuple[list[str], list[str], list[str]]:
    """Names of components that are where an equal one is, those inside another, and those not searched for.

    The first two name the other component, too.
    """
    low, high = np.stack([component.bounds_in_model for component in components], axis=1)
    margins = SAME_SHARE * np.linalg.norm(high - low, axis=1)
    twice, inside, unsearched, work = list[str](), list[str](), list[str](), 0
    outer: dict[int, Array] = {}
    for k, component in enumerate(components):
        is_around = ((low <= low[k] + margins[k]) & (high >= high[k] - margins[k])).all(axis=1)
        is_same = np.maximum(np.abs(low - low[k]), np.abs(high - high[k])).max(axis=1) <= margins[k]
        same = [n for n in np.flatnonzero(is_same[:k]).tolist() if _is_equal(component, components[n], margins[k])]
        twice += [f"{component.name} (in {components[n].name})" for n in same[:1]]
        for n in () if same else np.flatnonzero(is_around & ~is_same).tolist():
            if work > MAX_WORK:
                unsearched.append(component.name)
                break
            corners = outer[n] = outer[n] if n in outer else _outer_corners(components[n])
            points = _points(component)
            # Most are outside already by their first point.
            count = next((i for i, point in enumerate(points) if _winding(point, corners) < MIN_WINDING), len(points))
            work += (count + 1) * len(corners)
            if count == len(points):
                inside.append(f"{component.name} (in {components[n].name})")
                break
    return twice, inside, unsearched


def _is_equal(one: Component, other: Component, margin_mm: float) -> bool:
    """Whether bodies with the same bounds have the same area, centre and spread, however they are triangulated."""
    meshes = [(component.vertices_in_model, component.faces.astype(np.int64)) for component in (one, other)]
    area, other_area = (face_areas(*mesh).sum() for mesh in meshes)
    (center, spread), (other_center, other_spread) = (surface_moments(*mesh) for mesh in meshes)
    return bool(
        abs(area - other_area) <= SAME_MOMENTS * area
        and np.linalg.norm(center - other_center) <= margin_mm
        and np.abs(spread - other_spread).max() <= SAME_MOMENTS * np.trace(spread)
    )


def _points(component: Component) -> Array:
    """(N,3) some vertices and middles of triangles, evenly over the lists of them."""
    vertices, faces = component.vertices_in_model, component.faces
    candidates = np.concatenate([vertices[np.unique(faces)], vertices[faces].mean(axis=1)])
    return candidates[:: -(-len(candidates) // MAX_POINTS)]


def _outer_corners(component: Component) -> Array:
    """(F,3,3) corners of the triangles of a component's outer surfaces: a body in a cavity is not visible either."""
    vertices, faces = component.vertices_in_model, component.faces.astype(np.int64)
    bodies = face_bodies(faces, len(vertices))
    volumes = np.bincount(bodies, weights=signed_volumes(vertices, faces))
    return np.asarray(vertices[faces[volumes[bodies] > 0]])


def _winding(point: Array, corners: Array) -> float:
    """Winding number of triangles (F,3,3) about a point (3,).

    Source: Van Oosterom and Strackee 1983, "The solid angle of a plane triangle".
    """
    a, b, c = (corners - point).transpose(1, 0, 2)
    lengths = np.linalg.norm(corners - point, axis=2).T
    volume = np.einsum("ij,ij->i", a, np.cross(b, c))
    edges = ((a, b, lengths[2]), (b, c, lengths[0]), (c, a, lengths[1]))
    rest = sum(np.einsum("ij,ij->i", one, other) * length for one, other, length in edges)
    return float(np.arctan2(volume, lengths.prod(axis=0) + rest).sum() / (2.0 * np.pi))
