"""Faces that PMI is about as features of a part: planes, holes, pins, round faces and edges of its components."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from itertools import chain, count
from typing import cast

import numpy as np
from trimesh import unitize
from trimesh.triangles import closest_point

from arview.cad.datum_check import find_rims
from arview.cad.formats.pmi import PmiShape
from arview.cad.part import Datum, DatumFeature, Part, Vector
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
    """The features of a part that were asked for, without their labels, and ``labels`` of each."""

    def __init__(self, part: Part) -> None:
        self.part = part
        self.labels: dict[Datum, str] = {}
        self._rims = cache(lambda name: find_rims(part.model.component(name)))
        vertices, faces, self._ids = part.model.mesh
        self._corners = vertices[faces]
        self._normals = unitize(np.cross(*np.diff(self._corners, axis=1).transpose(1, 0, 2)))

    def of(self, shapes: Sequence[PmiShape]) -> list[Datum]:
        """The features that some shapes are: faces of one plane or cylinder are one.

        Raises:
            InputError: a shape that is no feature of a part file, or lies on no component.
        """
        groups: list[list[PmiShape]] = []
        for shape in shapes:
            same = [group for group in groups if any(_is_same(shape, other) for other in group)]
            groups = [group for group in groups if group not in same] + [[*chain(*same), shape]]
        return [self.labelled(self._feature(group)) for group in groups]

    def at(self, target: PmiShape, is_plane: bool) -> Datum:
        """The point feature of a datum target; of an area the plane on which it lies; raises InputError as `of`."""
        if target.kind == "line":
            raise InputError("its targets are lines, and a part file has points")
        point, direction = np.array(target.point_in_model), np.array(target.direction_in_model) * is_plane
        component, normal = self._surface(point, direction, target.length_mm if is_plane else ON_SURFACE_MM)
        return Datum("", "plane" if is_plane else "point", component, _vector(point), _vector(normal))

    def labelled(self, feature: Datum, label: str = "") -> Datum:
        """A feature with a given label, else with the one that it has, else with its kind and a number."""
        key = replace(feature, label="")
        taken = {*self.labels.values(), *(component.name for component in self.part.model.components)}
        names = (name for number in count(1) if (name := f"{feature.feature}_{number}") not in taken)
        self.labels[key] = label or self.labels.get(key) or next(names)
        return replace(key, label=self.labels[key])

    def _feature(self, group: list[PmiShape]) -> Datum:
        """The feature of the faces of one plane or cylinder, or of an edge, without a label."""
        first, kind = group[0], group[0].kind
        if kind not in ("plane", "cylinder", "line edge"):
            raise InputError(f"a {kind} is no feature of a part file")
        point, axis, corner = map(np.array, (first.point_in_model, first.direction_in_model, first.corner_in_model))
        radial = corner - point - ((corner - point) @ axis) * axis
        radial *= (-1.0 if first.is_hole else 1.0) / max(float(np.linalg.norm(radial)), 1e-9)
        component, _ = self._surface(corner, {"plane": axis, "cylinder": radial}.get(kind, np.zeros(3)))
        middles, areas = np.array([one.point_in_model for one in group]), np.array([one.area_mm2 for one in group])
        middle = _vector(np.average(middles, axis=0, weights=np.maximum(areas, 1e-9)))
        if kind != "cylinder":
            return Datum("", "plane" if kind == "plane" else "edge", component, middle, _vector(axis))
        along = (middles - point) @ axis + np.outer([-0.5, 0.5], [shape.length_mm for shape in group])
        turn = areas.sum() / max(np.pi * first.diameter_mm * float(np.ptp(along)), 1e-9)
        if turn < MIN_TURN:
            raise InputError(f"a round face over {360 * turn:.0f}° only is no feature of a part file")
        ends = sorted(
            [(point + along.min() * axis, -axis), (point + along.max() * axis, axis)],
            key=lambda end: float(end[0]["xyz".index(self.part.up[-1])]),
            reverse="-" not in self.part.up,
        )
        with_rim = [
            end
            for end in ends
            for rim in self._rims(component)
            if np.linalg.norm(rim.center_in_model - end[0]) <= ON_SURFACE_MM
            and abs(rim.radius_mm - 0.5 * first.diameter_mm) <= ON_SURFACE_MM
        ]
        round_kind: DatumFeature = "cylinder" if not with_rim else "hole" if first.is_hole else "pin"
        place, outward = [*with_rim, *ends][0]
        return Datum("", round_kind, component, _vector(place), _vector(outward), first.diameter_mm)

    def _surface(self, point: Array, normal: Array, reach_mm: float = ON_SURFACE_MM) -> tuple[str, Array]:
        """Component and normal (3,) of the triangle nearest to a point, across a normal that is not zero."""
        is_near = np.abs(np.einsum("ij,ij->i", self._normals, point - self._corners[:, 0])) <= ON_SURFACE_MM
        is_near &= self._normals @ normal >= ACROSS_COSINE * np.linalg.norm(normal)
        near = self._corners[is_near]
        distances = np.linalg.norm(closest_point(near, np.tile(point, (len(near), 1))) - point, axis=1)
        if distances.min(initial=np.inf) > reach_mm:
            raise InputError("it lies on no component; it may be drawn beside the body, or its component is left out")
        nearest = np.flatnonzero(is_near)[np.argmin(distances)]
        return self.part.model.components[self._ids[nearest]].name, self._normals[nearest]


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
    return (
        one.kind == other.kind
        and float(np.linalg.norm(np.cross(axis, other.direction_in_model))) < SAME_SINE
        and (is_flat or is_round)
    )


def _vector(values: Array) -> Vector:
    return cast(Vector, tuple(round(float(value), 6) + 0.0 for value in values))
