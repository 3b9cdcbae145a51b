"""Ray casting on a triangle mesh by a bounding-volume hierarchy.

Binned surface-area heuristic (Wald, "On fast construction of SAH-based bounding volume hierarchies", 2007)
and the ray-triangle test of Möller & Trumbore (1997). Both sides of a triangle are hit.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from arview.core.kernel import kernel
from arview.errors import InputError
from arview.geometry import Array


class Hierarchy(NamedTuple):
    """A bounding-volume hierarchy, as the kernels take it.

    Attributes:
        bounds: (M,6) low xyz, high xyz of every node, mm.
        links: (M,2) int32; the first triangle and the count of a leaf; the left child (the right one follows it) and 0
            of an inner node.
        triangles: (F,9) corner and two edge vectors, in the order of the leaves.
        order: (F,) int32 face index of every triangle.
    """

    bounds: Array
    links: NDArray[np.int32]
    triangles: Array
    order: NDArray[np.int32]


BINS = 12
"""Bins of the surface-area heuristic along the split axis."""


@kernel
def _bound_node(
    low: NDArray[np.float64],
    high: NDArray[np.float64],
    order: NDArray[np.int32],
    first: int,
    last: int,
    bounds: NDArray[np.float64],
) -> tuple[int, float, float]:
    """Write the box of some triangles into ``bounds`` (6,).

    Returns:
        the axis along which their centres are spread most, twice the spread, and twice the smallest centre.
    """
    for a in range(3):
        bounds[a], bounds[3 + a] = 1e300, -1e300
    axis, spread, origin = 0, -1.0, 0.0
    for a in range(3):
        smallest, largest = 1e300, -1e300
        for k in range(first, last):
            i = order[k]
            bounds[a] = min(bounds[a], low[i, a])
            bounds[3 + a] = max(bounds[3 + a], high[i, a])
            middle = low[i, a] + high[i, a]
            smallest = min(smallest, middle)
            largest = max(largest, middle)
        if largest - smallest > spread:
            axis, spread, origin = a, largest - smallest, smallest
    return axis, spread, origin


@kernel
def _best_plane(
    low: NDArray[np.float64],
    high: NDArray[np.float64],
    order: NDArray[np.int32],
    first: int,
    last: int,
    axis: int,
    origin: float,
    to_bin: float,
    box: NDArray[np.float64],
    sizes: NDArray[np.int64],
    cost: NDArray[np.float64],
) -> int:
    """The last bin left of the plane of least cost; ``box`` (B,6), ``sizes`` (B,) and ``cost`` (B,) are scratch."""
    bins = box.shape[0]
    sizes[:] = 0
    for b in range(bins):
        for a in range(3):
            box[b, a], box[b, 3 + a] = 1e300, -1e300
    for k in range(first, last):
        i = order[k]
        b = int((low[i, axis] + high[i, axis] - origin) * to_bin)
        sizes[b] += 1
        for a in range(3):
            box[b, a] = min(box[b, a], low[i, a])
            box[b, 3 + a] = max(box[b, 3 + a], high[i, a])
    # Area × count of everything left of each plane, then of everything right of it.
    grown = np.empty(6)
    cost[:] = 0.0
    for side in range(2):
        total = 0
        for a in range(3):
            grown[a], grown[3 + a] = 1e300, -1e300
        for step in range(bins - 1):
            b = step if side == 0 else bins - 1 - step
            total += sizes[b]
            for a in range(3):
                grown[a] = min(grown[a], box[b, a])
                grown[3 + a] = max(grown[3 + a], box[b, 3 + a])
            dx, dy, dz = grown[3] - grown[0], grown[4] - grown[1], grown[5] - grown[2]
            if total > 0:
                cost[b if side == 0 else b - 1] += total * (dx * dy + dy * dz + dz * dx)
    best = 0
    for b in range(1, bins - 1):
        if cost[b] < cost[best]:
            best = b
    return best


@kernel
def _partition(
    low: NDArray[np.float64],
    high: NDArray[np.float64],
    order: NDArray[np.int32],
    first: int,
    last: int,
    axis: int,
    origin: float,
    to_bin: float,
    plane: int,
    swap: NDArray[np.int32],
) -> int:
    """Move the triangles left of a plane before the others, in stable order; returns the first index of the right."""
    left, right = first, 0
    for k in range(first, last):
        i = order[k]
        if int((low[i, axis] + high[i, axis] - origin) * to_bin) <= plane:
            order[left] = i
            left += 1
        else:
            swap[right] = i
            right += 1
    order[left:last] = swap[:right]
    return left


@kernel
def _build(
    low: NDArray[np.float64], high: NDArray[np.float64], leaf_size: int
) -> tuple[NDArray[np.float64], NDArray[np.int32], NDArray[np.int32]]:
    """The hierarchy over the boxes of triangles.

    Args:
        low, high: (F,3) corners of each triangle's box, mm.
        leaf_size: a node of at most so many triangles is a leaf.

    Returns:
        bounds (M,6), links (M,2) and order (F,), see `Hierarchy`.
    """
    count = low.shape[0]
    order = np.arange(count).astype(np.int32)
    swap = np.empty(count, dtype=np.int32)
    bounds = np.empty((2 * count, 6))
    links = np.zeros((2 * count, 2), dtype=np.int32)
    ranges = np.empty((2 * count, 2), dtype=np.int32)
    ranges[0, 0], ranges[0, 1] = 0, count
    nodes = 1
    box = np.empty((BINS, 6))
    sizes = np.empty(BINS, dtype=np.int64)
    cost = np.empty(BINS)
    node = 0
    while node < nodes:
        first, last = ranges[node, 0], ranges[node, 1]
        axis, spread, origin = _bound_node(low, high, order, first, last, bounds[node])
        if last - first <= leaf_size:
            links[node, 0], links[node, 1] = first, last - first
            node += 1
            continue
        cut = (first + last) // 2
        if spread > 0.0:
            to_bin = BINS * (1.0 - 1e-9) / spread
            plane = _best_plane(
                low,
                high,
                order,
                first=first,
                last=last,
                axis=axis,
                origin=origin,
                to_bin=to_bin,
                box=box,
                sizes=sizes,
                cost=cost,
            )
            left = _partition(
                low,
                high,
                order,
                first=first,
                last=last,
                axis=axis,
                origin=origin,
                to_bin=to_bin,
                plane=plane,
                swap=swap,
            )
            if first < left < last:
                cut = left
        links[node, 0], links[node, 1] = nodes, 0
        ranges[nodes, 0], ranges[nodes, 1] = first, cut
        ranges[nodes + 1, 0], ranges[nodes + 1, 1] = cut, last
        nodes += 2
        node += 1
    return bounds[:nodes].copy(), links[:nodes].copy(), order


@kernel(inline=True)
def _enter(bounds: Any, node: Any, ox: Any, oy: Any, oz: Any, ix: Any, iy: Any, iz: Any, limit: Any) -> Any:
    """Distance at which a ray enters a node's box; 1e300 when it misses the box or enters beyond ``limit``."""
    a, b = (bounds[node, 0] - ox) * ix, (bounds[node, 3] - ox) * ix
    near, far = min(a, b), max(a, b)
    a, b = (bounds[node, 1] - oy) * iy, (bounds[node, 4] - oy) * iy
    near, far = max(near, min(a, b)), min(far, max(a, b))
    a, b = (bounds[node, 2] - oz) * iz, (bounds[node, 5] - oz) * iz
    near, far = max(near, min(a, b)), min(far, max(a, b))
    # The slack keeps flat boxes (axis-aligned faces) from being lost to rounding.
    slack = 1e-9 * (1.0 + abs(far))
    if near > far + slack or far < -slack or near > limit:
        return 1e300
    return near


@kernel
def cast_ray(
    hierarchy: Hierarchy, ox: float, oy: float, oz: float, dx: float, dy: float, dz: float, limit: float, any_hit: bool
) -> tuple[float, int]:
    """The nearest hit of one ray.

    Args:
        hierarchy: see `Hierarchy`.
        ox, oy, oz: origin of the ray, mm.
        dx, dy, dz: its direction, of any length.
        limit: hits at or beyond this distance, in lengths of the direction, are ignored.
        any_hit: return the first hit found instead of the nearest, for tests of visibility.

    Returns:
        distance in lengths of the direction and face index; ``limit`` and -1 without a hit.
    """
    bounds, links, triangles, order = hierarchy
    ix = 1.0 / (dx if abs(dx) > 1e-30 else 1e-30)
    iy = 1.0 / (dy if abs(dy) > 1e-30 else 1e-30)
    iz = 1.0 / (dz if abs(dz) > 1e-30 else 1e-30)
    face = -1
    stack = np.empty(64, dtype=np.int32)
    depth = 0
    node = 0
    if _enter(bounds, 0, ox, oy, oz, ix, iy, iz, limit) == 1e300:
        return limit, face
    while True:
        first, count = links[node, 0], links[node, 1]
        if count > 0:
            for k in range(first, first + count):
                t = triangles[k]
                px, py, pz = dy * t[8] - dz * t[7], dz * t[6] - dx * t[8], dx * t[7] - dy * t[6]
                det = t[3] * px + t[4] * py + t[5] * pz
                if det == 0.0:
                    continue
                sx, sy, sz = ox - t[0], oy - t[1], oz - t[2]
                u = (sx * px + sy * py + sz * pz) / det
                if u < -1e-9 or u > 1.0 + 1e-9:
                    continue
                qx, qy, qz = sy * t[5] - sz * t[4], sz * t[3] - sx * t[5], sx * t[4] - sy * t[3]
                v = (dx * qx + dy * qy + dz * qz) / det
                if v < -1e-9 or u + v > 1.0 + 1e-9:
                    continue
                distance = (t[6] * qx + t[7] * qy + t[8] * qz) / det
                if 0.0 < distance < limit:
                    limit = distance
                    face = order[k]
                    if any_hit:
                        return limit, face
        else:
            left = _enter(bounds, first, ox, oy, oz, ix, iy, iz, limit)
            right = _enter(bounds, first + 1, ox, oy, oz, ix, iy, iz, limit)
            near, far = first, first + 1
            if right < left:
                near, far = far, near
            if max(left, right) < 1e300 and depth < 64:
                stack[depth] = far
                depth += 1
            if min(left, right) < 1e300:
                node = near
                continue
        if depth == 0:
            return limit, face
        depth -= 1
        node = stack[depth]


@kernel
def _cast_rays(
    hierarchy: Hierarchy,
    origins: NDArray[np.float64],
    directions: NDArray[np.float64],
    distances: NDArray[np.float64],
    faces: NDArray[np.int32],
) -> None:
    """Write the nearest hit of each ray (N,3) into ``distances`` (N,) and ``faces`` (N,)."""
    for i in range(origins.shape[0]):
        distance, face = cast_ray(
            hierarchy,
            origins[i, 0],
            origins[i, 1],
            oz=origins[i, 2],
            dx=directions[i, 0],
            dy=directions[i, 1],
            dz=directions[i, 2],
            limit=1e300,
            any_hit=False,
        )
        distances[i] = distance if face >= 0 else np.inf
        faces[i] = face


class RayCaster:
    """Casts rays on a triangle mesh, of which it builds the hierarchy once."""

    def __init__(self, vertices: ArrayLike, faces: ArrayLike, leaf_size: int = 4) -> None:
        """Build the hierarchy.

        Args:
            vertices: (V,3) mm; rays are given in the same frame.
            faces: (F,3) vertex indices.
            leaf_size: largest number of triangles of a leaf.

        Raises:
            InputError: no faces, or arrays of other shapes.
        """
        corners = np.asarray(vertices, dtype=np.float64)[np.asarray(faces)]
        if corners.ndim != 3 or corners.shape[1:] != (3, 3) or len(corners) == 0:
            raise InputError(f"ray caster: corners have shape {corners.shape}, expected (F, 3, 3) with F > 0")
        bounds, links, order = _build(corners.min(axis=1), corners.max(axis=1), leaf_size)
        edges = corners[:, 1:] - corners[:, :1]
        triangles = np.concatenate([corners[:, 0], edges[:, 0], edges[:, 1]], axis=1)
        self.hierarchy = Hierarchy(bounds, links, np.ascontiguousarray(triangles[order]), order)

    def cast(self, origins: ArrayLike, directions: ArrayLike) -> tuple[Array, NDArray[np.int32]]:
        """The nearest hit of each ray.

        Args:
            origins: (N,3) mm.
            directions: (N,3) of any length.

        Returns:
            distances (N,) in lengths of the direction, inf without a hit; face indices (N,), -1 without a hit.

        Raises:
            InputError: arrays of other shapes.
        """
        start = np.ascontiguousarray(origins, dtype=np.float64)
        toward = np.ascontiguousarray(directions, dtype=np.float64)
        if start.shape != toward.shape or start.ndim != 2 or start.shape[1] != 3:
            raise InputError(f"rays: origins {start.shape} and directions {toward.shape}, expected (N, 3) both")
        distances = np.empty(len(start))
        faces = np.empty(len(start), dtype=np.int32)
        _cast_rays(self.hierarchy, start, toward, distances, faces)
        return distances, faces
