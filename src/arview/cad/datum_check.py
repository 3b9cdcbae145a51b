"""Whether the features that a part file declares as datums are in the geometry, and which are nearest if not."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.cad.fitness import face_areas
from arview.cad.model import Component
from arview.cad.part import Datum, Part
from arview.cad.shape.mesh_topology import edge_faces
from arview.core.fits import fit_circle
from arview.geometry import Array, from_segment

SHARP_DEG = 25.0
"""Angle between faces from which their common edge is a rim."""
MIN_CORNERS = 6
"""Vertices that a rim has at least."""
ROUND_SHARE = 0.02
"""Largest deviation of the vertices of a rim from a circle, of its radius."""
AXIS_DEG = 5.0
"""Largest angle between declared and actual direction."""
RADIUS_SHARE = 0.05
"""Largest difference of radii, of the declared one."""
PLACE_SHARE = 0.25
"""Largest distance of the declared point from the axis, of the radius."""
PLACE_MM = 0.2
"""Largest distance of the declared point from a plane, which is also added to ``PLACE_SHARE`` of the radius."""


@dataclass(frozen=True)
class RoundEdge:
    """A round edge, or that of a slot, whose ends are half circles.

    Attributes:
        center_in_model: (3,) its middle, mm.
        axis_in_model: (3,) unit.
        radius_mm: of the circle or half circles.
        half_in_model: (3,) from the middle to the centre of one half circle, mm; zero for a circle.
    """

    center_in_model: Array
    axis_in_model: Array
    radius_mm: float
    half_in_model: Array = field(default_factory=lambda: np.zeros(3))


def datum_problems(part: Part) -> list[str]:
    """A text for each plane, hole, pin or cylinder, datum or other feature, that is not where the part file has it."""
    rims: dict[str, list[RoundEdge]] = {}
    texts, names = [], {component.name for component in part.model.components}
    for datum in (*part.datums, *part.features):
        if datum.component not in names:
            continue
        component = part.model.component(datum.component)
        if datum.feature in ("hole", "pin", "cylinder", "slot"):
            if datum.component not in rims:
                rims[datum.component] = find_rims(component, with_slots=True)
            same = [rim for rim in rims[datum.component] if rim.half_in_model.any() == (datum.feature == "slot")]
            text = _round_problem(datum, same)
        elif datum.feature == "plane":
            text = _plane_problem(datum, component)
        else:
            continue
        if text:
            texts.append(text if datum in part.datums else text.replace("datum", "feature", 1))
    return texts


def find_rims(component: Component, with_slots: bool = False) -> list[RoundEdge]:
    """The round edges of a component: closed loops of sharp edges whose vertices lie on a circle, or around a slot."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    vertices = component.vertices_in_model
    edges = _sharp_edges(vertices, component.faces.astype(np.int64), SHARP_DEG)
    count = len(vertices)
    degree = np.bincount(edges.ravel(), minlength=count)
    graph = coo_matrix((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(count, count))
    _, labels = connected_components(graph, directed=False)
    order = np.argsort(labels, kind="stable")
    loops = np.split(order, np.flatnonzero(np.diff(labels[order])) + 1)
    return [
        rim
        for loop in loops
        if len(loop) >= MIN_CORNERS and np.all(degree[loop] == 2)
        if (rim := _fitted_rim(vertices[loop], ROUND_SHARE, with_slots)) is not None
    ]


def _sharp_edges(vertices: Array, faces: NDArray[np.int64], sharp_deg: float) -> NDArray[np.int64]:
    """(E,2) vertices of the edges whose faces meet at an angle."""
    a, b, c = vertices[faces].transpose(1, 0, 2)
    normals = np.cross(b - a, c - a)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    edges = edge_faces(faces)
    cosine = np.einsum("ij,ij->i", normals[edges.faces[:, 0]], normals[edges.faces[:, 1]])
    return edges.ends[(edges.face_count == 2) & (cosine < np.cos(np.deg2rad(sharp_deg)))]


def _fitted_rim(points: Array, round_share: float, with_slots: bool) -> RoundEdge | None:
    """The circle, or the outline of a slot, through points (N,3); None when they are on none."""
    middle = points.mean(axis=0)
    _, sizes, axes = np.linalg.svd(points - middle)
    if sizes[1] < 1e-9:
        return None
    flat = (points - middle) @ axes[:2].T
    center, radius = fit_circle(flat)
    away = np.abs(np.hypot(*(flat - center).T) - radius)
    height = np.abs((points - middle) @ axes[2])
    half = np.zeros(2)
    if away.max() > round_share * radius and with_slots:
        # The smallest rectangle around a slot lies along it.
        box = cv2.boxPoints(cv2.minAreaRect(flat.astype(np.float32))).astype(np.float64)
        sides = sorted((box[1] - box[0], box[2] - box[1]), key=lambda side: float(np.linalg.norm(side)))
        radius, length = 0.5 * float(np.linalg.norm(sides[0])), float(np.linalg.norm(sides[1]))
        center, half = box.mean(axis=0), sides[1] * (0.5 - radius / max(length, 1e-9))
        away = np.abs(np.linalg.norm(from_segment(flat - center, half), axis=1) - radius)
    if radius <= 0 or max(away.max(), height.max()) > round_share * radius:
        return None
    return RoundEdge(middle + center @ axes[:2], axes[2], radius, half @ axes[:2])


def _round_problem(datum: Datum, rims: list[RoundEdge]) -> str:
    point, axis = np.array(datum.point_in_model), np.array(datum.direction_in_model)
    diameter_mm = datum.diameter_mm or 0.0
    radius_mm, differences = 0.5 * diameter_mm, []
    for rim in rims:
        offset = rim.center_in_model - point
        aside_mm = float(np.linalg.norm(offset - (offset @ axis) * axis))
        is_same = (
            abs(float(rim.axis_in_model @ axis)) > np.cos(np.deg2rad(AXIS_DEG))
            and abs(rim.radius_mm - radius_mm) <= RADIUS_SHARE * radius_mm
            and aside_mm <= PLACE_SHARE * radius_mm + PLACE_MM
        )
        if is_same:
            return ""
        differences.append(float(np.linalg.norm(offset)) + 2.0 * abs(rim.radius_mm - radius_mm))
    what = f"datum {datum.label}: {datum.component} has no {datum.feature} of ⌀ {diameter_mm:g} mm at {_place(point)}"
    if not rims:
        return f"{what}; it has no round edges at all"
    nearest = rims[int(np.argmin(differences))]
    return f"{what}; the nearest round edge has ⌀ {2 * nearest.radius_mm:.4g} mm at {_place(nearest.center_in_model)}"


def _plane_problem(datum: Datum, component: Component) -> str:
    point, normal = np.array(datum.point_in_model), np.array(datum.direction_in_model)
    faces = component.faces.astype(np.int64)
    a, b, c = component.vertices_in_model[faces].transpose(1, 0, 2)
    crossed = np.cross(b - a, c - a)
    crossed /= np.maximum(np.linalg.norm(crossed, axis=1, keepdims=True), 1e-300)
    is_parallel = np.abs(crossed @ normal) > np.cos(np.deg2rad(AXIS_DEG))
    what = f"datum {datum.label}: {datum.component} has no plane at {_place(point)} with normal {_place(normal)}"
    if not is_parallel.any():
        return f"{what}; no face of it is parallel to that"
    heights = np.einsum("ij,j->i", component.vertices_in_model[faces].mean(axis=1) - point, normal)[is_parallel]
    if np.abs(heights).min() <= PLACE_MM:
        return ""
    areas = face_areas(component.vertices_in_model, faces)[is_parallel]
    near = np.abs(heights) <= np.abs(heights).min() + PLACE_MM
    height = float(np.average(heights[near], weights=areas[near]))
    return f"{what}; the nearest is {height:+.4g} mm away along the normal"


def _place(point: Array) -> str:
    return "(" + ", ".join(f"{value + 0.0:.4g}" for value in np.round(point, 6)) + ")"
