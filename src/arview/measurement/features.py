"""Features as measurands: where each stands relative to the datum frame, and how wide a round one is.

A feature is measured as a datum is (`measurement.datums`). Its offsets are solved for its own small motion, along all
that they determine, and for the change of its radius. The derivative of this solution by the offsets carries their
noise, and the errors of the camera poses, so that features measured in the same photos share theirs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from arview.cad import Component, Datum, DatumFeature
from arview.core.fits import orthogonal_complement, robust_sigma
from arview.geometry import Array
from arview.measurement.datums.alignment import FORM_MM, Alignment, contribution
from arview.measurement.datums.cad_features import edge_line, flat_faces, round_faces, slot_edges, surface_faces
from arview.measurement.datums.datum_fit import check_fit_covered, fit_datum
from arview.measurement.datums.directions import observable_directions, shift_origin
from arview.measurement.datums.equations import DatumEquations, DatumNotMeasuredError, point_from_move
from arview.measurement.datums.options import CORRELATED_POINTS, REACH_MM
from arview.measurement.types import Method, Move
from arview.measurement.uncertainty.combine import CombinedMove, combine
from arview.measurement.uncertainty.pose_propagation import PosePropagation

METHODS: tuple[Method, ...] = ("sweep", "edges")
"""By which the offsets of a flat face may be measured: on its surface, and along its border."""
STATE = 7
"""Numbers of a feature's state: twist about its centre in model axes (rad, mm), and the change of its radius, mm."""
CELLS = 5
"""Cells along each side of a flat face of whose points the means are its form."""
CURVED_CELLS = 3
"""The same for a curved surface, along each side of its box; they are divided further by the signs of the normal."""
MIN_CELL_POINTS = 4
"""Points of a cell below which its mean says nothing."""
MAX_MOVE_MM = 2.0 * REACH_MM
"""Displacement of any part of a feature beyond which it was matched wrongly: it is searched for within half of that."""
CLEAR_SHARE = 0.1
"""Share of what a curved surface tells best of its motion below which it is taken to tell nothing."""
MIN_SPAN = 0.5
"""Share of a face's length and width over which it must be measured: a strip in a gap is matched wrongly."""
RADIUS_PX = 0.02
"""Standard uncertainty of a radius by where along the step of brightness the edge is taken to be, px of the photos."""


@dataclass(frozen=True)
class SurfaceForm:
    """Deviation of a face or surface from its CAD at its own best place.

    Attributes:
        points: (B,3) middles of its cells, mm.
        normals: (B,3) unit.
        offsets_mm: (B,) along them.
        variances: (B,) mm².
    """

    points: Array
    normals: Array
    offsets_mm: Array
    variances: Array


@dataclass(frozen=True)
class MeasuredFeature:
    """A feature relative to its nominal place in the rough frame.

    Attributes:
        name: of the feature.
        feature: its kind; ``fit`` is a whole component.
        center: (3,) nominal point about which it turns, mm.
        axis: (3,) its nominal axis or normal.
        places: (V,3) nominal points between which it extends.
        radius_mm: nominal; 0 for what is not round.
        state: (7,) see `STATE`; zero along ``undetermined``.
        covariance: (7,7) of its own noise and form.
        undetermined: (K,7) states of about a millimetre that the data leave free.
        by_poses: (7,P) derivative by the camera poses.
        form: of a face or surface, where it was measured.
        note: what its measurement takes for granted, or empty.
    """

    name: str
    feature: DatumFeature
    center: Array
    axis: Array
    places: Array
    radius_mm: float
    state: Array
    covariance: Array
    undetermined: Array
    by_poses: Array
    form: SurfaceForm | None = None
    note: str = ""


def feature_of(
    datum: Datum, component: Component, ways: Sequence[DatumEquations], poses: PosePropagation | None, px_mm: float
) -> MeasuredFeature:
    """A feature from its measured offsets.

    Args:
        datum: the feature as the part file has it.
        component: that carries it.
        ways: its offsets by one or two independent methods, whose results are combined.
        poses: for the errors of the camera poses; None leaves them out.
        px_mm: size of a pixel of the photos there; 0 without photos.

    Raises:
        DatumNotMeasuredError: too little of it was found.
    """
    axis, point = np.array(datum.direction_in_model), np.array(datum.point_in_model)
    ways = [one for one in ways if len(one.points)]
    if not ways:
        raise DatumNotMeasuredError(f"datum {datum.label} ({datum.feature}): none of it was seen")
    middle = ways[0].points.mean(axis=0)
    places = _places(datum, component)
    # A rim is centred on its axis, at the end that is seen; a face or an edge in its own middle.
    center = (
        places.mean(axis=0)
        if datum.feature in ("plane", "edge", "surface")
        else point + axis * (axis @ (middle - point))
    )
    if datum.feature == "slot":  # its tilt is not measured: it is stated where it was seen
        places = places - np.outer((places - center) @ axis, axis)
    reach_mm = max(1.0, float(np.sqrt(np.mean(np.sum((ways[0].points - center) ** 2, axis=1)))))
    found: list[MeasuredFeature] = []
    faults: list[DatumNotMeasuredError] = []
    for one in ways:
        try:
            found.append(_solved(datum, one, poses, px_mm, center, places=places, reach_mm=reach_mm))
        except DatumNotMeasuredError as error:
            faults.append(error)
    if not found:
        raise faults[0]
    if len(found) == 1:
        return found[0]
    moves = [
        Move(
            datum.component,
            method,
            center,
            twist=feature.state[:6],
            covariance=feature.covariance[:6, :6],
            undetermined=feature.undetermined[:, :6] / _unit(reach_mm),
            radius_mm=reach_mm,
            used=0,
            residual_mm=0.0,
            support=1.0,
        )
        for feature, method in zip(found, METHODS, strict=False)
    ]
    both = component_feature(component, center, axis, combine(moves), None)
    by_poses = np.mean([feature.by_poses for feature in found], axis=0)
    return replace(
        found[0], state=both.state, covariance=both.covariance, undetermined=both.undetermined, by_poses=by_poses
    )


def _unit(reach_mm: float) -> Array:
    """(6,) what makes rotations of a twist of displacements at a distance."""
    return np.array([1.0 / reach_mm] * 3 + [1.0] * 3)


def _solved(
    datum: Datum,
    one: DatumEquations,
    poses: PosePropagation | None,
    px_mm: float,
    center: Array,
    places: Array,
    reach_mm: float,
) -> MeasuredFeature:
    """A feature from its offsets by one method, as `feature_of` has it; it turns about ``center`` (3,)."""
    fit = fit_datum(one, False)
    check_fit_covered(one, fit)
    axis = np.array(datum.direction_in_model)
    rows = one.rows[:, :6] - one.rows[:, 3:6] @ shift_origin(center)[:, :6]
    unit = _unit(reach_mm)
    allowed = np.eye(6)[:, 3:] if datum.feature in ("hole", "pin", "slot", "point") else np.eye(6)
    if datum.feature == "slot":
        allowed = np.concatenate([allowed, np.concatenate([axis, np.zeros(3)])[:, None]], axis=1)
    # The equations of a whole move are its principal directions, of which some are far more certain.
    trusted = np.ones(len(rows)) if one.feature == "fit" else fit.weights
    columns = observable_directions(rows * unit, allowed, trusted)
    is_curved = datum.feature == "surface"
    if is_curved:
        # What its shape hardly tells stays in its form: facets would seem to tell how a cylinder turns about its axis.
        _, values, right = np.linalg.svd(rows * unit @ columns, full_matrices=False)
        columns = columns @ right[values > CLEAR_SHARE * values[0]].T
    design = rows @ (columns * unit[:, None])
    if one.by_radius is not None:
        design = np.concatenate([design, one.by_radius[:, None]], axis=1)
    weighted = design * (fit.weights / fit.weights.max())[:, None]
    solution = np.linalg.pinv(weighted.T @ design, rcond=1e-12, hermitian=True) @ weighted.T
    count = columns.shape[1]
    gain = np.zeros((STATE, len(rows)))
    gain[:6] = (columns * unit[:, None]) @ solution[:count]
    if one.by_radius is not None:
        gain[6] = solution[count]
    # The noise of a curved surface is that of its cells, which hold what the motion leaves.
    covariance = np.zeros((STATE, STATE)) if is_curved else contribution(gain, one, fit)
    if one.by_radius is not None:
        covariance[6, 6] += (RADIUS_PX * px_mm) ** 2 + FORM_MM**2
    state = gain @ one.offsets_mm
    across = point_from_move(places - center)[:, :, :6] @ state[:6]
    in_plane = orthogonal_complement(axis[None]).T
    spans, extents = np.ptp(one.points[fit.inliers] @ in_plane, axis=0), np.ptp(places @ in_plane, axis=0)
    is_strip = one.feature == "plane" and bool((spans < MIN_SPAN * extents).any())
    if is_strip or np.linalg.norm(across, axis=1).max() > MAX_MOVE_MM:
        raise DatumNotMeasuredError(
            f"datum {datum.label} ({datum.feature}): what was seen of it does not tell where all of it is"
        )
    free = np.zeros((0, 6)) if is_curved else orthogonal_complement(columns.T) * unit
    return MeasuredFeature(
        datum.label,
        datum.feature,
        center,
        axis,
        places,
        radius_mm=0.5 * (datum.diameter_mm or 0.0),
        state=state,
        covariance=covariance,
        undetermined=np.concatenate([free, np.zeros((len(free), 1))], axis=1),
        by_poses=np.zeros((STATE, 0)) if poses is None else gain @ poses.offsets(one),
        form=_form(one, one.offsets_mm - design @ solution @ one.offsets_mm, axis)
        if one.feature in ("plane", "surface")
        else None,
    )


def component_feature(
    component: Component, point: Array, axis: Array, together: CombinedMove, poses: PosePropagation | None
) -> MeasuredFeature:
    """A whole component as a feature, at its stated point (3,)."""
    move = together.at(point)
    covariance, state = np.zeros((STATE, STATE)), np.zeros(STATE)
    covariance[:6, :6] = np.sum([*move.covariances.values(), move.disagreement], axis=0)
    state[:6] = move.twist
    free = move.undetermined / np.array([move.radius_mm] * 3 + [1.0] * 3)
    by_poses = np.zeros((STATE, 0))
    if poses is not None:
        by_poses = np.concatenate([twist := poses.twist(component, point), np.zeros((1, twist.shape[1]))])
    along = (component.vertices_in_model - point) @ axis
    places = point + np.outer([along.min(), along.max()], axis)
    return MeasuredFeature(
        component.name,
        "fit",
        point,
        axis,
        places,
        radius_mm=0.0,
        state=state,
        covariance=covariance,
        undetermined=np.concatenate([free, np.zeros((len(free), 1))], axis=1),
        by_poses=by_poses,
    )


def joint_state(
    features: Sequence[MeasuredFeature], alignment: Alignment, poses: PosePropagation | None
) -> tuple[Array, Array]:
    """State (7F,) of some features in the datum frame and its covariance (7F,7F), with errors that they share."""
    frames = []
    for one in features:
        by_scale = np.zeros((1, 7))
        by_scale[0, 6] = one.radius_mm
        frames.append(np.concatenate([alignment.twist_from_move(one.center), by_scale]))
    frame = np.concatenate(frames)
    state = np.concatenate([one.state for one in features]) - frame @ alignment.move
    covariance = frame @ alignment.covariance @ frame.T
    for index, one in enumerate(features):
        own = slice(STATE * index, STATE * (index + 1))
        covariance[own, own] += one.covariance
    if poses is not None:
        by_poses = np.concatenate([one.by_poses for one in features]) - frame @ poses.frame
        covariance = covariance + by_poses @ poses.covariance @ by_poses.T
    return state, covariance


def _places(datum: Datum, component: Component) -> Array:
    """(V,3) points between which a feature extends: corners of a face, ends of an axis or edge."""
    if datum.feature in ("plane", "surface"):
        find_faces = flat_faces if datum.feature == "plane" else surface_faces
        return component.vertices_in_model[np.unique(component.faces[find_faces(component, datum)])]
    if datum.feature == "edge":
        line = edge_line(component, datum)
        return np.stack([line.start, line.end])
    center = np.array(datum.point_in_model)
    if datum.feature == "slot":
        _, middle, half = slot_edges(component, datum)[-1]
        return np.stack([middle - half, middle + half])
    if datum.feature == "cylinder":
        vertices = component.vertices_in_model[np.unique(component.faces[round_faces(component, datum)[0]])]
        along = (vertices - center) @ np.array(datum.direction_in_model)
        return center + np.outer([along.min(), along.max()], datum.direction_in_model)
    # A rim or a point shows nothing of its tilt; the second place lets an orientation ask for it.
    return center + np.outer([0.0, datum.diameter_mm or 1.0], datum.direction_in_model)


def _form(one: DatumEquations, residuals: Array, normal: Array) -> SurfaceForm | None:
    """Means of the residuals (N,) of a face over cells of its surface; None where there are too few for a form.

    Outliers of the fit count where they are most of a cell: a dent is no error of measurement.
    """
    if one.feature == "plane":
        normals = np.tile(normal, (len(residuals), 1))
        cells = _cells(one.points @ orthogonal_complement(normal[None]).T, CELLS)
    else:
        normals = one.rows[:, 3:6]
        cells = np.concatenate([_cells(one.points, CURVED_CELLS), (normals > 0.0).astype(int)], axis=1)
    _, keys = np.unique(cells, axis=0, return_inverse=True)
    groups = [keys.ravel() == key for key in range(keys.max() + 1)]
    middle = np.sum([np.where(of, np.median(residuals[of]), 0.0) for of in groups], axis=0)
    sigma_mm = robust_sigma(residuals - middle)
    groups = [of & (np.abs(residuals - middle) <= 3.0 * sigma_mm) for of in groups]
    kept: list[NDArray[np.bool_]] = [of for of in groups if np.count_nonzero(of) >= MIN_CELL_POINTS]
    if len(kept) < CELLS:
        return None
    weights = 1.0 / one.variances
    means = np.array([np.average(residuals[of], weights=weights[of]) for of in kept])
    variances = np.array([sigma_mm**2 / max(1.0, np.count_nonzero(of) / CORRELATED_POINTS) for of in kept])
    middles = np.stack([np.average(one.points[of], axis=0, weights=weights[of]) for of in kept])
    along = np.stack([np.average(normals[of], axis=0, weights=weights[of]) for of in kept])
    return SurfaceForm(middles, along / np.linalg.norm(along, axis=1, keepdims=True), means, variances)


def _cells(places: Array, count: int) -> NDArray[np.int64]:
    """(N,D) which of ``count`` cells along each axis of their box some places (N,D) are in."""
    low, size = places.min(axis=0), np.maximum(np.ptp(places, axis=0), 1e-9)
    return np.asarray(np.minimum(count * (places - low) / size, count - 1), dtype=np.int64)
