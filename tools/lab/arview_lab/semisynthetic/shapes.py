"""The test shapes: CAD made in code, each difficult in its own way, 100–250 mm across."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np

from arview.cad import Component, Model, Symmetry, make_model
from arview.errors import InputError
from arview.geometry import exp_so3, rigid
from arview_lab.semisynthetic.solids import (
    Mesh,
    box,
    circle,
    cylinder,
    joined,
    lump,
    moved,
    prism,
    rectangle,
    sheet,
    slot,
    tube,
)

Color = tuple[float, float, float]

STEEL: Color = (0.56, 0.57, 0.58)
DARK: Color = (0.38, 0.39, 0.41)
BRASS: Color = (0.62, 0.56, 0.42)
BLUE: Color = (0.36, 0.43, 0.52)
GREEN: Color = (0.40, 0.47, 0.40)
SAND: Color = (0.60, 0.54, 0.47)


def shape(name: str) -> Model:
    """The test shape of a name.

    Raises:
        InputError: there is no such shape.
    """
    if name not in _MAKERS and name not in _BOX_MAKERS:
        raise InputError(f"shape {name!r} is not known; give one of {', '.join((*SHAPES, *BOX_SHAPES))}")
    return _made(name)


def near_symmetries(name: str) -> tuple[Symmetry, ...]:
    """Rotations under which a shape is symmetric but for a small feature; without it in view the pose is ambiguous."""
    return NEAR_SYMMETRIES.get(name, ())


def block() -> Model:
    """Plain: a stepped block with a boss, 150 × 80 × 72 mm, 3 flat-sided bodies in one."""
    profile = np.array([(0, 0), (150, 0), (150, 22), (104, 22), (104, 46), (46, 46), (46, 60), (0, 60)], dtype=float)
    stairs = prism(profile, (), 0.0, 80.0)
    upright = moved(stairs, rigid(exp_so3([np.pi / 2, 0, 0]), [0.0, 80.0, 0.0]))
    return _model("block", (("block", joined(upright, box((10, 14, 60), (38, 44, 72))), STEEL),))


def organic() -> Model:
    """Organic: a smooth body without an edge or a symmetry, about 180 mm long, 20,480 triangles."""
    bumps = [
        ((1.0, 0.15, 0.35), 34.0, 0.38),
        ((-1.0, 0.3, -0.2), 22.0, 0.45),
        ((-0.35, 1.0, 0.3), 18.0, 0.40),
        ((0.1, -0.5, 1.0), 20.0, 0.35),
        ((0.35, -1.0, -0.25), -10.0, 0.42),
        ((0.2, 0.3, -1.0), -9.0, 0.5),
    ]
    return _model("organic", (("body", lump(np.array([58.0, 42.0, 36.0]), bumps), SAND),))


def assembly() -> Model:
    """Assembly: a plate with posts, nuts, blocks, a bracket and a rail, 200 × 140 × 68 mm, 11 components."""
    holes = tuple(circle(center, 5.5) for center in ((-90, -60), (90, -60), (90, 60)))
    plate = prism(rectangle((-100, -70), (100, 70)), holes, 0.0, 10.0)
    foot = prism(rectangle((44, 20), (86, 52)), (circle((72, 36), 4.5),), 10.0, 15.0)
    wall = box((44, 20, 15), (50, 52, 52))
    parts = (
        ("plate", plate, STEEL),
        ("post_1", cylinder((-72, 34), 12.0, 10.0, 68.0), DARK),
        ("post_2", cylinder((-34, -44), 9.0, 10.0, 48.0), DARK),
        ("post_3", tube((66, -34), 16.0, 9.0, 10.0, 36.0), BLUE),
        ("nut_1", prism(circle((-2, 50), 11.0, 6), (circle((-2, 50), 5.0),), 10.0, 20.0), BRASS),
        ("nut_2", prism(circle((26, -54), 11.0, 6, 0.4), (circle((26, -54), 5.0),), 10.0, 20.0), BRASS),
        ("nut_3", prism(circle((-88, -8), 8.0, 6, 0.2), (circle((-88, -8), 4.0),), 10.0, 18.0), BRASS),
        ("block_1", box((-46, 8, 10), (-10, 32, 34)), GREEN),
        ("block_2", box((-8, -32, 10), (26, -12, 58)), SAND),
        ("bracket_1", joined(foot, wall), STEEL),
        ("rail_1", box((-62, -64, 10), (8, -56, 20)), DARK),
    )
    return _model("assembly", parts)


def bracket() -> Model:
    """Thin: a twice bent sheet of 2 mm with holes and a cut corner, 150 × 90 × 70 mm."""
    thick, radius = 2.0, 4.0
    length = 0.5 * np.pi * (radius + 0.5 * thick)
    first, second = 80.0, 80.0 + length + 60.0
    foot = np.array([(0, 0), (first, 0), (first, 90), (24, 90), (0, 66)], dtype=float)
    web = np.array([(first + length, 0), (second, 20), (second, 90), (first + length, 90)], dtype=float)
    top = np.array([(second + length, 20), (second + length + 40, 20), (second + length + 62, 56)], dtype=float)
    top = np.concatenate([top, [(second + length + 62, 90), (second + length, 90)]])
    middle = first + length
    flats = [
        (foot, (circle((20, 22), 7.0), slot((50, 60), 34.0, 12.0), circle((58, 20), 5.0))),
        (web, (circle((middle + 32, 48), 16.0), circle((middle + 14, 78), 4.0))),
        (top, (circle((second + length + 30, 70), 6.0), circle((second + length + 26, 36), 4.0))),
    ]
    mesh = sheet(flats, [(first, 90.0, radius), (second, -90.0, radius)], thick)
    return _model("bracket", (("sheet", mesh, STEEL),))


def flange() -> Model:
    """Near-symmetric: a hub on a disc with 6 bolt holes, ⌀170 × 58 mm; a notch in the rim breaks the symmetry."""
    angle = np.deg2rad(np.arange(360) - 90.0)
    rim = 85.0 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    # The notch: 12 mm wide and 9 mm deep at the disc's +X, between two bolt holes.
    inside = (np.abs(rim[:, 1]) < 6.0) & (rim[:, 0] > 0)
    first, last = np.flatnonzero(inside)[[0, -1]]
    edge = np.sqrt(85.0**2 - 36.0)
    notch = np.array([(edge, -6.0), (76.0, -6.0), (76.0, 6.0), (edge, 6.0)])
    outline = np.concatenate([rim[:first], notch, rim[last + 1 :]])
    bolts = np.deg2rad(30.0 + 60.0 * np.arange(6))
    holes = tuple(circle((64.0 * np.cos(b), 64.0 * np.sin(b)), 6.5, 24) for b in bolts)
    disc = prism(outline, (*holes, circle((0, 0), 17.0, 48)), 0.0, 14.0)
    hub = joined(tube((0, 0), 38.0, 20.0, 14.0, 58.0), tube((0, 0), 44.0, 38.0, 14.0, 22.0))
    return _model("flange", (("flange", joined(disc, hub), STEEL),))


def ribbed() -> Model:
    """Tiny features: a base with many ribs of 2.5 mm, pins and small holes, 190 × 120 × 42 mm."""
    columns, rows = np.meshgrid(np.arange(9), np.arange(3))
    spots = [(float(-82 + 9.5 * i), float(30 + 10 * k)) for i, k in zip(columns.ravel(), rows.ravel(), strict=True)]
    holes = tuple(circle(spot, 2.4, 16) for spot in spots if spot != spots[13])
    holes += tuple(circle((80.0, float(y)), 3.0, 16) for y in (-48, -34, -20, 20, 48))
    base = prism(rectangle((-95, -60), (95, 60)), holes, 0.0, 16.0)
    heights = (26, 26, 22, 22, 26, 20, 20, 14, 26, 26)
    ribs = [box((-84 + 11 * k, -52, 16), (-81.5 + 11 * k, 12, 16 + heights[k])) for k in range(10)]
    cross = [box((-84, -22, 16), (17.5, -19.5, 28)), box((30, -50, 16), (62, -47.5, 34))]
    pins = [cylinder((34 + 12 * (k % 3), -36 + 13 * (k // 3)), 3.0, 16.0, 28.0 + 4 * (k % 2), 20) for k in range(7)]
    boss = tube((42, 36), 15.0, 8.0, 16.0, 30.0)
    return _model("ribbed", (("ribbed", joined(base, *ribs, *cross, *pins, boss), DARK),))


def carton() -> Model:
    """Carton: a plain box, 118 × 84 × 62 mm, of which only twelve edges are known."""
    return _model("carton", (("carton", box((0, 0, 0), (118, 84, 62)), SAND),))


def symmetries_of(name: str) -> tuple[Symmetry, ...]:
    """Rotations under which the CAD of a shape is the same: half turns of a box."""
    if name not in BOX_SHAPES:
        return ()
    x, y, z = shape(name).center_in_model.tolist()
    axes = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    return tuple(Symmetry(axis, (x, y, z), 2) for axis in axes)


def _model(name: str, parts: tuple[tuple[str, Mesh, Color], ...]) -> Model:
    components = [Component(part, vertices, faces.astype(np.int32), color) for part, (vertices, faces), color in parts]
    return make_model(name, tuple(components))


_MAKERS: dict[str, Callable[[], Model]] = {
    "block": block,
    "organic": organic,
    "assembly": assembly,
    "bracket": bracket,
    "flange": flange,
    "ribbed": ribbed,
}
SHAPES = tuple(_MAKERS)
"""Names of the shapes."""
_BOX_MAKERS: dict[str, Callable[[], Model]] = {"carton": carton}
BOX_SHAPES = tuple(_BOX_MAKERS)
"""Names of plain boxes, which show little but what is printed on them; they do not belong to `SHAPES`."""
NEAR_SYMMETRIES = {"flange": (Symmetry((0.0, 0.0, 1.0), (0.0, 0.0, 0.0), 6),)}


@cache
def _made(name: str) -> Model:
    return (_MAKERS | _BOX_MAKERS)[name]()
