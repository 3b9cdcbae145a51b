"""Files that the studio writes beside the part file: guide views, contact sheet, sheet for the station."""

from __future__ import annotations

import base64
from collections.abc import Callable, Sequence
from html import escape
from pathlib import Path

import cv2

from arview import guideviews
from arview.cad import Part
from arview.core.atomic import write_file
from arview.errors import InputError
from arview.station.studio.document import StudioDocument
from arview.station.studio.photo_plan import photo_plan

STATION_PHOTOS = 24
"""Photos of the plan on the sheet for the station."""


def write_exports(document: StudioDocument, kinds: Sequence[str]) -> list[Path]:
    """Write files named after the part file; the part file must be saved, because they belong to what it says.

    Args:
        document: the part.
        kinds: some of ``gv`` (guide views), ``sheet`` (contact sheet, PNG), ``station`` (page to print, HTML).

    Raises:
        InputError: an unknown kind, or the part file has unsaved edits.
        OutputError: a file cannot be written.
    """
    makers: dict[str, tuple[str, Callable[[Part], bytes]]] = {
        "sheet": ("_views.png", _sheet),
        "station": ("_station.html", station_page),
    }
    unknown = [kind for kind in kinds if kind != "gv" and kind not in makers]
    if unknown or not kinds:
        raise InputError(f"kinds: {', '.join(unknown) or 'none'}; expected some of gv, {', '.join(makers)}")
    if not document.text.is_saved:
        raise InputError("the part file has edits that are not saved; save it first")
    part, stem = document.part, _stem(document.path, document.part)
    written = []
    for kind in kinds:
        if kind == "gv":
            path = document.path.with_name(f"{stem}.gv")
            guideviews.make_guide_views(part.model, part.effective_view_range).save(path)
        else:
            ending, make = makers[kind]
            path = document.path.with_name(stem + ending)
            write_file(path, make(part))
        written.append(path)
    return written


def station_page(part: Part) -> bytes:
    """A page to print and hang up at the station: the part, from where to look, and where to take photos from."""
    plan = photo_plan(part, STATION_PHOTOS)
    view_range = part.effective_view_range
    picture = base64.b64encode(_sheet(part, max_views=8)).decode()
    inspected = [s for s in part.settings if s.role == "inspect"]
    rows = "".join(
        f"<tr><td>{escape(s.name)}</td><td>{_with_unit(s.position_tolerance_mm, ' mm')}</td>"
        f"<td>{_with_unit(s.angle_tolerance_deg, '°')}</td></tr>"
        for s in inspected[:60]
    )
    more = f"<p>and {len(inspected) - 60} more</p>" if len(inspected) > 60 else ""
    rings = sorted({round(photo["elevation_deg"]) for photo in plan["photos"]})
    hidden = [row["name"] for row in plan["components"] if row["remark"]]
    hidden_text = f"<p>Hidden in most of these photos: {escape(', '.join(hidden[:12]))}.</p>" if hidden else ""
    low, high = view_range.elevation_deg
    return f"""<!doctype html><html lang="en"><meta charset="utf-8"><title>{escape(part.name)}: station</title>
<style>body{{font:12pt/1.4 sans-serif;margin:15mm;max-width:180mm}}img{{width:100%}}
table{{border-collapse:collapse}}
td,th{{border:1px solid #999;padding:1mm 3mm;text-align:left}}
@media print{{body{{margin:0}}}}</style>
<h1>{escape(part.name)}</h1>
<img alt="Views of the part" src="data:image/png;base64,{picture}">
<h2>Live</h2>
<p>Hold the camera {view_range.distance_mm[0]:.0f} to {view_range.distance_mm[1]:.0f} mm from the part, at an elevation
of {low:.0f} to {high:.0f}°.</p>
<h2>Photos</h2>
<p>{STATION_PHOTOS} photos, {plan["distance_mm"]:.0f} mm from the part, evenly round it, alternately
{" and ".join(f"{ring}°" for ring in rings)} above it. The part, zoom and focus stay as they are.</p>
{hidden_text}
<h2>Inspected</h2><table><tr><th>component</th><th>position</th><th>angle</th></tr>{rows}</table>{more}
</html>""".encode()


def _sheet(part: Part, max_views: int = 40) -> bytes:
    views = guideviews.assessed_guide_views(part.model, part.effective_view_range)
    sheet = guideviews.contact_sheet(part.model, views, max_views=max_views, unique=guideviews.assess(views))
    _, png = cv2.imencode(".png", cv2.cvtColor(sheet, cv2.COLOR_RGB2BGR))
    return png.tobytes()


def _with_unit(value: float | None, unit: str) -> str:
    return "" if value is None else f"{value:g}{unit}"


def _stem(path: Path, part: Part) -> str:
    """Beginning of the files' names: that of the part file, or of the CAD where the part file is called part.toml."""
    return part.cad_path.stem if path.stem == "part" else path.stem
