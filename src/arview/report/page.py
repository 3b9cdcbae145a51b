"""The page of a report: the context of its template, and rendering."""

from __future__ import annotations

import base64
import hashlib
import io
from collections.abc import Sequence
from datetime import UTC, datetime
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from arview import measurement, overlay, reconstruction
from arview.core.progress import Progress
from arview.errors import InputError
from arview.geometry import Array
from arview.inspection import (
    ComponentDeviation,
    Details,
    Inspection,
    Verdict,
    decimals_of,
    overall_verdict,
    verdict_sentence,
)
from arview.report import charts, explanations
from arview.report.characteristics import by_excess, characteristic_row
from arview.report.decisions import decisions_context
from arview.report.evidence import ReportEvidence
from arview.report.formatting import (
    NONE,
    VERDICT_WORD,
    determined,
    distance_digits,
    exact_number,
    finding_text,
    foreign_text,
    number,
    short_text,
    verdict_word,
    zone_text,
)
from arview.report.halves import repeatability_context
from arview.report.pictures import Crop, Gallery, RgbImage, make_gallery, overview
from arview.report.rework import rework_context
from arview.report.scene import make_scene, scene_json
from arview.version import __version__

_FONTS = (("Inter", "400", "inter-400"), ("Inter", "600", "inter-600"), ('"Inter Greek"', "400", "inter-greek-400"))
_GRADIENT = ", ".join(f"rgb({r:.0f} {g:.0f} {b:.0f})" for r, g, b in measurement.COLOR_STOPS)
_PRINT_SCRIPT = (
    'addEventListener("beforeprint", () => document.querySelectorAll("details").forEach((d) => { d.open = true; }));'
)
_EXAGGERATIONS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)


JPEG_QUALITY = 84
"""Quality of the pictures, without visible artefacts at the size of the page."""
MAP_LIMIT_MM = 1.0
"""End of the colour scale of the distance map."""


def build_context(evidence: ReportEvidence, progress: Progress) -> dict[str, Any]:
    """The context of the template, for screen and print."""
    inspection, part, sparse = evidence.inspection, evidence.part, evidence.sparse
    model = None if part is None else part.model
    gallery = Gallery({}, (), ())
    if model is not None and sparse is not None:
        gallery = make_gallery(inspection, model, sparse, lambda done, total: progress("pictures", done, total))
    progress("charts", 0, 1)
    whole = overall_verdict(inspection)
    title = f"{inspection.part} {inspection.serial}".strip()
    context: dict[str, Any] = {
        "version": __version__,
        "written": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "title": f"Inspection report: {title}",
        "running": f"Inspection report · {title} · {_moment(inspection)}",
        "part": inspection.part,
        "drawing": inspection.drawing,
        "measured": _moment(inspection),
        "serial": inspection.serial,
        "sha256": evidence.sha256,
        "source_name": evidence.source.name,
        "inspection_base64": base64.b64encode(evidence.source.read_bytes()).decode("ascii"),
        "verdict": {"verdict": whole.value, "word": VERDICT_WORD[whole], "sentence": verdict_sentence(inspection)},
        "facts": explanations.facts(inspection),
        "note": inspection.provenance.note,
        "warnings": inspection.warnings,
        "absences": evidence.absent,
        "unread": gallery.unread,
        "how": explanations.paragraphs(inspection),
        "provenance": explanations.provenance(inspection, evidence.part),
        "uncertainty_lead": explanations.uncertainty(inspection),
    }
    context |= _components(evidence) | _findings(evidence, gallery)
    context["characteristics"] = [characteristic_row(one) for one in by_excess(inspection)]
    for row in context["characteristics"]:
        if row["name"] in gallery.characteristics:
            row["crop"] = _crop(gallery.characteristics[row["name"]], "ring: its nominal place")
    context["numbered"] = [characteristic_row(one) for one in inspection.characteristics]
    context |= _distance_map(evidence) | _budget(inspection) | _datums(inspection)
    context |= repeatability_context(inspection) | decisions_context(evidence)
    progress("rework", 0, 1)
    context |= rework_context(evidence)
    progress("photos", 0, 1)
    context |= _photos(evidence)
    if model is not None:
        context["overview"] = _embedded(overview(inspection, model, sparse), JPEG_QUALITY)
        context["overview_caption"] = (
            "Components at their design positions over a photo; exaggerated arrows point to the measured positions."
            if sparse is not None
            else "The nominal part; exaggerated arrows point to the measured positions."
        )
    progress("3D view", 0, 1)
    context |= _viewer(evidence)
    context["charts"] = _charts(evidence) | context.pop("photo_charts")
    return context


def render(context: dict[str, Any], for_print: bool, template_path: Path | None = None) -> str:
    """The page as HTML, with the viewer for screens and without it for print.

    Raises:
        InputError: the template cannot be read or is wrong.
    """
    import jinja2

    from arview.web import font, three_js

    here = resources.files("arview.report")
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.ChainableUndefined, trim_blocks=True)
    faces = [
        f"@font-face {{ font-family: {family}; font-weight: {weight}; font-style: normal; "
        f'src: url({_data_url(font(name), "font/woff2")}) format("woff2"); }}'
        for family, weight, name in _FONTS
    ]
    gradient = f".gradient {{ background: linear-gradient(to right, {_GRADIENT}); }}"
    css = "\n".join(["", *faces, (here / "report.css").read_text(encoding="utf-8"), gradient, ""])
    scripts = three_js(), (here / "viewer.js").read_text(encoding="utf-8"), _PRINT_SCRIPT
    try:
        template = environment.from_string((template_path or here / "template.html").read_text(encoding="utf-8"))
        return template.render(
            context,
            for_print=for_print,
            policy=None if for_print else _policy(css, scripts),
            css=Markup(css),
            hex={verdict.value: color for verdict, color in charts.VERDICT_HEX.items()},
            three=Markup(scripts[0]),
            viewer=Markup(scripts[1]),
            print_script=Markup(scripts[2]),
        )
    except (OSError, ValueError, TypeError, jinja2.TemplateError) as error:
        if template_path is None:
            raise
        raise InputError(f"{template_path}: cannot be used as a template: {error}") from error


def _policy(css: str, scripts: Sequence[str]) -> str:
    """The Content-Security-Policy of the page: nothing is loaded, and only these scripts and styles are used.

    They are named by their hashes (CSP Level 3, 6.7.3.3), taken from what arview brings, never from the finished page,
    so that a script that got into a text of the inspection would not run.
    """

    def hashes(texts: Sequence[str]) -> str:
        digests = (hashlib.sha256(text.encode("utf-8")).digest() for text in texts)
        return " ".join(f"'sha256-{base64.b64encode(digest).decode('ascii')}'" for digest in digests)

    return (
        f"default-src 'none'; script-src {hashes(scripts)}; style-src {hashes([css])}; img-src data:; font-src data:; "
        "base-uri 'none'; form-action 'none'"
    )


def _components(evidence: ReportEvidence) -> dict[str, Any]:
    rows = []
    for index, one in enumerate(evidence.inspection.components):
        center = _center(one, evidence)
        digits = decimals_of(one.uncertainty_mm)
        axes = []
        for axis in range(3):
            moved = one.displacement_mm[axis]
            nominal = None if center is None else float(center[axis])
            measured = None if nominal is None or moved is None else nominal + moved
            is_open = moved is None and one.verdict is not Verdict.NOT_MEASURED and one.finding is None
            axes.append(
                {
                    "name": "xyz"[axis],
                    "nominal": number(nominal, digits),
                    "measured": determined(None) if is_open else number(measured, digits),
                    "deviation": determined(None) if is_open else number(moved, digits, signed=True),
                }
            )
        nothing = one.distance_mm is None and (one.finding is not None or one.verdict is Verdict.NOT_MEASURED)
        rows.append(
            {
                "name": one.name,
                "axes": axes,
                "anchor": None if one.verdict is Verdict.PASS else f"finding-{index}",
                "distance": NONE if nothing else determined(one.distance_mm, distance_digits(one)),
                "uncertainty": number(one.uncertainty_mm, digits),
                "tolerance": exact_number(one.tolerance_mm),
                "zone": zone_text(one),
                "tilt": NONE if nothing else determined(one.tilt_deg, 2),
                "twist": NONE if nothing else determined(one.twist_deg, 2, signed=True),
                "verdict": one.verdict.value,
                "word": verdict_word(one),
            }
        )
    lead = verdict_sentence(evidence.inspection)
    return {
        "rows": rows,
        "components_lead": f"{lead[:1].upper()}{lead[1:]}.",
        "legend": explanations.legend_of(evidence.inspection),
    }


def _center(one: ComponentDeviation, evidence: ReportEvidence) -> Array | None:
    """Nominal position of the point that the displacement refers to, or None."""
    if one.details is not None:
        return np.array(one.details.center_mm)
    if evidence.part is not None:
        return np.asarray(evidence.part.model.component(one.name).bounds_in_model.mean(axis=0))
    return None


def _findings(evidence: ReportEvidence, gallery: Gallery) -> dict[str, Any]:
    inspection = evidence.inspection
    order = {one.name: index for index, one in enumerate(inspection.components)}
    has_photos = evidence.part is not None and evidence.sparse is not None
    findings, passed = [], []
    for one in overlay.by_urgency(inspection):
        crops = [_crop(crop) for crop in gallery.components.get(one.name, ())]
        entry = {"name": one.name, "verdict": one.verdict.value, "word": verdict_word(one)}
        if one.verdict is Verdict.PASS:
            if crops:
                passed.append((order[one.name], entry | {"crop": crops[0], "short": short_text(one)}))
            continue
        details = one.details
        findings.append(
            entry
            | {
                "anchor": f"finding-{order[one.name]}",
                "text": finding_text(one),
                "crops": crops,
                "no_crop": "No photo shows it." if has_photos else "",
                "methods": [] if details is None else [explanations.method_row(method) for method in details.methods],
                "notes": [] if details is None else _own_notes(details),
            }
        )
    foreign = [
        {"text": foreign_text(one), "crops": [_crop(crop, "its box") for crop in crops]}
        for one, crops in zip(
            inspection.foreign_objects, gallery.foreign or [()] * len(inspection.foreign_objects), strict=True
        )
    ]
    return {
        "findings": findings,
        "foreign": foreign,
        "passed": [entry for _, entry in sorted(passed, key=lambda p: p[0])],
    }


def _own_notes(details: Details) -> list[str]:
    """Notes that are not also those of a method."""
    of_methods = {note for method in details.methods for note in (*method.notes, method.reason)}
    return [note for note in details.notes if note not in of_methods]


def _crop(crop: Crop, what: str = "overlay: design position") -> dict[str, Any]:
    arrow = "" if crop.arrow_scale is None else f"; arrow × {crop.arrow_scale:g}"
    caption = f"{crop.photo}; {what}{arrow}"
    return {"photo": crop.photo, "caption": caption, **_embedded(crop.image, JPEG_QUALITY)}


def _distance_map(evidence: ReportEvidence) -> dict[str, Any]:
    report = evidence.inspection.distance_map
    context: dict[str, Any] = {
        "map_limit": f"{MAP_LIMIT_MM:g}",
    }
    if report is not None:
        context["reach"] = f"{report.reach_mm:g}"
        context["statistics"] = [
            {
                "name": "all" if index == 0 else row.name,
                "count": f"{row.count:,}",
                "mean": number(row.mean_mm, signed=True),
                "median": number(row.median_mm, signed=True),
                "sigma": number(row.sigma_mm),
                "fwhm": number(row.fwhm_mm),
            }
            for index, row in enumerate(report.statistics)
        ]
    if evidence.distances is not None:
        width, legend = 1300, 110  # map_picture draws its legend there; the page has its own
        image = measurement.map_picture(evidence.distances, limit_mm=MAP_LIMIT_MM, width=width, height=900)
        context["map"] = _embedded(_trimmed(image[:, : width - legend]), JPEG_QUALITY)
    return context


def _trimmed(image: RgbImage, margin: int = 12) -> RgbImage:
    """The picture without white borders."""
    rows, columns = (np.flatnonzero((image < 250).any(axis=(1 - axis, 2))) for axis in (0, 1))
    if len(rows) == 0:
        return image
    low_v, high_v = max(0, rows[0] - margin), rows[-1] + margin
    low_u, high_u = max(0, columns[0] - margin), columns[-1] + margin
    return image[low_v:high_v, low_u:high_u]


def _budget(inspection: Inspection) -> dict[str, Any]:
    names: dict[str, float] = {}
    for one in inspection.components:
        for line in one.details.budget if one.details is not None else ():
            names[line.name] = names.get(line.name, 0.0) + line.std_mm**2
    ordered = sorted(names, key=lambda name: -names[name])
    rows = []
    for one in inspection.components:
        if one.details is not None and one.details.budget:
            std = {line.name: line.std_mm for line in one.details.budget}
            rows.append(
                {
                    "name": one.name,
                    "cells": [number(std.get(name)) for name in ordered],
                    "k": number(one.details.k, 2),
                    "uncertainty": number(one.uncertainty_mm, decimals_of(one.uncertainty_mm)),
                }
            )
    return {"budget": {"names": ordered, "rows": rows}}


def _datums(inspection: Inspection) -> dict[str, Any]:
    system = inspection.datum_system
    if system is None:
        return {"datums": []}
    rows = [
        {
            "label": d.label,
            "feature": "best fit" if d.feature == "fit" else d.feature,
            "component": d.component,
            "locked": explanations.constraint_text(d.locked),
            "count": f"{d.used:,} of {d.of:,}" if d.of else NONE,
            "residual": number(d.residual_mm),
            "rest": number(d.rest_mm),
            "radius": number(d.radius_mm, signed=True),
            "method": d.method,
        }
        for d in system.datums
    ]
    notes = "".join(f" {note[:1].upper()}{note[1:]}." for note in system.notes)
    return {"datums": rows, "datums_lead": notes.strip()}


def _photos(evidence: ReportEvidence) -> dict[str, Any]:
    """Reprojection errors, coverage and the list of photos."""
    from arview.reconstruction.coverage import coverage

    sparse, part = evidence.sparse, evidence.part
    if sparse is None or not sparse.photos:
        return {"photo_charts": {}}
    lengths = np.linalg.norm(reconstruction.reprojection_residuals(sparse), axis=1)
    centres = np.array([photo.centre_in_scan for photo in sparse.photos])
    middle = part.model.center_in_model if part is not None else np.median(sparse.points_in_scan, axis=0)
    away = np.linalg.norm(centres - middle, axis=1)
    rows = []
    for index, photo in enumerate(sparse.photos):
        mine = lengths[sparse.observed_photo == index]
        median, high = np.percentile(mine, [50.0, 95.0]) if len(mine) else (float("nan"), float("nan"))
        rows.append(
            {
                "number": index + 1,
                "name": photo.name,
                "points": f"{len(mine):,}",
                "median": number(float(median), 2) if len(mine) else NONE,
                "high": number(float(high), 2) if len(mine) else NONE,
                "distance": number(float(away[index]), 0),
            }
        )
    rms = float(np.sqrt(np.mean(lengths**2))) if len(lengths) else 0.0
    lead = (
        f"{len(sparse.photos)} photos, {len(sparse.points_in_scan):,} points observed {len(lengths):,} times;"
        f" reprojection error {rms:.2f} px rms, {float(np.median(lengths)) if len(lengths) else 0.0:.2f} px median."
    )
    if sparse.unplaced:
        lead += (
            f" {len(sparse.unplaced)} could not be registered: " + ", ".join(name for name, _ in sparse.unplaced) + "."
        )
    context: dict[str, Any] = {"photos": rows, "photos_lead": lead}
    if part is not None:
        seen = coverage(part.model, [(photo.camera, photo.cam_from_scan) for photo in sparse.photos])
        context["coverage"] = [
            {
                "name": one.name,
                "photos": len(one.photos),
                "directions": one.directions,
                "spread": number(one.spread_deg, 0),
                "gap": number(one.gap_deg, 0),
            }
            for one in seen.components
        ]
        context["coverage_advice"] = seen.advice
    names = [photo.name for photo in sparse.photos]
    context["photo_charts"] = {
        "reprojection": Markup(charts.reprojection_chart(lengths, sparse.observed_photo, names)),
        "coverage": Markup(charts.coverage_chart(centres - middle)),
    }
    return context


def _charts(evidence: ReportEvidence) -> dict[str, Markup]:
    inspection, system = evidence.inspection, evidence.inspection.datum_system
    made = {
        "tolerance": charts.tolerance_chart(inspection.components),
        "budget": charts.budget_chart(inspection.components),
    }
    if evidence.distances is not None:
        made["histogram"] = charts.histogram_chart(evidence.distances)
    if system is not None and system.datums:
        made["datums"] = charts.datum_chart(system.datums)
    return {name: Markup(text) for name, text in made.items()}


def _viewer(evidence: ReportEvidence) -> dict[str, Any]:
    model = None if evidence.part is None else evidence.part.model
    scene = make_scene(evidence.inspection, model, evidence.cloud, evidence.distances, evidence.sparse)
    if scene is None:
        return {"scene": ""}
    cloud = scene.get("cloud", {})
    has_uncovered = bool(scene.get("uncovered", {}).get("points"))
    lead = ["Components at their design positions (transparent) and measured positions (solid)."]
    if "mesh" not in scene:
        lead = [
            "The CAD model is not shown: " + ("it was not given." if model is None else "it has too many triangles.")
        ]
    if cloud:
        shown = len(cloud["points"]) // 8
        lead.append(f"{shown:,} of the {cloud['of']:,} points of the cloud.")
    else:
        lead.append(evidence.absent.get("cloud", "There is no cloud."))
    if has_uncovered:
        lead.append("Hatched: surfaces that no two photos saw; the CAD model stands in for them.")
    modes = [
        (name, text)
        for name, text in (("photo", "photos"), ("distance", "distance to the CAD model"))
        if ("colors" if name == "photo" else "distances") in cloud
    ]
    return {
        "scene": Markup(scene_json(scene)),
        "scene_lead": " ".join(lead),
        "has_mesh": "mesh" in scene,
        "has_uncovered": has_uncovered,
        "cloud_modes": modes,
        "exaggerations": _EXAGGERATIONS,
        "exaggeration": round(scene.get("arrow_scale", 1.0)),
    }


def _moment(inspection: Inspection) -> str:
    return inspection.created.strftime("%Y-%m-%d %H:%M UTC")


def _embedded(image: RgbImage, quality: int) -> dict[str, Any]:
    """A picture as a data URL, JPEG."""
    from PIL import Image

    out = io.BytesIO()
    Image.fromarray(image).save(out, "JPEG", quality=quality, optimize=True)
    return {"url": _data_url(out.getvalue(), "image/jpeg"), "width": image.shape[1], "height": image.shape[0]}


def _data_url(data: bytes, kind: str) -> str:
    return f"data:{kind};base64,{base64.b64encode(data).decode('ascii')}"
