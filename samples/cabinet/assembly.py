"""The CAD of the cabinet: the back panel of a control box with what is mounted on it, large and very small, in mm.

Model frame: origin in the middle of the panel's front face, +Z out of it. The panel spans x ±180, y ±140 and z −2…0;
its rim is bent back.
"""

from __future__ import annotations

import build123d as bd
from solids import box, hexagon, on_plate, post, ring, turned

PANEL_MM = 2.0
PAINT = (0.62, 0.64, 0.63)
ZINC = (0.72, 0.70, 0.62)
PLASTIC = (0.30, 0.31, 0.33)
DATUM_HOLES = ((-165.0, -125.0), (165.0, -125.0))
RAILS = (55.0, -30.0)
"""y of each rail."""


def _panel() -> bd.Part:
    panel = bd.Pos(0, 0, -PANEL_MM / 2) * bd.Box(360, 280, PANEL_MM)
    panel = bd.fillet(panel.edges().filter_by(bd.Axis.Z), 8.0)
    panel -= bd.Pos(180, 140, 0) * bd.Rot(0, 0, 45) * bd.Box(40, 40, 10)
    for x, y in DATUM_HOLES:
        panel -= bd.Pos(x, y, 0) * bd.Cylinder(4.0, 10)
    for x, y in ((-165, 122), (0, 128), (120, -128), (-60, -128)):
        panel -= bd.Pos(x, y, 0) * bd.Cylinder(3.0, 10)
    for x in (-90, 95):
        panel -= bd.Pos(x, 118, 0) * bd.Box(26, 9, 10)
    return panel


def _rail(length: float) -> bd.Part:
    """Top-hat rail of 35 × 7.5 mm, the crown up."""
    outline = bd.Polyline(
        (-17.5, 6.5), (-13.5, 6.5), (-12.5, 0), (12.5, 0), (13.5, 6.5), (17.5, 6.5), (17.5, 7.5), (12.6, 7.5),
        (11.6, 1), (-11.6, 1), (-12.6, 7.5), (-17.5, 7.5), close=True,
    )  # fmt: skip
    rail = bd.extrude(bd.Plane.YZ * bd.make_face(outline), length)
    return bd.Pos(-length / 2, 0, 0) * rail


def _breaker(width: float) -> bd.Part:
    body = box(width, 84, 44) + bd.Pos(0, 0, 44) * box(width, 45, 22)
    body = bd.chamfer(body.edges().group_by(bd.Axis.Z)[-1], 1.0)
    return body + bd.Pos(0, 4, 66) * box(8, 10, 9)


def _terminals(count: int) -> bd.Part:
    body = box(6.0 * count, 46, 34)
    for k in range(count):
        for y in (-14, 14):
            body -= bd.Pos(6.0 * (k - (count - 1) / 2), y, 34) * bd.Cylinder(2.0, 12)
    return body + bd.Pos(3.0 * count + 4, 0, 0) * box(8, 50, 30)


def _duct(length: float) -> bd.Part:
    duct = box(length, 30, 40) - bd.Pos(0, 0, 1.5) * box(length + 2, 27, 40)
    for k in range(int(length // 15)):
        duct -= bd.Pos(-length / 2 + 10 + 15 * k, 0, 26) * bd.Box(5, 40, 30)
    return duct


def _gland(across: float, thread: float) -> bd.Part:
    return hexagon(across, 6) + bd.Pos(0, 0, 6) * post(thread, 14) - bd.Cylinder(0.28 * thread, 60)


def _screw() -> bd.Part:
    """Pan head of an M4 screw, with a cross of 1 mm."""
    head = turned((0, 0), (4, 0), (4, 1.4), (3.6, 2.1), (2.8, 2.6), (0, 2.6))
    for turn in (0, 90):
        head -= bd.Pos(0, 0, 2.6) * bd.Rot(0, 0, turn) * bd.Box(4.4, 1.0, 2.4)
    return head


def _hinge() -> bd.Part:
    knuckle = bd.Pos(0, 0, 4.5) * bd.Rot(0, 90, 0) * bd.Cylinder(4.5, 46)
    return box(46, 24, 2.0) + bd.Pos(0, 12, 0) * knuckle


def components() -> list[tuple[str, object, tuple[float, float, float]]]:
    """Name, solid at its nominal place and colour of every component; the panel comes first."""
    found: list = [("panel", _panel(), PAINT)]
    found += [(f"rail_{k + 1}", on_plate(0, y) * _rail(270), ZINC) for k, y in enumerate(RAILS)]
    found += [(f"breaker_{k + 1}", bd.Pos(-105 + 21 * k, RAILS[0], 7.5) * _breaker(17.5), PLASTIC) for k in range(3)]
    found += [
        ("terminal_1", bd.Pos(60, RAILS[0], 7.5) * _terminals(8), PLASTIC),
        ("terminal_2", bd.Pos(-60, RAILS[1], 7.5) * _terminals(12), PLASTIC),
        ("duct_1", on_plate(0, -82) * _duct(250), PLASTIC),
        ("bolt_1", on_plate(150, -20) * (hexagon(13, 5.5) + bd.Pos(0, 0, 5.5) * post(8, 12)), ZINC),
        ("gland_1", on_plate(40, 118) * _gland(24, 20), PLASTIC),
        ("gland_2", on_plate(-35, 118) * _gland(20, 16), PLASTIC),
        ("hinge_1", on_plate(-150, 118, 180) * _hinge(), ZINC),
        ("spacer_1", on_plate(95, RAILS[1] - 32, 0) * ring(14, 5, 8), ZINC),
    ]
    places = ((-152, 75), (-152, -60), (152, 70), (152, -95), (80, -118), (-110, -118))
    found += [(f"m4_{k + 1}", on_plate(x, y, 17.0 * k) * _screw(), ZINC) for k, (x, y) in enumerate(places)]
    return found
