"""Faces that PMI is about as features of a part: planes, holes, pins, round faces and edges of its components."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import count

import numpy as np
from trimesh.triangles import closest_point

from arview.cad.datum_check import find_rims
from arview.cad.formats.pmi import PmiShape
from arview.cad.part import Datum, Part
from arview.errors import InputError
from arview.geometry import Array

ON_SURFACE_MM = 0.2
"""Largest distance of a shape of the CAD file from the triangles of its component, and of a rim from a cylinder."""
SAME_MM, SAME_SINE = 1e-3, 1e-4
"""Differences of place and direction below which faces lie on one plane or cylinder."""
ACROSS_COSINE = 0.9
"""Cosine of the angle between a normal of a surface and that of the triangles that stand for it."""
MIN_TURN = 0.5
"""Share of its circumference that a round face has at least; less is the end of a slot, or a fillet."""


class PmiFeatures:
    """The features of a part that were asked for, each once, in ``found``."""

    def __init__(self, part: Part) -> None:
        self.part = part
        self.found: list[Datum] = []

    def of(self, shapes: Sequence[PmiShape], label: str = "") -> list[Datum]:
        """The features that some shapes are: faces of one plane or cylinder are one.

        Args:
            shapes: faces and edges.
            label: of a feature that was not asked for before; empty: its kind and a number.

        Raises:
            InputError: a shape that is no feature of a part file, or lies on no component.
        """
        groups: list[list[PmiShape]] = []
        for shape in shapes:
            same = [group for group in groups if any(_is_same(shape, other) for other in group)]
            groups = [group for group in groups if group not in same] + [[*sum(same, []), shape]]
        return [self._labelled(self._feature(group), label) for group in groups]

    def at(self, target: PmiShape, label: str, is_plane: bool) -> Datum:
        """The point feature of a datum target; of an area the plane on which it lies; raises InputError as `of`."""
        point, direction = np.array(target.point_in_model), np.array(target.direction_in_model)
        reach_mm = target.length_mm if is_plane else ON_SURFACE_MM
        component, normal = self._surface(point, direction if is_plane else None, reach_mm)
        feature = Datum("", "plane" if is_plane else "point", component, _vector(point), _vector(normal))
        return self._labelled(feature, label)

    def _labelled(self, feature: Datum, label: str) -> Datum:
        known = next((other for other in self.found if replace(other, label="") == feature), None)
        if known is None:
            taken = {*(one.label for one in self.found), *(one.name for one in self.part.model.components)}
            names = (f"{feature.feature}_{number}" for number in count(1))
            known = replace(feature, label=label or next(name for name in names if name not in taken))
            self.found.append(known)
        return known

    def _feature(self, group: list[PmiShape]) -> Datum:
        """The feature of the faces of one plane or cylinder, or of an edge, without a label."""
        first, kind = group[0], group[0].kind
        if kind not in ("plane", "edge", "cylinder"):
            raise InputError(f"a {kind} is no feature of a part file")
        point, axis = np.array(first.point_in_model), np.array(first.direction_in_model)
        corner = np.array(first.corner_in_model)
        radial = corner - point - ((corner - point) @ axis) * axis
        radial *= (-1.0 if first.is_hole else 1.0) / max(float(np.linalg.norm(radial)), 1e-9)
        component, _ = self._surface(corner, {"plane": axis, "cylinder": radial}.get(kind))
        middles = np.array([shape.point_in_model for shape in group])
        areas = np.array([shape.area_mm2 for shape in group])
        if kind != "cylinder":
            middle = np.average(middles, axis=0, weights=np.maximum(areas, 1e-9))
            return Datum("", "plane" if kind == "plane" else "edge", component, _vector(middle), _vector(axis))
        along = (middles - point) @ axis + np.outer([-0.5, 0.5], [shape.length_mm for shape in group])
        ends = point + np.outer([along.min(), along.max()], axis)
        turn = areas.sum() / max(np.pi * first.diameter_mm * float(np.ptp(along)), 1e-9)
        if turn < MIN_TURN:
            raise InputError(f"a round face over {360 * turn:.0f}° only is no feature of a part file")
        rims = [
            (float(end["xyz".index(self.part.up[-1])]), end, outward)
            for end, outward in zip(ends, (-axis, axis), strict=True)
            for rim in find_rims(self.part.model.component(component))
            if np.linalg.norm(rim.center_in_model - end) <= ON_SURFACE_MM
            and abs(rim.radius_mm - 0.5 * first.diameter_mm) <= ON_SURFACE_MM
        ]
        place = (max if "-" not in self.part.up else min)(rims, key=lambda rim: rim[0], default=(0.0, ends[0], axis))
        round_kind = "cylinder" if not rims else "hole" if first.is_hole else "pin"
        return Datum("", round_kind, component, _vector(place[1]), _vector(place[2]), first.diameter_mm)

    def _surface(self, point: Array, normal: Array | None, reach_mm: float = ON_SURFACE_MM) -> tuple[str, Array]:
        """Component and normal (3,) of the triangle nearest to a point, where a normal is given across that."""
        vertices, faces, ids = self.part.model.mesh
        a, b, c = vertices[faces].transpose(1, 0, 2)
        normals = np.cross(b - a, c - a)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
        is_near = np.abs(np.einsum("ij,ij->i", normals, point - a)) <= ON_SURFACE_MM
        if normal is not None:
            is_near &= normals @ normal > ACROSS_COSINE
        near = np.stack([a, b, c], axis=1)[is_near]
        distances = np.linalg.norm(closest_point(near, np.tile(point, (len(near), 1))) - point, axis=1)
        if distances.min(initial=np.inf) > reach_mm:
            raise InputError("it lies on no component; it may be drawn beside the body, or its component is left out")
        nearest = int(np.argmin(distances))
        return self.part.model.components[ids[is_near][nearest]].name, normals[is_near][nearest]


def _is_same(one: PmiShape, other: PmiShape) -> bool:
    """Whether two faces lie on one plane, or follow each other on one cylinder."""
    axis, offset = np.array(one.direction_in_model), np.array(other.point_in_model) - one.point_in_model
    along = float(offset @ axis)
    is_flat = one.kind == "plane" and abs(along) < SAME_MM and float(axis @ other.direction_in_model) > 0.0
    is_round = (
        one.kind == "cylinder"
        and one.is_hole == other.is_hole
        and abs(one.diameter_mm - other.diameter_mm) < SAME_MM
        and float(np.linalg.norm(offset - along * axis)) < SAME_MM
        and abs(along) < 0.5 * (one.length_mm + other.length_mm) + SAME_MM
    )
    is_parallel = float(np.linalg.norm(np.cross(axis, other.direction_in_model))) < SAME_SINE
    return one.kind == other.kind and is_parallel and (is_flat or is_round)


def _vector(values: Array) -> tuple[float, float, float]:
    x, y, z = (round(float(value), 6) + 0.0 for value in values)
    return x, y, z
