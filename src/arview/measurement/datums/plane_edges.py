"""A plane without texture, carried by the edges of its faces: holes, steps and borders that lie in it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from arview.cad import Datum
from arview.core.fits import orthogonal_complement
from arview.geometry import Array, exp_so3, log_so3, rigid
from arview.measurement.datums.equations import DatumEquations, DatumNotMeasuredError, move_equations
from arview.measurement.datums.options import REACH_MM
from arview.measurement.photo.component import MeasuredComponent
from arview.measurement.photo.edge_offsets import HALF_SLOPE, edge_offsets
from arview.measurement.photo.edges import MAX_DARK_SHIFT_PX, MIN_POINTS, MIN_SIGMA_PX, ComponentEdges
from arview.measurement.photo.fit import RigidFit, fit_rigid, move_rows
from arview.measurement.photo.patches import tangents_of
from arview.measurement.photo.rival_edges import EdgePoints, rival_offsets_px
from arview.measurement.photo.views import PhotoViews
from arview.measurement.types import Move

FINE_REACH_PX = 3.0
"""Search range around the place that the first search of a rim found."""
DATUM_EDGE_PX = 0.07
"""Standard uncertainty common to straight edges of a datum, by rust, chalk and burrs."""
PLANE_FORM_MM = 0.02
"""Standard uncertainty of a plane beside all other edges of its component, by form."""
RIVAL_PX = 3.0
"""Rim points with the opposite rim this near in a photo are not used there."""


def measure_plane_by_edges(datum: Datum, views: PhotoViews, whole: Move | None = None) -> DatumEquations:
    """Equations of a datum plane from steps of brightness across all edges of the component that lie in it.

    Shift and turn of these edges are fitted in space from all photos at once; only the two rotations and the
    displacement along the normal, which a plane locks, are used. Edges beside which another one runs are left out: in
    thin sheet they may be few. The fit of the whole component tells where its plane is too, but for its form, and is
    combined with them by covariance.

    Args:
        datum: the plane.
        views: the photos.
        whole: measured move of the datum's component, or None.

    Raises:
        DatumNotMeasuredError: too few of its edges are seen, or they do not determine the plane.
    """
    index = views.model.index(datum.component)
    body = MeasuredComponent(views, index, None)
    predicted = ComponentEdges(body).predicted(np.eye(4))
    normal, point = np.array(datum.direction_in_model), np.array(datum.point_in_model)
    lies = np.abs((predicted.points - point) @ normal) < 0.05
    lies &= np.abs(predicted.tangents @ normal) < 0.02
    gaps_px = rival_offsets_px(predicted, views, RIVAL_PX)[lies]
    edges, is_clear = predicted.of(lies), np.hypot(*gaps_px.T) > RIVAL_PX
    directions = plane_directions(normal)
    _check_seen(datum, edges)
    moves = []
    if whole is not None and not _is_open(whole, directions):
        moves = [with_form(whole).at(edges.points.mean(axis=0))]
    try:
        moves.append(_by_own_edges(datum, edges.of(is_clear), views))
    except DatumNotMeasuredError:
        if not moves:
            raise
    move = _combined(moves, directions)
    equations, _ = move_equations(datum.label, move, datum.locks)
    return DatumEquations(
        equations.label,
        "fit",
        equations.rows,
        offsets_mm=equations.offsets_mm,
        variances=equations.variances,
        points=equations.points,
        of=equations.of,
        by_radius=None,
        locks=datum.locks,
        directions=directions,
    )


def with_form(whole: Move) -> Move:
    """The move of a component with the uncertainty that a face of it has by its form."""
    form = np.diag(np.repeat([whole.radius_mm, 1.0], 3) ** -2.0) * PLANE_FORM_MM**2
    return replace(whole, covariance=whole.covariance + form)


def _check_seen(datum: Datum, edges: EdgePoints) -> None:
    """Raise DatumNotMeasuredError unless enough edge points are seen in at least three photos."""
    if len(edges.points) < MIN_POINTS or len(np.unique(edges.view)) < 3:
        raise DatumNotMeasuredError(
            f"datum {datum.label} ({datum.feature}): {len(edges.points)} points of edges in it are seen in"
            f" {len(np.unique(edges.view))} photos"
        )


def _is_open(move: Move, directions: Array) -> bool:
    """Whether a move leaves any of the directions (6,K) undetermined."""
    return bool(len(move.undetermined) and np.linalg.norm(move.undetermined @ directions, axis=1).max() > 0.1)


def _combined(moves: list[Move], directions: Array) -> Move:
    """The mean of moves along the directions (6,3), weighted by covariance; all else is undetermined.

    Where they differ by more than their covariances explain, the covariance is inflated (Birge 1932).
    """
    first, last = moves[0], moves[-1].at(moves[0].center_in_model)
    values = [directions.T @ move.twist for move in (first, last)[: len(moves)]]
    covariances = [directions.T @ move.covariance @ directions for move in (first, last)[: len(moves)]]
    weights = [np.linalg.inv(one) for one in covariances]
    covariance = np.linalg.inv(np.sum(weights, axis=0))
    value = covariance @ np.sum([weight @ one for weight, one in zip(weights, values, strict=True)], axis=0)
    if len(moves) > 1:
        apart = values[0] - values[1]
        squares = float(apart @ np.linalg.solve(covariances[0] + covariances[1], apart)) / len(apart)
        covariance = covariance * max(1.0, squares)
    return replace(
        first,
        method="edges",
        twist=directions @ value,
        covariance=directions @ covariance @ directions.T,
        undetermined=orthogonal_complement(directions.T),
    )


def _by_own_edges(datum: Datum, edges: EdgePoints, views: PhotoViews) -> Move:
    """Motion of a datum plane by the edges in it. Raises DatumNotMeasuredError if they do not determine it."""
    name = f"datum {datum.label} ({datum.feature})"
    _check_seen(datum, edges)
    center = edges.points.mean(axis=0)
    radius_mm = float(np.sqrt(((edges.points - center) ** 2).sum(axis=1).mean()))
    place, fit, dark = np.eye(4), None, np.zeros(6)
    px_mm = views.mm_per_px(center)
    for reach_px in (REACH_MM / px_mm + 2.0, FINE_REACH_PX, FINE_REACH_PX):
        found = _fitted(edges, place, center, radius_mm, views, reach_px, px_mm)
        if found is None:
            raise DatumNotMeasuredError(f"{name}: its edges are not seen where they should be")
        fit, dark = found
        turn, middle = exp_so3(fit.twist[:3]), place[:3, :3] @ center + place[:3, 3]
        place = rigid(turn, middle - turn @ middle + fit.twist[3:]) @ place
    assert fit is not None
    unit = np.array([radius_mm] * 3 + [1.0] * 3)
    project = (np.eye(6) - fit.undetermined.T @ fit.undetermined) / unit[:, None] * unit
    twist = project @ np.concatenate([log_so3(place[:3, :3]), place[:3, :3] @ center + place[:3, 3] - center])
    systematic = np.diag(1.0 / unit**2) * (DATUM_EDGE_PX * px_mm) ** 2
    # Where the face is brighter than all around it, glare moves all its edges alike.
    covariance = fit.covariance + project @ (systematic + np.outer(dark, dark)) @ project.T
    used = int(np.count_nonzero(fit.weights > 0.1))
    move = Move(
        datum.component,
        "edges",
        center,
        twist=twist,
        covariance=covariance,
        undetermined=fit.undetermined,
        radius_mm=radius_mm,
        used=used,
        residual_mm=fit.residual_mm,
        support=1.0,
    )
    if _is_open(move, plane_directions(np.array(datum.direction_in_model))):
        raise DatumNotMeasuredError(f"{name}: the edges in it do not determine its tilt; photograph it from more sides")
    return move


def plane_directions(normal: Array) -> Array:
    """(6,3) the directions that a plane locks: rotations about lines in it, translation along its normal."""
    first, second = (vectors[0] for vectors in tangents_of(normal[None]))
    result = np.zeros((6, 3))
    result[:3, 0], result[:3, 1], result[3:, 2] = first, second, normal
    return result


def _fitted(
    edges: EdgePoints,
    place: Array,
    center: Array,
    radius_mm: float,
    views: PhotoViews,
    reach_px: float,
    px_mm: float,
) -> tuple[RigidFit, Array] | None:
    """Motion of the edges from a place (4,4), and the twist (6,) that a shift of all of them to the dark side makes.

    None if too few steps are found.
    """
    moved = EdgePoints(edges.points @ place[:3, :3].T + place[:3, 3], edges.tangents @ place[:3, :3].T, edges.view)
    middle = place[:3, :3] @ center + place[:3, 3]
    found = edge_offsets(moved, middle, views, reach_px)
    ok = found.seen & (found.slopes != 0.0)
    if np.count_nonzero(ok) < MIN_POINTS:
        return None
    slope = np.abs(found.slopes[ok])
    sigmas = 0.3 * found.mm_per_px[ok] * np.sqrt((slope + HALF_SLOPE) / slope)
    fit = fit_rigid(
        move_rows(moved.points[ok], found.directions[ok], middle),
        found.offsets_mm[ok],
        sigmas,
        free=np.zeros((0, 6)),
        radius_mm=radius_mm,
        undetermined_mm=REACH_MM,
        places=moved.points[ok] / (4.0 * px_mm),
        min_sigma=MIN_SIGMA_PX / 0.3,
        max_pairs=3000,
    )
    return fit, fit.gain @ (np.sign(found.slopes[ok]) * found.mm_per_px[ok]) * (0.5 * MAX_DARK_SHIFT_PX)
