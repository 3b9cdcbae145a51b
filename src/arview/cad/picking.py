"""Features of a component's mesh at a point: the plane, hole, pin, slot, cylinder or edge that can become a datum.

CAD kernels put the vertices of a mesh on the true surface. So the circle through the vertices of a rim and the axis
from the normals of a round face are those of the surface, up to the rounding of the file, however coarse the mesh is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from arview.cad.datum_check import RoundEdge, find_rims
from arview.cad.fitness import face_areas
from arview.cad.model import Component
from arview.cad.part import DatumFeature
from arview.cad.shape.mesh_topology import edge_faces
from arview.core.fits import fit_circle
from arview.errors import InputError
from arview.geometry import Array, from_segment

FLAT_DEG = 0.5
"""Largest angle between the normals of a plane's faces."""
SMOOTH_DEG = 25.0
"""Largest angle between neighbouring faces of a round surface."""
ROUND_SHARE = 0.02
"""Largest deviation of the vertices of a round surface from a cylinder, of its radius."""
NEAR_SHARE = 0.08
"""Rims and edges this near the point count, of the component's size."""


@dataclass(frozen=True)
class PickedFeature:
    """A feature at the picked point.

    Attributes:
        feature: its kind, as datums name it.
        point_in_model: (3,) a point on it, mm: middle of a plane, centre of a rim, foot of an axis, middle of an edge.
        direction_in_model: (3,) unit normal of a plane, unit axis of what is round, unit direction of an edge.
        diameter_mm: of what is round; width of a slot.
        size_mm: extent: largest of a plane, length of a cylinder, an edge or a slot, diameter of a rim.
        distance_mm: from the picked point.
    """

    feature: DatumFeature
    point_in_model: Array
    direction_in_model: Array
    diameter_mm: float | None
    size_mm: float
    distance_mm: float


def pick_features(component: Component, face: int, point_in_model: Array) -> list[PickedFeature]:
    """The features of a component at a point on one of its faces, the likeliest first.

    A rim near the point comes before the face, since a rim is small and a face can be picked anywhere.

    Args:
        component: that was picked.
        face: index of the picked triangle.
        point_in_model: (3,) picked point, mm.

    Raises:
        InputError: there is no such face.
    """
    if not 0 <= face < len(component.faces):
        raise InputError(f"{component.name}: no face {face}, it has {len(component.faces)}")
    point = np.asarray(point_in_model, dtype=np.float64)
    vertices, faces = component.vertices_in_model, component.faces.astype(np.int64)
    normals, neighbours = _normals(vertices, faces), _neighbours(faces)
    reach_mm = NEAR_SHARE * float(np.linalg.norm(np.ptp(vertices, axis=0)))
    found = _rims(component, point, reach_mm)
    flat = _region(face, neighbours, normals, FLAT_DEG, normals[face])
    smooth = _region(face, neighbours, normals, SMOOTH_DEG, None)
    cylinder = _cylinder(vertices, faces, normals, smooth, point) if len(smooth) > len(flat) else None
    if cylinder is not None:
        found.append(cylinder)
    else:
        found.append(_plane(vertices, faces, normals, flat, face, point))
    edge = _edge(
        vertices, faces, neighbours, normals=normals, flat=flat, point=point, reach_mm=reach_mm, sharp_deg=SMOOTH_DEG
    )
    if edge is not None:
        found.append(edge)
    return found


def smooth_faces(component: Component, face: int) -> NDArray[np.int64]:
    """Indices of the faces that are joined with one without a sharp edge."""
    faces = component.faces.astype(np.int64)
    return _region(face, _neighbours(faces), _normals(component.vertices_in_model, faces), SMOOTH_DEG, None)


def _normals(vertices: Array, faces: NDArray[np.int64]) -> Array:
    """(F,3) unit normals."""
    a, b, c = vertices[faces].transpose(1, 0, 2)
    crossed = np.cross(b - a, c - a)
    return np.asarray(crossed / np.maximum(np.linalg.norm(crossed, axis=1, keepdims=True), 1e-300))


def _neighbours(faces: NDArray[np.int64]) -> NDArray[np.int64]:
    """(F,3) face across the edge from corner k to the next one; -1 where there is none or more than one."""
    edges = edge_faces(faces)
    is_shared = edges.face_count == 2
    across = np.full(faces.size, -1, dtype=np.int64)
    across[edges.sides[is_shared]] = edges.faces[is_shared, ::-1]
    return across.reshape(-1, 3)


def _region(
    start: int, neighbours: NDArray[np.int64], normals: Array, max_deg: float, reference: Array | None
) -> NDArray[np.int64]:
    """Faces reached from one without passing an angle: to the reference normal, or else between neighbours."""
    min_cosine = np.cos(np.deg2rad(max_deg))
    inside = np.zeros(len(normals), dtype=bool)
    inside[start] = True
    front = np.array([start])
    while len(front):
        beyond = neighbours[front]
        is_joined = beyond >= 0
        cosine = np.einsum("fkj,fkj->fk", normals[beyond], normals[front][:, None, :])
        if reference is not None:
            cosine = normals[beyond] @ reference
        front = np.unique(beyond[is_joined & (cosine >= min_cosine)])
        front = front[~inside[front]]
        inside[front] = True
    return np.flatnonzero(inside)


def _plane(
    vertices: Array, faces: NDArray[np.int64], normals: Array, flat: NDArray[np.int64], face: int, point: Array
) -> PickedFeature:
    """The plane of the flat faces around the picked one."""
    areas = face_areas(vertices, faces[flat])
    normal = (normals[flat] * areas[:, None]).sum(axis=0)
    normal /= np.linalg.norm(normal)
    corners = vertices[np.unique(faces[flat])]
    middle = np.average(vertices[faces[flat]].mean(axis=1), axis=0, weights=areas)
    middle = middle + ((corners - middle) @ normal).mean() * normal
    size_mm = float(np.linalg.norm(np.ptp(corners, axis=0)))
    return PickedFeature("plane", middle, normal, None, size_mm, abs(float((point - middle) @ normal)))


def _cylinder(
    vertices: Array,
    faces: NDArray[np.int64],
    normals: Array,
    smooth: NDArray[np.int64],
    point: Array,
) -> PickedFeature | None:
    """The cylinder through the faces of a smooth region; None when they do not lie on one."""
    areas = face_areas(vertices, faces[smooth])
    _, _, axes = np.linalg.svd(normals[smooth] * np.sqrt(areas)[:, None], full_matrices=False)
    axis, corners = axes[2], vertices[np.unique(faces[smooth])]
    flat = corners @ axes[:2].T
    center, radius = fit_circle(flat)
    if radius <= 0 or np.abs(np.hypot(*(flat - center).T) - radius).max() > ROUND_SHARE * radius:
        return None
    along = corners @ axis
    foot = center @ axes[:2] + along.min() * axis
    offset = point - foot
    distance = abs(float(np.linalg.norm(offset - (offset @ axis) * axis)) - radius)
    return PickedFeature("cylinder", foot, axis, 2.0 * radius, float(np.ptp(along)), distance)


def _rims(component: Component, point: Array, reach_mm: float) -> list[PickedFeature]:
    """Rims near the point, the nearest first: of holes where the material is outside of the circle, else of pins."""
    found = []
    for rim in find_rims(component, with_slots=True):
        offset = point - rim.center_in_model
        height = float(offset @ rim.axis_in_model)
        aside = float(np.linalg.norm(from_segment(offset - height * rim.axis_in_model, rim.half_in_model)))
        distance = float(np.hypot(height, aside - rim.radius_mm))
        if distance > min(reach_mm, 0.5 * rim.radius_mm):
            continue
        is_hole, is_slot = _is_hole(component, rim), bool(rim.half_in_model.any())
        if is_slot and not is_hole:
            continue
        feature: DatumFeature = "slot" if is_slot else "hole" if is_hole else "pin"
        found.append(
            PickedFeature(
                feature,
                rim.center_in_model,
                _outward(component, rim),
                2.0 * rim.radius_mm,
                2.0 * (rim.radius_mm + float(np.linalg.norm(rim.half_in_model))),
                distance,
            )
        )
    return sorted(found, key=lambda feature: feature.distance_mm)


def _wall(component: Component, rim: RoundEdge) -> tuple[Array, Array]:
    """Middles (N,3) relative to the rim's centre and normals (N,3) of the faces along the axis that touch the rim."""
    vertices, faces = component.vertices_in_model, component.faces.astype(np.int64)
    offset = vertices - rim.center_in_model
    height = offset @ rim.axis_in_model
    across = from_segment(offset - height[:, None] * rim.axis_in_model, rim.half_in_model)
    aside = np.linalg.norm(across, axis=1)
    on_rim = np.hypot(height, aside - rim.radius_mm) < 1e-3 * rim.radius_mm
    touching = faces[on_rim[faces].any(axis=1)]
    normals = _normals(vertices, touching)
    is_wall = np.abs(normals @ rim.axis_in_model) < 0.3
    middles = vertices[touching[is_wall]].mean(axis=1) - rim.center_in_model
    return from_segment(middles, rim.half_in_model), normals[is_wall]


def _is_hole(component: Component, rim: RoundEdge) -> bool:
    """The wall at the rim faces the axis."""
    middles, normals = _wall(component, rim)
    return bool(len(middles)) and float(np.einsum("ij,ij->i", middles, normals).mean()) < 0


def _outward(component: Component, rim: RoundEdge) -> Array:
    """The rim's axis, away from the wall: the direction from which the rim is seen."""
    middles, _ = _wall(component, rim)
    side = float((middles @ rim.axis_in_model).mean()) if len(middles) else -1.0
    return np.asarray(rim.axis_in_model if side < 0 else -rim.axis_in_model)


def _edge(
    vertices: Array,
    faces: NDArray[np.int64],
    neighbours: NDArray[np.int64],
    normals: Array,
    flat: NDArray[np.int64],
    point: Array,
    reach_mm: float,
    sharp_deg: float,
) -> PickedFeature | None:
    """The straight sharp edge of the picked face that is nearest to the point, if it is near enough."""
    beyond = neighbours[flat]
    cosine = np.einsum("fkj,fj->fk", normals[beyond], normals[flat])
    owner, corner = np.nonzero((beyond >= 0) & (cosine < np.cos(np.deg2rad(sharp_deg))))
    starts = vertices[faces[flat[owner], corner]]
    ends = vertices[faces[flat[owner], (corner + 1) % 3]]
    if len(starts) == 0:
        return None
    along = ends - starts
    length = np.linalg.norm(along, axis=1)
    unit = along / length[:, None]
    share = np.clip(np.einsum("ij,ij->i", point - starts, unit), 0.0, length)
    distance = np.linalg.norm(starts + share[:, None] * unit - point, axis=1)
    nearest = int(np.argmin(distance))
    if distance[nearest] > reach_mm:
        return None
    direction, offset = unit[nearest], np.concatenate([starts, ends]) - starts[nearest]
    collinear = np.linalg.norm(offset - (offset @ direction)[:, None] * direction, axis=1) < 1e-4 * length.max() + 1e-6
    places = (offset @ direction)[collinear]
    # A short piece of a polygon around a rim is no straight edge.
    size_mm = float(np.ptp(places))
    if size_mm < 0.5 * reach_mm:
        return None
    middle = starts[nearest] + 0.5 * (places.min() + places.max()) * direction
    return PickedFeature("edge", middle, direction, None, size_mm, float(distance[nearest]))
