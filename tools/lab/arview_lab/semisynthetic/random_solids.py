"""Random solids of many kinds, for training networks that are not specific to any part."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from arview.cad import Component, Model, make_model
from arview.geometry import Array, exp_so3, rigid
from arview_lab.semisynthetic.solids import (
    Loop,
    Mesh,
    box,
    circle,
    cylinder,
    lump,
    moved,
    prism,
    rectangle,
    tube,
)

Rng = np.random.Generator
Color = tuple[float, float, float]
Spot = tuple[float, float]
HALF_SIZE_MM = (36.0, 85.0)
"""Range of about half the size of the solids."""
ONE_COLOUR = 0.5
"""Share of the solids that have one colour."""


def random_solid(seed: int) -> Model:
    """A random solid: a plate with features, a smooth body, a stepped prism, a turned part, a frame, or many features.

    The same seed gives the same solid.

    Raises:
        ValueError: outlines of this seed cross each other; use another.
    """
    rng = np.random.default_rng(seed)
    size = rng.uniform(*HALF_SIZE_MM)
    kinds = (_plate, _plate, _smooth, _stepped, _turned, _frame, _smooth_with_things, _finned, _finned, _studded)
    meshes = kinds[seed % len(kinds)](size, rng)
    whole, is_one = _colour(rng), rng.random() < ONE_COLOUR
    return _model(f"random_{seed}", meshes, lambda: whole if is_one else _colour(rng))


def random_near_symmetric(seed: int) -> Model:
    """A random solid that is symmetric under some rotations but for one or two features: a disc or a plate.

    The same seed gives the same solid.

    Raises:
        ValueError: outlines of this seed cross each other; use another.
    """
    rng = np.random.default_rng([seed, 1])
    size = rng.uniform(*HALF_SIZE_MM)
    meshes = (_even_disc if rng.random() < 0.6 else _even_plate)(size, rng)
    whole = _colour(rng)
    return _model(f"twin_{seed}", meshes, lambda: whole)


def _model(name: str, meshes: list[Mesh], colour: Callable[[], Color]) -> Model:
    """A model of bodies, coloured in turn."""
    parts = [
        Component(f"body_{k}", vertices, faces.astype(np.int32), colour()) for k, (vertices, faces) in enumerate(meshes)
    ]
    return make_model(name, tuple(parts))


def _plate(size: float, rng: Rng) -> list[Mesh]:
    a, b, thick = size, size * rng.uniform(0.5, 1.0), size * rng.uniform(0.06, 0.25)
    is_rectangle = rng.random() < 0.6
    outline = rectangle((-a, -b), (a, b)) if is_rectangle else _polygon(a, b, rng)
    holes: tuple[Loop, ...] = ()
    if is_rectangle and rng.random() < 0.7:
        centers = ((-0.75 * a, -0.7 * b), (0.7 * a, 0.65 * b))
        holes = tuple(circle(center, size * rng.uniform(0.03, 0.1)) for center in centers)
    meshes = [prism(outline, holes, 0.0, thick), *_things(2, 9, 0.65 * a, 0.65 * b, thick, size, rng)]
    if rng.random() < 0.4:
        meshes += _upside_down(_things(1, 4, 0.6 * a, 0.6 * b, 0.0, size, rng))
    return meshes


def _smooth(size: float, rng: Rng) -> list[Mesh]:
    bumps = []
    for _ in range(rng.integers(2, 8)):
        x, y, z = rng.normal(size=3)
        bumps.append(((float(x), float(y), float(z)), size * rng.uniform(-0.2, 0.5), rng.uniform(0.3, 0.7)))
    return [lump(size * rng.uniform((0.4, 0.3, 0.3), (1.0, 0.8, 0.7)), bumps, 4)]


def _smooth_with_things(size: float, rng: Rng) -> list[Mesh]:
    things = _things(1, 4, 0.3 * size, 0.3 * size, 0.2 * size, size, rng)
    return [*_smooth(size, rng), *(_turned_about(mesh, rng) for mesh in things)]


def _stepped(size: float, rng: Rng) -> list[Mesh]:
    count = rng.integers(2, 5)
    places = np.sort(rng.uniform(-size, size, count + 1))
    places[0], places[-1] = -size, size
    heights = size * rng.uniform(0.2, 1.1, count)
    corners = [(-size, 0.0), (size, 0.0)]
    for k in reversed(range(count)):
        corners += [(places[k + 1], heights[k]), (places[k], heights[k])]
    body = prism(np.array(corners), (), -size * rng.uniform(0.2, 0.5), size * rng.uniform(0.2, 0.5))
    return [_turned_about(body, rng), *_things(0, 4, 0.4 * size, 0.4 * size, 0.0, size, rng)]


def _turned(size: float, rng: Rng) -> list[Mesh]:
    meshes, top = [], 0.0
    for _ in range(rng.integers(2, 5)):
        height, radius = size * rng.uniform(0.1, 0.6), size * rng.uniform(0.2, 0.9)
        is_tube, inner = rng.random() < 0.4, radius * rng.uniform(0.3, 0.8)
        new = tube((0, 0), radius, inner, top, top + height) if is_tube else cylinder((0, 0), radius, top, top + height)
        meshes.append(new)
        top += height
    # Features on one side, because a body of revolution has no orientation.
    return meshes + _things(1, 4, 0.5 * size, 0.5 * size, top * rng.uniform(0.2, 0.9), size, rng)


def _frame(size: float, rng: Rng) -> list[Mesh]:
    w, d, h = size, size * rng.uniform(0.5, 1.0), size * rng.uniform(0.3, 1.0)
    thick = size * rng.uniform(0.02, 0.1)
    walls = [
        box((-w, -d, 0), (w, -d + thick, h)),
        box((-w, d - thick, 0), (w, d, h)),
        box((-w, -d, 0), (-w + thick, d, h)),
        box((w - thick, -d, 0), (w, d, h)),
        box((-w, -d, 0), (w, d, thick)),
    ]
    kept = [wall for wall in walls if rng.random() < 0.8] or walls[:2]
    return kept + _things(0, 5, 0.6 * w, 0.6 * d, thick, size, rng)


def _finned(size: float, rng: Rng) -> list[Mesh]:
    """A slab with groups of small holes, thin ribs and pins; from afar or from below it is nearly plain."""
    a, b, thick = size, size * rng.uniform(0.4, 1.0), size * rng.uniform(0.05, 0.35)
    holes: list[Loop] = []
    for x, y in [spot for _ in range(rng.integers(0, 4)) for spot in _spots(0.9 * a, 0.9 * b, size, rng)]:
        radius = size * rng.uniform(0.012, 0.035)
        if all(np.hypot(*(np.mean(hole, axis=0) - (x, y))) > 0.1 * size for hole in holes):
            holes.append(circle((x, y), radius, 16))
    meshes = [prism(rectangle((-a, -b), (a, b)), tuple(holes), 0.0, thick)]
    for _ in range(rng.integers(0, 3)):
        count, wide = rng.integers(3, 13), size * rng.uniform(0.01, 0.03)
        pitch = rng.uniform(3.0, 8.0) * wide
        x0, y0 = rng.uniform(-0.9 * a, 0.9 * a), rng.uniform(-0.9 * b, 0.2 * b)
        y1, rise = min(0.95 * b, y0 + size * rng.uniform(0.3, 1.2)), size * rng.uniform(0.04, 0.35)
        for x in np.arange(x0, 0.95 * a - wide, pitch)[:count]:
            top = thick + rise * (rng.uniform(0.6, 1.0) if rng.random() < 0.3 else 1.0)
            meshes.append(box((x, y0, thick), (x + wide, y1, top)))
    for _ in range(rng.integers(0, 4)):
        meshes += _studs(a, b, thick, size, rng)
    if rng.random() < 0.3:
        meshes += _things(1, 3, 0.6 * a, 0.6 * b, thick, size, rng)
    if rng.random() < 0.25:
        meshes += _upside_down(_studs(a, b, 0.0, size, rng))
    return meshes


def _studded(size: float, rng: Rng) -> list[Mesh]:
    """A block with groups of small studs on some of its sides."""
    half = size * rng.uniform(0.3, 1.0, 3)
    meshes = [box(-half, half)]
    for axis, sign in [(axis, sign) for axis in range(3) for sign in (-1.0, 1.0) if rng.random() < 0.6]:
        i, j = (axis + 1) % 3, (axis + 2) % 3
        outward = np.zeros((3, 3))
        outward[i, 0], outward[j, 1], outward[axis, 2] = 1.0, sign, sign
        place = rigid(outward, np.zeros(3))
        meshes += [moved(mesh, place) for mesh in _studs(half[i], half[j], half[axis], size, rng)]
    return meshes + [_turned_about(mesh, rng) for mesh in _things(0, 3, 0.3 * size, 0.3 * size, 0.3 * size, size, rng)]


def _even_disc(size: float, rng: Rng) -> list[Mesh]:
    """A disc with a hub and evenly spaced holes and features, and something that breaks its symmetry."""
    count = int(rng.choice((0, 2, 3, 4, 5, 6, 6, 8)))
    thick, angles = size * rng.uniform(0.06, 0.35), 2.0 * np.pi * (np.arange(count) + 0.5) / max(1, count)
    rim = circle((0, 0), size, 4 * int(rng.integers(1, 4)) if rng.random() < 0.2 else 180)
    hub, ring = size * rng.uniform(0.15, 0.5), size * rng.uniform(0.65, 0.8)
    wide = size * rng.uniform(0.04, 0.12)
    spots = [(float(ring * np.cos(a)), float(ring * np.sin(a))) for a in angles]
    is_holed, is_thinged = rng.random() < 0.7, rng.random() < 0.25
    breaks = rng.permutation(5)[: rng.integers(1, 3)]
    if 0 in breaks or (count == 0 and 1 in breaks) or not (is_holed or is_thinged):
        rim = _notched(rim, size * rng.uniform(0.05, 0.2), size * rng.uniform(0.05, 0.18))
    round_things = _uneven(spots, wide, 1 in breaks, 2 in breaks, (0.6, 1.5), rng)
    holes = [circle(*thing, 24) for thing in round_things] if is_holed else []
    if 3 in breaks:
        holes.append(circle((ring, 0.0), wide * rng.uniform(0.4, 1.0), 24))
    bore = hub * rng.uniform(0.3, 0.8)
    is_bored = rng.random() < 0.6
    if is_bored:
        holes.append(circle((0, 0), bore, 48))
    meshes = [prism(rim, tuple(holes), 0.0, thick)]
    if rng.random() < 0.85:
        top = thick + size * rng.uniform(0.1, 0.9)
        meshes.append(tube((0, 0), hub, bore, thick, top) if is_bored else cylinder((0, 0), hub, thick, top))
    if rng.random() < 0.3:
        meshes.append(tube((0, 0), hub * 1.2, hub, thick, thick + size * rng.uniform(0.05, 0.2)))
    if rng.random() < 0.3:
        meshes.append(tube((0, 0), 1.1 * hub, bore, -size * rng.uniform(0.05, 0.4), 0.0))
    if is_thinged and not is_holed:
        high = thick + size * rng.uniform(0.05, 0.3)
        meshes += [cylinder(*thing, thick, high, 20) for thing in round_things]
    if 4 in breaks:
        meshes += _small_thing(0.5 * (hub + ring), thick, size, rng)
    return meshes


def _even_plate(size: float, rng: Rng) -> list[Mesh]:
    """A plate with pairs of features and holes, symmetric under half a turn but for something that breaks it."""
    a, b, thick = size, size * rng.uniform(0.3, 1.0), size * rng.uniform(0.06, 0.4)
    outline = rectangle((-a, -b), (a, b))
    breaks = rng.permutation(4)[: rng.integers(1, 3)]
    if 0 in breaks:
        cut_a, cut_b = rng.uniform(0.1, 0.4) * b, rng.uniform(0.1, 0.4) * b
        outline = np.concatenate([outline[:2], [(a, b - cut_b), (a - cut_a, b)], outline[3:]])
    wide = min(0.12 * size, 0.15 * b) * rng.uniform(0.4, 1.0)
    corners = [(x * (a - 2.0 * wide), y * (b - 2.0 * wide)) for x, y in ((-1, -1), (1, 1), (-1, 1), (1, -1))]
    corners = corners[: 2 * int(rng.integers(1, 3))]
    round_things = _uneven(corners, wide, 1 in breaks, 2 in breaks, (0.5, 1.4), rng)
    if rng.random() < 0.7 and 0 not in breaks:
        meshes = [prism(outline, tuple(circle(*thing, 24) for thing in round_things), 0.0, thick)]
    else:
        meshes = [prism(outline, (), 0.0, thick)]
        high = thick + size * rng.uniform(0.05, 0.5)
        meshes += [cylinder(*thing, thick, high, 20) for thing in round_things]
    half_turn = rigid(exp_so3([0.0, 0.0, np.pi]), np.zeros(3))
    for mesh in _things(0, 4, 0.4 * a, 0.4 * b, thick, size, rng):
        meshes += [mesh, moved(mesh, half_turn)]
    if 3 in breaks:
        meshes += _small_thing(0.7 * b, thick, size, rng)
    return meshes


def _uneven(
    spots: list[Spot], wide: float, is_one_missing: bool, is_one_other: bool, factors: tuple[float, float], rng: Rng
) -> list[tuple[Spot, float]]:
    """Centres and equal radii, of which the first may be missing, or wider or narrower by one of two factors."""
    if is_one_missing:
        return [(spot, wide) for spot in spots[1:]]
    first = wide * rng.choice(factors) if is_one_other and spots else wide
    return [(spot, wide if k else first) for k, spot in enumerate(spots)]


def _small_thing(place: float, low: float, size: float, rng: Rng) -> list[Mesh]:
    """A small box or post on a plane, at a distance from its centre."""
    wide, top = size * rng.uniform(0.04, 0.12), low + size * rng.uniform(0.03, 0.25)
    if rng.random() < 0.5:
        return [cylinder((place, 0.0), wide, low, top, 20)]
    return [box((place - wide, -0.7 * wide, low), (place + wide, 0.7 * wide, top))]


def _notched(rim: Loop, wide: float, deep: float) -> Loop:
    """A round outline with a rectangle cut out of it where it crosses +X."""
    radius = float(np.linalg.norm(rim, axis=1).max())
    inside = (np.abs(rim[:, 1]) < 0.5 * wide) & (rim[:, 0] > 0.0)
    edge = np.sqrt(radius**2 - 0.25 * wide**2)
    notch = np.array([(edge, -wide), (radius - deep, -wide), (radius - deep, wide), (edge, wide)]) * (1.0, 0.5)
    angles = np.arctan2(rim[~inside, 1], rim[~inside, 0]) % (2.0 * np.pi)
    return np.concatenate([notch[2:], rim[~inside][np.argsort(angles)], notch[:2]])


def _studs(reach_x: float, reach_y: float, low: float, size: float, rng: Rng) -> list[Mesh]:
    """A group of small pins or boxes on a plane."""
    wide, top = size * rng.uniform(0.01, 0.04), low + size * rng.uniform(0.01, 0.2)
    are_round = rng.random() < 0.6
    spots = _spots(0.9 * reach_x, 0.9 * reach_y, size, rng)
    if are_round:
        return [cylinder(spot, wide, low, top, 12) for spot in spots]
    return [box((x - wide, y - 0.6 * wide, low), (x + wide, y + 0.6 * wide, top)) for x, y in spots]


def _spots(reach_x: float, reach_y: float, size: float, rng: Rng) -> list[Spot]:
    """Positions in rows and columns, of which some are left out."""
    pitch, columns, rows = size * rng.uniform(0.09, 0.2), rng.integers(1, 10), rng.integers(1, 5)
    x0, y0 = rng.uniform(-reach_x, reach_x), rng.uniform(-reach_y, reach_y)
    if rng.random() < 0.3:
        columns, rows = rows, columns
    spots = []
    for k in range(columns * rows):
        x, y = x0 + pitch * (k % columns), y0 + pitch * (k // columns)
        if abs(x) < reach_x and abs(y) < reach_y and rng.random() < 0.93:
            spots.append((float(x), float(y)))
    return spots


def _things(
    low_count: int, end_count: int, reach_x: float, reach_y: float, low: float, size: float, rng: Rng
) -> list[Mesh]:
    """Boxes, posts, tubes, nuts, walls and irregular prisms on a plane."""
    made = []
    for _ in range(rng.integers(low_count, end_count)):
        x, y = rng.uniform(-reach_x, reach_x), rng.uniform(-reach_y, reach_y)
        top, wide = low + size * rng.uniform(0.1, 0.7), size * rng.uniform(0.06, 0.22)
        deep, inner = wide * rng.uniform(0.3, 1.0), wide * rng.uniform(0.4, 0.8)
        kinds = (
            lambda x=x, y=y, w=wide, d=deep, t=top: box((x - w, y - d, low), (x + w, y + d, t)),
            lambda x=x, y=y, w=wide, t=top: cylinder((x, y), 0.7 * w, low, t),
            lambda x=x, y=y, w=wide, i=inner, t=top: tube((x, y), w, i, low, t),
            lambda x=x, y=y, w=wide, t=top: prism(circle((x, y), 0.8 * w, 6, rng.random()), (), low, 0.5 * (low + t)),
            lambda x=x, y=y, w=wide, t=top: box((x - 0.02 * size, y - w, low), (x + 0.02 * size, y + w, t)),
            lambda x=x, y=y, w=wide, d=deep, t=top: prism(np.array([x, y]) + _polygon(w, d, rng), (), low, t),
        )
        made.append(kinds[rng.integers(len(kinds))]())
    return made


def _polygon(radius_x: float, radius_y: float, rng: Rng) -> Loop:
    """A convex polygon of 4 to 8 corners on an ellipse, around its centre."""
    while True:
        angles = np.sort(rng.uniform(0.0, 2.0 * np.pi, rng.integers(4, 9)))
        if np.max(np.diff(np.append(angles, angles[0] + 2.0 * np.pi))) < 2.4:
            return np.stack([radius_x * np.cos(angles), radius_y * np.sin(angles)], axis=1)


def _upside_down(meshes: list[Mesh]) -> list[Mesh]:
    turn = rigid(exp_so3([np.pi, 0, 0]), np.zeros(3))
    return [moved(mesh, turn) for mesh in meshes]


def _turned_about(mesh: Mesh, rng: Rng) -> Mesh:
    """The mesh rotated by quarter turns about one of the axes."""
    axis: Array = np.eye(3)[rng.integers(3)]
    return moved(mesh, rigid(exp_so3(0.5 * np.pi * rng.integers(4) * axis), np.zeros(3)))


def _colour(rng: Rng) -> Color:
    """Mostly greys, some muted and a few strong colours."""
    kind = rng.random()
    if kind < 0.8:
        grey, tint = (rng.uniform(0.1, 0.75), 0.02) if kind < 0.5 else (rng.uniform(0.2, 0.7), 0.12)
        r, g, b = np.clip(grey + rng.normal(0.0, tint, 3), 0.03, 0.95)
    else:
        r, g, b = rng.uniform(0.03, 0.95, 3)
    return float(r), float(g), float(b)
