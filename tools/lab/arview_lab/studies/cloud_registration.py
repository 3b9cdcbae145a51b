"""Components of a cloud placed by the classical ICP and by the exact surface, beside the truth if it is known."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from arview.cad import load_part
from arview.cad.part import Part
from arview.errors import InputError
from arview.geometry import Array, apply, invert
from arview.measurement.cloud.deviation import (
    BAND_MM,
    GRID_MM,
    MIN_POINTS,
    CloudComponent,
    cloud_component,
    crop_component,
    measure_components_in_cloud,
)
from arview.measurement.cloud.points import CloudPoints, prepare_cloud
from arview.measurement.folder import in_model_frame, read_cloud
from arview.measurement.types import Move, NotMeasured
from arview.reconstruction.scale.cad import base_names
from arview.reconstruction.types import DenseCloud
from arview_lab.chart import Chart
from arview_lab.cloud.classical_icp import ClassicalIcpOptions, icp_move
from arview_lab.studies.common import Study

WAYS = (
    ("exact surface", None),
    ("point to plane", ClassicalIcpOptions()),
    ("point to point", ClassicalIcpOptions(steps=("point",))),
)
"""Names of the ways, and options of the classical ICP; None is the registration to the exact surface."""


def cloud_registration_study(cloud_path: str, part_path: str, truth_path: str | None = None) -> Study:
    """Displacement of every component relative to the base, by each way on the same points.

    Args:
        cloud_path: cloud in any frame.
        part_path: part or CAD file.
        truth_path: ``truth.json`` of a sample, or None.

    Raises:
        InputError: a file cannot be read, the part is not found, or the base cannot be measured.
    """
    part, cloud = cloud_of_part(cloud_path, part_path)
    truth = {} if truth_path is None else true_places(truth_path)
    base = base_names(part)[0]
    names = [base, *(name for name in part.inspected if name != base)]
    rows: list[tuple[object, ...]] = []
    chart = Chart("Classical ICP and exact surface", "component", "error / mm" if truth else "from exact surface / mm")
    summary = []
    first: dict[str, Array] = {}
    exact = measure_components_in_cloud(cloud, part.model, part, names=names)
    for way, options in WAYS:
        found = exact if options is None else placed_by_icp(exact, cloud, part, options)
        at_base = _base(found, base)
        errors = []
        for one in found:
            if one.component == base:
                continue
            if isinstance(one, NotMeasured):
                rows.append((one.component, way, "", "", "", "", "", one.reason))
                continue
            moved = apply(at_base, apply(one.measured_from_nominal, one.center_in_model)) - one.center_in_model
            first.setdefault(one.component, moved)
            apart = float(np.linalg.norm(moved - first[one.component]))
            error: float | str = ""
            if one.component in truth:
                place = apply(truth[one.component], one.center_in_model) - one.center_in_model
                # Along what the shape leaves free, both are as undetermined.
                free = one.undetermined[:, 3:]
                off = moved - place
                off = off - free.T @ (free @ off)
                error = float(np.linalg.norm(off))
            errors.append(error if isinstance(error, float) else apart)
            rows.append((one.component, way, *(float(v) for v in moved), apart, error, ""))
        if errors:
            chart.add(np.arange(len(errors)), np.array(errors), way, "points")
            what = "error" if truth else "difference from the exact surface"
            summary.append(
                f"{way}: {len(errors)} components, {what} median {1e3 * np.median(errors):.1f} um, "
                f"largest {1e3 * np.max(errors):.1f} um"
            )
    columns = ("component", "way", "dx_mm", "dy_mm", "dz_mm", "from_exact_mm", "error_mm", "note")
    return Study("registration_cloud", {"registration_cloud": (columns, rows)}, chart.draw(), tuple(summary))


def placed_by_icp(
    exact: Sequence[Move | NotMeasured], cloud: DenseCloud, part: Part, options: ClassicalIcpOptions | None = None
) -> list[Move | NotMeasured]:
    """The same components placed by the classical ICP, from the points that the exact surface was given.

    Args:
        exact: results of `measure_components_in_cloud` without photos and with its usual options.
        cloud: that was measured.
        part: the same.
        options: of the classical ICP.
    """
    icp = options or ClassicalIcpOptions()
    box = part.model.bounds_in_model + np.array([[-BAND_MM], [BAND_MM]])
    points = prepare_cloud(cloud, box, GRID_MM, MIN_POINTS)
    with threadpool_limits(1, "blas"):
        return [
            _by_icp(found, cloud_component(found.component, part.model, part, None), points, icp)
            if isinstance(found, Move)
            else found
            for found in exact
        ]


def _by_icp(found: Move, c: CloudComponent, cloud: CloudPoints, options: ClassicalIcpOptions) -> Move | NotMeasured:
    own = crop_component(c, cloud)[1]
    samples, faces = c.surface.sample(max(0.5 * options.grid_mm, 0.2))
    usable = c.usable_faces[faces]
    normals = c.surface.face_normals[faces[usable]]
    try:
        return icp_move(found, own.points, samples[usable], normals, c.component.bounds_in_model, options)
    except InputError as error:
        return NotMeasured(found.component, "cloud", str(error).removeprefix("registration: "))


def cloud_of_part(cloud_path: str, part_path: str) -> tuple[Part, DenseCloud]:
    """A part, and a cloud of it in mm in the rough frame of its CAD. Raises InputError."""
    part = load_part(part_path)
    placed = in_model_frame(read_cloud(cloud_path, part.model), replace(part, datums=()))
    if placed.cloud is None:
        raise InputError(f"{cloud_path}: holds no cloud")
    return part, placed.cloud


def true_places(path: str) -> dict[str, Array]:
    """(4,4) ``measured_from_nominal`` of each component in a sample's ``truth.json``. Raises InputError."""
    try:
        content: Any = json.loads(Path(path).read_text(encoding="utf-8"))
        found = {
            name: np.array(one["measured_from_nominal"], dtype=np.float64)
            for name, one in content["truth"].items()
            if "measured_from_nominal" in one
        }
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: is not the truth.json of a sample ({error})") from error
    if not found or any(one.shape != (4, 4) for one in found.values()):
        raise InputError(f"{path}: holds no true places (measured_from_nominal, 4 × 4)")
    return found


def _base(found: list[Move | NotMeasured], name: str) -> Array:
    """(4,4) nominal_from_measured of the base."""
    for one in found:
        if one.component == name:
            if isinstance(one, NotMeasured):
                raise InputError(f"{name}: could not be measured, so there is no frame: {one.reason}")
            return invert(one.measured_from_nominal)
    raise InputError(f"part: has no component {name!r}")
