"""Datum features in the CAD: faces of a component that form a plane or a cylinder, and straight edges."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from arview.cad import Component, Datum, find_rims, smooth_faces
from arview.errors import InputError
from arview.geometry import Array, from_segment
from arview.measurement.cloud.mesh_surface import MeshSurface
from arview.measurement.datums.options import REACH_MM

_TOLERANCE_MM = 0.05
"""Largest distance of a vertex from the plane, cylinder or line to which it belongs."""


def _faces(component: Component) -> tuple[Array, Array]:
    """Corners (F,3,3) and unit normals (F,3) of the faces; normals of faces without area are zero."""
    corners = component.vertices_in_model[component.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    size = np.linalg.norm(normals, axis=1, keepdims=True)
    return corners, np.where(size > 1e-9, normals / np.maximum(size, 1e-300), 0.0)


def flat_faces(component: Component, datum: Datum) -> NDArray[np.bool_]:
    """(F,) which faces lie in a datum plane. Raises InputError when none does."""
    corners, normals = _faces(component)
    direction = np.array(datum.direction_in_model)
    heights = (corners - np.array(datum.point_in_model)) @ direction
    found = (normals @ direction > 0.999) & (np.abs(heights).max(axis=1) < _TOLERANCE_MM)
    if not found.any():
        raise InputError(f"datum {datum.label}: {datum.component!r} has no flat face at {list(datum.point_in_model)}")
    return np.asarray(found)


def slot_edges(component: Component, datum: Datum) -> list[tuple[float, Array, Array]]:
    """Edges of a slot: height along the datum's axis, middle (3,) and half length (3,); the lowest first.

    Raises:
        InputError: there are none.
    """
    axis, point, width = np.array(datum.direction_in_model), np.array(datum.point_in_model), datum.diameter_mm or 0.0
    found = []
    for rim in find_rims(component, with_slots=True):
        arm = rim.center_in_model - point
        aside = arm - (arm @ axis) * axis
        if (
            rim.half_in_model.any()
            and abs(rim.axis_in_model @ axis) > 0.999
            and abs(2.0 * rim.radius_mm - width) < 0.03 * width
            and np.linalg.norm(aside) < 0.25 * width
        ):
            found.append((float(arm @ axis), rim.center_in_model, rim.half_in_model))
    if not found:
        raise InputError(
            f"datum {datum.label}: {datum.component!r} has no slot {width:g} mm wide about {list(datum.point_in_model)}"
        )
    return sorted(found, key=lambda edge: edge[0])


def round_faces(component: Component, datum: Datum) -> tuple[NDArray[np.bool_], float]:
    """Faces of a cylinder about the datum's axis, or of the wall of a slot.

    Returns:
        (F,) which faces these are, and 1 for faces that point outwards (pin), -1 for those of a bore.

    Raises:
        InputError: there are none.
    """
    corners, normals = _faces(component)
    axis, radius = np.array(datum.direction_in_model), 0.5 * float(datum.diameter_mm or 0.0)
    arms = corners - np.array(datum.point_in_model)
    radial = arms - (arms @ axis)[..., None] * axis
    if datum.feature == "slot":
        half = slot_edges(component, datum)[0][2]
        radial = from_segment(radial, half)
    near = np.abs(np.linalg.norm(radial, axis=2) - radius).max(axis=1) < max(_TOLERANCE_MM, 0.02 * radius)
    found = near & (np.abs(normals @ axis) < 0.05) & normals.any(axis=1)
    if np.count_nonzero(found) < 6:
        raise InputError(
            f"datum {datum.label}: {datum.component!r} has no {datum.feature} of ⌀{2 * radius:g} mm about"
            f" {list(datum.point_in_model)}"
        )
    outward = np.sum(normals[found] * radial[found].mean(axis=1), axis=1)
    return np.asarray(found), 1.0 if np.mean(outward > 0) > 0.5 else -1.0


def surface_faces(component: Component, datum: Datum) -> NDArray[np.bool_]:
    """(F,) which faces are joined with that at the datum's point without a sharp edge.

    Raises:
        InputError: the point is not on the component.
    """
    surface = MeshSurface(component.vertices_in_model, component.faces)
    start = surface.closest(np.array([datum.point_in_model]), REACH_MM).faces[0]
    if start < 0:
        raise InputError(
            f"datum {datum.label}: {list(datum.point_in_model)} is not on the surface of {datum.component!r}"
        )
    found = np.zeros(len(component.faces), dtype=bool)
    found[smooth_faces(component, int(start))] = True
    return found


@dataclass(frozen=True)
class EdgeLine:
    """A straight edge.

    Attributes:
        start, end: (3,) its ends, mm.
        normals: (2,3) unit normals of the two faces that meet there.
    """

    start: Array
    end: Array
    normals: Array

    @property
    def direction(self) -> Array:
        """(3,) unit vector from start to end."""
        return np.asarray((self.end - self.start) / np.linalg.norm(self.end - self.start))

    def points(self, count: int, margin_mm: float) -> Array:
        """(N,3) evenly spaced points, at least ``margin_mm`` (or a quarter of the length) from the ends."""
        length = float(np.linalg.norm(self.end - self.start))
        share = np.linspace(min(margin_mm / length, 0.25), 1.0 - min(margin_mm / length, 0.25), count)
        return np.asarray(self.start + share[:, None] * (self.end - self.start))


def edge_line(component: Component, datum: Datum) -> EdgeLine:
    """The edge of a component along the datum's line. Raises InputError when no two flat faces meet there."""
    corners, normals = _faces(component)
    axis, point = np.array(datum.direction_in_model), np.array(datum.point_in_model)
    arms = corners - point
    along = arms @ axis
    on = np.linalg.norm(arms - along[..., None] * axis, axis=2) < _TOLERANCE_MM
    sides = np.flatnonzero((on.sum(axis=1) == 2) & normals.any(axis=1))
    different = [normals[i] for i in sides if abs(normals[i] @ normals[sides[0]]) < 0.9]
    if not different:
        raise InputError(
            f"datum {datum.label}: {datum.component!r} has no straight edge through {list(datum.point_in_model)}"
        )
    places = along[sides][on[sides]]
    return EdgeLine(
        point + places.min() * axis, point + places.max() * axis, np.stack([normals[sides[0]], different[0]])
    )
