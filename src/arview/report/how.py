"""How it was measured, in words and tables."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any

from arview.cad.part import Part
from arview.inspection import Inspection, MethodResult
from arview.report.words import NONE, determined, number
from arview.version import __version__

LEGEND = (
    "Nominal and measured are the place of the middle of the component's bounding box in the datum frame, deviation is"
    " measured minus nominal (dx, dy, dz). Distance is the length of the deviation and is compared with the tolerance,"
    " which is a radius; position Ø is the diameter of the smallest position tolerance zone that holds the component"
    " (ISO 1101), twice the distance, with the allowed diameter in brackets. U is the expanded uncertainty of the"
    " distance. Tilt is the angle between measured and design axis, twist the turn about that axis. Undetermined: the"
    " measurement does not say; the value is unknown, not zero."
)
_DOF = {
    "rx": "rotation about x",
    "ry": "rotation about y",
    "rz": "rotation about z",
    "tx": "position along x",
    "ty": "position along y",
    "tz": "position along z",
}
_METHODS = {
    "sweep": "sweep: patches of the component's surface are moved along their normals until the photos agree on them",
    "edges": "edges: the edges of the CAD are fitted to those in the photos",
    "cloud": "cloud: the dense cloud is registered to the CAD (for comparison, unless it is the only one)",
}


def in_words(locked: str) -> str:
    """Degrees of freedom like ``rx ry tz`` in words; other texts as they are."""
    parts = locked.split()
    return ", ".join(_DOF[part] for part in parts) if parts and all(part in _DOF for part in parts) else locked


def facts(inspection: Inspection) -> list[tuple[str, str]]:
    """The box at the head of the report."""
    source = inspection.provenance
    tolerances = {c.tolerance_mm for c in inspection.components if c.tolerance_mm is not None}
    largest = max((c.uncertainty_mm for c in inspection.components if c.uncertainty_mm is not None), default=None)
    allowed = " to ".join(number(value) for value in sorted({min(tolerances), max(tolerances)})) if tolerances else ""
    return [
        ("Part", inspection.part),
        ("Serial", inspection.serial or "none"),
        ("Measured", inspection.created.strftime("%Y-%m-%d %H:%M UTC")),
        ("By", f"{source.tool} {source.version}"),
        ("Photos", str(source.photos) if source.photos else "none"),
        ("Tolerance (radius)", f"{allowed} mm" if allowed else "none"),
        ("Largest U", f"{number(largest)} mm" if largest is not None else NONE),
        ("CAD, sha256", f"{inspection.model_hash[:16]}…"),
    ]


def paragraphs(inspection: Inspection) -> list[str]:
    """The measurement in sentences."""
    source, system = inspection.provenance, inspection.datum_system
    options = dict(source.options)
    text = []
    used = [_METHODS[name] for name in options.get("methods", "").split(",") if name in _METHODS]
    if source.photos:
        text.append(
            f"{source.photos} photos were placed relative to each other by their image features (structure from"
            " motion), brought to millimetres and into the frame of the CAD, and each component was measured in them."
        )
    else:
        text.append(f"Method: {source.method}.")
    if used:
        text.append("Ways of measuring: " + "; ".join(used) + ". Sweep and edges are combined by their covariance.")
    if system is not None and system.scale_from:
        scale = f"The scale comes from {system.scale_from}"
        if system.scale_std is not None:
            scale += f"; its relative standard uncertainty is {100.0 * system.scale_std:.3f} %"
        text.append(scale + ".")
    if system is not None and system.datums:
        labels = ", ".join(datum.label for datum in system.datums)
        text.append(
            f"All deviations are stated in the frame of the datums {labels}, in this order; what they leave free is"
            " decided by the best fit of the base."
        )
    if "guard" in options:
        guard = options["guard"]
        text.append(
            f"Decision rule (ISO 14253-1, guard factor {guard}): a component passes when distance + {guard} · U is"
            f" within its tolerance, fails when distance − {guard} · U is not, and is undecided between. The part"
            " passes when every component does and nothing foreign is there."
        )
    return text


def uncertainty(inspection: Inspection) -> str:
    """What U means."""
    options = dict(inspection.provenance.options)
    text = f"U is the expanded uncertainty (k = {options.get('k', '2')}) of the distance from the design place"
    if "probability" in options:
        share = 100.0 * float(options["probability"])
        text += (
            f"; near zero it is as large as makes its interval hold the true distance {share:g} times of 100, as a"
            " distance cannot be negative"
        )
    draws = options.get("monte_carlo", "0")
    if draws.isdigit() and int(draws):
        text += f" (GUM Supplement 1, {int(draws):,} draws)"
    if any(c.details is not None and c.details.budget for c in inspection.components):
        return f"{text}. The budget lists the standard uncertainty of each contribution along the displacement."
    return f"{text}."


def provenance(inspection: Inspection, part: Part | None) -> list[tuple[str, str]]:
    """Everything that identifies the measurement."""
    source = inspection.provenance
    rows = [
        ("measured by", f"{source.tool} {source.version}"),
        ("method", source.method),
        ("CAD, sha256 of the geometry", inspection.model_hash),
        ("photos, hash", source.photos_hash),
        ("CAD file", "" if part is None else part.cad_path.name),
        ("software", ", ".join(f"{name} {version}" for name, version in source.software)),
        ("options", ", ".join(f"{name} = {value}" for name, value in source.options)),
        ("processor time", "" if source.cpu_s is None else f"{source.cpu_s:.0f} s"),
        ("report written by", f"arview {__version__}, {datetime.now(UTC):%Y-%m-%d %H:%M} UTC"),
    ]
    return [(name, value) for name, value in rows if value]


def method_row(method: MethodResult) -> dict[str, Any]:
    """A row of a finding's table of methods."""
    if method.displacement_mm is None:
        remark = f"not measured: {method.reason}" if method.reason else "not measured"
        return {
            "name": method.method,
            "cells": [NONE] * 3,
            "std": NONE,
            "used": NONE,
            "residual": NONE,
            "remark": remark,
        }
    std = method.std_mm or (None, None, None)
    return {
        "name": method.method,
        "cells": [determined(value, signed=True) for value in method.displacement_mm],
        "std": ", ".join(NONE if value is None else number(value) for value in std),
        "used": f"{method.used:,}",
        "residual": number(method.residual_mm),
        "remark": "; ".join(method.notes),
    }
