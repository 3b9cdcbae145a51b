"""The datum features of a part file, measured in the photos: planes and points by the sweep, rims by their edges."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from arview.cad.model import Component, Model
from arview.cad.part import Datum
from arview.cad.samples import sample_surface
from arview.errors import InputError
from arview.geometry import Array
from arview.measurement.datums.alignment import (
    Equations,
    move_equations,
    robust_weights,
    surface_equations,
)
from arview.measurement.datums.cad_features import edge_line, round_faces
from arview.measurement.photo.edges import EdgePoints, edge_offsets
from arview.measurement.photo.options import EdgeOptions, SweepOptions
from arview.measurement.photo.patches import near_edges, near_others, tangents_of
from arview.measurement.photo.sweep import sweep_offsets
from arview.measurement.photo.views import PhotoViews
from arview.measurement.types import Move


@dataclass(frozen=True)
class DatumOptions:
    """How datum features are measured."""

    samples: int = 500  # on a plane; more are nearer to each other than their errors are alike
    clear_mm: float = 8.0  # of other components: weld beads and spatter lie within a leg's length of the joint
    min_clear_mm: float = 2.0  # where a plane has no room for that
    point_radius_mm: float = 4.0  # of the disc that stands for a datum point; some patches
    reach_mm: float = 1.0  # how far a feature may be from its rough place
    rim_points: int = 120  # around a hole; about a px apart on small ones
    fine_reach_px: float = 3.0  # around the place that the first look at a rim has found
    rim_px: float = 0.07  # standard uncertainty of a rim by rust, chalk and burrs beside it: of four rendered rims
    rival_px: float = 3.0  # a point of a rim with the other rim so near, in that photo, is not looked at
    sweep: SweepOptions = field(default_factory=SweepOptions)
    edges: EdgeOptions = field(default_factory=EdgeOptions)


def measure_datums_in_photos(
    datums: tuple[Datum, ...],
    views: PhotoViews,
    moves: Mapping[str, Move],
    options: DatumOptions | None = None,
) -> list[Equations]:
    """Offsets of each datum feature, in order of precedence.

    Args:
        datums: of the part file.
        views: photos in the rough frame of the model.
        moves: best fits of components, for datums of the feature ``fit``.
        options: see there.

    Raises:
        InputError: the CAD has no such feature, or no photo shows it; the datum is named.
    """
    options = options or DatumOptions()
    return [_measure(datum, views, moves, options) for datum in datums]


def _measure(datum: Datum, views: PhotoViews, moves: Mapping[str, Move], o: DatumOptions) -> Equations:
    if datum.feature == "fit":
        if datum.component not in moves:
            raise InputError(f"datum {datum.label}: {datum.component!r} could not be measured as a whole")
        return move_equations(datum.label, moves[datum.component], datum.locks)[0]
    if datum.feature in ("hole", "pin"):
        return _measure_rim(datum, views, o)
    if datum.feature == "cylinder":
        return _measure_cylinder(datum, views, o)
    if datum.feature == "edge":
        return _measure_edge(datum, views, o)
    component = views.model.component(datum.component)
    radius_mm = o.point_radius_mm if datum.feature == "point" else None
    points = plane_samples(component, datum, o.samples, radius_mm)
    if not len(points):
        raise InputError(f"datum {datum.label}: {datum.component!r} has no flat face at {list(datum.point_in_model)}")
    points = _clear(points, views, component, datum, o)
    normals = np.tile(np.array(datum.direction_in_model), (len(points), 1))
    index = views.model.index(datum.component)
    found = sweep_offsets(points, normals, views, o.reach_mm, o.sweep, index)
    ok, seen = found.is_ok, int(np.count_nonzero((found.views >= 0).sum(axis=1) >= o.sweep.min_views))
    variances = found.variances_mm2[ok] + o.sweep.min_sigma_mm**2
    return surface_equations(
        datum.label, datum.feature, points[ok], normals[ok], found.offsets_mm[ok], variances, seen, locks=datum.locks
    )


def base_plane(component: Component, toward: Array) -> Datum | None:
    """The largest flat face of a component that looks towards (3,), as a datum; None when it is no large part of it."""
    corners = component.vertices_in_model[component.faces]
    doubled = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.linalg.norm(doubled, axis=1)
    normals = doubled / np.maximum(areas, 1e-12)[:, None]
    heights = np.einsum("nx,nx->n", normals, corners.mean(axis=1))
    ahead = normals @ (toward / np.linalg.norm(toward)) > 0.5
    if not ahead.any():
        return None
    keys = np.round(np.concatenate([normals * 500.0, heights[:, None] * 20.0], axis=1)[ahead])
    groups, owner = np.unique(keys, axis=0, return_inverse=True)
    of_group = np.bincount(owner.ravel(), weights=areas[ahead], minlength=len(groups))
    if of_group.max() < 0.2 * areas.sum():
        return None
    face = np.flatnonzero(ahead)[np.flatnonzero(owner.ravel() == np.argmax(of_group))[0]]
    point, normal = corners[face].mean(axis=0), normals[face]
    x, y, z = point.tolist()
    a, b, c = normal.tolist()
    return Datum("plane", "plane", component.name, (x, y, z), (a, b, c))


# --- planes ----------------------------------------------------------------------------------------------


def plane_samples(component: Component, datum: Datum, count: int, radius_mm: float | None = None) -> Array:
    """About ``count`` points (N,3) on a grid on the faces of a component that lie in a datum plane.

    With a radius only those of a disc around the datum's point.
    """
    normal, point = np.array(datum.direction_in_model), np.array(datum.point_in_model)
    corners = component.vertices_in_model[component.faces]
    doubled = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.linalg.norm(doubled, axis=1)
    heights = (corners - point) @ normal
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
    places = places[_inside(places, triangles)]
    return np.asarray(point + places[:, :1] * first + places[:, 1:] * second)


def _inside(places: Array, triangles: Array) -> NDArray[np.bool_]:
    """(N,) which points (N,2) are in any of the triangles (T,3,2)."""
    result = np.zeros(len(places), dtype=bool)
    for a, b, c in triangles:
        sides = [(q[0] - p[0]) * (places[:, 1] - p[1]) - (q[1] - p[1]) * (places[:, 0] - p[0])
                 for p, q in ((a, b), (b, c), (c, a))]  # fmt: skip
        result |= (np.min(sides, axis=0) >= 0) | (np.max(sides, axis=0) <= 0)
    return result


def _clear(points: Array, views: PhotoViews, component: Component, datum: Datum, o: DatumOptions) -> Array:
    """Those away from other components, and from what ends the face, as far as there is room."""
    index = views.model.index(datum.component)
    patch_mm = 0.5 * o.sweep.patch_px * views.mm_per_px(points.mean(axis=0))
    for clear_mm in (o.clear_mm, o.min_clear_mm):
        kept = points[~near_others(points, views.model, index, clear_mm)]
        if len(kept) >= min(100, 0.3 * len(points)):
            break
    # Where a point moved by half a patch leaves the face its patch does too.
    around = plane_neighbours(kept, np.array(datum.direction_in_model), 0.7 * patch_mm)
    normal, point = np.array(datum.direction_in_model), np.array(datum.point_in_model)
    corners = component.vertices_in_model[component.faces]
    flat = np.abs((corners - point) @ normal).max(axis=1) < 0.05
    first, second = (axis[0] for axis in tangents_of(normal[None]))
    triangles = np.stack([(corners[flat] - point) @ first, (corners[flat] - point) @ second], axis=2)
    places = np.stack([(around - point) @ first, (around - point) @ second], axis=-1)
    whole = _inside(places.reshape(-1, 2), triangles).reshape(places.shape[:2]).all(axis=1)
    return kept[whole] if np.count_nonzero(whole) >= 20 else kept


def plane_neighbours(points: Array, normal: Array, distance_mm: float) -> Array:
    """(N,8,3) points around each of (N,3), in the plane."""
    first, second = (axis[0] for axis in tangents_of(normal[None]))
    angle = np.arange(8) * np.pi / 4
    ring = distance_mm * (np.cos(angle)[:, None] * first + np.sin(angle)[:, None] * second)
    return np.asarray(points[:, None] + ring)


# --- rims ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Rim:
    """A circle of the CAD: centre (3,), unit axis (3,) towards the cameras, radius; the other end of the hole."""

    center: Array
    axis: Array
    radius_mm: float
    other_center: Array
    other_radius_mm: float

    def points(self, count: int, other: bool = False) -> tuple[Array, Array, Array]:
        """Points (N,3), radial (N,3) and tangent (N,3) directions around it."""
        first, second = (axis[0] for axis in tangents_of(self.axis[None]))
        angle = np.arange(count) * 2 * np.pi / count
        radial = np.cos(angle)[:, None] * first + np.sin(angle)[:, None] * second
        center, radius = (self.other_center, self.other_radius_mm) if other else (self.center, self.radius_mm)
        return center + radius * radial, radial, np.cross(self.axis, radial)


def find_rim(model: Model, datum: Datum, toward: Array) -> Rim:
    """The edge of a hole or pin that faces a direction (3,), found among the vertices of the CAD.

    A chamfered hole's is the wide end of its chamfer, which is the edge that photos show.

    Raises InputError when the CAD has no circle of that size about the datum's axis.
    """
    component, diameter = model.component(datum.component), float(datum.diameter_mm or 0.0)
    point, axis = np.array(datum.point_in_model), np.array(datum.direction_in_model)
    axis = axis if axis @ toward >= 0 else -axis
    vertices = component.vertices_in_model[np.unique(component.faces)] - point
    heights = vertices @ axis
    across = vertices - heights[:, None] * axis
    radii = np.linalg.norm(across, axis=1)
    low, high = (0.47, 1.0) if datum.feature == "hole" else (0.25, 0.53)
    near = (radii > low * diameter) & (radii < high * diameter)
    circles = []
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
    top = max(height for height, _ in wall)
    ends = [c for c in circles if c[0] >= top - 0.05 and c[0] <= top + 0.25 * diameter]
    height, radius = max(ends, key=lambda c: (round(c[0], 1), -abs(c[1] - 0.5 * diameter)))
    other = min(wall)
    return Rim(point + height * axis, axis, radius, point + other[0] * axis, other[1])


def _measure_rim(datum: Datum, views: PhotoViews, o: DatumOptions) -> Equations:
    center = np.array(datum.point_in_model)
    toward = views.centres.mean(axis=0) - center
    rim = find_rim(views.model, datum, toward)
    points, radial, tangents = rim.points(o.rim_points)
    seen_from = _rim_views(views, rim, points, radial, o)
    which, view = np.nonzero(seen_from)
    if len(np.unique(view)) < 3:
        raise InputError(f"datum {datum.label} ({datum.feature}): fewer than 3 photos show it; photograph it too")
    px_mm = views.mm_per_px(rim.center)

    def edges_at(found: Array) -> tuple[EdgePoints, Array]:
        moved = points[which] + found[:3] + found[3] * radial[which]
        return EdgePoints(moved, tangents[which], view), rim.center + found[:3]

    def design_of(directions: Array, ok: NDArray[np.bool_]) -> Array:
        return np.concatenate([directions, np.sum(directions * radial[which[ok]], axis=1)[:, None]], axis=1)

    steps = _find_steps(datum, views, edges_at, design_of, 4, px_mm, o)
    equations = surface_equations(
        datum.label, datum.feature, points[which[steps.ok]], steps.directions, steps.offsets, steps.variances,
        len(which), steps.design[:, 3], datum.locks,
    )  # fmt: skip
    return replace(equations, form_mm=o.rim_px * px_mm)


@dataclass(frozen=True)
class _Steps:
    """Steps of brightness found at some of N edge points.

    ``ok`` (N,); of those: ``directions`` (K,3) across the edge, ``offsets`` (K,) from the nominal place, their
    ``variances``, mm, and ``design`` (K,U), their derivative by what is unknown of the place.
    """

    ok: NDArray[np.bool_]
    directions: Array
    offsets: Array
    variances: Array
    design: Array


def _find_steps(
    datum: Datum, views: PhotoViews, edges_at: Callable[[Array], tuple[EdgePoints, Array]],
    design_of: Callable[[Array, NDArray[np.bool_]], Array], unknowns: int, px_mm: float, o: DatumOptions,
    rcond: float = 1e-15,
) -> _Steps:  # fmt: skip
    """Three looks: a wide one, then about the place that the one before has found.

    Args:
        datum: for the message.
        views: the photos.
        edges_at: of the unknowns (U,), the edge points there and a point on the feature's inside.
        design_of: of directions (K,3) and which points they are at, the derivative (K,U) of offsets by the unknowns.
        unknowns: U.
        px_mm: size of a pixel.
        o: reach of the looks.
        rcond: directions of the unknowns that are known worse than this are left at zero.

    Raises:
        InputError: too few steps.
    """
    place = np.zeros(unknowns)
    for reach_px in (o.reach_mm / px_mm + 2.0, o.fine_reach_px, o.fine_reach_px):
        edges, inside = edges_at(place)
        found = edge_offsets(edges, inside, views, reach_px, o.edges)
        ok = found.seen & (found.slopes != 0.0)
        if np.count_nonzero(ok) < o.edges.min_points:
            raise InputError(
                f"datum {datum.label} ({datum.feature}): its edge is seen at {np.count_nonzero(ok)} of"
                f" {len(ok)} places only; is it filled, or covered?"
            )
        directions, slope = found.directions[ok], np.abs(found.slopes[ok])
        variances = (0.3 * found.mm_per_px[ok]) ** 2 * (slope + o.edges.half_slope) / slope
        design = design_of(directions, ok)
        offsets = found.offsets_mm[ok] + design @ place
        share, _ = robust_weights(design, offsets, variances)
        weighted = design * (share / variances)[:, None]
        place = np.linalg.pinv(weighted.T @ design, rcond=rcond, hermitian=True) @ (weighted.T @ offsets)
    return _Steps(ok, directions, offsets, variances, design)


def _rim_views(views: PhotoViews, rim: Rim, points: Array, radial: Array, o: DatumOptions) -> NDArray[np.bool_]:
    """(N,M) which photos show which points of a rim, with no other edge near them."""
    other = rim.points(o.rim_points, other=True)[0]
    groups = (points + 0.3 * radial + 0.05 * rim.axis)[:, None]
    result = np.zeros((len(points), len(views.cameras)), dtype=bool)
    for index, camera in enumerate(views.cameras):
        toward = views.centres[index] - rim.center
        if toward @ rim.axis < 0.25 * np.linalg.norm(toward):
            continue
        pose = views.cam_from_model[index]
        window = views.window(index, None, np.eye(4), groups[:, 0])
        visible = views.visible(index, window, groups)
        pixels, rivals = (camera.project(p @ pose[:3, :3].T + pose[:3, 3]) for p in (points, other))
        apart = np.linalg.norm(pixels[:, None] - rivals[None], axis=2).min(axis=1)
        result[:, index] = visible & (apart > o.rival_px)
    return result


# --- cylinders and edges ---------------------------------------------------------------------------------


def _measure_cylinder(datum: Datum, views: PhotoViews, o: DatumOptions) -> Equations:
    """The round faces by the sweep, with patches of their shape; how thick it is says nothing about its axis."""
    component, index = views.model.component(datum.component), views.model.index(datum.component)
    faces, side = round_faces(component, datum)
    px_mm = views.mm_per_px(np.array(datum.point_in_model))
    samples = sample_surface(replace(component, faces=component.faces[faces]), 3.0 * px_mm, o.samples)
    apart = ~near_others(samples.points, views.model, index, o.min_clear_mm)
    samples = samples.of(apart & ~near_edges(samples.points, component, o.sweep.edge_px * px_mm))
    if len(samples.points) < o.sweep.min_samples:
        raise InputError(f"datum {datum.label} (cylinder): too little of it is clear of edges and other components")
    found = sweep_offsets(samples.points, samples.normals, views, o.reach_mm, o.sweep, index)
    ok, seen = found.is_ok, int(np.count_nonzero((found.views >= 0).sum(axis=1) >= o.sweep.min_views))
    axis = np.array(datum.direction_in_model)
    radial = samples.points - np.array(datum.point_in_model)
    radial = side * (radial - (radial @ axis)[:, None] * axis)
    radial /= np.linalg.norm(radial, axis=1, keepdims=True)
    variances = found.variances_mm2 + o.sweep.min_sigma_mm**2
    return surface_equations(
        datum.label, "cylinder", samples.points[ok], radial[ok], found.offsets_mm[ok], variances[ok], seen,
        np.full(np.count_nonzero(ok), side), datum.locks,
    )  # fmt: skip


def _measure_edge(datum: Datum, views: PhotoViews, o: DatumOptions) -> Equations:
    """Steps of brightness across a straight edge, in all photos that show it."""
    line = edge_line(views.model.component(datum.component), datum)
    px_mm = views.mm_per_px(0.5 * (line.start + line.end))
    points = line.points(o.rim_points, 6.0 * px_mm)
    points = points[~near_others(points, views.model, views.model.index(datum.component), o.min_clear_mm)]
    groups = (points + 0.05 * line.normals.sum(axis=0))[:, None]
    seen = np.zeros((len(points), len(views.cameras)), dtype=bool)
    for index in range(len(views.cameras)):
        toward = views.centres[index] - points.mean(axis=0) if len(points) else np.zeros(3)
        if (line.normals @ toward > 0.1 * np.linalg.norm(toward)).any() and len(points):
            seen[:, index] = views.visible(index, views.window(index, None, np.eye(4), groups[:, 0]), groups)
    which, view = np.nonzero(seen)
    if len(np.unique(view)) < 3:
        raise InputError(f"datum {datum.label} (edge): fewer than 3 photos show it; photograph it too")
    project = np.eye(3) - np.outer(line.direction, line.direction)
    inside = 0.5 * (line.start + line.end) - 10.0 * line.normals.sum(axis=0)
    tangents = np.tile(line.direction, (len(which), 1))
    steps = _find_steps(
        datum, views, lambda shift: (EdgePoints(points[which] + shift, tangents, view), inside),
        lambda directions, _: directions @ project, 3, px_mm, o, rcond=1e-6,
    )  # fmt: skip
    equations = surface_equations(
        datum.label, "edge", points[which[steps.ok]], steps.directions, steps.offsets, steps.variances, len(which),
        None, datum.locks,
    )  # fmt: skip
    return replace(equations, form_mm=o.rim_px * px_mm)
