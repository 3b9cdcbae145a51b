"""Datum features measured in the photos: faces and points by the sweep, rims and edges by steps of brightness."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from arview.cad import Component, Datum, sample_surface
from arview.errors import InputError
from arview.geometry import Array, apply, from_segment
from arview.measurement.datums.cad_features import edge_line, round_faces, surface_faces
from arview.measurement.datums.datum_fit import check_covered, robust_weights
from arview.measurement.datums.equations import (
    DatumEquations,
    DatumNotMeasuredError,
    move_equations,
    surface_equations,
)
from arview.measurement.datums.options import CLEAR_MM, MIN_CLEAR_MM, POINT_RADIUS_MM, REACH_MM
from arview.measurement.datums.plane_edges import DATUM_EDGE_PX, FINE_REACH_PX, RIVAL_PX, measure_plane_by_edges
from arview.measurement.datums.planes import inside_triangles, plane_neighbours, plane_samples
from arview.measurement.datums.rims import Rim, find_rim
from arview.measurement.datums.roundness import rim_shift_mm, waves
from arview.measurement.photo.edge_offsets import HALF_SLOPE, edge_offsets
from arview.measurement.photo.edges import MIN_POINTS
from arview.measurement.photo.patches import near_edges, near_others, tangents_of
from arview.measurement.photo.rival_edges import EdgePoints
from arview.measurement.photo.sweep import MIN_SAMPLES, MIN_SIGMA_MM, MIN_VIEWS, PATCH_PX, SWEEP_EDGE_PX, sweep_offsets
from arview.measurement.photo.views import PhotoViews
from arview.measurement.types import Move

SAMPLES = 500
"""Samples on a plane; errors of denser samples are correlated."""
RIM_POINTS = 120
"""Points around a hole; about one px apart on small ones."""
BLUR_PX2 = 3.0
"""Mean square distance, px², over which a step is averaged: along the edge by its parallel profiles, across it by lens,
sensor and smoothing. Averaged over so much, a curved edge seems to lie farther inside, by half of it times its
curvature (the blurred edge moves by the heat equation)."""
RIM_PX = 0.04
"""Expected standard uncertainty of a rim's position by rust, chalk and burrs beside it."""


def measure_datums_in_photos(
    datums: tuple[Datum, ...],
    views: PhotoViews,
    moves: Mapping[str, Move],
) -> list[DatumEquations]:
    """Measure the offsets of each datum feature, in order of precedence.

    Args:
        datums: of the part file.
        views: photos in the rough frame of the model.
        moves: best fits of components, for datums with the feature ``fit``.

    Raises:
        InputError: the CAD has no such feature, or too few photos show it; the message names the datum.
    """
    return [_measure(datum, views, moves) for datum in datums]


def _measure(datum: Datum, views: PhotoViews, moves: Mapping[str, Move]) -> DatumEquations:
    """Offsets of one datum, by the method for its feature."""
    if datum.feature == "fit":
        if datum.component not in moves:
            raise DatumNotMeasuredError(f"datum {datum.label}: {datum.component!r} could not be measured as a whole")
        return move_equations(datum.label, moves[datum.component], datum.locks)[0]
    if datum.feature in ("hole", "pin", "slot"):
        return _measure_rim(datum, views)
    if datum.feature in ("cylinder", "surface"):
        return _measure_surface(datum, views)
    if datum.feature == "edge":
        return _measure_edge(datum, views)
    if datum.feature == "point":
        return _measure_flat(datum, views)
    return measure_plane_in_photos(datum, views, moves, is_one_enough=True)[0]


def measure_plane_in_photos(
    datum: Datum, views: PhotoViews, moves: Mapping[str, Move], is_one_enough: bool
) -> list[DatumEquations]:
    """Offsets of a plane by its surface and by its edges; with ``is_one_enough`` by edges only if need be.

    The surface of a large face tells more than its edges, and has a form; that of a small one without texture little.

    Raises:
        DatumNotMeasuredError: neither shows it.
    """
    if datum.targets_in_model:
        return [_measure_flat(datum, views)]
    ways: tuple[Callable[[], DatumEquations], ...] = (
        lambda: _measure_flat(datum, views),
        lambda: measure_plane_by_edges(datum, views, moves.get(datum.component)),
    )
    found: list[DatumEquations] = []
    faults: list[DatumNotMeasuredError] = []
    for way in ways:
        try:
            equations = way()
            check_covered(equations)
            found.append(equations)
        except DatumNotMeasuredError as error:
            faults.append(error)
        if found and is_one_enough:
            break
    if not found:
        reason = str(faults[1]).removeprefix(f"datum {datum.label} ({datum.feature}): ")
        raise DatumNotMeasuredError(f"{faults[0]}; nor by its edges: {reason}") from faults[1]
    return found


def _measure_flat(datum: Datum, views: PhotoViews) -> DatumEquations:
    """Offsets of the flat faces of a plane, or of the discs around a point or datum targets, by the sweep."""
    component = views.model.component(datum.component)
    middles = (datum.point_in_model,) if datum.feature == "point" else datum.targets_in_model
    places = [replace(datum, point_in_model=middle) for middle in middles or (datum.point_in_model,)]
    radius_mm = POINT_RADIUS_MM if middles else None
    points = np.concatenate([plane_samples(component, place, SAMPLES, radius_mm) for place in places])
    if not len(points):
        raise InputError(f"datum {datum.label}: {datum.component!r} has no flat face at {list(datum.point_in_model)}")
    points = _clear(points, views, component, datum)
    if not len(points):
        raise DatumNotMeasuredError(
            f"datum {datum.label} ({datum.feature}): none of it is {MIN_CLEAR_MM:g} mm clear of other components"
        )
    normals = np.tile(np.array(datum.direction_in_model), (len(points), 1))
    index = views.model.index(datum.component)
    found = sweep_offsets(points, normals, views, REACH_MM, index)
    ok, seen = found.is_ok, int(np.count_nonzero((found.views >= 0).sum(axis=1) >= MIN_VIEWS))
    variances = found.variances_mm2[ok] + MIN_SIGMA_MM**2
    return surface_equations(
        datum.label, datum.feature, points[ok], normals[ok], found.offsets_mm[ok], variances, seen, locks=datum.locks
    )


def _clear(points: Array, views: PhotoViews, component: Component, datum: Datum) -> Array:
    """The points away from other components and from the borders of the face, as far as there is room."""
    index = views.model.index(datum.component)
    patch_mm = 0.5 * PATCH_PX * views.mm_per_px(points.mean(axis=0))
    for clear_mm in (CLEAR_MM, MIN_CLEAR_MM):
        kept = points[~near_others(points, views.model, index, clear_mm)]
        if len(kept) >= min(100, 0.3 * len(points)):
            break
    if not len(kept):
        return kept
    # A patch leaves the face where a point displaced by half a patch does.
    around = plane_neighbours(kept, np.array(datum.direction_in_model), 0.7 * patch_mm)
    normal, point = np.array(datum.direction_in_model), np.array(datum.point_in_model)
    corners = component.vertices_in_model[component.faces]
    flat = np.abs((corners - point) @ normal).max(axis=1) < 0.05
    first, second = (axis[0] for axis in tangents_of(normal[None]))
    triangles = np.stack([(corners[flat] - point) @ first, (corners[flat] - point) @ second], axis=2)
    places = np.stack([(around - point) @ first, (around - point) @ second], axis=-1)
    whole = inside_triangles(places.reshape(-1, 2), triangles).reshape(places.shape[:2]).all(axis=1)
    return kept[whole] if np.count_nonzero(whole) >= 20 else kept


def _measure_rim(datum: Datum, views: PhotoViews) -> DatumEquations:
    """Steps of brightness across the rim of a hole, pin or slot; its radius is fitted too, and how a slot turns."""
    center = np.array(datum.point_in_model)
    toward = views.centres.mean(axis=0) - center
    rim = find_rim(views.model, datum, toward)
    points, radial, tangents = rim.points(RIM_POINTS)
    seen_from = _rim_views(views, rim, points, radial)
    which, view = np.nonzero(seen_from)
    if len(np.unique(view)) < 3:
        raise DatumNotMeasuredError(
            f"datum {datum.label} ({datum.feature}): fewer than 3 photos show it; photograph it too"
        )
    px_mm = views.mm_per_px(rim.center)

    is_slot = bool(rim.half.any())
    by_shape = np.stack([radial, np.cross(rim.axis, points - rim.center)][: 1 + is_slot], axis=1)[which]

    def edges_at(found: Array) -> tuple[EdgePoints, Array]:
        moved = points[which] + found[:3] + found[3:] @ by_shape
        return EdgePoints(moved, tangents[which], view), rim.center + found[:3]

    def design_of(directions: Array, ok: NDArray[np.bool_]) -> Array:
        return np.concatenate([directions, np.einsum("kx,kux->ku", directions, by_shape[ok])], axis=1)

    steps = _find_steps(datum, views, edges_at, design_of, 4 + is_slot, px_mm)
    inward_mm = 0.5 * BLUR_PX2 * _curvatures(views, points)[which, view][steps.ok] * steps.mm_per_px
    offsets = steps.offsets + inward_mm * np.sign(steps.design[:, 3])
    equations = surface_equations(
        datum.label,
        datum.feature,
        points[which[steps.ok]],
        normals=steps.directions,
        offsets_mm=offsets,
        variances=steps.variances,
        of=len(which),
        by_radius=steps.design[:, 3],
        locks=datum.locks,
    )
    if is_slot:
        return replace(equations, form_mm=RIM_PX * px_mm)
    angles = (np.arange(len(points)) * 2 * np.pi / len(points))[which[steps.ok]]
    shift_mm = rim_shift_mm(steps.design, offsets, steps.variances, angles, RIM_PX * px_mm)
    return replace(equations, form_mm=shift_mm, by_form=waves(steps.design[:, 3], angles))


@dataclass(frozen=True)
class _Steps:
    """Steps of brightness found at K of N edge points.

    Attributes:
        ok: (N,) where a step was found.
        directions: (K,3) unit, across the edge.
        offsets: (K,) from nominal along the directions, mm.
        variances: (K,) mm².
        design: (K,U) derivative of the offsets by the unknowns.
        mm_per_px: (K,) size of a pixel along the directions.
    """

    ok: NDArray[np.bool_]
    directions: Array
    offsets: Array
    variances: Array
    design: Array
    mm_per_px: Array


def _find_steps(
    datum: Datum,
    views: PhotoViews,
    edges_at: Callable[[Array], tuple[EdgePoints, Array]],
    design_of: Callable[[Array, NDArray[np.bool_]], Array],
    unknowns: int,
    px_mm: float,
    rcond: float = 1e-15,
) -> _Steps:
    """Search for steps three times: once over a wide range, then around the place that the previous search gave.

    Args:
        datum: for the message.
        views: the photos.
        edges_at: maps unknowns (U,) to the edge points there and a point inside the feature.
        design_of: maps directions (K,3), and which points they are at, to the derivative (K,U) of the offsets.
        unknowns: U.
        px_mm: size of a pixel.
        rcond: unknowns whose relative information is below this stay at zero.

    Raises:
        InputError: too few steps were found.
    """
    place = np.zeros(unknowns)
    for reach_px in (REACH_MM / px_mm + 2.0, FINE_REACH_PX, FINE_REACH_PX):
        edges, inside = edges_at(place)
        found = edge_offsets(edges, inside, views, reach_px)
        ok = found.seen & (found.slopes != 0.0)
        if np.count_nonzero(ok) < MIN_POINTS:
            raise DatumNotMeasuredError(
                f"datum {datum.label} ({datum.feature}): its edge was found at only {np.count_nonzero(ok)} of"
                f" {len(ok)} places; is it filled, or covered?"
            )
        directions, slope = found.directions[ok], np.abs(found.slopes[ok])
        variances = (0.3 * found.mm_per_px[ok]) ** 2 * (slope + HALF_SLOPE) / slope
        design = design_of(directions, ok)
        offsets = found.offsets_mm[ok] + design @ place
        share, _ = robust_weights(design, offsets, variances)
        weighted = design * (share / variances)[:, None]
        place = np.linalg.pinv(weighted.T @ design, rcond=rcond, hermitian=True) @ (weighted.T @ offsets)
    return _Steps(ok, directions, offsets, variances, design, found.mm_per_px[ok])


def _curvatures(views: PhotoViews, points: Array) -> Array:
    """(N,M) curvature, 1/px, in each photo, of a closed curve through points (N,3)."""
    result = np.zeros((len(points), len(views.cameras)))
    for index, camera in enumerate(views.cameras):
        pixels = camera.project(apply(views.cam_from_model[index], points))
        first = 0.5 * (np.roll(pixels, -1, axis=0) - np.roll(pixels, 1, axis=0))
        second = np.roll(pixels, -1, axis=0) - 2.0 * pixels + np.roll(pixels, 1, axis=0)
        turn = np.abs(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0])
        result[:, index] = turn / np.maximum(np.linalg.norm(first, axis=1), 1e-9) ** 3
    return result


def _rim_views(views: PhotoViews, rim: Rim, points: Array, radial: Array) -> NDArray[np.bool_]:
    """(N,M) which photos show which points of a rim without another edge near them."""
    other = rim.points(RIM_POINTS, other=True)[0]
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
        # At the near side the other rim is hidden behind this one; only a rim that is seen can be mistaken for it.
        shown = _seen_through(rim, other, views.centres[index])
        apart = np.linalg.norm(pixels[:, None] - rivals[None], axis=2)
        apart = np.where(shown[None], apart, np.inf).min(axis=1)
        result[:, index] = visible & (apart > RIVAL_PX)
    return result


def _seen_through(rim: Rim, other: Array, eye: Array) -> NDArray[np.bool_]:
    """(N,) which points of the other rim are seen from a point (3,): for a hole through it, for a pin beside it."""
    toward, height = eye - other, (rim.center - other) @ rim.axis
    at_rim = other + toward * (height / (toward @ rim.axis))[:, None] - rim.center
    off = from_segment(at_rim - (at_rim @ rim.axis)[:, None] * rim.axis, rim.half)
    is_inside = np.linalg.norm(off, axis=1) < rim.radius_mm
    return is_inside if rim.is_hole else ~is_inside


# --- cylinders and edges ---------------------------------------------------------------------------------


def _measure_surface(datum: Datum, views: PhotoViews) -> DatumEquations:
    """Offsets of curved faces by the sweep with curved patches; the radius of a cylinder is fitted."""
    component, index = views.model.component(datum.component), views.model.index(datum.component)
    is_round = datum.feature == "cylinder"
    faces, side = round_faces(component, datum) if is_round else (surface_faces(component, datum), 0.0)
    px_mm = views.mm_per_px(np.array(datum.point_in_model))
    samples = sample_surface(replace(component, faces=component.faces[faces]), 3.0 * px_mm, SAMPLES)
    apart = ~near_others(samples.points, views.model, index, MIN_CLEAR_MM)
    samples = samples.of(apart & ~near_edges(samples.points, component, SWEEP_EDGE_PX * px_mm))
    if len(samples.points) < MIN_SAMPLES:
        raise DatumNotMeasuredError(
            f"datum {datum.label} ({datum.feature}): too little of it is clear of edges and other components"
        )
    found = sweep_offsets(samples.points, samples.normals, views, REACH_MM, index)
    ok, seen = found.is_ok, int(np.count_nonzero((found.views >= 0).sum(axis=1) >= MIN_VIEWS))
    axis = np.array(datum.direction_in_model)
    radial = samples.points - np.array(datum.point_in_model)
    radial = side * (radial - (radial @ axis)[:, None] * axis)
    radial = radial / np.linalg.norm(radial, axis=1, keepdims=True) if is_round else samples.normals
    variances = found.variances_mm2 + MIN_SIGMA_MM**2
    return surface_equations(
        datum.label,
        datum.feature,
        samples.points[ok],
        normals=radial[ok],
        offsets_mm=found.offsets_mm[ok],
        variances=variances[ok],
        of=seen,
        by_radius=np.full(np.count_nonzero(ok), side) if is_round else None,
        locks=datum.locks,
    )


def _measure_edge(datum: Datum, views: PhotoViews) -> DatumEquations:
    """Steps of brightness across a straight edge, in all photos that show it."""
    line = edge_line(views.model.component(datum.component), datum)
    px_mm = views.mm_per_px(0.5 * (line.start + line.end))
    points = line.points(RIM_POINTS, 6.0 * px_mm)
    points = points[~near_others(points, views.model, views.model.index(datum.component), MIN_CLEAR_MM)]
    groups = (points + 0.05 * line.normals.sum(axis=0))[:, None]
    seen = np.zeros((len(points), len(views.cameras)), dtype=bool)
    for index in range(len(views.cameras)):
        toward = views.centres[index] - points.mean(axis=0) if len(points) else np.zeros(3)
        if (line.normals @ toward > 0.1 * np.linalg.norm(toward)).any() and len(points):
            seen[:, index] = views.visible(index, views.window(index, None, np.eye(4), groups[:, 0]), groups)
    which, view = np.nonzero(seen)
    if len(np.unique(view)) < 3:
        raise DatumNotMeasuredError(f"datum {datum.label} (edge): fewer than 3 photos show it; photograph it too")
    project = np.eye(3) - np.outer(line.direction, line.direction)
    inside = 0.5 * (line.start + line.end) - 10.0 * line.normals.sum(axis=0)
    tangents = np.tile(line.direction, (len(which), 1))
    steps = _find_steps(
        datum,
        views,
        lambda shift: (EdgePoints(points[which] + shift, tangents, view), inside),
        lambda directions, _: directions @ project,
        3,
        px_mm,
        rcond=1e-6,
    )
    equations = surface_equations(
        datum.label,
        "edge",
        points[which[steps.ok]],
        normals=steps.directions,
        offsets_mm=steps.offsets,
        variances=steps.variances,
        of=len(which),
        by_radius=None,
        locks=datum.locks,
    )
    return replace(equations, form_mm=DATUM_EDGE_PX * px_mm)
