"""Exact closest points on a triangle mesh, for registering and comparing clouds.

The boxes that `arview.rendering.RayCaster` builds are searched from near to far; the closest point of a triangle
follows from the regions of its plane (Ericson, Real-Time Collision Detection, 2005, 5.1.5), and the side of the surface
from angle-weighted normals of edges and corners (Bærentzen & Aanæs, TVCG 2005).
"""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from arview.core.kernel import kernel
from arview.errors import InputError
from arview.geometry import Array
from arview.rendering import RayCaster

_LEAF = 4
"""Triangles in a leaf of the tree."""
_CHUNK = 4096
"""Points that a thread takes at a time."""
_WELD_MM = 1e-5
"""Vertices nearer than this are merged, because files may repeat them for each face."""
_SHARP_DEG = 30.0
"""Faces that meet at a larger angle form an edge; at a smaller angle they belong to a curved surface."""


@dataclass(frozen=True)
class ClosestPoints:
    """Closest points of a surface to N points.

    Attributes:
        points: (N,3) on the surface.
        faces: (N,) int64 index of the triangle, -1 where none is within reach (other values are NaN there).
        distances: (N,) mm, positive outside.
        normals: (N,3) unit: on smooth areas the interpolated normal of the curved surface, on edges the direction in
            which ``distances`` increases.
        is_edge: (N,) whether the closest point lies on an edge or corner of the shape, or on the border of an open
            surface; such a point does not constrain the surface along its normal.
    """

    points: Array
    faces: NDArray[np.int64]
    distances: Array
    normals: Array
    is_edge: NDArray[np.bool_]


class MeshSurface:
    """A triangle mesh for closest-point queries.

    Args:
        vertices: (V,3), mm.
        faces: (F,3), counter-clockwise seen from outside. Faces without area are never returned.
        groups: (F,) component of each face; normals are smoothed only within a component. Default: one component.

    Raises:
        InputError: no face has an area, or a vertex is not finite.
    """

    def __init__(self, vertices: Array, faces: NDArray[np.integer], groups: NDArray[np.integer] | None = None) -> None:
        self.vertices = np.ascontiguousarray(vertices, dtype=np.float64)
        self.faces = np.ascontiguousarray(faces, dtype=np.int64)
        self.groups = np.zeros(len(self.faces), dtype=np.int64) if groups is None else np.asarray(groups, np.int64)
        if not np.isfinite(self.vertices).all():
            raise InputError("surface: a vertex is NaN or infinite")
        self.triangles = self.vertices[self.faces]
        normals = np.cross(self.triangles[:, 1] - self.triangles[:, 0], self.triangles[:, 2] - self.triangles[:, 0])
        doubled = np.linalg.norm(normals, axis=1)
        self.areas = 0.5 * doubled
        used = np.flatnonzero(doubled > 1e-10)
        if len(used) == 0:
            raise InputError("surface: no triangle has an area")
        self.face_normals = normals / np.maximum(doubled, 1e-300)[:, None]
        side_normals, is_edge, corner_normals = self._neighbourhood(used)
        tree = RayCaster(self.vertices, self.faces[used], _LEAF).hierarchy
        self._bounds, self._links, self._order = tree.bounds, tree.links, used[tree.order]
        self._triangles = np.ascontiguousarray(self.triangles[self._order])
        self._sides = np.ascontiguousarray(side_normals[self._order])
        self._is_edge = np.ascontiguousarray(is_edge[self._order])
        self._corner_normals = np.ascontiguousarray(corner_normals[self._order])
        self._place = np.full(len(self.faces), -1, dtype=np.int64)
        self._place[self._order] = np.arange(len(self._order))

    def closest(self, points: Array, reach: float = np.inf, hint: NDArray[np.int64] | None = None) -> ClosestPoints:
        """Closest points of the surface to points (N,3), within ``reach`` mm.

        ``hint`` (N,) are faces that are likely to be near, such as those of the previous query; they only save time.
        """
        points = np.ascontiguousarray(points, dtype=np.float64)
        count = len(points)
        hints = np.full(count, -1, dtype=np.int64) if hint is None else np.where(hint >= 0, self._place[hint], -1)
        out = ClosestPoints(
            np.empty((count, 3)),
            np.empty(count, np.int64),
            np.empty(count),
            np.empty((count, 3)),
            np.empty(count, bool),
        )

        def work(start: int) -> None:
            part = slice(start, start + _CHUNK)
            _query(
                points[part],
                hints[part],
                reach * reach,
                triangles=self._triangles,
                sides=self._sides,
                edges=self._is_edge,
                corner_normals=self._corner_normals,
                bounds=self._bounds,
                links=self._links,
                order=self._order,
                out_points=out.points[part],
                out_faces=out.faces[part],
                out_distances=out.distances[part],
                out_normals=out.normals[part],
                out_edges=out.is_edge[part],
            )

        starts = range(0, count, _CHUNK)
        if count > 2 * _CHUNK:
            list(_pool().map(work, starts))
        else:
            for start in starts:
                work(start)
        return out

    def sample(self, spacing_mm: float, seed: int = 0) -> tuple[Array, NDArray[np.int64]]:
        """Points (N,3) spread evenly by area, one per ``spacing_mm``² but at least one, and the face (N,) of each."""
        return self.spread(max(1, round(self.areas.sum() / spacing_mm**2)), seed)

    def spread(self, count: int, seed: int = 0) -> tuple[Array, NDArray[np.int64]]:
        """``count`` random points (N,3), evenly by area, and the face (N,) of each."""
        rng = np.random.default_rng(seed)
        share = np.cumsum(self.areas) / self.areas.sum()
        faces = np.searchsorted(share, (np.arange(count) + rng.random(count)) / count, side="right")
        faces = np.minimum(faces, len(self.faces) - 1)
        u, v = np.sqrt(rng.random(count)), rng.random(count)
        weights = np.stack([1.0 - u, u * (1.0 - v), u * v], axis=1)
        return np.einsum("nc,ncx->nx", weights, self.triangles[faces]), faces

    def _neighbourhood(self, used: NDArray[np.int64]) -> tuple[Array, NDArray[np.bool_], Array]:
        """Normals at the sides and corners of each face.

        Returns:
            (F,7,3) normals of the face, its sides 01 12 20 and its corners, which determine the side of the surface;
            (F,7) which of these are sharp; (F,3,3) normals at the corners of the smooth surface to which the face
            belongs.
        """
        # Files often repeat vertices for each face; coinciding vertices of two components stay separate.
        _, same = np.unique(np.round(self.vertices / _WELD_MM).astype(np.int64), axis=0, return_inverse=True)
        _, corner = np.unique(
            same.ravel()[self.faces] * (self.groups.max() + 1) + self.groups[:, None], return_inverse=True
        )
        corner, normals = corner.reshape(-1, 3), self.face_normals
        sums, angles = np.zeros((corner.max() + 1, 3)), np.zeros(corner.shape)
        for k in range(3):
            a = self.triangles[:, (k + 1) % 3] - self.triangles[:, k]
            b = self.triangles[:, (k + 2) % 3] - self.triangles[:, k]
            angles[:, k] = np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), np.sum(a * b, axis=1))
            for axis in range(3):
                sums[:, axis] += np.bincount(corner[:, k], angles[:, k] * normals[:, axis], len(sums))
        sides = np.concatenate([corner[used][:, [k, (k + 1) % 3]] for k in range(3)])
        of_face = np.tile(used, 3)
        _, side = np.unique(sides.min(axis=1) * len(sums) + sides.max(axis=1), return_inverse=True)
        side_sums = np.stack([np.bincount(side, normals[of_face, axis]) for axis in range(3)], axis=1)
        # The sum of two unit normals has length 2 cos(angle / 2). A border has one face; more than two are no surface.
        on_side = np.bincount(side)
        is_sharp = (np.linalg.norm(side_sums, axis=1) < 2.0 * np.cos(np.deg2rad(0.5 * _SHARP_DEG))) | (on_side != 2)
        is_sharp_corner = np.zeros(len(sums), dtype=bool)
        is_sharp_corner[sides[is_sharp[side]].ravel()] = True
        out, flags = np.zeros((len(self.faces), 7, 3)), np.zeros((len(self.faces), 7), dtype=bool)
        out[:, 0], out[:, 4:] = normals, sums[corner]
        out[used, 1:4] = side_sums[side].reshape(3, -1, 3).transpose(1, 0, 2)
        flags[:, 4:] = is_sharp_corner[corner]
        flags[used, 1:4] = is_sharp[side].reshape(3, -1).T
        length = np.linalg.norm(out, axis=2, keepdims=True)
        around = np.argsort(corner[used].ravel(), kind="stable")
        ends = np.searchsorted(corner[used].ravel()[around], np.arange(len(sums) + 1))
        smooth = _smooth(corner, normals, angles, np.repeat(used, 3)[around], ends, np.cos(np.deg2rad(_SHARP_DEG)))
        return np.where(length > 1e-9, out / np.maximum(length, 1e-9), normals[:, None]), flags, smooth


@lru_cache(maxsize=1)
def _pool() -> ThreadPoolExecutor:
    """Threads for queries only, so that a thread of another pool can wait for a query without a deadlock."""
    return ThreadPoolExecutor(max(1, min(4, os.cpu_count() or 1)), thread_name_prefix="closest")


@kernel
def _smooth(
    corner: NDArray[np.int64],
    normals: NDArray[np.float64],
    angles: NDArray[np.float64],
    faces_around: NDArray[np.int64],
    ends: NDArray[np.int64],
    min_cosine: float,
) -> NDArray[np.float64]:
    """(F,3,3) normals at the corners of faces, averaged over adjacent faces that meet the face at a small angle."""
    out = np.zeros((len(corner), 3, 3))
    for face in range(len(corner)):
        for k in range(3):
            total = np.zeros(3)
            for j in range(ends[corner[face, k]], ends[corner[face, k] + 1]):
                other = faces_around[j]
                if np.dot(normals[face], normals[other]) > min_cosine:
                    for m in range(3):
                        if corner[other, m] == corner[face, k]:
                            total += angles[other, m] * normals[other]
            length = np.sqrt(np.dot(total, total))
            out[face, k] = total / length if length > 1e-9 else normals[face]
    return out


@kernel(inline=True)
def _to_box(x: Any, y: Any, z: Any, box: Any) -> Any:
    """Squared distance of a point to a box, low xyz and high xyz."""
    dx = max(box[0] - x, 0.0, x - box[3])
    dy = max(box[1] - y, 0.0, y - box[4])
    dz = max(box[2] - z, 0.0, z - box[5])
    return dx * dx + dy * dy + dz * dz


@kernel(numpy_errors=True)
def _on_triangle(px: float, py: float, pz: float, t: NDArray[np.float64]) -> tuple[float, float, int]:
    """Weights of corners 1 and 2 at the closest point of a triangle, and its region: 0 inside, 1–3 side, 4–6 corner."""
    abx, aby, abz = t[1, 0] - t[0, 0], t[1, 1] - t[0, 1], t[1, 2] - t[0, 2]
    acx, acy, acz = t[2, 0] - t[0, 0], t[2, 1] - t[0, 1], t[2, 2] - t[0, 2]
    apx, apy, apz = px - t[0, 0], py - t[0, 1], pz - t[0, 2]
    d1 = abx * apx + aby * apy + abz * apz
    d2 = acx * apx + acy * apy + acz * apz
    if d1 <= 0.0 and d2 <= 0.0:
        return 0.0, 0.0, 4
    bpx, bpy, bpz = px - t[1, 0], py - t[1, 1], pz - t[1, 2]
    d3 = abx * bpx + aby * bpy + abz * bpz
    d4 = acx * bpx + acy * bpy + acz * bpz
    if d3 >= 0.0 and d4 <= d3:
        return 1.0, 0.0, 5
    vc = d1 * d4 - d3 * d2
    if vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        return d1 / (d1 - d3), 0.0, 1
    cpx, cpy, cpz = px - t[2, 0], py - t[2, 1], pz - t[2, 2]
    d5 = abx * cpx + aby * cpy + abz * cpz
    d6 = acx * cpx + acy * cpy + acz * cpz
    if d6 >= 0.0 and d5 <= d6:
        return 0.0, 1.0, 6
    vb = d5 * d2 - d1 * d6
    if vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        return 0.0, d2 / (d2 - d6), 3
    va = d3 * d6 - d5 * d4
    if va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        w = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        return 1.0 - w, w, 2
    total = va + vb + vc
    return vb / total, vc / total, 0


@kernel(numpy_errors=True)
def _query(
    points: NDArray[np.float64], hints: NDArray[np.int64], reach2: float, triangles: NDArray[np.float64],
    sides: NDArray[np.float64], edges: NDArray[np.bool_], corner_normals: NDArray[np.float64],
    bounds: NDArray[np.float64], links: NDArray[np.int32], order: NDArray[np.int64],
    out_points: NDArray[np.float64], out_faces: NDArray[np.int64],
    out_distances: NDArray[np.float64], out_normals: NDArray[np.float64], out_edges: NDArray[np.bool_]
) -> None:  # fmt: skip
    """Closest points of a chunk of points, written into the arrays ``out_…``; see `ClosestPoints`."""
    stack, near = np.empty(128, dtype=np.int64), np.empty(128)
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        best, found, where = reach2, -1, 0
        qx = qy = qz = np.nan
        q1 = q2 = 0.0
        top = 0
        hint = hints[i]
        stack[0], near[0] = 0, _to_box(x, y, z, bounds[0])
        top = 1
        while top > 0 or hint >= 0:
            if hint >= 0:
                first, last, hint = hint, hint + 1, -1
            else:
                top -= 1
                node = stack[top]
                if not near[top] < best:
                    continue
                if links[node, 1] == 0:
                    a, b = np.int64(links[node, 0]), np.int64(links[node, 0] + 1)
                    da, db = _to_box(x, y, z, bounds[a]), _to_box(x, y, z, bounds[b])
                    if da > db:
                        a, b, da, db = b, a, db, da
                    if db < best:
                        stack[top], near[top] = b, db
                        top += 1
                    if da < best:
                        stack[top], near[top] = a, da
                        top += 1
                    continue
                first, last = np.int64(links[node, 0]), np.int64(links[node, 0] + links[node, 1])
            for k in range(first, last):
                t = triangles[k]
                v, w, place = _on_triangle(x, y, z, t)
                u = 1.0 - v - w
                cx = u * t[0, 0] + v * t[1, 0] + w * t[2, 0]
                cy = u * t[0, 1] + v * t[1, 1] + w * t[2, 1]
                cz = u * t[0, 2] + v * t[1, 2] + w * t[2, 2]
                d = (x - cx) ** 2 + (y - cy) ** 2 + (z - cz) ** 2
                if d < best:
                    best, found, where = d, k, place
                    qx, qy, qz = cx, cy, cz
                    q1, q2 = v, w
        out_points[i, 0], out_points[i, 1], out_points[i, 2] = qx, qy, qz
        if found < 0:
            out_faces[i], out_distances[i], out_edges[i] = -1, np.nan, True
            out_normals[i, 0] = out_normals[i, 1] = out_normals[i, 2] = np.nan
            continue
        n = sides[found, where]
        side = (x - qx) * n[0] + (y - qy) * n[1] + (z - qz) * n[2]
        distance = np.sqrt(best) if side >= 0 else -np.sqrt(best)
        out_faces[i], out_distances[i], out_edges[i] = order[found], distance, edges[found, where]
        if edges[found, where] and abs(distance) > 1e-9:
            out_normals[i, 0] = (x - qx) / distance
            out_normals[i, 1] = (y - qy) / distance
            out_normals[i, 2] = (z - qz) / distance
        else:
            c = corner_normals[found]
            n = (1.0 - q1 - q2) * c[0] + q1 * c[1] + q2 * c[2]
            out_normals[i] = n / np.sqrt(np.dot(n, n))
