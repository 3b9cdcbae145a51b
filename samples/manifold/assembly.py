"""The CAD of the manifold: a casting with a curved duct and fourteen components on it, in mm.

Model frame: origin in the middle of the mounting flange's top face, +Z up out of it. The flange spans x ±120, y ±80 and
z −14…0; the body on it is 70 mm high, the duct's own flange faces up at z = 112.
"""

from __future__ import annotations

import build123d as bd
import numpy as np
from solids import angle, box, clip, hexagon, matrix, post, ring, seated, turned

IRON = (0.45, 0.46, 0.47)
STEEL = (0.66, 0.66, 0.64)
ZINC = (0.72, 0.68, 0.52)
BRASS = (0.70, 0.56, 0.26)
DUCT_X, DUCT_Z = 85.0, 112.0
PAD = np.array([58.0, -52.0, 0.0])
PAD_AXIS = np.array([0.0, -0.5, np.cos(np.deg2rad(30.0))])


def _housing() -> bd.Part:
    """The body with a slope of 45° along its −X edge, rounded as castings are."""
    block = bd.Pos(-25, 0, 35) * bd.Box(110, 90, 70)
    block = bd.fillet(block.edges().filter_by(bd.Axis.Z), 10.0)
    slope = bd.Pos(-80, 0, 70) * bd.Rot(0, 45, 0) * bd.Box(24 * np.sqrt(2), 200, 24 * np.sqrt(2))
    block -= slope
    rim = [edge for edge in block.edges() if edge.center().Z > 45]
    return bd.fillet(rim, 3.0)


def _duct() -> tuple[bd.Part, bd.Part]:
    """The duct's outside and its bore: out of the body along +X, then round and up."""
    start, bend, turn = (10.0, 0.0, 36.0), 45.0, np.sqrt(0.5)
    middle = (40 + bend * turn, 0.0, 36 + bend * (1 - turn))
    path = bd.Wire(
        [
            bd.Edge.make_line(start, (40, 0, 36)),
            bd.Edge.make_three_point_arc((40, 0, 36), middle, (DUCT_X, 0, 36 + bend)),
            bd.Edge.make_line((DUCT_X, 0, 36 + bend), (DUCT_X, 0, DUCT_Z)),
        ]
    )
    circle = bd.Plane(start, (0, 1, 0), (1, 0, 0))
    outside = bd.sweep(circle * bd.Circle(26), path)
    return outside, bd.sweep(circle * bd.Circle(19), path)


def _body() -> bd.Part:
    flange = bd.Pos(0, 0, -7) * bd.Box(240, 160, 14)
    flange = bd.fillet(flange.edges().filter_by(bd.Axis.Z), 14.0)
    outside, bore = _duct()
    body = flange + _housing() + outside + bd.Pos(DUCT_X, 0, DUCT_Z - 12) * bd.Pos(0, 0, 6) * bd.Cylinder(42, 12)
    pad = seated(PAD - 20 * PAD_AXIS, PAD_AXIS)
    boss = pad * (bd.Pos(0, 0, 21) * bd.Cylinder(13, 42))
    below = bd.Pos(0, 0, -50 - 14) * bd.Box(600, 600, 100)
    body = body + (boss - below) - bore
    for x, y in ((-105, -65), (105, -65), (105, 65), (-105, 65)):
        body -= bd.Pos(x, y, -7) * bd.Cylinder(5.5, 30)
    return body


def _nipple() -> bd.Part:
    """Hose nipple: a hexagon, a neck and three barbs, with a bore."""
    barbs = [(5.5, 8), (5.5, 14)]
    for k in range(3):
        barbs += [(7.5, 14 + 6 * k), (5.5, 20 + 6 * k)]
    tube = turned((2.5, 8), *barbs, (2.5, 32))
    return hexagon(20, 9) - bd.Cylinder(2.5, 40) + tube


def _plug() -> bd.Part:
    return turned((0, 0), (12, 0), (12, 5), (11, 6), (0, 6)) + bd.Pos(0, 0, 6) * box(11, 11, 10)


def _cap() -> bd.Part:
    """A domed cap."""
    dome = bd.Sphere(15) & bd.Pos(0, 0, 25) * bd.Box(60, 60, 50)
    return bd.Pos(0, 0, 3) * dome + bd.Pos(0, 0, 1.5) * bd.Cylinder(16, 3)


def _sensor() -> bd.Part:
    return hexagon(22, 10) + turned((0, 10), (8, 10), (8, 26), (6, 28), (6, 36), (0, 36))


SEATS = {
    "stud_1": seated((-101, 14, 0), (0, 0, 1)),
    "stud_2": seated((2, 24, 70), (0, 0, 1)),
    "stud_3": seated(PAD + 22 * PAD_AXIS, PAD_AXIS),
    "nipple_1": seated((-68, 4, 58), (-1, 0, 1), (0, 1, 0)),
    "nipple_2": seated((-44, 45, 38), (0, 1, 0)),
    "clip_1": seated((-14, -20, 70), (0, 0, 1), (np.cos(0.3), np.sin(0.3), 0)),
    "bracket_1": seated((-34, -45, 34), (0, -1, 0)),
    "bracket_2": seated((12, -58, 0), (0, 0, 1), (-1, 0, 0)),
    "nut_1": seated((DUCT_X + 31 * np.cos(0.7), 31 * np.sin(0.7), DUCT_Z), (0, 0, 1)),
    "nut_2": seated((DUCT_X - 31 * np.cos(0.7), -31 * np.sin(0.7), DUCT_Z), (0, 0, 1), (0.9, 0.4, 0)),
    "boss_1": seated((58, 54, 0), (0, 0, 1)),
    "plug_1": seated((2, 45, 40), (0, 1, 0), (0.95, 0, 0.3)),
    "cap_1": seated((-36, 22, 70), (0, 0, 1)),
    "sensor_1": seated((-100, -28, 0), (0, 0, 1), (0.8, 0.6, 0)),
}


def seats() -> dict[str, np.ndarray]:
    return {name: matrix(seat) for name, seat in SEATS.items()}


def components() -> list[tuple[str, object, tuple[float, float, float]]]:
    """Name, solid at its nominal place and colour of every component; the body comes first."""
    own = {
        "stud_1": (post(12, 38), STEEL),
        "stud_2": (post(10, 30), STEEL),
        "stud_3": (post(12, 36), STEEL),
        "nipple_1": (_nipple(), BRASS),
        "nipple_2": (_nipple(), BRASS),
        "clip_1": (clip(48, 14, 12, 1.5), ZINC),
        "bracket_1": (angle(44, 26, 34, 4, 9), STEEL),
        "bracket_2": (angle(30, 22, 30, 4, 9), STEEL),
        "nut_1": (hexagon(17, 9) - bd.Cylinder(4.2, 30), ZINC),
        "nut_2": (hexagon(17, 9) - bd.Cylinder(4.2, 30), ZINC),
        "boss_1": (ring(26, 12, 14), STEEL),
        "plug_1": (_plug(), STEEL),
        "cap_1": (_cap(), ZINC),
        "sensor_1": (_sensor(), BRASS),
    }
    placed = [(name, SEATS[name] * solid, color) for name, (solid, color) in own.items()]
    return [("body", _body(), IRON), *placed]
