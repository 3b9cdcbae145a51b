"""A CAD mesh as a model of polygons for ViSP (.cao), with a list of those edges that are not sharp."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from arview.geometry import Array

Edge = tuple[int, int]
FLAT_DEG = 0.1
"""Triangles with a smaller angle between them lie in one plane."""
SHARP_DEG = 30.0
"""Edges with a smaller angle are seen only where they are a silhouette."""
SAME = 1e-6
"""Vertices nearer to each other than this, in the unit of the mesh, are one."""


@dataclass(frozen=True)
class Polygons:
    """A mesh as polygons.

    Attributes:
        points: (P,3).
        loops: indices of the corners of each polygon, counterclockwise seen from outside.
        smooth: edges of the polygons that are not sharp, with the normals (3,) on both sides.
    """

    points: Array
    loops: tuple[tuple[int, ...], ...]
    smooth: dict[Edge, tuple[Array, Array]]


def polygons_of(vertices: Array, faces: NDArray[np.int32]) -> Polygons:
    """Merge the coplanar triangles of a mesh (V,3), (F,3) into polygons.

    A region with holes stays in triangles, whose inner edges are then among the smooth ones.
    """
    _, first, inverse = np.unique(np.round(vertices / SAME), axis=0, return_index=True, return_inverse=True)
    points, triangles = vertices[first], inverse.reshape(-1)[faces]
    sides = points[triangles]
    normals = np.cross(sides[:, 1] - sides[:, 0], sides[:, 2] - sides[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    has_area = lengths > 0
    triangles, normals = triangles[has_area], normals[has_area] / lengths[has_area, None]
    beside: dict[Edge, list[int]] = defaultdict(list)
    for index, triangle in enumerate(triangles.tolist()):
        for edge in _edges(triangle):
            beside[_undirected(edge)].append(index)
    pairs = np.array([around for around in beside.values() if len(around) == 2], dtype=np.int64).reshape(-1, 2)
    is_flat = np.sum(normals[pairs[:, 0]] * normals[pairs[:, 1]], axis=1) > np.cos(np.radians(FLAT_DEG))
    flat = pairs[is_flat]
    graph = coo_array((np.ones(len(flat)), (flat[:, 0], flat[:, 1])), shape=(len(triangles), len(triangles)))
    _, regions = connected_components(graph, directed=False)
    order = np.argsort(regions, kind="stable")
    groups = np.split(order, np.flatnonzero(np.diff(regions[order])) + 1)
    loops = [loop for group in groups for loop in _loops(points, triangles[group], normals[group[0]])]
    smooth = {}
    for loop in loops:
        for edge in map(_undirected, _edges(loop)):
            around = beside[edge]
            if len(around) == 2 and normals[around[0]] @ normals[around[1]] > np.cos(np.radians(SHARP_DEG)):
                smooth[edge] = (normals[around[0]], normals[around[1]])
    return Polygons(points, tuple(loops), smooth)


def _undirected(edge: Edge) -> Edge:
    return min(edge), max(edge)


def _edges(loop: Iterable[int]) -> list[Edge]:
    corners = list(loop)
    return list(zip(corners, corners[1:] + corners[:1], strict=True))


def _loops(points: Array, triangles: NDArray[np.int32], normal: Array) -> list[tuple[int, ...]]:
    """The outline of coplanar triangles, or these themselves where the outline is not one simple loop."""
    plain = [tuple(triangle) for triangle in triangles.tolist()]
    if len(plain) == 1:
        return plain
    directed = {edge for triangle in plain for edge in _edges(triangle)}
    outline = [(a, b) for a, b in directed if (b, a) not in directed]
    following = dict(outline)
    if len(following) != len(outline):
        return plain
    loop = [outline[0][0]]
    while (after := following[loop[-1]]) != loop[0]:
        loop.append(after)
        if len(loop) > len(outline):
            return plain
    return [_from_convex(points, loop, normal)] if len(loop) == len(outline) else plain


def _from_convex(points: Array, loop: list[int], normal: Array) -> tuple[int, ...]:
    """The loop from where its first three corners give its normal best: ViSP takes it from these."""
    corners = points[loop]
    first, second = np.roll(corners, -1, axis=0) - corners, np.roll(corners, -2, axis=0) - corners
    start = int(np.argmax(np.cross(first, second) @ normal))
    return tuple(loop[start:] + loop[:start])


def write_cao(path: Path, polygons: Polygons) -> None:
    """Write polygons in ViSP's format; their unit is that of the points."""
    lines = ["V1", str(len(polygons.points))]
    lines += [" ".join(f"{value:.9f}" for value in point) for point in polygons.points]
    lines += ["0", "0", str(len(polygons.loops))]  # lines and faces of lines
    lines += [" ".join(map(str, (len(loop), *loop))) for loop in polygons.loops]
    lines += ["0", "0"]  # cylinders and circles
    path.write_text("\n".join(lines) + "\n")


def write_smooth(path: Path, polygons: Polygons) -> None:
    """Write a line for each smooth edge: its ends and the normals on both sides, twelve numbers."""
    lines = []
    for (a, b), (one, other) in polygons.smooth.items():
        numbers = np.concatenate([polygons.points[a], polygons.points[b], one, other])
        lines.append(" ".join(f"{value:.9f}" for value in numbers))
    path.write_text("\n".join(lines) + "\n" if lines else "")
