"""An inspection that is written by hand, or from the list of another measurement: valid from the start."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime

import numpy as np

from arview import acceptance, measurement
from arview.cad import Part
from arview.errors import InputError
from arview.inspection import ComponentDeviation, Details, Inspection, Provenance, Verdict
from arview.version import __version__

_NOTHING = (False, False, False, False, False, False)


def new_inspection(
    part: Part, listed: Sequence[acceptance.ListedComponent] = (), serial: str | None = None, label: str = ""
) -> Inspection:
    """An inspection of the part's inspected components, with the values of a list where it has them.

    Components without values are ``not_measured``. Verdicts follow the decision rule of ISO 14253-1 from U of the
    distance and the tolerance of the part file.

    Args:
        part: the part.
        listed: measured components, in the datum frame of the part.
        serial: serial number of the specimen; default: that of the part file.
        label: where the list comes from, for the provenance.

    Raises:
        InputError: a listed component does not exist or has no U.
    """
    names = [name for name in part.inspected if name in {one.name for one in part.model.components}]
    values = {one.name: one for one in listed}
    unknown = sorted(set(values) - set(names))
    if unknown:
        raise InputError(f"{label}: the part has no inspected component {', '.join(map(repr, unknown))}")
    return Inspection(
        part=part.name,
        serial=serial if serial is not None else part.serial or "",
        model_hash=part.model.source_hash,
        created=datetime.now(UTC).replace(microsecond=0),
        components=tuple(_component(part, name, values.get(name), label) for name in names),
        provenance=Provenance(
            "arview inspection new", __version__, f"values from {label}" if listed else "written by hand", ""
        ),
    )


def _component(part: Part, name: str, value: acceptance.ListedComponent | None, label: str) -> ComponentDeviation:
    tolerance_mm = part.component_settings(name).position_tolerance_mm
    measurand = measurement.measurand_of(name, part)
    center, kind = measurand.point_in_model, measurand.kind
    if value is not None and value.point != "part":
        component = part.model.component(name)
        center = component.centroid_in_model if value.point == "mass" else component.bounds_in_model.mean(axis=0)
        kind = ("volume_centroid" if component.is_solid else "area_centroid") if value.point == "mass" else "box_center"
    details = Details((float(center[0]), float(center[1]), float(center[2])), kind)
    moved = np.full(3, np.nan)
    if value is not None:
        moved = value.place - center if np.isnan(value.displacement).all() else value.displacement
    known = ~np.isnan(moved)
    if value is None or not known.any():
        none = (None, None, None)
        return ComponentDeviation(name, none, None, _NOTHING, None, tolerance_mm, Verdict.NOT_MEASURED, details=details)
    if value.uncertainty is None or np.isnan(value.uncertainty[known]).any():
        raise InputError(f"{label}: {name}: has no U; a measured value needs its expanded uncertainty (k = 2)")
    distance = float(np.linalg.norm(moved[known]))
    along = moved[known] / distance if distance > 0.0 else np.full(int(known.sum()), known.sum() ** -0.5)
    uncertainty = float(np.sqrt(((along * value.uncertainty[known]) ** 2).sum()))
    verdict = measurement.decide(distance, uncertainty, tolerance_mm)
    if verdict is Verdict.PASS and not known.all():
        verdict = Verdict.UNDECIDED  # a displacement along the undetermined axis would enlarge the distance
    dx, dy, dz = (float(one) if is_known else None for one, is_known in zip(moved, known, strict=True))
    return ComponentDeviation(
        name,
        (dx, dy, dz),
        distance,
        (False, False, False, bool(known[0]), bool(known[1]), bool(known[2])),
        uncertainty,
        tolerance_mm,
        verdict,
        details=details,
    )
