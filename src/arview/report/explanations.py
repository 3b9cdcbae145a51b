"""Texts and tables that explain how the part was measured."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any

from arview.cad import Part
from arview.inspection import MEASURANDS, Inspection, MethodResult, decimals_of
from arview.report.formatting import NONE, determined, exact_number, number
from arview.version import __version__

LEGEND = (
    "Nominal and measured are the position in the datum frame of the component's {point}; deviation is measured minus"
    " nominal (dx, dy, dz). Distance is the length of the deviation and is compared with the"
    " tolerance, which is a radius. Position Ø is the diameter of the smallest position tolerance zone that contains"
    " the component (ISO 1101), twice the distance, with the allowed diameter in parentheses. U is the expanded"
    " uncertainty of the distance. Tilt is the angle between measured and design direction of the component's own axis"
    " (of symmetry, or else the normal of the surface on which it stands), twist the rotation about it. Undetermined"
    " means that the measurement cannot determine the value: it is unknown, not zero."
)


def legend_of(inspection: Inspection) -> str:
    """The legend of the table of components, with the points whose positions it states."""
    names: dict[str, list[str]] = {}
    for one in inspection.components:
        kind = "box_center" if one.details is None else one.details.measurand
        names.setdefault(MEASURANDS[kind], []).append(one.name)
    if len(names) <= 1:
        return LEGEND.format(point=next(iter(names), MEASURANDS["volume_centroid"]))
    common, *others = sorted(names, key=lambda point: -len(names[point]))
    rest = "; of ".join(f"{', '.join(names[point])} the {point}" for point in others)
    return LEGEND.format(point=f"{common}, or of {rest}")


_DOF = {
    "rx": "rotation about x",
    "ry": "rotation about y",
    "rz": "rotation about z",
    "tx": "position along x",
    "ty": "position along y",
    "tz": "position along z",
}
_METHODS = {
    "sweep": "sweep: patches of the component's surface are moved along their normals until the photos match",
    "edges": "edges: the edges of the CAD model are fitted to those in the photos",
    "cloud": "cloud: the dense cloud is registered to the CAD model (for comparison, unless it is the only method)",
}


def constraint_text(locked: str) -> str:
    """Degrees of freedom like ``rx ry tz`` as text; other texts are returned unchanged."""
    parts = locked.split()
    return ", ".join(_DOF[part] for part in parts) if parts and all(part in _DOF for part in parts) else locked


def facts(inspection: Inspection) -> list[tuple[str, str]]:
    """Names and values of the summary at the head of the report."""
    source = inspection.provenance
    tolerances = {c.tolerance_mm for c in inspection.components if c.tolerance_mm is not None}
    largest = max((c.uncertainty_mm for c in inspection.components if c.uncertainty_mm is not None), default=None)
    allowed = (
        " to ".join(exact_number(value) for value in sorted({min(tolerances), max(tolerances)})) if tolerances else ""
    )
    return [
        ("Part", inspection.part),
        *([("Drawing", inspection.drawing)] if inspection.drawing else []),
        ("Serial", inspection.serial or "none"),
        ("Measured", inspection.created.strftime("%Y-%m-%d %H:%M UTC")),
        ("By", f"{source.tool} {source.version}"),
        ("Photos", str(source.photos) if source.photos else "none"),
        ("Tolerance (radius)", f"{allowed} mm" if allowed else "none"),
        ("Largest U", f"{number(largest, decimals_of(largest))} mm" if largest is not None else NONE),
        ("CAD, sha256", f"{inspection.model_hash[:16]}…"),
    ]


def paragraphs(inspection: Inspection) -> list[str]:
    """Description of the measurement."""
    source, system = inspection.provenance, inspection.datum_system
    options = dict(source.options)
    text = []
    used = [_METHODS[name] for name in options.get("methods", "").split(",") if name in _METHODS]
    if source.photos:
        text.append(
            f"The poses of {source.photos} photos were determined from image features (structure from motion) and"
            " transformed to millimetres in the frame of the CAD model. Each component was measured in these photos."
        )
    else:
        text.append(f"Method: {source.method}.")
    if used:
        text.append("Measurement methods: " + "; ".join(used) + ". Sweep and edges are combined by their covariances.")
    if system is not None and system.scale_from:
        scale = f"The scale comes from {system.scale_from}"
        if system.scale_std is not None:
            scale += f"; its relative standard uncertainty is {100.0 * system.scale_std:.3f} %"
        text.append(scale + ".")
    if system is not None and system.datums:
        labels = ", ".join(datum.label for datum in system.datums)
        text.append(
            f"All deviations are stated in the frame of the datums {labels}, in this order; remaining degrees of"
            " freedom are determined by the best fit of the base."
        )
    if "guard" in options:
        guard = options["guard"]
        text.append(
            f"Decision rule (ISO 14253-1, guard factor {guard}): a component passes if distance + {guard} · U is within"
            f" its tolerance, fails if distance − {guard} · U exceeds it, and is undecided otherwise. The part passes"
            " if all components pass and there are no foreign objects."
        )
    return text


def uncertainty(inspection: Inspection) -> str:
    """Definition of U."""
    options = dict(inspection.provenance.options)
    text = f"U is the expanded uncertainty (k = {options.get('k', '2')}) of the distance from the design position"
    if "probability" in options:
        share = 100.0 * float(options["probability"])
        text += (
            f"; near zero it is chosen such that its interval contains the true distance with a probability of"
            f" {share:g} %, because a distance cannot be negative"
        )
    draws = options.get("monte_carlo", "0")
    if draws.isdigit() and int(draws):
        text += f" (GUM Supplement 1, {int(draws):,} draws)"
    if any(c.details is not None and c.details.budget for c in inspection.components):
        return f"{text}. The budget lists the standard uncertainty of each contribution along the displacement."
    return f"{text}."


def provenance(inspection: Inspection, part: Part | None) -> list[tuple[str, str]]:
    """Names and values that identify the measurement."""
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
    """A row of the table of methods of a finding."""
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
