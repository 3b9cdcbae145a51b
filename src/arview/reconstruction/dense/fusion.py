"""Fusion of the depth maps of several views into one cloud of the points that enough of them confirm.

Each pixel's element is looked up in the maps of neighbouring views (forward-backward check: Schönberger 2016, Galliani
2015); those that agree are merged along the pixel's own ray, weighted by their variances. Views are independent here,
so each thread takes one; of all points in a small cell the one with the smallest standard deviation is kept.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.core.kernel import kernel
from arview.core.progress import Progress
from arview.geometry import Array, invert
from arview.reconstruction.dense.depth import DepthMap
from arview.reconstruction.dense.options import MIN_VIEWS
from arview.reconstruction.dense.views import Image
from arview.reconstruction.types import DenseCloud

MIN_ZNCC = 0.5
"""Pixels with a lower mean correlation with the sources are not used."""
MAX_SIGMA_PX = 0.25
"""Pixels with a larger standard deviation, in pixels of parallax, are not used: no texture."""
MAX_SPREAD_PX = 0.2
"""Largest standard deviation of a merged point along its normal, in pixels of the maps at the point."""
AGREEMENT_PX = 1.5
"""Two depth maps agree if the point moves by less than this in the photo, in pixels of the maps (half the working size)
…."""
NORMAL_ANGLE_DEG = 20.0
"""… and their normals differ by less than this."""
GRAZING_DEG = 75.0
"""Surfaces seen at a larger angle from their normal are not used."""

MAX_NEIGHBOURS = 8
"""Other views against which a view is checked."""
_RELATIVE_DEPTH = 0.01
"""Depths that differ by more than this share belong to different surfaces."""
_CELL_PX = 0.5
"""Side of the cells, each of which keeps one point, in pixels of the maps at the surface."""
_CELL_LENGTH = 5.0
"""Length of the cells along the normal, in units of their sides; it removes less accurate points near a surface."""
_LEANING = 0.7
"""Cosine between ray and normal below which a pixel gives more than one point."""
_ISOLATED = 3
"""A pixel with fewer neighbours (of 8) on its surface is removed as isolated."""


_Points = tuple[Array, NDArray[np.float32], Image, NDArray[np.float32], NDArray[np.uint8]]
"""Points (N,3), normals (N,3), colours (N,3), standard deviations (N,), view counts (N,)."""


@dataclass(frozen=True)
class _Stack:
    """All maps one after another, as arrays for kernels.

    Attributes:
        elements: (P,6) float32: plane n·X = 1 in the camera (normal divided by the plane's distance), variance of w, w
            at the pixel (0: none), and 1 where the element may become a point itself instead of only confirming others.
        layout: (V,3) first pixel, width, height.
        cameras: (V,4) fx fy cx cy.
        poses: (V,3,4) cam_from_scan.
    """

    elements: NDArray[np.float32]
    layout: NDArray[np.int64]
    cameras: Array
    poses: Array


def fuse(
    maps: Sequence[DepthMap],
    images: Sequence[Image],
    threads: int,
    progress: Progress,
) -> DenseCloud:
    """Fuse depth maps into the cloud of all points that ``options.min_views`` maps agree on.

    Args:
        maps: depth maps of the views.
        images: (H,W,3) uint8 RGB of each map's size.
        threads: number of views worked on at a time.
        progress: called with the stage's name, views done and views in all.

    Returns:
        The cloud; empty when no points agree.
    """
    stack = _stacked(maps)
    limits = np.array(
        [
            AGREEMENT_PX,
            _RELATIVE_DEPTH,
            np.cos(np.deg2rad(NORMAL_ANGLE_DEG)),
            MIN_VIEWS,
            MAX_SPREAD_PX,
        ]
    )
    neighbours = [_neighbour_views(maps, i) for i in range(len(maps))]
    merged = np.zeros((len(stack.elements), 3), dtype=np.float32)

    def merge(i: int) -> None:
        _merge(
            i,
            neighbours[i],
            stack.elements,
            layout=stack.layout,
            cameras=stack.cameras,
            poses=stack.poses,
            limits=limits,
            merged=merged,
        )

    def points_of(i: int) -> _Points:
        first, width, height = stack.layout[i]
        _drop_crumbs(merged[first : first + width * height].reshape(height, width, 3))
        return _points(maps[i], images[i], stack, merged, i)

    with ThreadPoolExecutor(threads) as pool:
        for done, _ in enumerate(pool.map(merge, range(len(maps))), start=1):
            progress("fusion", done, len(maps))
        parts = list(pool.map(points_of, range(len(maps))))
    points, normals, colors, sigma, views = (np.concatenate([part[k] for part in parts]) for k in range(5))
    known = merged[:, 0] > 0
    footprint = float(np.median(merged[known, 0])) / maps[0].camera.fx if known.any() else 1.0
    best = _best_of_cells(points, normals, sigma, _CELL_PX * footprint)
    return DenseCloud(points[best], normals[best], colors[best], sigma[best], views[best])


def _best_of_cells(
    points: Array, normals: NDArray[np.float32], sigma: NDArray[np.float32], side: float
) -> NDArray[np.int64]:
    """Indices of the most accurate point of each cell; cells are longer along the axis nearest to the normal.

    Where two cells behind each other hold points of one surface, only the more accurate point is kept, so that the
    density of points does not depend on where a surface crosses the borders of cells.
    """
    if len(points) == 0:
        return np.empty(0, dtype=np.int64)
    axis = np.argmax(np.abs(normals), axis=1)
    everyone = np.arange(len(points))
    facing = 2 * axis + (normals[everyone, axis] > 0)
    sides = side * np.where(np.arange(3) == axis[:, None], _CELL_LENGTH, 1.0)
    cell = np.floor((points - points.min(axis=0)) / sides).astype(np.int64)
    counts = cell.max(axis=0) + 2  # plus one, so that the cell behind the last one of a row is not the next row's first
    key = ((facing * counts[0] + cell[:, 0]) * counts[1] + cell[:, 1]) * counts[2] + cell[:, 2]
    # One integer holds cell and deviation (in 65,536 steps), so that a single sort of integers orders by both.
    step = (np.minimum(sigma / max(float(sigma.max()), 1e-30), 1.0) * 65535).astype(np.int64)
    order = np.argsort((key << 16) + step, kind="stable")
    best = order[np.flatnonzero(np.diff(key[order], prepend=-1))]
    along, behind = points[everyone, axis][best], np.array([counts[1] * counts[2], counts[2], 1])[axis[best]]
    keys, is_best = key[best], np.ones(len(best), dtype=bool)
    at = np.minimum(np.searchsorted(keys, keys + behind), len(keys) - 1)
    (front,) = np.nonzero((keys[at] == keys + behind) & (np.abs(along[at] - along) < 0.5 * _CELL_LENGTH * side))
    is_worse = sigma[best[front]] > sigma[best[at[front]]]
    is_best[np.where(is_worse, front, at[front])] = False
    return best[is_best]


def _stacked(maps: Sequence[DepthMap]) -> _Stack:
    """All maps as arrays for kernels."""
    elements = []
    for m in maps:
        camera, planes = m.camera, m.planes
        v, u = np.mgrid[0 : camera.height, 0 : camera.width].astype(np.float32)
        x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
        a, b, w = planes[..., 1] * camera.fx, planes[..., 2] * camera.fy, planes[..., 0]
        c = w - a * x - b * y
        cosine = w / np.maximum(np.sqrt((a * a + b * b + c * c) * (x * x + y * y + 1.0)), 1e-30)
        is_known = (w > 0) & (m.scores > 0) & (m.sigmas <= MAX_SIGMA_PX * m.unit_w)
        is_good = is_known & (m.scores >= MIN_ZNCC) & (cosine >= np.cos(np.deg2rad(GRAZING_DEG)))
        element = np.stack([a, b, c, m.sigmas**2, np.where(is_known, w, 0.0), is_good], axis=-1)
        elements.append(element.reshape(-1, 6).astype(np.float32))
    sizes = np.array([(m.camera.width, m.camera.height) for m in maps])
    first = np.concatenate([[0], np.cumsum(sizes[:, 0] * sizes[:, 1])[:-1]])
    return _Stack(
        np.concatenate(elements),
        np.column_stack([first, sizes]),
        np.array([[m.camera.fx, m.camera.fy, m.camera.cx, m.camera.cy] for m in maps]),
        np.ascontiguousarray([m.cam_from_scan[:3] for m in maps]),
    )


def _neighbour_views(maps: Sequence[DepthMap], index: int) -> NDArray[np.int64]:
    """The views with the most similar viewing directions, without the view itself."""
    axes = np.stack([m.cam_from_scan[2, :3] for m in maps])
    likeness = axes @ axes[index]
    likeness[index] = -2.0
    order = np.argsort(-likeness, kind="stable")[: min(MAX_NEIGHBOURS, len(maps) - 1)]
    return order[likeness[order] > 0.0]


@kernel(inline=True)
def _seen_at(j: Any, p0: Any, p1: Any, p2: Any, layout: Any, cameras: Any, poses: Any) -> Any:
    """Index of the pixel of map j onto which a point projects (-1: none), and the point in that camera."""
    m = poses
    x = m[j, 0, 0] * p0 + m[j, 0, 1] * p1 + m[j, 0, 2] * p2 + m[j, 0, 3]
    y = m[j, 1, 0] * p0 + m[j, 1, 1] * p1 + m[j, 1, 2] * p2 + m[j, 1, 3]
    z = m[j, 2, 0] * p0 + m[j, 2, 1] * p1 + m[j, 2, 2] * p2 + m[j, 2, 3]
    at = -1
    if z > 0.0:
        u, v = cameras[j, 0] * x / z + cameras[j, 2] + 0.5, cameras[j, 1] * y / z + cameras[j, 3] + 0.5
        if u >= 0.0 and v >= 0.0 and u < layout[j, 1] and v < layout[j, 2]:
            at = layout[j, 0] + int(v) * layout[j, 1] + int(u)
    return at, x, y, z


@kernel(numpy_errors=True)
def _merge(
    i: int,
    neighbours: NDArray[np.int64],
    elements: NDArray[np.float32],
    layout: NDArray[np.int64],
    cameras: NDArray[np.float64],
    poses: NDArray[np.float64],
    limits: NDArray[np.float64],
    merged: NDArray[np.float32],
) -> None:
    """Write merged depth, its standard deviation and the number of views of each pixel of view i that enough confirm.

    ``limits``: agreement in px, relative depth, cosine of the normals' angle, number of views, spread in px.
    """
    first, width, height = layout[i]
    agreement, relative, min_cosine, min_views, spread_px = limits
    fx, fy, cx, cy = cameras[i]
    depths, weights = np.empty(neighbours.shape[0] + 1), np.empty(neighbours.shape[0] + 1)
    r, t = poses[i, :, :3].copy(), poses[i, :, 3].copy()
    centre = -(r.T @ t)
    for at in range(first, first + width * height):
        w = elements[at, 4]
        if not (w > 0.0 and elements[at, 5] > 0.0):
            continue
        column, row = (at - first) % width, (at - first) // width
        xn, yn = (column - cx) / fx, (row - cy) / fy
        z = 1.0 / w
        # The pixel's ray and normal in the scan frame; points are centre + depth * ray.
        ray0 = r[0, 0] * xn + r[1, 0] * yn + r[2, 0]
        ray1 = r[0, 1] * xn + r[1, 1] * yn + r[2, 1]
        ray2 = r[0, 2] * xn + r[1, 2] * yn + r[2, 2]
        a, b, c = elements[at, 0], elements[at, 1], elements[at, 2]
        n0 = r[0, 0] * a + r[1, 0] * b + r[2, 0] * c
        n1 = r[0, 1] * a + r[1, 1] * b + r[2, 1] * c
        n2 = r[0, 2] * a + r[1, 2] * b + r[2, 2] * c
        length = np.sqrt(n0 * n0 + n1 * n1 + n2 * n2)
        depths[0], weights[0] = z, 1.0 / max(elements[at, 3] * z**4, 1e-18 * z * z)
        views, against = 1, 0
        for f in range(neighbours.shape[0]):
            j = neighbours[f]
            q, x, y, depth = _seen_at(
                j, centre[0] + z * ray0, centre[1] + z * ray1, centre[2] + z * ray2, layout, cameras, poses
            )
            if q < 0 or not elements[q, 4] > 0.0:
                continue
            # Where the other element's plane lies on the line of sight of view j through the point.
            there = (elements[q, 0] * x + elements[q, 1] * y) / depth + elements[q, 2]
            if not there > 0.0:
                continue
            shift = 1.0 / there - depth
            if abs(shift) > relative * depth:
                # View j sees something behind the point, so the point is contradicted.
                against += shift > 0.0
                continue
            here = _confirmed_depth(
                elements,
                q,
                poses,
                i,
                j,
                (x, y, depth, shift),
                (ray0, ray1, ray2),
                (n0, n1, n2, length),
                centre,
                (fx, fy, xn, yn, z),
                (agreement, relative, min_cosine),
            )
            if here > 0.0:
                depths[views], weights[views] = here, 1.0 / max(elements[q, 3] * here**4, 1e-18 * z * z)
                views += 1
        if views < min_views or against >= views:
            continue
        mean, variance = _weighted_mean(depths, weights, views)
        # The standard deviation along the normal, which the ray meets at an angle.
        sigma = np.sqrt(variance) * abs(n0 * ray0 + n1 * ray1 + n2 * ray2) / length
        if sigma <= spread_px * z / fx:
            merged[at, 0], merged[at, 1], merged[at, 2] = mean, sigma, views


@kernel(numpy_errors=True, inline=True)
def _confirmed_depth(
    elements: Any,
    q: Any,
    poses: Any,
    i: Any,
    j: Any,
    seen: Any,
    ray: Any,
    normal: Any,
    centre: Any,
    pixel: Any,
    limits: Any,
) -> Any:
    """Depth along a pixel's ray at which the element of another view lies, or -1 where the two disagree.

    Args:
        elements, poses: of all views, see `_Stack`.
        q: index of the element of the other view.
        i, j: the pixel's view and the other view.
        seen: the point in the other camera, and how far behind it the element's plane is.
        ray, normal: of the pixel in the scan frame; the normal with its length.
        centre: camera centre of view i.
        pixel: fx, fy, normalised coordinates, and depth of the pixel.
        limits: agreement in px, relative depth, cosine of the normals' angle.
    """
    e0, e1, e2 = elements[q, 0], elements[q, 1], elements[q, 2]
    x, y, depth, shift = seen
    ray0, ray1, ray2 = ray
    n0, n1, n2, length = normal
    fx, fy, xn, yn, z = pixel
    agreement, relative, min_cosine = limits
    m0 = poses[j, 0, 0] * e0 + poses[j, 1, 0] * e1 + poses[j, 2, 0] * e2
    m1 = poses[j, 0, 1] * e0 + poses[j, 1, 1] * e1 + poses[j, 2, 1] * e2
    m2 = poses[j, 0, 2] * e0 + poses[j, 1, 2] * e1 + poses[j, 2, 2] * e2
    cosine = (m0 * n0 + m1 * n1 + m2 * n2) / (length * np.sqrt(m0 * m0 + m1 * m1 + m2 * m2))
    if cosine < min_cosine:
        return -1.0
    # Moving the point along the other view's ray onto the plane displaces it in this view by a number of pixels.
    stretch = 1.0 + shift / depth
    x, y, depth = x * stretch - poses[j, 0, 3], y * stretch - poses[j, 1, 3], depth * stretch - poses[j, 2, 3]
    p0 = poses[j, 0, 0] * x + poses[j, 1, 0] * y + poses[j, 2, 0] * depth
    p1 = poses[j, 0, 1] * x + poses[j, 1, 1] * y + poses[j, 2, 1] * depth
    p2 = poses[j, 0, 2] * x + poses[j, 1, 2] * y + poses[j, 2, 2] * depth
    q0 = poses[i, 0, 0] * p0 + poses[i, 0, 1] * p1 + poses[i, 0, 2] * p2 + poses[i, 0, 3]
    q1 = poses[i, 1, 0] * p0 + poses[i, 1, 1] * p1 + poses[i, 1, 2] * p2 + poses[i, 1, 3]
    q2 = poses[i, 2, 0] * p0 + poses[i, 2, 1] * p1 + poses[i, 2, 2] * p2 + poses[i, 2, 3]
    if not q2 > 0.0 or (fx * (q0 / q2 - xn)) ** 2 + (fy * (q1 / q2 - yn)) ** 2 > agreement * agreement:
        return -1.0
    offset = 1.0 - (e0 * poses[j, 0, 3] + e1 * poses[j, 1, 3] + e2 * poses[j, 2, 3])
    along = m0 * ray0 + m1 * ray1 + m2 * ray2
    here = (offset - (m0 * centre[0] + m1 * centre[1] + m2 * centre[2])) / along
    return here if abs(here - z) < relative * z else -1.0


@kernel(numpy_errors=True)
def _weighted_mean(depths: NDArray[np.float64], weights: NDArray[np.float64], count: int) -> tuple[float, float]:
    """Weighted mean of the first depths, and its variance.

    Two maps share one photo on average, so they count as half as many independent ones.
    """
    total, mean = 0.0, 0.0
    for k in range(count):
        total += weights[k]
        mean += weights[k] * depths[k]
    mean /= total
    spread = 0.0
    for k in range(count):
        spread += weights[k] * (depths[k] - mean) ** 2
    return mean, 2.0 * max(1.0 / total, spread / total / (count - 1))


@kernel
def _drop_crumbs(merged: NDArray[np.float32]) -> None:
    """Clear pixels that share a surface with hardly any of their neighbours."""
    height, width = merged.shape[:2]
    depth = merged[..., 0].copy()
    for y in range(height):
        for x in range(width):
            if depth[y, x] == 0.0:
                continue
            near = 0
            for v in range(max(y - 1, 0), min(y + 2, height)):
                for u in range(max(x - 1, 0), min(x + 2, width)):
                    near += abs(depth[v, u] - depth[y, x]) < 0.005 * depth[y, x]
            if near - 1 < _ISOLATED:
                merged[y, x] = 0.0


def _points(m: DepthMap, image: Image, stack: _Stack, merged: NDArray[np.float32], index: int) -> _Points:
    """Points, normals, colours, standard deviations and view counts of the merged pixels of one view."""
    first, width, height = stack.layout[index]
    here = slice(first, first + width * height)
    (chosen,) = np.nonzero(merged[here, 0] > 0)
    depth, element = merged[here][chosen, 0].astype(np.float64), stack.elements[here][chosen, :3].astype(np.float64)
    pixels = np.stack([chosen % width, chosen // width], axis=-1)
    rays = m.camera.unproject(pixels)
    facing = np.sum(element * rays, axis=1)
    lengths = np.linalg.norm(element, axis=1) * np.linalg.norm(rays, axis=1)
    is_leaning = facing < _LEANING * lengths
    scan_from_cam = invert(m.cam_from_scan)
    normals = -element @ scan_from_cam[:3, :3].T
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    # On an inclined surface a pixel covers a long piece of it, so each quarter of the pixel gives a point.
    places, of = [rays[~is_leaning] * depth[~is_leaning, None]], [np.flatnonzero(~is_leaning)]
    (leaning,) = np.nonzero(is_leaning)
    for quarter in np.array([[-0.25, -0.25], [0.25, -0.25], [-0.25, 0.25], [0.25, 0.25]]):
        aside = m.camera.unproject(pixels[leaning] + quarter)
        ratio = np.sum(element[leaning] * aside, axis=1) / facing[leaning]
        is_near = ratio > 0.5  # the pixel may reach past the horizon of its plane
        places.append(aside[is_near] * (depth[leaning] / ratio)[is_near, None])
        of.append(leaning[is_near])
    which = np.concatenate(of)
    points = np.concatenate(places) @ scan_from_cam[:3, :3].T + scan_from_cam[:3, 3]
    if image.shape[:2] != (height, width):
        image = np.asarray(cv2.resize(image, (int(width), int(height)), interpolation=cv2.INTER_AREA))
    colors = image[pixels[which, 1], pixels[which, 0]]
    sigma, views = merged[here][chosen[which], 1:].T
    return points, normals[which].astype(np.float32), colors, sigma, views.astype(np.uint8)
