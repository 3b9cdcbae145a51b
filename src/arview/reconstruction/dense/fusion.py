"""Depth maps of several views → one cloud of the points that enough of them agree on.

Each pixel's element is looked up in the maps of the views around (forward-backward check: Schönberger 2016,
Galliani 2015); those that agree are merged along the pixel's own ray, weighted by how well each is known. Views are
independent in this, so threads take one each; of all points in a small cell the best known one stays.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.core.kernel import kernel
from arview.core.progress import Progress
from arview.geometry import Array, invert
from arview.reconstruction.dense.depth import DepthMap
from arview.reconstruction.dense.options import DenseOptions
from arview.reconstruction.dense.views import Image
from arview.reconstruction.types import DenseCloud

FELLOWS = 8
"""Other views that a view is checked against."""
_RELATIVE_DEPTH = 0.01
"""Depths differ by more than this share: another surface, whatever the pixels say."""
_CELL_PX = 0.5
"""Side of the cells, of which each holds one point, in pixels of the maps (as wide as they are on the surface)."""
_CELL_LENGTH = 5.0
"""Length of the cells along the normal, in their sides: what is less well known than the surface there goes."""
_LEANING = 0.7
"""Cosine between ray and normal below which a pixel gives more than one point."""
_ISOLATED = 3
"""A pixel with fewer neighbours (of 8) on its surface is a crumb."""


_Points = tuple[Array, NDArray[np.float32], Image, NDArray[np.float32], NDArray[np.uint8]]
"""Points (N,3), normals (N,3), colours (N,3), deviations (N,), view counts (N,)."""


@dataclass(frozen=True)
class _Stack:
    """All maps one after another: elements in the scan frame for numba.

    ``elements`` (P,6) float32: normal form n·X = 1 in the camera (n divided by the plane's distance), variance of w,
    w at the pixel (0: none), and 1 where it may become a point, not only bear out others.
    ``layout`` (V,3): first pixel, width, height. ``cameras`` (V,4): fx fy cx cy.
    ``poses`` (V,3,4): cam_from_scan.
    """

    elements: NDArray[np.float32]
    layout: NDArray[np.int64]
    cameras: Array
    poses: Array


def fuse(
    maps: Sequence[DepthMap], images: Sequence[Image], options: DenseOptions, threads: int,
    progress: Progress,
) -> DenseCloud:  # fmt: skip
    """The cloud of all points that ``options.min_views`` maps agree on; empty when there are none.

    Args:
        maps: depth maps of the views.
        images: (H,W,3) uint8 RGB of each map's size.
        options: thresholds.
        threads: views at a time.
        progress: called with the stage's name, views done and views in all.
    """
    stack = _stacked(maps, options)
    limits = np.array(
        [
            options.agreement_px,
            _RELATIVE_DEPTH,
            np.cos(np.deg2rad(options.normal_angle_deg)),
            options.min_views,
            options.max_spread_px,
        ]
    )
    fellows = [_fellows(maps, i) for i in range(len(maps))]
    merged = np.zeros((len(stack.elements), 3), dtype=np.float32)

    def merge(i: int) -> None:
        _merge(i, fellows[i], stack.elements, stack.layout, stack.cameras, stack.poses, limits, merged)

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
    """Indices of the best known point of each cell; cells are longer along the axis nearest to the normal.

    Where two cells one behind the other hold points of one surface, the better known one stays: how many points a
    surface gets does not depend on where the cells' borders cut it.
    """
    if len(points) == 0:
        return np.empty(0, dtype=np.int64)
    axis = np.argmax(np.abs(normals), axis=1)
    everyone = np.arange(len(points))
    facing = 2 * axis + (normals[everyone, axis] > 0)
    sides = side * np.where(np.arange(3) == axis[:, None], _CELL_LENGTH, 1.0)
    cell = np.floor((points - points.min(axis=0)) / sides).astype(np.int64)
    counts = cell.max(axis=0) + 2  # one to spare: the cell behind the last one is not the next row's first
    key = ((facing * counts[0] + cell[:, 0]) * counts[1] + cell[:, 1]) * counts[2] + cell[:, 2]
    # One number holds both, by cell and then by deviation in 65,536 steps: one sort of integers, the quickest there is.
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


def _stacked(maps: Sequence[DepthMap], options: DenseOptions) -> _Stack:
    elements = []
    for m in maps:
        camera, planes = m.camera, m.planes
        v, u = np.mgrid[0 : camera.height, 0 : camera.width].astype(np.float32)
        x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
        a, b, w = planes[..., 1] * camera.fx, planes[..., 2] * camera.fy, planes[..., 0]
        c = w - a * x - b * y
        cosine = w / np.maximum(np.sqrt((a * a + b * b + c * c) * (x * x + y * y + 1.0)), 1e-30)
        is_known = (w > 0) & (m.scores > 0) & (m.sigmas <= options.max_sigma_px * m.unit_w)
        is_good = is_known & (m.scores >= options.min_zncc) & (cosine >= np.cos(np.deg2rad(options.grazing_deg)))
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


def _fellows(maps: Sequence[DepthMap], index: int) -> NDArray[np.int64]:
    """The views whose direction is nearest to a view's, its own left out."""
    axes = np.stack([m.cam_from_scan[2, :3] for m in maps])
    likeness = axes @ axes[index]
    likeness[index] = -2.0
    order = np.argsort(-likeness, kind="stable")[: min(FELLOWS, len(maps) - 1)]
    return order[likeness[order] > 0.0]


@kernel(inline=True)
def _seen_at(j, p0, p1, p2, layout, cameras, poses):  # type: ignore[no-untyped-def]
    """Index of the pixel of map j that a point falls on (-1: none) and the point in that camera."""
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
def _merge(i, fellows, elements, layout, cameras, poses, limits, merged):  # type: ignore[no-untyped-def]
    """Merged depth, its standard deviation and the number of views of each pixel of view i that enough agree on."""
    first, width, height = layout[i]
    agreement, relative, min_cosine, min_views, spread_px = limits
    fx, fy, cx, cy = cameras[i]
    count = fellows.shape[0]
    depths, weights = np.empty(count + 1), np.empty(count + 1)
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
        for f in range(count):
            j = fellows[f]
            q, x, y, depth = _seen_at(
                j, centre[0] + z * ray0, centre[1] + z * ray1, centre[2] + z * ray2, layout, cameras, poses
            )
            if q < 0 or not elements[q, 4] > 0.0:
                continue
            # The other element: where its plane lies on the line of sight of j through the point, and on this ray.
            e0, e1, e2 = elements[q, 0], elements[q, 1], elements[q, 2]
            there = (e0 * x + e1 * y) / depth + e2
            if not there > 0.0:
                continue
            shift = 1.0 / there - depth
            if abs(shift) > relative * depth:
                # Seen through: the other view looks past the point at something behind it.
                against += shift > 0.0
                continue
            m0 = poses[j, 0, 0] * e0 + poses[j, 1, 0] * e1 + poses[j, 2, 0] * e2
            m1 = poses[j, 0, 1] * e0 + poses[j, 1, 1] * e1 + poses[j, 2, 1] * e2
            m2 = poses[j, 0, 2] * e0 + poses[j, 1, 2] * e1 + poses[j, 2, 2] * e2
            cosine = (m0 * n0 + m1 * n1 + m2 * n2) / (length * np.sqrt(m0 * m0 + m1 * m1 + m2 * m2))
            if cosine < min_cosine:
                continue
            # Moved along the other's ray onto its plane, the point moves in this view by so many pixels.
            stretch = 1.0 + shift / depth
            x, y, depth = x * stretch - poses[j, 0, 3], y * stretch - poses[j, 1, 3], depth * stretch - poses[j, 2, 3]
            p0 = poses[j, 0, 0] * x + poses[j, 1, 0] * y + poses[j, 2, 0] * depth
            p1 = poses[j, 0, 1] * x + poses[j, 1, 1] * y + poses[j, 2, 1] * depth
            p2 = poses[j, 0, 2] * x + poses[j, 1, 2] * y + poses[j, 2, 2] * depth
            q0 = r[0, 0] * p0 + r[0, 1] * p1 + r[0, 2] * p2 + t[0]
            q1 = r[1, 0] * p0 + r[1, 1] * p1 + r[1, 2] * p2 + t[1]
            q2 = r[2, 0] * p0 + r[2, 1] * p1 + r[2, 2] * p2 + t[2]
            if not q2 > 0.0 or (fx * (q0 / q2 - xn)) ** 2 + (fy * (q1 / q2 - yn)) ** 2 > agreement * agreement:
                continue
            offset = 1.0 - (e0 * poses[j, 0, 3] + e1 * poses[j, 1, 3] + e2 * poses[j, 2, 3])
            along = m0 * ray0 + m1 * ray1 + m2 * ray2
            here = (offset - (m0 * centre[0] + m1 * centre[1] + m2 * centre[2])) / along
            if not abs(here - z) < relative * z:
                continue
            depths[views], weights[views] = here, 1.0 / max(elements[q, 3] * here**4, 1e-18 * z * z)
            views += 1
        if views < min_views or against >= views:
            continue
        total, mean = 0.0, 0.0
        for k in range(views):
            total += weights[k]
            mean += weights[k] * depths[k]
        mean /= total
        spread = 0.0
        for k in range(views):
            spread += weights[k] * (depths[k] - mean) ** 2
        # Two maps share a photo on average: they count as half as many independent ones.
        variance = 2.0 * max(1.0 / total, spread / total / (views - 1))
        # Along the normal, which the ray meets at an angle.
        sigma = np.sqrt(variance) * abs(n0 * ray0 + n1 * ray1 + n2 * ray2) / length
        if sigma <= spread_px * z / fx:
            merged[at, 0], merged[at, 1], merged[at, 2] = mean, sigma, views


@kernel
def _drop_crumbs(merged):  # type: ignore[no-untyped-def]
    """Set pixels to 0 that hardly any neighbour is on a surface with."""
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
    """Points, normals, colours, deviations and view counts of the merged pixels of one view."""
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
    # Where the surface leans, a pixel covers a long piece of it: a point for each quarter of the pixel.
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
