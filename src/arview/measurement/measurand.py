"""The measurand of a component: the point whose displacement is stated, and the axes in which its motion is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from arview.cad import Component, Model, Part, Symmetry, face_areas, find_rims, sample_surface
from arview.errors import InputError
from arview.geometry import Array
from arview.measurement.photo.patches import near_others, symmetries_of, tangents_of

CONTACT_MM = 0.3
"""Surfaces this near to another component stand on it; CAD leaves gaps for welds and glue."""
SAMPLES = 4000
"""Samples on the surface of a component, where no whole face is in contact."""
MIN_SAMPLES = 10
"""Samples that make a contact."""
MIN_COHERENCE = 0.7
"""Length of the mean normal of the contact for it to be one flat seat."""


@dataclass(frozen=True)
class Measurand:
    """The point whose displacement is stated, and the component's own axes.

    Attributes:
        kind: volume_centroid, area_centroid, seat, axis, hole or given.
        point_in_model: (3,) its nominal position, mm.
        axes: (3,3) orthonormal rows, right-handed; the last one is the component's own axis.
        axis_from: what the own axis is: symmetry, seat, face or model.
    """

    kind: str
    point_in_model: Array
    axes: Array
    axis_from: str

    def axes_for(self, undetermined: Array) -> Array:
        """The own axes (3,3), turned about the last so that one is along what of (K,6) is undetermined across it."""
        axis = self.axes[2]
        across = np.concatenate([undetermined[:, 3:], undetermined[:, :3]])
        across = across - (across @ axis)[:, None] * axis
        sizes = np.linalg.norm(across, axis=1)
        if not len(sizes) or sizes.max() < 0.05:
            return self.axes
        first = across[np.argmax(sizes > 0.05)]
        first = first / np.linalg.norm(first)
        return np.stack([first, np.cross(axis, first), axis])


def measurand_of(name: str, part: Part) -> Measurand:
    """The measurand of a component by the part file; its centre of mass unless another point is named.

    The centre of mass of what is round lies on its axis.

    Raises:
        InputError: the component has no such point; the message names the component.
    """
    component, settings = part.model.component(name), part.component_settings(name)
    seat = seat_of(component, part.model)
    symmetries = symmetries_of(component, part)
    axis, axis_from = _own_axis(component, symmetries, seat)
    kind, point = _point(name, part, component, symmetries, seat)
    if settings.point == "mass":
        turning = [one for one in symmetries if one.order is None]
        if len(turning) == 1:
            point = on_axis(point, turning[0])
    first, second = (vectors[0] for vectors in tangents_of(axis[None]))
    if np.linalg.det(np.stack([first, second, axis])) < 0:
        second = -second
    return Measurand(kind, point, np.stack([first, second, axis]), axis_from)


def on_axis(point: Array, symmetry: Symmetry) -> Array:
    """The foot of the perpendicular from a point (3,) to an axis."""
    axis, through = np.array(symmetry.axis_in_model), np.array(symmetry.through_in_model)
    return np.asarray(through + axis * (axis @ (point - through)))


@dataclass(frozen=True)
class Seat:
    """Where a component stands: middle of the contact (3,), and its unit normal (3,) into the component, or None."""

    middle: Array
    normal: Array | None


def seat_of(component: Component, model: Model) -> Seat | None:
    """The surface in contact with other components; None if it touches none."""
    corners = component.vertices_in_model[component.faces]
    areas = face_areas(component.vertices_in_model, component.faces.astype(np.int64))
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    index = model.index(component.name)
    # A face lies on another component where its corners, the middles of its sides and its centroid do.
    places = np.concatenate(
        [corners, 0.5 * (corners + np.roll(corners, 1, axis=1)), corners.mean(axis=1, keepdims=True)], axis=1
    )
    near = near_others(places.reshape(-1, 3), model, index, CONTACT_MM).reshape(places.shape[:2]).all(axis=1)
    if areas[near].sum() > 0.01 * areas.sum():
        middles, weights, directions = corners.mean(axis=1)[near], areas[near], normals[near]
    else:
        samples = sample_surface(component, 0.0, SAMPLES)
        touching = samples.of(near_others(samples.points, model, index, CONTACT_MM))
        if len(touching.points) < MIN_SAMPLES:
            return None
        middles, weights, directions = touching.points, np.ones(len(touching.points)), touching.normals
    mean = np.average(directions, axis=0, weights=weights)
    length = float(np.linalg.norm(mean))
    normal = -mean / length if length > MIN_COHERENCE else None
    return Seat(np.average(middles, axis=0, weights=weights), normal)


def _own_axis(component: Component, symmetries: list[Symmetry], seat: Seat | None) -> tuple[Array, str]:
    """(3,) own axis and what it is: of symmetry, the normal of the seat, that of the largest flat face, or +Z."""
    turning = [one for one in symmetries if one.order is None]
    main = turning if len(turning) == 1 else [one for one in symmetries if one.order is not None and one.order > 2]
    if len(main) == 1:
        axis = np.array(main[0].axis_in_model)
        up = axis @ (component.centroid_in_model - seat.middle) if seat is not None else axis[np.argmax(np.abs(axis))]
        return (axis if up >= 0 else -axis), "symmetry"
    if seat is not None and seat.normal is not None:
        return seat.normal, "seat"
    normal = _max_area_normal(component)
    return (normal, "face") if normal is not None else (np.array([0.0, 0.0, 1.0]), "model")


def _max_area_normal(component: Component) -> Array | None:
    """(3,) unit normal of the largest flat face; None if no direction has a tenth of the area."""
    corners = component.vertices_in_model[component.faces]
    doubled = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.linalg.norm(doubled, axis=1)
    normals = doubled / np.maximum(areas, 1e-300)[:, None]
    _, owner = np.unique(np.round(normals * 100.0), axis=0, return_inverse=True)
    of_group = np.bincount(owner.ravel(), weights=areas)
    if of_group.max() < 0.1 * areas.sum():
        return None
    mean = doubled[owner.ravel() == np.argmax(of_group)].sum(axis=0)
    return np.asarray(mean / np.linalg.norm(mean))


def _point(
    name: str, part: Part, component: Component, symmetries: list[Symmetry], seat: Seat | None
) -> tuple[str, Array]:
    """Kind and nominal position (3,) of the point that the part file names."""
    wanted = part.component_settings(name).point
    where = f"part {part.name!r}, component {name!r}: point = {wanted!r}"
    if wanted == "mass":
        return "volume_centroid" if component.is_solid else "area_centroid", component.centroid_in_model
    if not isinstance(wanted, str):
        return "given", np.array(wanted)
    if wanted == "hole":
        return "hole", _hole_center(component, where)
    if seat is None:
        raise InputError(f"{where}: it touches no other component; give coordinates [x, y, z]")
    if wanted == "seat":
        return "seat", seat.middle
    turning = [one for one in symmetries if one.order is None] or [one for one in symmetries if one.order != 2]
    if len(turning) != 1:
        raise InputError(f"{where}: it has {len(turning) or 'no'} axes of symmetry; declare one, or give coordinates")
    return "axis", on_axis(seat.middle, turning[0])


def _hole_center(component: Component, where: str) -> Array:
    """(3,) middle of the only hole of a component, between the ends of its bore."""
    bores: list[tuple[Array, Array, float]] = []
    for rim in find_rims(component):
        if not _is_bore(component, rim.center_in_model, rim.axis_in_model, rim.radius_mm):
            continue
        bores.append((rim.center_in_model, rim.axis_in_model, rim.radius_mm))
    if not bores:
        raise InputError(f"{where}: it has no round hole; give coordinates [x, y, z]")
    center, axis, _ = bores[0]
    for other, _, radius_mm in bores[1:]:
        arm = other - center
        if np.linalg.norm(arm - axis * (axis @ arm)) > 0.05 * radius_mm:
            raise InputError(f"{where}: it has more than one hole; give the coordinates of the centre [x, y, z]")
    narrow = min(radius for _, _, radius in bores)
    ends = [point for point, _, radius in bores if radius < 1.02 * narrow]
    return np.asarray(np.mean(ends, axis=0))


def _is_bore(component: Component, center: Array, axis: Array, radius_mm: float) -> bool:
    """Whether the round wall at a rim faces its axis."""
    corners = component.vertices_in_model[component.faces]
    arms = corners - center
    radial = arms - (arms @ axis)[..., None] * axis
    on = np.abs(np.linalg.norm(radial, axis=2) - radius_mm).max(axis=1) < 0.03 * radius_mm
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    wall = on & (np.abs(normals @ axis) < 0.1 * np.linalg.norm(normals, axis=1))
    if not wall.any():
        return False
    return bool(np.sum(normals[wall] * radial[wall].mean(axis=1)) < 0)
