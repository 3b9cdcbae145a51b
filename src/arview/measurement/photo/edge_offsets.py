"""Steps of brightness across predicted edge points in photos, as displacements in space."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from arview.core import subpixel_edges
from arview.core.kernel import kernel
from arview.geometry import Array
from arview.measurement.photo.rival_edges import EdgePoints, merged_shift_px
from arview.measurement.photo.views import PhotoViews

HALF_WIDTH_PX = 2.0
"""Profiles are averaged over this distance to either side along the edge."""
THRESHOLD = 1.0
"""Weakest step, in grey levels (of 255) per px in linear light."""
HALF_SLOPE = 6.0
"""Slope at which a step has half its full weight."""
BLUR_PX = 1.0
"""Standard deviation of a step's blur: lens, sensor, smoothing, and the samples of a profile."""


@dataclass(frozen=True)
class EdgeOffsets:
    """Steps of brightness near predicted edge points.

    Attributes:
        directions: (N,3) unit vectors in the model, across the edge and the line of sight; only this component of a
            displacement is visible in the photo.
        offsets_mm: (N,) position of the step along the direction; 0 where there is none.
        mm_per_px: (N,) size of a pixel in that direction.
        slopes: (N,) grey levels per px in linear light, positive where it gets brighter along the direction; 0 where
            there is no step.
        seen: (N,) whether the point is inside the photo.
        hypotheses_mm, strengths: (N,K) positions and slopes of all steps found, 0 = none.
        pose_rows: (N,6) derivative of the offset by the twist of its photo's pose.
        merged_mm: (N,) by how much the blurred step of another edge beside it may shift the step.
    """

    directions: Array
    offsets_mm: Array
    mm_per_px: Array
    slopes: Array
    seen: NDArray[np.bool_]
    hypotheses_mm: Array
    strengths: Array
    pose_rows: Array
    merged_mm: Array


def edge_offsets(
    edges: EdgePoints,
    center: Array,
    views: PhotoViews,
    reach_px: float,
    level: int = 0,
    gaps_px: Array | None = None,
) -> EdgeOffsets:
    """Find a step of brightness across each predicted edge point.

    Args:
        edges: points in photos that are known to show them.
        center: (3,) point from which the directions lead away.
        views: the photos.
        reach_px: search range to either side, px of the level.
        level: resolution of the photos: 0 is full size, each further level half of it.
        gaps_px: (N,2) of `rival_offsets_px`, in px of full size; None: no edge has another one beside it.
    """
    return steps_across(edge_rays(edges, center, views, level), edges.view, views, reach_px, level, gaps_px=gaps_px)


def edge_rays(edges: EdgePoints, center: Array, views: PhotoViews, level: int) -> EdgeRays:
    """Edge points in the photos, with directions that lead away from a point (3,)."""
    stack = views.levels[level]
    in_cam, pixels, normals, by_cam = subpixel_edges.project_edges(
        edges.points, edges.tangents, edges.view, stack.poses, stack.lenses
    )
    return EdgeRays(
        pixels, normals, *_outward(edges.points, edges.view, stack.poses, np.asarray(center), in_cam, normals, by_cam)
    )


def steps_across(
    rays: EdgeRays,
    view: NDArray[np.int64],
    views: PhotoViews,
    reach_px: float,
    level: int,
    shift_px: float = 0.0,
    gaps_px: Array | None = None,
) -> EdgeOffsets:
    """Find a step of brightness on each ray, or ``shift_px`` beside it, where steps are found by chance."""
    n = len(view)
    hypotheses, strengths, seen = np.zeros((n, 4)), np.zeros((n, 4)), np.zeros(n, dtype=bool)
    for v in np.unique(view):
        of = view == v
        pixels, normals = rays.pixels[of], rays.normals[of]
        light, corner = _crop(views, int(v), level, pixels, reach_px + abs(shift_px))
        pixels += shift_px * normals - corner
        hypotheses[of], strengths[of], seen[of] = subpixel_edges.find_steps(
            light, pixels, normals, reach_px, HALF_WIDTH_PX, THRESHOLD
        )
    chosen, slopes = subpixel_edges.choose_steps(hypotheses, strengths, 0.4 * reach_px, HALF_SLOPE)
    gap = np.full(n, np.inf)
    if gaps_px is not None:
        has_rival = np.isfinite(gaps_px).all(axis=1)
        gap[has_rival] = np.sum(gaps_px[has_rival] * rays.normals[has_rival], axis=1)
    size = rays.mm_per_px
    return EdgeOffsets(
        rays.directions,
        chosen * size,
        size,
        slopes=slopes,
        seen=seen,
        hypotheses_mm=hypotheses * size[:, None],
        strengths=strengths,
        pose_rows=rays.pose_rows,
        merged_mm=merged_shift_px(gap, BLUR_PX) * size,
    )


class EdgeRays(NamedTuple):
    """Predicted edge points in photos, and where a step across each may lie.

    Attributes:
        pixels, normals: (N,2) in the photo, across the edge; NaN where it does not show the point.
        directions, mm_per_px, pose_rows: as of `EdgeOffsets`.
    """

    pixels: Array
    normals: Array
    directions: Array
    mm_per_px: Array
    pose_rows: Array


@kernel(numpy_errors=True)
def _outward(
    points: NDArray[np.float64],
    view: NDArray[np.int64],
    poses: NDArray[np.float64],
    center: NDArray[np.float64],
    in_cam: NDArray[np.float64],
    normals: NDArray[np.float64],
    by_cam: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Directions, mm per px and rows of the poses of edges of `project_edges`, whose normals are turned outwards."""
    count = len(points)
    directions, mm_per_px, pose_rows = np.zeros((count, 3)), np.ones(count), np.zeros((count, 6))
    for i in range(count):
        pose, across, seen = poses[view[i]], by_cam[i], in_cam[i]
        along, square = 0.0, 0.0
        for k in range(3):
            directions[i, k] = pose[0, k] * across[0] + pose[1, k] * across[1] + pose[2, k] * across[2]
            along += directions[i, k] * (points[i, k] - center[k])
            square += across[k] * across[k]
        if not square > 0.0 or square == np.inf:
            directions[i] = (1.0, 0.0, 0.0)
            normals[i] = np.nan
            continue
        sign = -1.0 if along < 0.0 else 1.0
        mm_per_px[i] = 1.0 / np.sqrt(square)
        scale = sign * mm_per_px[i]
        normals[i] *= sign
        directions[i] *= scale
        pose_rows[i, 0] = scale * (seen[1] * across[2] - seen[2] * across[1])
        pose_rows[i, 1] = scale * (seen[2] * across[0] - seen[0] * across[2])
        pose_rows[i, 2] = scale * (seen[0] * across[1] - seen[1] * across[0])
        pose_rows[i, 3:] = scale * across
    return directions, mm_per_px, pose_rows


def _crop(
    views: PhotoViews, view: int, level: int, pixels: Array, reach_px: float
) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """A photo, or the part of a large one around some pixels, in linear light, and its first pixel (u, v)."""
    whole = views.linear(view, level)
    if whole is not None:
        return whole, np.zeros(2, dtype=np.int64)
    width, height = views.levels[level].sizes[view]
    margin = reach_px + 12.0
    pixels = pixels[np.isfinite(pixels).all(axis=1)]
    low = np.clip(np.floor(pixels.min(axis=0, initial=0.0 if not len(pixels) else np.inf) - margin), 0, [width, height])
    high = np.clip(np.ceil(pixels.max(axis=0, initial=0.0) + margin), 0, [width, height])
    first, last = low.astype(np.int64), np.maximum(high, low + 4).astype(np.int64)
    part = views.gray(view, level)[first[1] : last[1], first[0] : last[0]]
    if part.size == 0:
        return np.zeros((4, 4), dtype=np.float32), np.zeros(2, dtype=np.int64)
    return subpixel_edges.linear_light(np.ascontiguousarray(part)), first
