"""Datums one by one: those that cannot be measured are named with what could be, and replaced as far as needed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from arview.cad import Component, Datum, DatumFeature, Model, find_rims
from arview.errors import InputError
from arview.inspection import FailedDatum
from arview.measurement.datums.datum_fit import check_covered
from arview.measurement.datums.equations import DatumEquations, DatumNotMeasuredError
from arview.measurement.datums.plane_edges import plane_directions

MeasureDatum = Callable[[Datum], DatumEquations]
"""Measures one datum, or raises InputError."""


TRIED = 4
"""Other features measured for each datum; each takes about a second."""
MIN_FACE_SHARE = 0.05
"""Share of the component's area of a face that can be a datum."""


@dataclass(frozen=True)
class MeasuredDatums:
    """Equations of the datums that could be measured, and the others.

    Attributes:
        equations: in order of precedence; in the place of a plane that failed those of the base's best fit, which lock
            only what the plane would have.
        failed: the datums that could not be measured.
    """

    equations: list[DatumEquations]
    failed: tuple[FailedDatum, ...]


def measure_each(
    datums: Sequence[Datum],
    measure: MeasureDatum,
    model: Model,
    rest: DatumEquations | None,
) -> MeasuredDatums:
    """Measure the datums in their order of precedence; one that fails does not stop the others.

    Args:
        datums: of the part file.
        measure: measures one datum.
        model: the nominal CAD.
        rest: best fit of the base, or None.

    Raises:
        InputError: a datum is not in the CAD.
    """
    equations: list[DatumEquations] = []
    failed: list[FailedDatum] = []

    def checked(datum: Datum) -> DatumEquations:
        found = measure(datum)
        check_covered(found)
        return found

    for datum in datums:
        try:
            equations.append(checked(datum))
        except DatumNotMeasuredError as error:
            reason = str(error).removeprefix(f"datum {datum.label} ({datum.feature}): ")
            instead = _alternatives(datum, model.component(datum.component), checked)
            if rest is not None:
                instead.append(f'best fit of {rest.label} (feature = "fit")')
            directions = ""
            if datum.feature == "plane" and rest is not None:
                # Without it a hole would lock tilts, which a small circle determines poorly.
                equations.append(replace(rest, directions=plane_directions(np.array(datum.direction_in_model))))
                directions = "two rotations and the displacement along its normal"
            failed.append(FailedDatum(datum.label, datum.feature, datum.component, reason, tuple(instead), directions))
    return MeasuredDatums(equations, tuple(failed))


def _alternatives(datum: Datum, component: Component, measure: MeasureDatum) -> list[str]:
    """Other features of a component that could be measured in the place of a datum, as texts."""
    candidates = _other_planes(datum, component) if datum.feature in ("plane", "point") else []
    if datum.feature in ("hole", "pin", "cylinder"):
        candidates = _other_holes(datum, component)
    texts = []
    for candidate in candidates[:TRIED]:
        try:
            measure(candidate)
        except InputError:
            continue
        place = ", ".join(f"{value + 0.0:.4g}" for value in candidate.point_in_model)
        size = f" of ⌀{candidate.diameter_mm:.4g} mm" if candidate.diameter_mm is not None else ""
        texts.append(f"{candidate.feature}{size} at ({place})")
    return texts


def _other_planes(datum: Datum, component: Component) -> list[Datum]:
    """The largest other flat faces of a component, those with the datum's direction first."""
    corners = component.vertices_in_model[component.faces]
    doubled = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.linalg.norm(doubled, axis=1)
    normals = doubled / np.maximum(areas, 1e-300)[:, None]
    heights = np.einsum("nx,nx->n", normals, corners.mean(axis=1))
    keys = np.round(np.concatenate([normals * 500.0, heights[:, None] * 20.0], axis=1))
    groups, owner = np.unique(keys, axis=0, return_inverse=True)
    of_group = np.bincount(owner.ravel(), weights=areas, minlength=len(groups))
    wanted, point = np.array(datum.direction_in_model), np.array(datum.point_in_model)
    found = []
    for group in np.flatnonzero(of_group > MIN_FACE_SHARE * areas.sum()):
        face = np.flatnonzero(owner.ravel() == group)
        normal = doubled[face].sum(axis=0) / np.linalg.norm(doubled[face].sum(axis=0))
        middle = np.average(corners[face].mean(axis=1), axis=0, weights=areas[face])
        if normal @ wanted > 0.999 and abs((middle - point) @ normal) < 0.05:
            continue
        x, y, z = middle.tolist()
        a, b, c = normal.tolist()
        other = Datum("x", "plane", component.name, (x, y, z), (a, b, c))
        found.append((normal @ wanted < 0.999, -of_group[group], other))
    return [one for _, _, one in sorted(found, key=lambda item: item[:2])]


def _other_holes(datum: Datum, component: Component) -> list[Datum]:
    """The other holes or pins of a component about the datum's direction, the nearest first."""
    axis, point = np.array(datum.direction_in_model), np.array(datum.point_in_model)
    feature: DatumFeature = "pin" if datum.feature == "pin" else "hole"
    found: list[tuple[float, Datum]] = []
    for rim in find_rims(component):
        arm = rim.center_in_model - point
        aside = float(np.linalg.norm(arm - axis * (axis @ arm)))
        is_known = any(
            np.linalg.norm(np.cross(np.array(o.point_in_model) - rim.center_in_model, axis)) < 0.1 for _, o in found
        )
        if abs(float(rim.axis_in_model @ axis)) < 0.999 or aside < 0.5 * rim.radius_mm or is_known:
            continue
        x, y, z = rim.center_in_model.tolist()
        one = Datum("x", feature, component.name, (x, y, z), datum.direction_in_model, 2.0 * rim.radius_mm)
        found.append((aside, one))
    return [one for _, one in sorted(found, key=lambda item: item[0])]
