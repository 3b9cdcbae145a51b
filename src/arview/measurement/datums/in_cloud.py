"""Datum features measured in a cloud without photos, from the distances of its points to the CAD."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from arview.cad import Datum, Model
from arview.geometry import Array
from arview.measurement.cloud.enlarged import enlargement
from arview.measurement.cloud.mesh_surface import MeshSurface
from arview.measurement.cloud.points import CloudPoints, prepare_cloud
from arview.measurement.datums.cad_features import edge_line, flat_faces, round_faces, surface_faces
from arview.measurement.datums.datum_fit import robust_weights
from arview.measurement.datums.equations import (
    DatumEquations,
    DatumNotMeasuredError,
    move_equations,
    surface_equations,
)
from arview.measurement.datums.options import CLEAR_MM, CORRELATED_POINTS, MIN_CLEAR_MM, POINT_RADIUS_MM, REACH_MM
from arview.measurement.photo.patches import near_others
from arview.measurement.types import Move
from arview.reconstruction import DenseCloud

_GRID_MM = 0.5
"""Cell of the grid on which the cloud is averaged."""
_MIN_CLOUD_POINTS = 20
"""Points near the part that a cloud needs at all."""
_MAX_POINTS = 1500
"""Points of a feature that are used; errors of denser points are correlated."""
_MIN_POINTS = 12
"""Points that a feature needs."""
_EDGE_BAND_MM = (2.0, 15.0)
"""Distances from an edge between which its faces are used: beyond the rounding, but not as far as their other end."""


def measure_datums_in_cloud(
    datums: tuple[Datum, ...],
    model: Model,
    cloud: DenseCloud,
    moves: Mapping[str, Move],
) -> list[DatumEquations]:
    """Measure the offsets of each datum feature in a cloud.

    Args:
        datums: of the part file, in order of precedence.
        model: the nominal CAD.
        cloud: of the part, in mm, within about a millimetre of the frame of the CAD.
        moves: best fits of components, for datums with the feature ``fit``.

    Raises:
        InputError: the CAD has no such feature, or the cloud does not cover it; the message names the datum.
    """
    if not datums:
        return []
    points = points_for_datums(model, cloud)
    return [measure_datum_in_cloud(datum, model, points, moves) for datum in datums]


def points_for_datums(model: Model, cloud: DenseCloud) -> CloudPoints:
    """The points of a cloud near the part, averaged on the grid in which datums and features are measured.

    Raises:
        InputError: too few points of the cloud are near the part.
    """
    grid_mm = _GRID_MM / enlargement(model)
    return prepare_cloud(cloud, model.bounds_in_model + np.array([[-5.0], [5.0]]), grid_mm, _MIN_CLOUD_POINTS)


def measure_datum_in_cloud(datum: Datum, model: Model, cloud: CloudPoints, moves: Mapping[str, Move]) -> DatumEquations:
    """Offsets of one datum, by the method for its feature; errors as `measure_datums_in_cloud`."""
    if datum.feature == "fit":
        if datum.component not in moves:
            raise DatumNotMeasuredError(f"datum {datum.label}: {datum.component!r} could not be measured as a whole")
        return move_equations(datum.label, moves[datum.component], datum.locks)[0]
    component = model.component(datum.component)
    if datum.feature == "edge":
        return _measure_edge(datum, model, cloud)
    is_round = datum.feature in ("hole", "pin", "cylinder", "slot")
    find_faces = surface_faces if datum.feature == "surface" else flat_faces
    faces, side = round_faces(component, datum) if is_round else (find_faces(component, datum), 0.0)
    near, offsets, normals = _offsets(datum, model, cloud, faces)
    _check(datum, len(offsets))
    if datum.feature in ("hole", "pin", "slot"):  # a short bore does not determine the tilt of its axis
        axis = np.array(datum.direction_in_model)
        normals = normals - (normals @ axis)[:, None] * axis
    radius = np.full(len(offsets), side) if is_round else None
    variances = near.sigma**2
    equations = surface_equations(
        datum.label,
        datum.feature,
        near.points,
        normals=normals,
        offsets_mm=offsets,
        variances=variances,
        of=None,
        by_radius=radius,
        locks=datum.locks,
    )
    if radius is None:
        return equations
    # Bores in clouds from photos are rounded and partly filled: the centre may be off as far as the points are off the
    # circle.
    _, residuals = robust_weights(np.concatenate([normals, radius[:, None]], axis=1), offsets, variances)
    excess = float(np.mean(residuals**2) - np.median(variances))
    return replace(equations, form_mm=float(np.sqrt(max(0.0, excess))))


def _offsets(
    datum: Datum, model: Model, cloud: CloudPoints, faces: NDArray[np.bool_]
) -> tuple[CloudPoints, Array, Array]:
    """Points near some faces of the datum's component, their signed distances, and the faces' normals there."""
    component = model.component(datum.component)
    surface = MeshSurface(component.vertices_in_model, component.faces)
    small = 1.0 / enlargement(model)
    reach_mm = small * REACH_MM
    low, high = component.bounds_in_model[0] - reach_mm, component.bounds_in_model[1] + reach_mm
    near = cloud.only(np.all((cloud.points > low) & (cloud.points < high), axis=1))
    closest = surface.closest(near.points, reach_mm)
    mine = (closest.faces >= 0) & ~closest.is_edge
    mine[mine] &= faces[closest.faces[mine]]
    facing = np.sum(near.normals * np.nan_to_num(closest.normals), axis=1)
    mine &= (facing > 0.5) | ~near.normals.any(axis=1)
    middles = (datum.point_in_model,) if datum.feature == "point" else datum.targets_in_model
    if middles:
        apart = np.linalg.norm(near.points[:, None] - np.array(middles), axis=2).min(axis=1)
        mine &= apart < small * POINT_RADIUS_MM
    chosen, index = np.flatnonzero(mine), model.index(datum.component)
    for clear_mm in (small * CLEAR_MM, small * MIN_CLEAR_MM):
        clear = chosen[~near_others(near.points[chosen], model, index, clear_mm)] if len(chosen) else chosen
        if len(clear) >= min(300, 0.3 * len(chosen)):
            break
    if len(clear) > _MAX_POINTS:
        clear = np.sort(np.random.default_rng(0).permutation(clear)[:_MAX_POINTS])
    return near.only(clear), closest.distances[clear], closest.normals[clear]


def _measure_edge(datum: Datum, model: Model, cloud: CloudPoints) -> DatumEquations:
    """The line in which planes through both faces of an edge meet: each plane's offset at two places along the edge."""
    line = edge_line(model.component(datum.component), datum)
    ends = line.points(2, 0.25 * float(np.linalg.norm(line.end - line.start)))
    parts: list[tuple[Array, Array, Array]] = []
    for normal in line.normals:
        x, y, z = (float(v) for v in normal)
        face = Datum(datum.label, "plane", datum.component, datum.point_in_model, (x, y, z))
        near, offsets, _ = _offsets(datum, model, cloud, flat_faces(model.component(datum.component), face))
        from_line = near.points - line.start
        across = from_line @ np.cross(normal, line.direction)
        from_edge = np.abs(across) * enlargement(model)
        band = (from_edge > _EDGE_BAND_MM[0]) & (from_edge < _EDGE_BAND_MM[1])
        _check(datum, int(np.count_nonzero(band)))
        along, across = (from_line @ line.direction)[band], across[band]
        design = np.stack([np.ones_like(along), along, across], axis=1)
        variances = near.sigma[band] ** 2
        share, residuals = robust_weights(design, offsets[band], variances)
        solver = (
            np.linalg.pinv((design * (share / variances)[:, None]).T @ design)
            @ (design * (share / variances)[:, None]).T
        )
        at = np.stack([np.ones(2), (ends - line.start) @ line.direction, np.zeros(2)], axis=1)
        factor = max(1.0, float((share * residuals**2 / variances).sum() / max(1.0, share.sum() - 3.0)))
        # Errors of neighbouring points are correlated over some millimetres.
        # They count as one in ten points of the grid.
        spread = CORRELATED_POINTS * factor * np.sum((at @ solver) ** 2 * variances, axis=1)
        parts.append((at @ (solver @ offsets[band]), spread, np.tile(normal, (2, 1))))
    offsets, variances, normals = (np.concatenate(column) for column in zip(*parts, strict=True))
    return surface_equations(
        datum.label,
        "edge",
        np.tile(ends, (2, 1)),
        normals=normals,
        offsets_mm=offsets,
        variances=variances,
        of=None,
        by_radius=None,
        locks=datum.locks,
    )


def _check(datum: Datum, count: int) -> None:
    """Raise InputError when too few points of the cloud are on a datum."""
    if count < _MIN_POINTS:
        raise DatumNotMeasuredError(
            f"datum {datum.label} ({datum.feature}): {count} points of the cloud are on it, {_MIN_POINTS} are needed;"
            " uncover it, or name another feature in the part file"
        )
