"""The CAD of the photo sample: a steel plate with sixteen named components welded to it, in mm.

Model frame: origin in the middle of the plate's top face, +Z up out of the plate, which spans x and y ±150, z −8…0.
"""

from __future__ import annotations

import build123d as bd
from solids import box, on_plate, post, ring

STEEL_DARK = (0.25, 0.26, 0.28)
STEEL_LIGHT = (0.66, 0.66, 0.64)
STEEL_BLUE = (0.42, 0.48, 0.56)
ZINC = (0.72, 0.68, 0.52)


def _base_plate() -> bd.Part:
    plate = bd.Pos(0, 0, -4) * bd.Box(300, 300, 8)
    plate = bd.fillet(plate.edges().filter_by(bd.Axis.Z), 6.0)
    for x, y in ((-130, -130), (130, -130), (130, 130), (-130, 130)):
        plate -= bd.Pos(x, y, -4) * bd.Cylinder(6.5, 30)
    return plate


def _square_nut(side: float, height: float, hole: float) -> bd.Part:
    return box(side, side, height) - bd.Cylinder(hole / 2, 3 * height)


def _chamfered_block(x: float, y: float, z: float, chamfer: float) -> bd.Part:
    """Block with a chamfer along the top edge of its +X side."""
    block = box(x, y, z)
    edge = block.edges().filter_by(bd.Axis.Y).sort_by(lambda e: e.center().X + e.center().Z)[-1]
    return bd.chamfer(edge, chamfer)


def _link(distance: float, width: float, thickness: float, hole: float) -> bd.Part:
    """Flat bar with round ends and a hole in each."""
    link = box(distance, width, thickness)
    for x in (-distance / 2, distance / 2):
        link += bd.Pos(x, 0, thickness / 2) * bd.Cylinder(width / 2, thickness)
    for x in (-distance / 2, distance / 2):
        link -= bd.Pos(x, 0, 0) * bd.Cylinder(hole / 2, 4 * thickness)
    return link


def _angle(width: float, foot: float, height: float) -> bd.Part:
    """Angle bracket of 4 mm sheet: foot along +Y, wall in the XZ plane with two holes."""
    bracket = bd.Pos(0, foot / 2, 0) * box(width, foot, 4) + bd.Pos(0, 2, 0) * box(width, 4, height)
    for x in (-width / 4, width / 4):
        bracket -= bd.Pos(x, 0, 0.62 * height) * bd.Rot(90, 0, 0) * bd.Cylinder(4.0, 20)
    return bracket


def components() -> list[tuple[str, object, tuple[float, float, float]]]:
    """Name, solid at its nominal place and colour of every component; the plate comes first."""
    return [
        ("base_plate", _base_plate(), STEEL_DARK),
        ("post_1", on_plate(-88, 62) * post(16, 40), STEEL_LIGHT),
        ("post_2", on_plate(52, 98) * post(20, 25), STEEL_LIGHT),
        ("post_3", on_plate(98, -58) * post(16, 40), STEEL_LIGHT),
        ("post_4", on_plate(-28, -98) * post(20, 25), STEEL_LIGHT),
        ("nut_1", on_plate(-116, -6, 12) * _square_nut(24, 11, 13), ZINC),
        ("nut_2", on_plate(12, 122, 30) * _square_nut(30, 13, 17), ZINC),
        ("nut_3", on_plate(120, 36, 55) * _square_nut(24, 11, 13), ZINC),
        ("block_1", on_plate(-92, -70, 25) * _chamfered_block(60, 36, 20, 6), STEEL_LIGHT),
        ("block_2", on_plate(32, 38, 8) * box(40, 40, 12), STEEL_LIGHT),
        ("block_3", on_plate(50, -114, -6) * box(70, 14, 30), STEEL_LIGHT),
        ("link_1", on_plate(-42, 98, 40) * _link(46, 22, 10, 12), STEEL_BLUE),
        ("link_2", on_plate(104, 88, -60) * _link(36, 20, 8, 11), STEEL_BLUE),
        ("boss_1", on_plate(18, -54) * ring(36, 19, 18), STEEL_LIGHT),
        ("boss_2", on_plate(-110, 110) * ring(28, 13, 14), STEEL_LIGHT),
        ("bracket_1", on_plate(-48, 14, -35) * _angle(50, 32, 40), STEEL_BLUE),
        ("bracket_2", on_plate(100, -8, 100) * _angle(46, 28, 35), STEEL_BLUE),
    ]
