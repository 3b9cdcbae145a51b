"""Features of one view: contour points with normals and run lengths, edge points with tangents.

The contour is traced in the silhouette; each of its points is then moved onto the mesh edge that causes it, so that
its position is that of the CAD and not of a pixel. The run lengths of a contour point are how far its normal stays on
the part (inwards) and on the background (outwards): Stoiber et al., "A Sparse Gaussian Approach to Region-Based 6DoF
Object Tracking" (ACCV 2020).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.camera import Camera
from arview.core.kernel import kernel
from arview.geometry import Array
from arview.rendering import EDGE_CONTOUR, MeshEdges, Rendering, ViewEdgeSamples, sample_visible_edges

MAX_SHIFT_PX = 1.6
"""Largest distance over which a contour pixel is moved onto a sample of a mesh edge."""
MIN_CHAIN_PX = 24
"""Shorter outlines, those of specks and pinholes, are left out."""
TANGENT_REACH_PX = 5
"""Neighbours along the outline, on either side, that a contour point's tangent is fitted to."""
SHORT_EDGE_PX = 6.0
"""Tangents of shorter edges are smoothed."""

NORMAL_REACH_PX = 2.0
"""Distance from the outline at which its two sides are told apart."""


@dataclass(frozen=True)
class ViewFeatures:
    """Features of one view; points are in the model frame, mm.

    Attributes:
        contour_points: (C,3).
        contour_normals: (C,3) unit vectors, outwards and across the line of sight.
        contour_runs_mm: (C,2) how far the normal stays on the part, and on the background.
        contour_component: (C,) component index.
        edge_points: (E,3).
        edge_tangents: (E,3) unit vectors; along the outline so that the image normal (-v, u) points outwards.
        edge_kinds: (E,) EDGE_* bits.
        edge_component: (E,) component index.
    """

    contour_points: Array
    contour_normals: Array
    contour_runs_mm: Array
    contour_component: NDArray[np.int32]
    edge_points: Array
    edge_tangents: Array
    edge_kinds: NDArray[np.uint8]
    edge_component: NDArray[np.int32]


@kernel
def _run_length(mask: NDArray[np.uint8], u: float, v: float, du: float, dv: float, on_part: bool, longest: int) -> int:
    """Number of steps of one pixel from (u, v) along (du, dv) during which the mask stays ``on_part``."""
    height, width = mask.shape
    for step in range(1, longest + 1):
        x = int(np.round(u + du * (step - 0.5)))
        y = int(np.round(v + dv * (step - 0.5)))
        inside = 0 <= x < width and 0 <= y < height and mask[y, x] > 0
        if inside != on_part:
            return step - 1
    return longest


@kernel
def _describe_contour(
    mask: NDArray[np.uint8],
    xs: NDArray[np.float64],
    ys: NDArray[np.float64],
    starts: NDArray[np.int64],
    ends_: NDArray[np.int64],
    half: int,
    longest: int,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """Positions, outward normals and run lengths at the pixels of closed outlines.

    Args:
        mask: (H,W) silhouette, > 0 on the part.
        xs, ys: (N,) pixels of all outlines, one after the other.
        starts, ends_: (N,) first index of each pixel's outline, and one past its last.
        half: neighbours on either side that the tangent is fitted to.
        longest: largest run length, px.

    Returns:
        u, v (N,) half a pixel outside the pixels' centres, normals (N,2), run lengths (N,2) on the part and on the
        background, px, and whether both are at least a pixel (N,).
    """
    count = xs.shape[0]
    u = np.empty(count)
    v = np.empty(count)
    normal = np.zeros((count, 2))
    runs = np.zeros((count, 2))
    ok = np.zeros(count, dtype=np.bool_)
    for i in range(count):
        first, last = starts[i], ends_[i]
        size = last - first
        k = i - first
        # The tangent is the least-squares line through the neighbours along the outline.
        tx = 0.0
        ty = 0.0
        for s in range(1, half + 1):
            after = first + (k + s) % size
            before = first + (k - s) % size
            tx += s * (xs[after] - xs[before])
            ty += s * (ys[after] - ys[before])
        norm = np.sqrt(tx * tx + ty * ty)
        u[i] = xs[i]
        v[i] = ys[i]
        if norm < 1e-9:
            continue
        nx, ny = ty / norm, -tx / norm
        inner = _run_length(mask, u[i], v[i], -nx, -ny, True, 3)
        outer = _run_length(mask, u[i], v[i], nx, ny, True, 3)
        if inner < outer:
            nx, ny = -nx, -ny
        normal[i, 0], normal[i, 1] = nx, ny
        # The centre of a pixel of the outline lies inside: the outline itself is about half a pixel further out.
        u[i] += 0.5 * nx
        v[i] += 0.5 * ny
        runs[i, 0] = _run_length(mask, u[i], v[i], -nx, -ny, True, longest)
        runs[i, 1] = _run_length(mask, u[i], v[i], nx, ny, False, longest)
        ok[i] = runs[i, 0] >= 1 and runs[i, 1] >= 1
    return u, v, normal, runs, ok


@kernel
def _nearest_sample(
    u: NDArray[np.float64],
    v: NDArray[np.float64],
    sample_pixels: NDArray[np.float64],
    width: int,
    height: int,
    reach: float,
) -> NDArray[np.int32]:
    """Index of the nearest sample within ``reach`` px of each (u, v), or -1, found by a grid of pixels."""
    grid = np.full((height, width), -1, dtype=np.int32)
    following = np.full(sample_pixels.shape[0], -1, dtype=np.int32)
    for i in range(sample_pixels.shape[0]):
        x = int(np.round(sample_pixels[i, 0]))
        y = int(np.round(sample_pixels[i, 1]))
        following[i] = grid[y, x]
        grid[y, x] = i
    nearest = np.full(u.shape[0], -1, dtype=np.int32)
    cells = int(np.ceil(reach))
    for i in range(u.shape[0]):
        best = reach * reach
        x0, y0 = int(np.round(u[i])), int(np.round(v[i]))
        for y in range(max(0, y0 - cells), min(height, y0 + cells + 1)):
            for x in range(max(0, x0 - cells), min(width, x0 + cells + 1)):
                j = grid[y, x]
                while j >= 0:
                    d = (sample_pixels[j, 0] - u[i]) ** 2 + (sample_pixels[j, 1] - v[i]) ** 2
                    if d < best:
                        best = d
                        nearest[i] = j
                    j = following[j]
    return nearest


def _smooth_tangents(pixels: Array, tangents_px: Array, shape: tuple[int, int]) -> Array:
    """Unit directions (N,2) in the picture, averaged over the neighbours within 3 px by their structure tensor."""
    x = np.round(pixels[:, 0]).astype(np.intp)
    y = np.round(pixels[:, 1]).astype(np.intp)
    flat = y * shape[1] + x
    size = shape[0] * shape[1]
    products = (tangents_px[:, 0] ** 2, tangents_px[:, 0] * tangents_px[:, 1], tangents_px[:, 1] ** 2)
    xx, xy, yy = (
        cv2.boxFilter(np.bincount(flat, p, size).reshape(shape), -1, (7, 7), normalize=False)[y, x] for p in products
    )
    angle = 0.5 * np.arctan2(2.0 * xy, xx - yy)
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)


class _Contour(NamedTuple):
    """Contour points of one view; see the attributes of the same names of `ViewFeatures`."""

    points: Array
    normals: Array
    runs_mm: Array
    component: NDArray[np.int32]


def extract_features(
    rendering: Rendering,
    cam_from_model: Array,
    camera: Camera,
    edges: MeshEdges,
    contour_count: int,
    edge_count: int,
) -> ViewFeatures:
    """Contour and edge points of one rendered view.

    Args:
        rendering: the view; the part must lie inside the picture.
        cam_from_model: (4,4) its pose.
        camera: ideal camera of the view.
        edges: edges of the same model.
        contour_count, edge_count: largest numbers of points, spread evenly over all that are found.
    """
    intrinsics = (camera.fx, camera.fy, camera.cx, camera.cy)
    samples = sample_visible_edges(edges, cam_from_model, intrinsics, rendering.depth_mm, spacing_px=1.0)
    tangents, usable = _edge_tangents(samples, cam_from_model, camera, rendering.silhouette)
    chosen = usable[_evenly(len(usable), edge_count)]
    contour = _contour(rendering, cam_from_model, camera, samples, contour_count)
    return ViewFeatures(
        contour_points=contour.points,
        contour_normals=contour.normals,
        contour_runs_mm=contour.runs_mm,
        contour_component=contour.component,
        edge_points=samples.points_in_model[chosen],
        edge_tangents=tangents[chosen],
        edge_kinds=samples.kinds[chosen],
        edge_component=samples.component[chosen],
    )


def _edge_tangents(
    samples: ViewEdgeSamples, cam_from_model: Array, camera: Camera, mask: NDArray[np.uint8]
) -> tuple[Array, NDArray[np.intp]]:
    """Unit tangents (N,3) of edge samples in the model frame, and the indices of the samples that are usable.

    Short edges of curved surfaces zigzag: their tangents are smoothed. Long edges along the line of sight have no
    direction in the picture and are left out. Tangents (u, v) of the outline run so that (-v, u) points outwards.
    """
    fx, fy, cx, cy = camera.fx, camera.fy, camera.cx, camera.cy
    tangents_in_cam = samples.tangents_in_model @ cam_from_model[:3, :3].T
    x = (samples.pixels[:, 0] - cx) / fx
    y = (samples.pixels[:, 1] - cy) / fy
    tangents_px = np.stack(
        [
            fx * (tangents_in_cam[:, 0] - x * tangents_in_cam[:, 2]),
            fy * (tangents_in_cam[:, 1] - y * tangents_in_cam[:, 2]),
        ],
        axis=1,
    )
    norms = np.linalg.norm(tangents_px, axis=1)
    along_sight = norms < 0.05 * fx
    tangents_px /= np.maximum(norms, 1e-12)[:, None]
    if not len(samples.pixels):
        return samples.tangents_in_model, np.zeros(0, dtype=np.intp)
    is_short = samples.lengths_px < SHORT_EDGE_PX
    smooth_px = _smooth_tangents(samples.pixels, tangents_px, (mask.shape[0], mask.shape[1]))
    smooth_in_cam = np.stack([smooth_px[:, 0] / fx, smooth_px[:, 1] / fy, np.zeros(len(smooth_px))], axis=1)
    smooth_in_cam /= np.linalg.norm(smooth_in_cam, axis=1, keepdims=True)
    tangents = np.where(is_short[:, None], smooth_in_cam @ cam_from_model[:3, :3], samples.tangents_in_model)
    directions_px = np.where(is_short[:, None], smooth_px, tangents_px)
    is_inward = _run_inwards(samples.pixels, directions_px, mask) & ((samples.kinds & EDGE_CONTOUR) > 0)
    tangents[is_inward] *= -1.0
    return tangents, np.flatnonzero(~along_sight | is_short)


def _run_inwards(pixels: Array, tangents_px: Array, mask: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Of which edges (N,) the normal (-v, u) of the tangent (u, v) points to the inside of a silhouette (H,W)."""
    inside = cv2.blur((mask > 0).astype(np.float32), (3, 3))
    normals = NORMAL_REACH_PX * np.stack([-tangents_px[:, 1], tangents_px[:, 0]], axis=1)
    outer, inner = (
        cv2.remap(inside, (pixels + shift).astype(np.float32)[None], None, cv2.INTER_LINEAR)[0]
        for shift in (normals, -normals)
    )
    return np.asarray(outer > inner)


def _contour(
    rendering: Rendering, cam_from_model: Array, camera: Camera, samples: ViewEdgeSamples, count: int
) -> _Contour:
    """At most ``count`` points of the silhouette's outline; those near an edge sample of the contour lie on it."""
    fx, fy, cx, cy = camera.fx, camera.fy, camera.cx, camera.cy
    mask, depth = rendering.silhouette, rendering.depth_mm
    height, width = depth.shape
    found, _ = cv2.findContours(mask, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    chains = [chain[:, 0, :] for chain in found if len(chain) >= MIN_CHAIN_PX]
    if not chains:
        return _Contour(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 2)), np.zeros(0, dtype=np.int32))
    lengths = [len(chain) for chain in chains]
    pixels = np.concatenate(chains).astype(np.float64)
    firsts = np.repeat(np.cumsum([0, *lengths[:-1]]), lengths)
    lasts = np.repeat(np.cumsum(lengths), lengths)
    longest = max(width, height) // 2
    u, v, normal_px, runs_px, ok = _describe_contour(
        mask, pixels[:, 0].copy(), pixels[:, 1].copy(), firsts, lasts, TANGENT_REACH_PX, longest
    )
    is_inside = (u > 2) & (v > 2) & (u < width - 3) & (v < height - 3)
    keep = np.flatnonzero(ok & is_inside)
    keep = keep[_evenly(len(keep), count)]
    u, v, normal_px, runs_px = u[keep], v[keep], normal_px[keep], runs_px[keep]
    inner = np.round(pixels[keep]).astype(np.intp)
    z = depth[inner[:, 1], inner[:, 0]].astype(np.float64)
    points_in_cam = np.stack([(u - cx) / fx * z, (v - cy) / fy * z, z], axis=1)
    points = (points_in_cam - cam_from_model[:3, 3]) @ cam_from_model[:3, :3]
    outline = np.flatnonzero(samples.kinds & EDGE_CONTOUR)
    nearest = _nearest_sample(u, v, samples.pixels[outline], width, height, MAX_SHIFT_PX)
    is_moved = nearest >= 0
    points[is_moved] = samples.points_in_model[outline[nearest[is_moved]]]
    return _Contour(
        points=points,
        normals=_normals_across_sight(points, normal_px, cam_from_model),
        runs_mm=runs_px * (z / fx)[:, None],
        component=rendering.component_ids[inner[:, 1], inner[:, 0]].astype(np.int32),
    )


def _normals_across_sight(points: Array, normals_px: Array, cam_from_model: Array) -> Array:
    """Unit normals (C,3) in the model frame, across the line of sight, that project to normals (C,2) in the picture."""
    model_from_cam_rotation = cam_from_model[:3, :3].T
    eye = -model_from_cam_rotation @ cam_from_model[:3, 3]
    normals_in_cam = np.stack([normals_px[:, 0], normals_px[:, 1], np.zeros(len(normals_px))], axis=1)
    normals = normals_in_cam @ cam_from_model[:3, :3]
    sight = points - eye
    sight /= np.linalg.norm(sight, axis=1, keepdims=True)
    normals -= np.sum(normals * sight, axis=1, keepdims=True) * sight
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return normals


def _evenly(available: int, wanted: int) -> NDArray[np.intp]:
    """At most ``wanted`` indices, spread evenly over ``available`` ones."""
    if available <= wanted:
        return np.arange(available)
    return np.floor((np.arange(wanted) + 0.5) * available / wanted).astype(np.intp)
