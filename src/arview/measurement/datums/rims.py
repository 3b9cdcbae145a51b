"""The edges of holes, pins and slots in the CAD."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from arview.cad import Datum, Model
from arview.errors import InputError
from arview.geometry import Array
from arview.measurement.datums.cad_features import slot_edges
from arview.measurement.photo.patches import tangents_of


@dataclass(frozen=True)
class Rim:
    """A circular edge of the CAD, or that of a slot, and the one at the other end of the hole or pin.

    Attributes:
        center: (3,) mm.
        axis: (3,) unit, towards the cameras.
        radius_mm: of the edge.
        other_center, other_radius_mm: of the edge at the other end.
        is_hole: whether it is of a hole, otherwise of a pin.
        half: (3,) of a slot, from its middle to the centre of one of its round ends, mm; zero for a circle.
    """

    center: Array
    axis: Array
    radius_mm: float
    other_center: Array
    other_radius_mm: float
    is_hole: bool = True
    half: Array = field(default_factory=lambda: np.zeros(3))

    def points(self, count: int, other: bool = False) -> tuple[Array, Array, Array]:
        """``count`` points (N,3) around the edge, with radial (N,3) and tangent (N,3) unit directions."""
        first, second = (axis[0] for axis in tangents_of(self.axis[None]))
        center, radius = (self.other_center, self.other_radius_mm) if other else (self.center, self.radius_mm)
        angle, along = np.arange(count) * 2 * np.pi / count, np.zeros(count)
        if self.half.any():
            # Around both ends and along both sides, from the middle of one end on.
            length, arc = float(np.linalg.norm(self.half)), np.pi * radius
            first, second = self.half / length, np.cross(self.axis, self.half / length)
            ends = np.cumsum([0.0, 0.5 * arc, 2.0 * length, arc, 2.0 * length, 0.5 * arc])
            way = np.arange(count) / count * ends[-1]
            angle = np.interp(way, ends, np.pi * np.array([0.0, 0.5, 0.5, 1.5, 1.5, 2.0]))
            along = np.interp(way, ends, length * np.array([1.0, 1.0, -1.0, -1.0, 1.0, 1.0]))
        radial = np.cos(angle)[:, None] * first + np.sin(angle)[:, None] * second
        return center + along[:, None] * first + radius * radial, radial, np.cross(self.axis, radial)


def find_rim(model: Model, datum: Datum, toward: Array) -> Rim:
    """Find the edge of a hole, pin or slot that faces a direction (3,) among the vertices of the CAD.

    Of a chamfered hole this is the wide end of the chamfer, which is the edge that photos show.

    Raises:
        InputError: the CAD has no circle, or no slot, of that size about the datum's axis.
    """
    component, diameter = model.component(datum.component), float(datum.diameter_mm or 0.0)
    point, axis = np.array(datum.point_in_model), np.array(datum.direction_in_model)
    axis = axis if axis @ toward >= 0 else -axis
    if datum.feature == "slot":
        edges = slot_edges(
            component, replace(datum, direction_in_model=(float(axis[0]), float(axis[1]), float(axis[2])))
        )
        (_, bottom, _), (_, top, half) = edges[0], edges[-1]
        return Rim(top, axis, 0.5 * diameter, bottom, 0.5 * diameter, half=half)
    vertices = component.vertices_in_model[np.unique(component.faces)] - point
    heights = vertices @ axis
    across = vertices - heights[:, None] * axis
    radii = np.linalg.norm(across, axis=1)
    low, high = (0.47, 1.0) if datum.feature == "hole" else (0.25, 0.53)
    near, circles = (radii > low * diameter) & (radii < high * diameter), []
    keys = np.round(np.stack([heights[near] / 0.02, radii[near] / 0.02], axis=1))
    for key in np.unique(keys, axis=0):
        of = np.flatnonzero(near)[(np.abs(keys - key) <= 1).all(axis=1)]
        if len(of) >= 8 and np.linalg.norm(across[of].mean(axis=0)) < 0.1 * diameter:
            circles.append((float(heights[of].mean()), float(radii[of].mean())))
    wall = [c for c in circles if abs(c[1] - 0.5 * diameter) < 0.03 * diameter]
    if not wall:
        raise InputError(
            f"datum {datum.label}: {datum.component!r} has no {datum.feature} of ⌀{diameter:g} mm about"
            f" {list(datum.point_in_model)}"
        )
    top_mm = max(height for height, _ in wall)
    ends = [c for c in circles if c[0] >= top_mm - 0.05 and c[0] <= top_mm + 0.25 * diameter]
    height, radius = max(ends, key=lambda c: (round(c[0], 1), -abs(c[1] - 0.5 * diameter)))
    other = min(wall)
    return Rim(point + height * axis, axis, radius, point + other[0] * axis, other[1], datum.feature == "hole")
