"""Closed triangle meshes of simple solids, from which the test shapes are built.

A `Mesh` is vertices (V,3) float64 in mm and faces (F,3) int64, counter-clockwise seen from outside.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from arview.geometry import Array, apply
from arview.guideviews.sphere import icosphere_directions

Mesh = tuple[Array, NDArray[np.int64]]
Loop = Array
"""(N,2) corners of a closed polygon in mm, counter-clockwise."""

_MAX_HALVINGS = 7
"""Times that a polygon's sides are halved at most."""


def box(low: ArrayLike, high: ArrayLike) -> Mesh:
    """An axis-aligned box."""
    (x0, y0, z0), (x1, y1, z1) = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
    return prism(rectangle((x0, y0), (x1, y1)), (), z0, z1)


def cylinder(center: tuple[float, float], radius: float, low: float, high: float, sides: int = 48) -> Mesh:
    """An upright cylinder."""
    return prism(circle(center, radius, sides), (), low, high)


def tube(center: tuple[float, float], outer: float, inner: float, low: float, high: float) -> Mesh:
    """An upright tube; ``outer`` and ``inner`` are radii."""
    return prism(circle(center, outer, 64), (circle(center, inner, 48),), low, high)


def rectangle(low: tuple[float, float], high: tuple[float, float]) -> Loop:
    """A rectangle's corners."""
    return np.array([low, (high[0], low[1]), high, (low[0], high[1])], dtype=np.float64)


def circle(center: tuple[float, float], radius: float, sides: int = 32, phase_rad: float = 0.0) -> Loop:
    """A regular polygon on a circle; six sides make a nut."""
    angle = phase_rad + 2.0 * np.pi * np.arange(sides) / sides
    return np.asarray(center) + radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def slot(center: tuple[float, float], length: float, width: float, sides: int = 32) -> Loop:
    """A rounded slot along x."""
    ring = circle((0.0, 0.0), 0.5 * width, sides)
    shift = np.where(ring[:, 0] >= 0, 0.5, -0.5) * (length - width)
    return np.asarray(center) + ring + np.stack([shift, np.zeros(sides)], axis=1)


def triangulate(outline: Loop, holes: tuple[Loop, ...] = ()) -> tuple[Array, NDArray[np.int64]]:
    """Points (P,2) and triangles (T,3), counter-clockwise, of a polygon with holes.

    The Delaunay triangulation contains all sides of a polygon if they are short enough, so they are halved until the
    triangles inside cover exactly the polygon's area.

    Raises:
        ValueError: the polygon crosses itself, or a hole crosses its outline.
    """
    from scipy.spatial import Delaunay

    loops = [np.asarray(loop, dtype=np.float64) for loop in (outline, *holes)]
    wanted = _area(loops[0]) - sum(_area(loop) for loop in loops[1:])
    for _ in range(_MAX_HALVINGS):
        points = np.concatenate(loops)
        triangles = Delaunay(points).simplices.astype(np.int64)
        a, b, c = points[triangles].transpose(1, 0, 2)
        doubled = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
        triangles[doubled < 0] = triangles[doubled < 0][:, ::-1]
        middle = (a + b + c) / 3.0
        inside = (np.abs(doubled) > 1e-9) & _contains(loops[0], middle)
        for hole in loops[1:]:
            inside &= ~_contains(hole, middle)
        if abs(0.5 * float(np.abs(doubled[inside]).sum()) - wanted) <= 1e-9 * wanted:
            return points, triangles[inside]
        loops = [_halved(loop) for loop in loops]
    raise ValueError("the polygon crosses itself, or a hole crosses its outline")


def thickened(points: Array, triangles: NDArray[np.int64], low: float, high: float) -> Mesh:
    """The solid between two heights over flat triangles (T,3) of points (P,2)."""
    count = len(points)
    vertices = np.concatenate([np.column_stack([points, np.full(count, z)]) for z in (low, high)])
    sides = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    known = set(map(tuple, sides.tolist()))
    rim = np.array([side for side in sides.tolist() if (side[1], side[0]) not in known], dtype=np.int64)
    i, j = rim.T
    walls = np.concatenate([np.stack([i, j, j + count], axis=1), np.stack([i, j + count, i + count], axis=1)])
    return vertices, np.concatenate([triangles[:, ::-1], triangles + count, walls])


def prism(outline: Loop, holes: tuple[Loop, ...], low: float, high: float) -> Mesh:
    """An upright prism over a polygon with holes."""
    return thickened(*triangulate(outline, holes), low, high)


def sheet(flats: list[tuple[Loop, tuple[Loop, ...]]], bends: list[tuple[float, float, float]], thick: float) -> Mesh:
    """Bent sheet metal from its flat pattern.

    Args:
        flats: flat pieces between the bends, polygons with holes in the pattern's (s, y), mm; pieces on both sides
            of a bend end on its lines.
        bends: (s, angle in deg, inner radius in mm) of each, in order; a bend occupies the pattern from s to
            s + angle · (radius + thick / 2); its sides continue those of the neighbouring pieces.
        thick: thickness of the sheet, mm.

    Returns:
        The sheet in (x, y, z): flat at z = 0 to ``thick`` before the first bend; positive angles bend upwards.
    """
    points, triangles = [], []
    offset = 0
    for outline, holes in flats:
        flat, faces = triangulate(outline, holes)
        points.append(flat)
        triangles.append(faces + offset)
        offset += len(flat)
    for s, angle_deg, radius in bends:
        length = np.deg2rad(abs(angle_deg)) * (radius + 0.5 * thick)
        corners = np.concatenate([outline for outline, _ in flats])
        steps = 9
        edges = [corners[np.abs(corners[:, 0] - end) < 1e-6, 1] for end in (s, s + length)]
        along = np.linspace(0.0, 1.0, steps)
        low = (1 - along) * edges[0].min() + along * edges[1].min()
        high = (1 - along) * edges[0].max() + along * edges[1].max()
        points += [np.column_stack([s + along * length, low]), np.column_stack([s + along * length, high])]
        k = offset + np.arange(steps - 1)
        triangles.append(np.stack([k, k + 1, k + 1 + steps], axis=1))
        triangles.append(np.stack([k, k + 1 + steps, k + steps], axis=1))
        offset += 2 * steps
    flat, faces = _welded(np.concatenate(points), np.concatenate(triangles))
    vertices, solid = thickened(flat, faces, 0.0, thick)
    return _bent(vertices, bends, thick), solid


def _bent(vertices: Array, bends: list[tuple[float, float, float]], thick: float) -> Array:
    """Vertices (V,3) of the flat sheet (s, y, height) wrapped around its bends."""
    s, height = vertices[:, 0], vertices[:, 2]
    x, z = s.copy(), height.copy()
    start, heading = np.zeros(2), 0.0
    last = 0.0
    for where, angle_deg, radius in bends:
        angle = np.deg2rad(abs(angle_deg))
        sign = np.sign(angle_deg)
        length = angle * (radius + 0.5 * thick)
        forward = np.array([np.cos(heading), np.sin(heading)])
        normal = np.array([-np.sin(heading), np.cos(heading)])
        foot = start + (where - last) * forward
        # The middle surface of the sheet follows a circle whose centre lies on the side to which it bends.
        to_center = 0.5 * thick + sign * (radius + 0.5 * thick)
        center = foot + to_center * normal
        beyond = s > where + 1e-9
        turn = np.clip((s[beyond] - where) / length, 0.0, 1.0) * angle * sign
        reach = np.maximum(s[beyond] - where - length, 0.0)
        c, n = np.cos(heading + turn), np.sin(heading + turn)
        x[beyond] = center[0] - (height[beyond] - to_center) * n + reach * c
        z[beyond] = center[1] + (height[beyond] - to_center) * c + reach * n
        heading += angle * sign
        start = center - to_center * np.array([-np.sin(heading), np.cos(heading)])
        last = where + length
    return np.column_stack([x, vertices[:, 1], z])


def lump(radii: Array, bumps: list[tuple[tuple[float, float, float], float, float]], subdivisions: int = 5) -> Mesh:
    """A smooth closed body: an ellipsoid with rounded bumps and dents.

    Args:
        radii: (3,) half axes of the ellipsoid, mm.
        bumps: (direction, height in mm, width in rad) of each; negative heights are dents.
        subdivisions: of the icosahedron: 5 gives 20,480 triangles.
    """
    from scipy.spatial import ConvexHull

    directions = icosphere_directions(subdivisions)
    radius = 1.0 / np.linalg.norm(directions / np.asarray(radii), axis=1)
    for direction, height, width in bumps:
        way = np.asarray(direction) / np.linalg.norm(direction)
        angle = np.arccos(np.clip(directions @ way, -1.0, 1.0))
        radius += height * np.exp(-0.5 * (angle / width) ** 2)
    faces = ConvexHull(directions).simplices.astype(np.int64)
    a, b, c = directions[faces].transpose(1, 0, 2)
    inward = np.einsum("fk,fk->f", np.cross(b - a, c - a), a) < 0
    faces[inward] = faces[inward][:, ::-1]
    return directions * radius[:, None], faces


def moved(mesh: Mesh, model_from_mesh: Array) -> Mesh:
    """The mesh moved by a rigid transform (4,4)."""
    return apply(model_from_mesh, mesh[0]), mesh[1]


def joined(*meshes: Mesh) -> Mesh:
    """Several bodies as one mesh; they may touch or overlap, no boolean operation is made."""
    offsets = np.cumsum([0, *(len(vertices) for vertices, _ in meshes)])
    faces = [faces + offset for (_, faces), offset in zip(meshes, offsets[:-1], strict=True)]
    return np.concatenate([vertices for vertices, _ in meshes]), np.concatenate(faces)


def _welded(points: Array, triangles: NDArray[np.int64]) -> tuple[Array, NDArray[np.int64]]:
    """Merge points at the same position."""
    _, first, inverse = np.unique(np.round(points, 6), axis=0, return_index=True, return_inverse=True)
    return points[first], inverse.ravel()[triangles].astype(np.int64)


def _area(loop: Loop) -> float:
    x, y = loop.T
    return 0.5 * float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y))


def _halved(loop: Loop) -> Loop:
    middles = 0.5 * (loop + np.roll(loop, -1, axis=0))
    return np.stack([loop, middles], axis=1).reshape(-1, 2)


def _contains(loop: Loop, points: Array) -> NDArray[np.bool_]:
    """Which points (N,2) lie inside a polygon: an odd number of sides to their right."""
    (x0, y0), (x1, y1) = loop.T, np.roll(loop, -1, axis=0).T
    u, v = points[:, :1], points[:, 1:]
    crosses = (y0 > v) != (y1 > v)
    with np.errstate(divide="ignore", invalid="ignore"):
        right = u < x0 + (v - y0) / (y1 - y0) * (x1 - x0)
    return np.asarray(np.count_nonzero(crosses & right, axis=1) % 2 == 1)
