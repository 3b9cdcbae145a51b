"""CSV with a line for each component, and another with one for each characteristic: RFC 4180, decimal point."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Mapping, Sequence
from typing import Literal

from arview.inspection.details import MEASURANDS
from arview.inspection.fingerprint import fingerprint
from arview.inspection.record import ComponentDeviation, Inspection
from arview.inspection.rounding import decimals_beside_limit, decimals_of, exact, fixed

HEADER = (
    "part",
    "serial",
    "measured_utc",
    "component",
    "verdict",
    "finding",
    "nominal_x_mm",
    "nominal_y_mm",
    "nominal_z_mm",
    "measured_x_mm",
    "measured_y_mm",
    "measured_z_mm",
    "dx_mm",
    "dy_mm",
    "dz_mm",
    "distance_mm",
    "U_mm",
    "k",
    "low_95_mm",
    "high_95_mm",
    "tolerance_mm",
    "position_diameter_mm",
    "tilt_deg",
    "twist_deg",
    "angle_deg",
    "angle_U_deg",
    "angle_tolerance_deg",
    "notes",
    "inspection_sha256",
    "point",
    "decision",
    "decision_reason",
    "decision_by",
    "decision_utc",
)
"""Columns. Cells of undetermined or unmeasured values are empty."""


CHARACTERISTIC_HEADER = (
    "part", "serial", "measured_utc", "characteristic", "kind", "of", "datums", "verdict", "value_mm", "U_mm", "zone",
    "zone_mm", "bonus_mm", "min_mm", "max_mm", "nominal_mm", "reason", "notes", "source", "inspection_sha256",
)  # fmt: skip
"""Columns of the characteristics."""


def to_csv(
    inspection: Inspection,
    sha256: str | None = None,
    decided: Mapping[str, tuple[str, str, str, str]] | None = None,
    of: Literal["components", "characteristics"] = "components",
    decimal: Literal[".", ","] = ".",
) -> str:
    """The inspection as CSV with the columns of `HEADER`, or of `CHARACTERISTIC_HEADER`; lines end with CR LF.

    Measured values are rounded to what their U allows.

    Args:
        inspection: the inspection.
        sha256: fingerprint of the file it was read from; default: that of the inspection.
        decided: decision, reason, name and time of people's decisions about components, by their names.
        of: what there is a line for.
        decimal: with a comma cells are separated by semicolons, as spreadsheets in most of Europe read them.
    """
    sha256 = sha256 or fingerprint(inspection)
    rows: list[Sequence[str]] = [HEADER]
    if of == "characteristics":
        rows = [CHARACTERISTIC_HEADER, *_characteristics(inspection, sha256)]
    else:
        for one in inspection.components:
            person = (decided or {}).get(one.name, ("", "", "", ""))
            rows.append((*_row(inspection, one), sha256, _point(one), *person))
    out = io.StringIO(newline="")
    writer = csv.writer(out, delimiter="," if decimal == "." else ";")
    writer.writerows([[_text(cell, decimal) for cell in row] for row in rows])
    return out.getvalue()


def _characteristics(inspection: Inspection, sha256: str) -> Iterator[list[str]]:
    """Rows of the characteristics."""
    for one in inspection.characteristics:
        yield [
            inspection.part,
            inspection.serial,
            inspection.created.strftime("%Y-%m-%dT%H:%M:%SZ"),
            one.name,
            one.kind,
            ", ".join(one.of),
            " ".join(one.datums),
            one.verdict.value,
            "" if one.value_mm is None else one.value_text.lstrip("S⌀"),
            _rounded(one.uncertainty_mm, decimals_of(one.uncertainty_mm)),
            "" if one.zone_mm is None else one.zone,
            *(_exact(number) for number in (one.zone_mm, one.bonus_mm or None, *one.limits_mm, one.nominal_mm)),
            one.reason,
            "; ".join(one.notes),
            one.source,
            sha256,
        ]


def _row(inspection: Inspection, one: ComponentDeviation) -> list[str]:
    details = one.details
    center = (None, None, None) if details is None else details.center_mm
    moved = [None if a is None or b is None else a + b for a, b in zip(center, one.displacement_mm, strict=True)]
    low, high = (None, None) if details is None or details.interval_mm is None else details.interval_mm
    zone = None if details is None else details.zone_diameter_mm
    if None in one.displacement_mm:
        zone = None  # a displacement along the undetermined axis would enlarge it
    u, tolerance = one.uncertainty_mm, one.tolerance_mm
    decimals = decimals_of(u)
    angle = angle_u = angle_limit = None
    if details is not None:
        angle, angle_u, angle_limit = details.angle_deg, details.angle_uncertainty_deg, details.angle_tolerance_deg
    angle_decimals = decimals_of(angle_u)
    return [
        inspection.part,
        inspection.serial,
        inspection.created.strftime("%Y-%m-%dT%H:%M:%SZ"),
        one.name,
        one.verdict.value,
        "" if one.finding is None else one.finding.value,
        *(_exact(value) for value in center),
        *(_rounded(value, decimals) for value in (*moved, *one.displacement_mm)),
        _rounded(one.distance_mm, decimals_beside_limit(one.distance_mm or 0.0, u, tolerance)),
        _rounded(u, decimals),
        _exact(None if details is None else details.k),
        _rounded(low, decimals),
        _rounded(high, decimals),
        _exact(tolerance),
        _rounded(zone, decimals_beside_limit(zone or 0.0, u, None if tolerance is None else 2.0 * tolerance)),
        _rounded(one.tilt_deg, angle_decimals),
        _rounded(one.twist_deg, angle_decimals),
        _rounded(angle, decimals_beside_limit(angle or 0.0, angle_u, angle_limit)),
        _rounded(angle_u, angle_decimals),
        _exact(angle_limit),
        "" if details is None else "; ".join(details.notes),
    ]


def _point(one: ComponentDeviation) -> str:
    """The point whose position is stated, in words."""
    return MEASURANDS["box_center" if one.details is None else one.details.measurand]


def _rounded(value: float | None, decimals: int) -> str:
    return "" if value is None else fixed(value, decimals)


def _exact(value: float | None) -> str:
    return "" if value is None else exact(value)


def _text(cell: str, decimal: str) -> str:
    """A cell; texts, unlike numbers, that a spreadsheet would read as a formula are prefixed with an apostrophe."""
    if _is_number(cell):
        return cell.replace(".", decimal)
    return f"'{cell}" if cell[:1] in ("=", "+", "-", "@", "\t") else cell


def _is_number(cell: str) -> bool:
    return cell.removeprefix("-").replace(".", "", 1).isdecimal()
