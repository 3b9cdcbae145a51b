"""Curved test shapes: smooth closed bodies without edges, made as level sets of implicit functions.

Bodies are joined by the polynomial smooth minimum (Quilez, "Smooth minimum", 2013), meshed by surface nets (Gibson,
"Constrained elastic surface nets", MICCAI 1998), and the vertices are then moved onto the level set by Newton steps.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicSpline

from arview.cad import Component, Model, make_model
from arview.errors import InputError
from arview.geometry import Array
from arview_lab.semisynthetic.solids import Mesh

Field = Callable[[Array], Array]
"""Function of points (...,3) in mm, negative inside a body; near the surface about the distance to it in mm."""

CELLS = 72
"""Cells of the sampling grid along the longest side of a body."""
PROJECTION_STEPS = 3
"""Newton steps that move the vertices onto the level set."""
SMOOTHING_ROUNDS = 5
"""Times that every vertex is moved to the mean of its neighbours, along the level set, for even triangles."""


def curved_shape(name: str) -> Model:
    """The curved test shape of a name.

    Raises:
        InputError: there is no such shape.
    """
    if name not in _MAKERS:
        raise InputError(f"curved shape {name!r} is not known; give one of {', '.join(CURVED_SHAPES)}")
    return _made(name)


def duck() -> Model:
    """A bath duck, 130 mm long: body, head, beak, tail and wings without a sharp edge."""
    body = ellipsoid((0, 0, 0), (52, 38, 33))
    tail = capsule((-38, 0, 10), (-62, 0, 34), 14, 5)
    wings = [ellipsoid((-8, side * 34, 6), (30, 9, 17)) for side in (-1, 1)]
    head = ellipsoid((34, 0, 47), (24, 23, 24))
    neck = capsule((24, 0, 18), (32, 0, 40), 22, 18)
    beak = ellipsoid((60, 0, 42), (13, 12, 5))
    body = smooth_union([body, tail, neck], 16.0)
    body = smooth_union([body, *wings], 6.0)
    return _model("duck", smooth_union([smooth_union([body, head], 8.0), beak], 4.0), (-80, 80), (0.86, 0.66, 0.10))


def cat() -> Model:
    """A sitting cat, 150 mm high, with ears, paws and a tail laid to one side."""
    trunk = [ellipsoid((-6, 0, 34), (40, 32, 36)), capsule((4, 0, 40), (20, 0, 92), 27, 17)]
    head = [ellipsoid((28, 0, 112), (25, 25, 22)), ellipsoid((46, 0, 105), (12, 12, 9))]
    ears = [capsule((24, side * 13, 122), (20, side * 21, 148), 9, 3) for side in (-1, 1)]
    legs = [capsule((24, side * 14, 60), (36, side * 15, 8), 10, 9) for side in (-1, 1)]
    haunches = [ellipsoid((-2, side * 27, 22), (27, 13, 21)) for side in (-1, 1)]
    tail = rod([(-36, 0, 14), (-54, 26, 9), (-34, 52, 9), (4, 58, 9), (30, 46, 12)], 8.0)
    whole = smooth_union([smooth_union(trunk, 18.0), smooth_union(head, 6.0)], 9.0)
    whole = smooth_union([whole, *ears, *legs, *haunches], 7.0)
    return _model("cat", smooth_union([whole, tail], 6.0), (-90, 160), (0.30, 0.31, 0.36))


def jug() -> Model:
    """A glazed jug, 170 mm high: a body of revolution with a handle and a spout, open at the top."""
    profile = [ellipsoid((0, 0, 38), (47, 47, 44)), capsule((0, 0, 60), (0, 0, 150), 37, 30)]
    outside = smooth_union(profile, 26.0)
    spout = capsule((22, 0, 112), (47, 0, 136), 18, 11)
    handle = rod([(-26, 0, 116), (-56, 0, 124), (-74, 0, 98), (-66, 0, 64), (-42, 0, 44)], 8.0)
    above = capsule((0, 0, 640), (0, 0, 641), 500, 500)
    cut = smooth_difference(smooth_union([outside, spout], 10.0), above, 5.0)
    solid = smooth_union([cut, handle], 8.0)
    hollow = smooth_union([capsule((0, 0, 80), (0, 0, 190), 21, 21), capsule((14, 0, 130), (56, 0, 154), 11, 8)], 4.0)
    return _model("jug", smooth_difference(solid, hollow, 5.0), (-90, 175), (0.22, 0.36, 0.52))


def mug() -> Model:
    """A mug, 95 mm high: a plain body of revolution, open at the top, whose handle hides behind it from many sides."""
    outside = capsule((0, 0, 22), (0, 0, 130), 40, 40)
    above = capsule((0, 0, 595), (0, 0, 596), 500, 500)
    handle = rod([(-36, 0, 78), (-58, 0, 74), (-66, 0, 52), (-56, 0, 30), (-36, 0, 26)], 6.0)
    solid = smooth_union([smooth_difference(outside, above, 3.0), handle], 4.0)
    return _model(
        "mug", smooth_difference(solid, capsule((0, 0, 42), (0, 0, 200), 35, 35), 3.0), (-75, 130), (0.62, 0.58, 0.50)
    )


def manifold() -> Model:
    """A cast pipe manifold, 190 mm long: a bent main pipe with three branches and thick rounded collars."""
    angle = np.linspace(0.0, 0.62 * np.pi, 7)
    arc = np.stack([120 * np.sin(angle) - 70, np.zeros(7), 70 - 90 * (1 - np.cos(angle))], axis=1)
    branches = [
        capsule(arc[1], arc[1] + (8, 52, 12), 13, 12),
        capsule(arc[3], arc[3] + (22, -46, 20), 15, 13),
        capsule(arc[5], arc[5] + (44, 14, 14), 12, 12),
    ]
    collars = [
        collar(arc[0], (-1, 0, 0), 29, 7),
        collar(arc[6], arc[6] - arc[5], 29, 7),
        collar(arc[1] + (8, 52, 12), (8, 52, 12), 21, 6),
        collar(arc[3] + (22, -46, 20), (22, -46, 20), 24, 6),
        collar(arc[5] + (44, 14, 14), (44, 14, 14), 20, 6),
    ]
    pipes = smooth_union([rod(arc, 18.0), *branches], 12.0)
    return _model("manifold", smooth_union([pipes, *collars], 5.0), (-130, 130), (0.52, 0.16, 0.12))


# --- Implicit functions ---------------------------------------------------------------------------------


def ellipsoid(center: ArrayLike, radii: ArrayLike) -> Field:
    """An axis-aligned ellipsoid; the distance is a first-order estimate."""
    middle, axes = np.asarray(center, dtype=np.float64), np.asarray(radii, dtype=np.float64)

    def field(points: Array) -> Array:
        scaled = (points - middle) / axes
        length = np.linalg.norm(scaled, axis=-1)
        slope = np.linalg.norm(scaled / axes, axis=-1)
        return length * (length - 1.0) / np.maximum(slope, 1e-9)

    return field


def capsule(start: ArrayLike, end: ArrayLike, first_radius: float, last_radius: float) -> Field:
    """A rod with round ends, whose radius changes linearly."""
    a, b = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)

    def field(points: Array) -> Array:
        along = np.clip((points - a) @ (b - a) / ((b - a) @ (b - a)), 0.0, 1.0)
        nearest = a + along[..., None] * (b - a)
        return np.linalg.norm(points - nearest, axis=-1) - (first_radius + along * (last_radius - first_radius))

    return field


def rod(points: ArrayLike, radius: float) -> Field:
    """A round rod of constant radius along a smooth curve through points (N,3)."""
    through = np.asarray(points, dtype=np.float64)
    fine = np.linspace(0.0, len(through) - 1.0, 4 * len(through))
    path = CubicSpline(np.arange(len(through)), through)(fine)
    pieces = [capsule(a, b, radius, radius) for a, b in pairwise(path)]

    def field(points: Array) -> Array:
        nearest = pieces[0](points)
        for piece in pieces[1:]:
            nearest = np.minimum(nearest, piece(points))
        return nearest

    return field


def collar(center: ArrayLike, axis: ArrayLike, radius: float, rounding: float) -> Field:
    """A thick disc with a round rim, at a right angle to an axis."""
    middle = np.asarray(center, dtype=np.float64)
    way = np.asarray(axis, dtype=np.float64) / np.linalg.norm(axis)

    def field(points: Array) -> Array:
        offset = points - middle
        height = offset @ way
        across = np.linalg.norm(offset - height[..., None] * way, axis=-1)
        beyond = np.maximum(across - (radius - rounding), 0.0)
        return np.hypot(beyond, height) - rounding

    return field


def smooth_union(fields: list[Field], width_mm: float) -> Field:
    """Union of bodies whose seams are rounded over a width."""

    def field(points: Array) -> Array:
        total = fields[0](points)
        for other in fields[1:]:
            value = other(points)
            share = np.maximum(width_mm - np.abs(total - value), 0.0) / width_mm
            total = np.minimum(total, value) - 0.25 * width_mm * share**2
        return total

    return field


def smooth_difference(body: Field, hollow: Field, width_mm: float) -> Field:
    """A body without another, with a rounded rim."""
    return _negative(smooth_union([_negative(body), hollow], width_mm))


def _negative(body: Field) -> Field:
    return lambda points: -body(points)


# --- Meshing --------------------------------------------------------------------------------------------


def surface_net(field: Field, low: ArrayLike, high: ArrayLike) -> Mesh:
    """Closed mesh of the level set 0 of a field inside a box, whose vertices lie on it.

    Args:
        field: see `Field`; positive on the box's sides.
        low, high: (3,) corners of the box, mm.
    """
    first, last = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
    # Where two sheets meet in one cell the net is not a manifold; another grid parts them.
    for count in range(CELLS, 2 * CELLS):
        step = float((last - first).max()) / count
        cells, faces = _net(field, first, last, step)
        if _is_closed(faces):
            break
    else:
        raise ValueError("no grid gives a closed mesh of this body")
    vertices = _on_level_set(field, first + step * (cells + 0.5), step)
    for _ in range(SMOOTHING_ROUNDS):
        vertices = _on_level_set(field, _averaged(vertices, faces), step)
    return vertices, faces


def _net(field: Field, first: Array, last: Array, step: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Cells (V,3) of a grid that the surface passes through, and the triangles (F,3) between them."""
    counts = np.ceil((last - first) / step).astype(int) + 1
    axes = [first[k] + step * np.arange(counts[k]) for k in range(3)]
    inside = field(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)) < 0.0
    number = np.full(tuple(counts - 1), -1, dtype=np.int64)
    corners = np.stack([inside[i : i - 1 or None, j : j - 1 or None, k : k - 1 or None]
                        for i in (0, 1) for j in (0, 1) for k in (0, 1)])  # fmt: skip
    mixed = corners.any(axis=0) & ~corners.all(axis=0)
    cells = np.argwhere(mixed)
    number[mixed] = np.arange(len(cells))
    return cells, np.concatenate([_quads(inside, number, axis) for axis in range(3)])


def _averaged(vertices: Array, faces: NDArray[np.int64]) -> Array:
    """Every vertex (V,3) moved half of the way to the mean of those it shares a triangle with."""
    sums, counts = np.zeros_like(vertices), np.zeros(len(vertices))
    for k in (1, 2):
        other = np.roll(faces, -k, axis=1).ravel()
        np.add.at(sums, faces.ravel(), vertices[other])
        np.add.at(counts, faces.ravel(), 1.0)
    return 0.5 * vertices + 0.5 * sums / np.maximum(counts, 1.0)[:, None]


def _quads(inside: NDArray[np.bool_], number: NDArray[np.int64], axis: int) -> NDArray[np.int64]:
    """Triangles (T,3) of the quads around the grid edges of one axis that the surface crosses."""
    before = np.moveaxis(inside, axis, 0)
    cells = np.moveaxis(number, axis, 0)
    crossed = before[:-1] != before[1:]
    crossed[:, [0, -1]] = False
    crossed[:, :, [0, -1]] = False
    i, j, k = np.nonzero(crossed)
    around = np.stack([cells[i, j - 1, k - 1], cells[i, j, k - 1], cells[i, j, k], cells[i, j - 1, k]], axis=1)
    outward = before[:-1][crossed]
    # The other two axes keep their order when one is moved to the front; for the middle axis that is a reflection.
    turned = outward != (axis == 1)
    around[~turned] = around[~turned][:, ::-1]
    return np.concatenate([around[:, [0, 1, 2]], around[:, [0, 2, 3]]])


def _on_level_set(field: Field, points: Array, step: float) -> Array:
    """Points moved along the field's gradient to its level set 0, at most a cell in each Newton step."""
    for _ in range(PROJECTION_STEPS):
        value = field(points)
        gradient = _gradient(field, points)
        move = -value[:, None] * gradient / np.maximum((gradient**2).sum(axis=1, keepdims=True), 1e-6)
        length = np.linalg.norm(move, axis=1, keepdims=True)
        points = points + move * np.minimum(1.0, step / np.maximum(length, 1e-12))
    return points


def _gradient(field: Field, points: Array, delta: float = 1e-3) -> Array:
    steps = delta * np.eye(3)
    return np.stack([(field(points + d) - field(points - d)) / (2.0 * delta) for d in steps], axis=-1)


def _model(name: str, field: Field, bounds: tuple[float, float], color: tuple[float, float, float]) -> Model:
    """Model of one body; the bounds only say where to search for it, along every axis."""
    axis = np.linspace(bounds[0], bounds[1], 41)
    places = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)
    inside = places[field(places) < 0.0]
    margin = 2.0 * (axis[1] - axis[0])
    low, high = inside.min(axis=0) - margin, inside.max(axis=0) + margin
    vertices, faces = surface_net(field, low, high)
    return make_model(name, (Component("body", vertices, faces.astype(np.int32), color),))


def _is_closed(faces: NDArray[np.int64]) -> bool:
    """Whether every directed side of the triangles (F,3) occurs once, and once in the other direction."""
    sides = np.concatenate([faces[:, [k, (k + 1) % 3]] for k in range(3)])
    count = int(faces.max()) + 1
    there, back = (np.unique(s[:, 0] * count + s[:, 1]) for s in (sides, sides[:, ::-1]))
    return len(there) == len(sides) and np.array_equal(there, back)


_MAKERS: dict[str, Callable[[], Model]] = {"duck": duck, "cat": cat, "jug": jug, "mug": mug, "manifold": manifold}
CURVED_SHAPES = tuple(_MAKERS)
"""Names of the curved shapes."""


@cache
def _made(name: str) -> Model:
    return _MAKERS[name]()
