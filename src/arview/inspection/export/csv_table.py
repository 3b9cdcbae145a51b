"""CSV with a line for each component: RFC 4180, decimal point."""

from __future__ import annotations

import csv
import io

from arview.inspection.record import ComponentDeviation, Inspection

HEADER = (
    "part", "serial", "measured_utc", "component", "verdict", "finding",
    "nominal_x_mm", "nominal_y_mm", "nominal_z_mm", "measured_x_mm", "measured_y_mm", "measured_z_mm",
    "dx_mm", "dy_mm", "dz_mm", "distance_mm", "U_mm", "k", "low_95_mm", "high_95_mm", "tolerance_mm",
    "position_diameter_mm", "tilt_deg", "twist_deg", "angle_deg", "angle_U_deg", "angle_tolerance_deg", "notes",
)  # fmt: skip
"""Columns. Cells of undetermined or unmeasured values are empty."""


def to_csv(inspection: Inspection) -> str:
    """The inspection as CSV with the columns of `HEADER`; lines end with CR LF."""
    out = io.StringIO(newline="")
    writer = csv.writer(out)
    writer.writerow(HEADER)
    for component in inspection.components:
        writer.writerow([_text(cell) for cell in _row(inspection, component)])
    return out.getvalue()


def _row(inspection: Inspection, one: ComponentDeviation) -> list[str | float | None]:
    details = one.details
    center = (None, None, None) if details is None else details.center_mm
    moved = [None if a is None or b is None else a + b for a, b in zip(center, one.displacement_mm, strict=True)]
    low, high = (None, None) if details is None or details.interval_mm is None else details.interval_mm
    zone = None if details is None else details.zone_diameter_mm
    if None in one.displacement_mm:
        zone = None  # a displacement along the undetermined axis would enlarge it
    angles: list[float | None] = [None] * 3
    if details is not None:
        angles = [details.angle_deg, details.angle_uncertainty_deg, details.angle_tolerance_deg]
    return [
        inspection.part, inspection.serial, inspection.created.strftime("%Y-%m-%dT%H:%M:%SZ"), one.name,
        one.verdict.value, "" if one.finding is None else one.finding.value, *center, *moved, *one.displacement_mm,
        one.distance_mm, one.uncertainty_mm, None if details is None else details.k, low, high, one.tolerance_mm,
        zone, one.tilt_deg, one.twist_deg, *angles, "" if details is None else "; ".join(details.notes),
    ]  # fmt: skip


def _text(cell: str | float | None) -> str:
    """Numbers with six decimals; texts that a spreadsheet would read as a formula are prefixed with an apostrophe."""
    if cell is None:
        return ""
    if isinstance(cell, str):
        return f"'{cell}" if cell[:1] in ("=", "+", "-", "@", "\t") else cell
    return f"{cell:.6f}"
