"""From the points of a file to a cloud in mm in the rough frame of the CAD: thinning, unit, place, side of normals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from arview.cad import Model
from arview.errors import InputError
from arview.geometry import Array, apply
from arview.measurement.cloud.global_registration import find_model_in_cloud
from arview.measurement.cloud.mesh_surface import MeshSurface
from arview.measurement.cloud.points import CloudPoints, grid_average, join
from arview.measurement.cloud.reading import UNITS_MM, RawPoints
from arview.reconstruction import DenseCloud, Similarity

MAX_POINTS = 2_500_000
"""A larger cloud is averaged on a grid."""
GRID_MM = 0.25
"""Cell of that grid: half the cell on which components are measured."""
CHUNK_POINTS = 4_000_000
"""Points averaged at a time, so that memory does not grow with the cloud."""


def dense_cloud(points: Array, normals: NDArray[np.floating] | None) -> DenseCloud:
    """A cloud without colours, standard deviations and numbers of views."""
    count = len(points)
    normals32 = np.zeros((count, 3), np.float32) if normals is None else np.asarray(normals, dtype=np.float32)
    return DenseCloud(
        np.asarray(points, dtype=np.float64),
        normals32,
        np.zeros((count, 3), np.uint8),
        np.full(count, np.nan, np.float32),
        np.zeros(count, np.uint8),
    )


def cloud_in_mm(raw: RawPoints, unit: str) -> DenseCloud:
    """The points of a file in mm, averaged on a grid if there are very many."""
    factor = UNITS_MM[unit]
    if len(raw) <= MAX_POINTS:
        return dense_cloud((raw.points + raw.origin) * factor, raw.normals)
    parts: list[CloudPoints] = []
    for start in range(0, len(raw), CHUNK_POINTS):
        part = slice(start, start + CHUNK_POINTS)
        points = raw.points[part].astype(np.float64) * factor
        normals = np.zeros_like(points) if raw.normals is None else raw.normals[part].astype(np.float64)
        parts.append(grid_average(CloudPoints(points, normals, np.ones(len(points))), GRID_MM))
    together = grid_average(join(parts), GRID_MM) if len(parts) > 1 else parts[0]
    return dense_cloud(together.points + raw.origin * factor, None if raw.normals is None else together.normals)


def place_cloud(
    cloud: DenseCloud, model: Model, factors: Sequence[float] = (1.0,), takes_first: bool = False
) -> tuple[Similarity, float]:
    """Find the CAD in a cloud whose unit may be one of several.

    Args:
        cloud: in mm, if the first factor is right.
        model: the nominal CAD.
        factors: mm per unit of the cloud that are to be tried, the most likely first.
        takes_first: do not try the others once the part is found.

    Returns:
        the place, with scale 1, and the factor by which the cloud must be multiplied before.

    Raises:
        InputError: the part is found with none of the factors, or with two of them.
    """
    found: list[tuple[Similarity, float]] = []
    failure: InputError | None = None
    for factor in factors:
        try:
            found.append((find_model_in_cloud(scaled(cloud, factor), model), factor))
        except InputError as error:
            failure = failure or error
        if found and takes_first:
            break
    if not found:
        raise failure or InputError("cloud: no unit was given")
    if len(found) > 1:
        raise InputError("cloud: the part is found in it in two units; say which is right with --cloud-unit")
    return found[0]


def scaled(cloud: DenseCloud, factor: float) -> DenseCloud:
    """The cloud multiplied by a factor."""
    if factor == 1.0:
        return cloud
    return replace(cloud, points=cloud.points * factor, sigma=np.asarray(cloud.sigma * factor, dtype=np.float32))


def orient_normals(cloud: DenseCloud, model: Model, reach_mm: float) -> tuple[DenseCloud, str]:
    """Turn the normals of a cloud, in the frame of the CAD, to the outside of the part; and what was done, in words.

    Normals that mostly point inward are turned all; where both signs occur, each follows the nearest surface of the
    CAD.
    """
    if not cloud.normals.any():
        return cloud, ""
    vertices, faces, _ = model.mesh
    surface = MeshSurface(vertices, faces)
    few = np.random.default_rng(0).permutation(len(cloud.points))[:20_000]
    cosines = _cosines(cloud, surface, few, reach_mm)
    cosines = cosines[np.abs(cosines) > 0.7]
    outward = float(np.mean(cosines > 0)) if len(cosines) else 1.0
    if outward > 0.9:
        return cloud, ""
    if outward < 0.1:
        return replace(cloud, normals=-cloud.normals), "the normals of the cloud point inward and were turned"
    normals = cloud.normals.copy()
    low, high = model.bounds_in_model[0] - reach_mm, model.bounds_in_model[1] + reach_mm
    near = np.flatnonzero(np.all((cloud.points > low) & (cloud.points < high), axis=1))
    cosines = _cosines(cloud, surface, near, reach_mm)
    normals[near] *= np.where(np.abs(cosines) > 0.5, np.sign(cosines), 0.0)[:, None].astype(np.float32)
    return replace(cloud, normals=normals), (
        f"{100 * outward:.0f} % of the normals of the cloud point outward: each was turned after the CAD"
    )


def _cosines(cloud: DenseCloud, surface: MeshSurface, chosen: NDArray[np.integer], reach_mm: float) -> Array:
    """Cosines of normals with those of the nearest surface; 0 where there is none within reach."""
    closest = surface.closest(cloud.points[chosen], reach_mm)
    return np.asarray(np.sum(np.nan_to_num(closest.normals) * cloud.normals[chosen], axis=1))


def moved_to_model(cloud: DenseCloud, found: Similarity) -> DenseCloud:
    """The cloud in the frame of the CAD."""
    rotation = found.model_from_scan[:3, :3].astype(np.float32)
    return replace(
        cloud,
        points=apply(found.model_from_scan, cloud.points * found.scale if found.scale != 1.0 else cloud.points),
        normals=cloud.normals @ rotation.T,
        sigma=np.asarray(cloud.sigma * found.scale, dtype=np.float32),
    )


def check_belongs(points: CloudPoints, model: Model, band_mm: float) -> None:
    """Raise InputError when few points are near the CAD, or many more when the cloud is mirrored."""
    vertices, faces, _ = model.mesh
    surface = MeshSurface(vertices, faces)
    few, near = points.points[:: max(1, len(points) // 6000)], 0.2 * band_mm

    def share(trial: Array) -> float:
        distance = surface.closest(trial, near).faces
        return float(np.mean(distance >= 0))

    as_is = share(few)
    center, mirrored = model.center_in_model, 0.0
    for flip in (np.array([-1.0, 1.0, 1.0]), np.array([1.0, -1.0, 1.0])):
        mirrored = max(mirrored, share((few - center) * flip + center))
    if mirrored > as_is + 0.03 and 1.0 - mirrored < 0.5 * (1.0 - as_is):
        raise InputError(
            f"cloud: {100 * mirrored:.0f} % of it lies on the CAD when mirrored, {100 * as_is:.0f} % as it is: the "
            "cloud or the CAD is left-handed"
        )
    if as_is < 0.3:
        raise InputError(
            f"cloud: only {100 * as_is:.0f} % of it is within {near:g} mm of the CAD: it is of another part, has a "
            "wrong scale, or is not aligned"
        )
