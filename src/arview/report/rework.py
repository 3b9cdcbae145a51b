"""The section of a report that says what to do about components out of tolerance."""

from __future__ import annotations

import base64
import io
from pathlib import Path
from typing import Any

from markupsafe import Markup

from arview.cad import Part
from arview.quality.rework import drawing_svg, make_instructions
from arview.report.evidence import ReportEvidence

_HOW = {
    "install": "install",
    "adjust": "adjust",
    "unbolt": "unbolt and move",
    "reweld": "weld again",
    "reglue": "glue again",
    "shim": "shim",
    "bend": "bend",
    "replace": "replace",
}
MAX_SIDE_PX = 900
"""Longer side of the pictures that a report holds."""


def rework_context(evidence: ReportEvidence) -> dict[str, Any]:
    """Instructions with their drawings and the pictures of the part file; none without the part."""
    part = evidence.part
    if part is None:
        return {"rework": []}
    rows = [
        {
            "name": one.component,
            "how": _HOW.get(one.how, one.how),
            "what": "" if any(one.what.lower() in step.lower() for step in one.steps) else one.what,
            "text": one.text,
            "steps": one.steps,
            "remark": one.remark,
            "drawing": Markup(drawing_svg(part, evidence.inspection, one.component, "report")),
            "pictures": [picture for name in one.pictures if (picture := _of_part(part, name)) is not None],
        }
        for one in make_instructions(part, evidence.inspection)
    ]
    return {"rework": rows}


def _of_part(part: Part, name: str) -> dict[str, Any] | None:
    """A picture of the part file for the page; None if it cannot be read any more."""
    found = embedded_picture(part.path.parent / name, MAX_SIDE_PX)
    return None if found is None else found | {"name": name}


def embedded_picture(path: Path, max_side_px: int) -> dict[str, Any] | None:
    """A picture file as a data URL, upright and not larger than needed; None if it is no picture."""
    from PIL import Image, ImageOps

    try:
        with Image.open(path) as opened:
            image = ImageOps.exif_transpose(opened).convert("RGB")
            image.thumbnail((max_side_px, max_side_px))
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
        return None
    out = io.BytesIO()
    image.save(out, "JPEG", quality=84, optimize=True)
    url = f"data:image/jpeg;base64,{base64.b64encode(out.getvalue()).decode('ascii')}"
    return {"url": url, "width": image.width, "height": image.height}
