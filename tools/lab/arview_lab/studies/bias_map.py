"""Spatial bias of a cloud: its mean signed distance to the surface by place, beside the noise of its points."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.cad.part import Part
from arview.errors import InputError
from arview.geometry import Array, apply
from arview.measurement.cloud.mesh_surface import MeshSurface
from arview.measurement.cloud.registration import RegistrationOptions, register_to_surface
from arview.reconstruction.scale.cad import base_names
from arview_lab.chart import Chart, Picture, stack
from arview_lab.studies.cloud_registration import cloud_of_part, true_places
from arview_lab.studies.common import Study

REACH_MM = 2.0
"""Points farther from the surface do not belong to it."""
MIN_POINTS = 8
"""Points that a cell needs."""
MAX_POINTS = 400_000


def bias_study(
    cloud_path: str, part_path: str, truth_path: str | None = None, cell_mm: float = 5.0, is_quick: bool = False,
    seed: int = 0,
) -> Study:  # fmt: skip
    """Average the signed distances of a cloud in cells of the surface, and compare their spread with the noise.

    If points erred independently, cell means would scatter by noise/√n; the rest of their variance is systematic.

    Args:
        cloud_path: cloud in any frame.
        part_path: part or CAD file.
        truth_path: ``truth.json`` of a sample with the true places of the components; None: nominal ones.
        cell_mm: size of the cells.
        is_quick: with a tenth of the points.
        seed: of the choice of points.

    Raises:
        InputError: a file cannot be read, the part is not found, or too few points are near it.
    """
    part, cloud = cloud_of_part(cloud_path, part_path)
    surface, groups = _surface(part, {} if truth_path is None else true_places(truth_path))
    points, normals = np.asarray(cloud.points, dtype=np.float64), np.asarray(cloud.normals, dtype=np.float64)
    count = (MAX_POINTS if not is_quick else MAX_POINTS // 10, len(points))
    few = np.random.default_rng(seed).permutation(len(points))[: min(count)]
    points, normals = points[few], normals[few]
    near = surface.closest(points, 3.0 * REACH_MM).faces >= 0
    if np.count_nonzero(near) < 50 * MIN_POINTS:
        raise InputError(f"{cloud_path}: {np.count_nonzero(near)} points are near the CAD: too few for a map")
    points, normals = points[near], normals[near]
    # The frame is that of the base: a shift of the whole cloud is no bias of its shape.
    is_base = np.isin(groups, [part.model.components.index(part.model.component(n)) for n in base_names(part)])
    options = RegistrationOptions(noise_points=0, first_distance_mm=3.0 * REACH_MM)
    fit = register_to_surface(points, surface, normals=normals, usable_faces=is_base, options=options)
    points = apply(fit.surface_from_points, points)
    closest = surface.closest(points, REACH_MM)
    on = (closest.faces >= 0) & ~closest.is_edge
    on &= (np.sum(normals * np.nan_to_num(closest.normals), axis=1) > 0.5) | ~normals.any(axis=1)
    table, means, sigmas, counts = _cells(
        points[on], closest.distances[on], closest.normals[on], groups[closest.faces[on]], part, cell_mm
    )
    if not len(means):
        raise InputError(f"{cloud_path}: no cell of {cell_mm:g} mm holds {MIN_POINTS} points; give a larger --cell")
    noise = float(np.sqrt(np.average(sigmas**2, weights=counts)))
    by_chance = float(np.sqrt(np.mean(sigmas**2 / counts)))
    spread = float(np.sqrt(np.mean(means**2)))
    systematic = float(np.sqrt(max(spread**2 - by_chance**2, 0.0)))
    summary = (
        f"{int(counts.sum())} points in {len(means)} cells of {cell_mm:g} mm",
        f"noise of a point within its cell: {1e3 * noise:.1f} um",
        f"mean signed error of a cell: rms {1e3 * spread:.1f} um, of which {1e3 * by_chance:.1f} um by chance and "
        f"{1e3 * systematic:.1f} um systematic",
        f"largest: {1e3 * means.min():+.1f} and {1e3 * means.max():+.1f} um",
    )
    columns = ("component", "x_mm", "y_mm", "z_mm", "nx", "ny", "nz", "points", "mean_mm", "std_mm", "chance_mm")
    places = np.array([[row[1], row[2]] for row in table], dtype=np.float64)
    facing = np.array([float(str(row[6])) for row in table]) > 0.5
    chart = Chart("Mean signed error of cells beside their noise", "noise in the cell / mm", "mean error / mm")
    chart.add(sigmas, means, "cells", "points")
    return Study(
        "bias", {"bias": (columns, table)}, stack([_map(places, means, facing, cell_mm), chart.draw()]), summary
    )


def _surface(part: Part, truth: dict[str, Array]) -> tuple[MeshSurface, Array]:
    """The CAD with its components at their true places, and the component of each face."""
    vertices, faces, groups, offset = [], [], [], 0
    for index, component in enumerate(part.model.components):
        at = component.vertices_in_model
        vertices.append(apply(truth[component.name], at) if component.name in truth else at)
        faces.append(component.faces + offset)
        groups.append(np.full(len(component.faces), index))
        offset += len(at)
    of_face = np.concatenate(groups)
    surface = MeshSurface(np.concatenate(vertices), np.concatenate(faces), of_face)
    return surface, of_face


def _cells(
    points: Array, distances: Array, normals: Array, groups: Array, part: Part, cell_mm: float
) -> tuple[list[tuple[object, ...]], Array, Array, Array]:
    """Rows of the table, and mean, standard deviation and number of the distances of each cell."""
    main = np.argmax(np.abs(normals), axis=1)
    side = 2 * main + (np.take_along_axis(normals, main[:, None], axis=1)[:, 0] < 0)
    key = np.column_stack([np.floor(points / cell_mm).astype(np.int64), side, groups.astype(np.int64)])
    _, of_point, counts = np.unique(key, axis=0, return_inverse=True, return_counts=True)
    of_point = of_point.ravel()

    def mean(values: Array) -> Array:
        return np.bincount(of_point, values, len(counts)) / counts

    means = mean(distances)
    sigmas = np.sqrt(mean((distances - means[of_point]) ** 2) * counts / np.maximum(counts - 1, 1))
    at = np.column_stack([mean(points[:, k]) for k in range(3)])
    facing = np.column_stack([mean(normals[:, k]) for k in range(3)])
    index = np.zeros(len(counts), dtype=np.int64)
    index[of_point] = groups
    kept = counts >= MIN_POINTS
    rows: list[tuple[object, ...]] = [
        (
            part.model.components[index[k]].name, *(float(v) for v in at[k]), *(float(v) for v in facing[k]),
            int(counts[k]), float(means[k]), float(sigmas[k]), float(sigmas[k] / np.sqrt(counts[k])),
        )
        for k in np.flatnonzero(kept)
    ]  # fmt: skip
    return rows, means[kept], sigmas[kept], counts[kept].astype(np.float64)


def _map(places: Array, means: Array, facing: NDArray[np.bool_], cell_mm: float) -> Picture:
    """(600,960,3) the cells that face upward, seen from above: blue below the surface, red above it."""
    image = np.full((600, 960, 3), 255, dtype=np.uint8)
    limit = max(float(np.quantile(np.abs(means), 0.95)), 1e-4)
    shown = np.flatnonzero(facing)
    if len(shown):
        low, high = places[shown].min(axis=0), places[shown].max(axis=0)
        scale = float(min(860.0 / max(high[0] - low[0], 1.0), 500.0 / max(high[1] - low[1], 1.0)))
        half = max(1, round(0.5 * cell_mm * scale))
        for k in shown:
            share = float(np.clip(means[k] / limit, -1.0, 1.0))
            pale = round(235 * (1.0 - abs(share)))
            color = (235, pale, pale) if share > 0 else (pale, pale, 235)
            u = round(50 + (places[k, 0] - low[0]) * scale)
            v = round(560 - (places[k, 1] - low[1]) * scale)
            cv2.rectangle(image, (u - half, v - half), (u + half, v + half), color, -1)
    text = f"Mean signed error of cells seen from above: blue -{1e3 * limit:.0f} um, red +{1e3 * limit:.0f} um"
    cv2.putText(image, text, (50, 28), cv2.FONT_HERSHEY_SIMPLEX, 0.6, (40, 40, 40), 1, cv2.LINE_AA)
    return image
