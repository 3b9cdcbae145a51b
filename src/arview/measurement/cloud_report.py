"""What an aligned cloud shows besides displacements: foreign objects, and its distances to the CAD."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from arview.cad import Model
from arview.core.atomic import write_file
from arview.errors import InputError, OutputError
from arview.geometry import apply, invert
from arview.inspection import ComponentDeviation, DistanceReport, ForeignReport, Verdict
from arview.measurement.cloud.distance_map import (
    DistanceMap,
    distance_map,
    histogram_png,
    map_picture,
    write_distance_ply,
)
from arview.measurement.cloud.foreign_objects import ForeignObject, find_foreign
from arview.measurement.datums.alignment import Alignment
from arview.reconstruction import DenseCloud

MIN_SCATTER = 1e-5
"""Scatter of measured points about each component's surface over the diameter of the part: a thousandth of a millimetre
at 100 mm, less than any scanner leaves, and more than the rounding of files."""


def scatter_doubts(distances: DistanceReport, diameter_mm: float) -> list[str]:
    """A warning where a cloud lies on the CAD without scatter, as points taken from the CAD do; else nothing."""
    sigma_mm = float(np.median([row.sigma_mm for row in distances.statistics[1:] or distances.statistics]))
    if sigma_mm > MIN_SCATTER * diameter_mm:
        return []
    return [
        f"the cloud has no scatter beside the CAD (sigma {sigma_mm:.5f} mm): such points are nominal ones, taken from a"
        " CAD, and not measured; check which columns or which file holds the measured points"
    ]


def inspect_cloud(
    cloud: DenseCloud,
    model: Model,
    alignment: Alignment,
    deviations: Sequence[ComponentDeviation],
    folder: Path | None = None,
) -> tuple[tuple[ForeignReport, ...], DistanceReport | None]:
    """Find foreign objects in a cloud, and compute its distances to the CAD in the datum frame.

    Args:
        cloud: in mm, in the rough frame of ``alignment``.
        model: the nominal CAD.
        alignment: the datum frame.
        deviations: of the components; foreign objects are searched for beside their measured positions.
        folder: where ``distances.ply``, ``map.png`` and a histogram of each component are written; None: nowhere.

    Raises:
        OutputError: the folder cannot be written to.
    """
    datum_from_rough = invert(alignment.rough_from_datum)
    aligned = replace(cloud, points=apply(datum_from_rough, np.asarray(cloud.points, dtype=np.float64)))
    places = {
        d.name: np.array(d.details.measured_from_nominal)
        for d in deviations
        if d.details is not None and d.details.measured_from_nominal is not None
    }
    unknown = [d.name for d in deviations if d.verdict is Verdict.NOT_MEASURED]
    try:
        found = find_foreign(aligned, model, places, unknown)
        distances = distance_map(aligned, model)
    except InputError:  # no point of the cloud is near the part; every component's record says so already
        return (), None
    files = () if folder is None else write_distance_map(distances, model, folder)
    return tuple(_report(one) for one in found), DistanceReport(distances.reach_mm, distances.statistics, files)


def write_distance_map(distances: DistanceMap, model: Model, folder: Path) -> tuple[str, ...]:
    """Write the coloured cloud, its picture and the histograms; their names relative to the folder's parent.

    Raises:
        OutputError: the folder cannot be written to.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{folder}: cannot be created ({error.strerror or error})") from error
    drawn = cv2.imencode(".png", cv2.cvtColor(map_picture(distances), cv2.COLOR_RGB2BGR))[1].tobytes()
    pictures = {"map.png": drawn, "histogram.png": histogram_png(distances, model)}
    for row in distances.statistics[1:]:
        name = "".join(c if c.isalnum() or c in "-_" else "_" for c in row.name)
        pictures[f"histogram_{name}.png"] = histogram_png(distances, model, row.name)
    write_distance_ply(distances, folder / "distances.ply")
    for name, picture in pictures.items():
        write_file(folder / name, picture)
    return tuple(f"{folder.name}/{name}" for name in ("distances.ply", *pictures))


def _report(one: ForeignObject) -> ForeignReport:
    x, y, z = one.center_in_model.tolist()
    a, b, c = one.size_mm.tolist()
    return ForeignReport((x, y, z), (a, b, c), one.area_mm2, one.nearest_component, one.distance_mm, one.describe())
