"""The CAD of the panel: a sheet with hat stringers, two rows of equal brackets and six other parts, in mm.

Model frame: origin in the middle of the sheet's top face, +Z up out of it. The sheet spans x ±450, y ±300 and
z −1.6…0.
"""

from __future__ import annotations

import build123d as bd
from solids import angle, clip, on_plate, post, ring

SHEET_MM = 1.6
PAINT = (0.55, 0.60, 0.58)
PRIMER = (0.50, 0.54, 0.52)
ZINC = (0.72, 0.68, 0.52)
DATUM_HOLES = ((-425.0, -275.0), (425.0, -275.0), (-425.0, 275.0))
ROWS = (-118.0, 88.0)
"""y of each row of brackets."""


def _hat(length: float) -> bd.Part:
    """Stringer along X: flanges 18 mm wide, a channel 24 mm high between them."""
    outline = bd.Polyline(
        (-36, 0), (-19.6, 0), (-12.6, 22.4), (12.6, 22.4), (19.6, 0), (36, 0), (36, SHEET_MM), (20.8, SHEET_MM),
        (13.8, 24), (-13.8, 24), (-20.8, SHEET_MM), (-36, SHEET_MM), close=True,
    )  # fmt: skip
    hat = bd.extrude(bd.Plane.YZ * bd.make_face(outline), length)
    return bd.Pos(-length / 2, 0, 0) * hat


def _sheet() -> bd.Part:
    sheet = bd.Pos(0, 0, -SHEET_MM / 2) * bd.Box(900, 600, SHEET_MM)
    sheet = bd.fillet(sheet.edges().filter_by(bd.Axis.Z), 20.0)
    # One corner is cut, so that the sheet looks the same from no two sides.
    sheet -= bd.Pos(450, 300, 0) * bd.Rot(0, 0, 45) * bd.Box(110, 110, 10)
    for x, y in DATUM_HOLES:
        sheet -= bd.Pos(x, y, 0) * bd.Cylinder(5.0, 10)
    for x, y in ((-405, 0), (405, 60), (-405, 118), (405, -130)):
        sheet -= bd.Pos(x, y, 0) * bd.Cylinder(7.0, 10)
    for x in (-150, 150):
        sheet -= bd.Pos(x, 265, 0) * bd.Cylinder(18.0, 10)
    for y in (-205, 0, 205):
        sheet += bd.Pos(0, y, 0) * _hat(760)
    return sheet


def components() -> list[tuple[str, object, tuple[float, float, float]]]:
    """Name, solid at its nominal place and colour of every component; the sheet comes first."""
    bracket = angle(34, 36, 40, 2.0, 9.0, 3.0)
    found: list = [("sheet", _sheet(), PAINT)]
    for row, y in enumerate(ROWS):
        for k in range(8):
            found.append((f"bracket_{8 * row + k + 1}", on_plate(-336 + 96 * k, y) * bracket, PRIMER))
    return [
        *found,
        ("clip_1", on_plate(-230, -262, 20) * clip(52, 16, 13, 1.5), ZINC),
        ("clip_2", on_plate(210, -262, -35) * clip(52, 16, 13, 1.5), ZINC),
        ("stud_1", on_plate(-330, 263) * post(12, 30), ZINC),
        ("stud_2", on_plate(300, 263) * post(12, 30), ZINC),
        ("boss_1", on_plate(-12, -265) * ring(30, 14, 12), PRIMER),
        ("boss_2", on_plate(12, 262) * ring(24, 11, 10), PRIMER),
    ]
