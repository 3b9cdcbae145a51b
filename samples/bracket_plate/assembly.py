"""The CAD of the sample part: a welded steel plate with eleven named components, in mm.

Model frame: origin in the middle of the plate's top face, +Z up out of the plate, X along its longer
side. The plate spans x ±110, y ±80, z −10…0.
"""

from __future__ import annotations

import build123d as bd
from solids import box, on_plate, post, ring

STEEL_DARK = (0.25, 0.26, 0.28)
STEEL_LIGHT = (0.66, 0.66, 0.64)
STEEL_BLUE = (0.42, 0.48, 0.56)
ZINC = (0.72, 0.68, 0.52)

# Hole centres (x, y) of the datums B (round locator) and C (clocking) in mm.
DATUM_B = (-97.0, -67.0)
DATUM_C = (97.0, -67.0)


def _nut(across_flats: float, height: float, hole: float) -> bd.Part:
    hexagon = bd.RegularPolygon(across_flats / 2, 6, major_radius=False)
    return bd.extrude(hexagon, height) - bd.Cylinder(hole / 2, 3 * height)


def _base_plate() -> bd.Part:
    outline = bd.Polyline(
        (-110, -80), (110, -80), (110, 44), (74, 80), (-8, 80), (-8, 68), (-34, 68), (-34, 80), (-110, 80),
        close=True,
    )  # fmt: skip
    plate = bd.Pos(0, 0, -10) * bd.extrude(bd.make_face(outline), 10)
    for x, y in (DATUM_B, DATUM_C):
        plate -= bd.Pos(x, y, -5) * bd.Cylinder(6.0, 30)
    return plate


def _block() -> bd.Part:
    block = box(44, 30, 22)
    edge = block.edges().filter_by(bd.Axis.Y).sort_by(lambda e: e.center().X + e.center().Z)[-1]
    return bd.chamfer(edge, 8.0)


def _bracket() -> bd.Part:
    """L-bracket: foot along +Y, wall in the XZ plane, with a hole in the foot and two in the wall."""
    bracket = bd.Pos(0, 16, 0) * box(46, 32, 4) + bd.Pos(0, 2, 0) * box(46, 4, 40)
    bracket -= bd.Pos(0, 20, 0) * bd.Cylinder(4.5, 20)
    for x in (-12, 12):
        bracket -= bd.Pos(x, 0, 26) * bd.Rot(90, 0, 0) * bd.Cylinder(4.0, 20)
    return bracket


def _rib() -> bd.Part:
    """Gusset in the XZ plane, 6 mm thick: a right triangle with both sharp corners cut."""
    outline = bd.Polyline((0, 0), (46, 0), (46, 6), (10, 34), (0, 34), close=True)
    return bd.Pos(0, 3, 0) * bd.extrude(bd.Plane.XZ * bd.make_face(outline), 6)


def _lug() -> bd.Part:
    """Flat lug with one round end, a slot and a round hole."""
    lug = box(34, 22, 8) + bd.Pos(17, 0, 4) * bd.Cylinder(11, 8)
    lug -= bd.Pos(17, 0, 0) * bd.Cylinder(5.5, 40)
    return lug - bd.Pos(-5, 0, 0) * box(14, 7, 40)


def components() -> list[tuple[str, object, tuple[float, float, float]]]:
    """Name, solid at its nominal place and colour of every component; the plate comes first."""
    return [
        ("base_plate", _base_plate(), STEEL_DARK),
        ("post_1", on_plate(-82, 52) * post(14, 45), STEEL_LIGHT),
        ("post_2", on_plate(-12, -50) * post(18, 28), STEEL_LIGHT),
        ("post_3", on_plate(62, 28) * post(12, 62), STEEL_LIGHT),
        ("nut_1", on_plate(-66, -38, 12) * _nut(19, 10, 10.2), ZINC),
        ("nut_2", on_plate(30, 58, 25) * _nut(24, 13, 13.8), ZINC),
        ("block_1", on_plate(46, -38, 18) * _block(), STEEL_LIGHT),
        ("bracket_1", on_plate(-46, 26, -20) * _bracket(), STEEL_BLUE),
        ("rib_1", on_plate(84, -14, 70) * _rib(), STEEL_BLUE),
        ("boss_1", on_plate(-20, -6) * ring(36, 21, 12), STEEL_LIGHT),
        ("lug_1", on_plate(20, 14, 35) * _lug(), STEEL_BLUE),
    ]
