"""Predicted edge points, and how near another edge runs beside them: its step shifts theirs, or is taken for it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from arview.geometry import Array, apply
from arview.measurement.photo.views import PhotoViews


@dataclass(frozen=True)
class EdgePoints:
    """Predicted edge points in the photos that show them.

    Attributes:
        points: (N,3) in the model, mm.
        tangents: (N,3) unit, in the model.
        view: (N,) index of the photo.
    """

    points: Array
    tangents: Array
    view: NDArray[np.int64]

    def of(self, which: NDArray[np.bool_] | NDArray[np.int64]) -> EdgePoints:
        """The chosen points."""
        return EdgePoints(self.points[which], self.tangents[which], self.view[which])


def rival_offsets_px(edges: EdgePoints, views: PhotoViews, reach_px: float, same_px: float = 0.3) -> Array:
    """(N,2) offset in the photo, across each edge point's edge, of the nearest other edge beside it; inf beyond reach.

    Args:
        edges: all visible edge points of a component in the photos.
        views: the photos.
        reach_px: distance within which another edge is looked for.
        same_px: points nearer than this across the edge are on the same line in the photo, and no rivals.
    """
    from scipy.spatial import cKDTree

    result = np.full((len(edges.points), 2), np.inf)
    for view in np.unique(edges.view):
        of = np.flatnonzero(edges.view == view)
        camera, pose = views.cameras[view], views.cam_from_model[view]
        in_cam = apply(pose, edges.points[of])
        pixels = camera.project(in_cam)
        onward = camera.project(in_cam + 1e-4 * in_cam[:, 2:] * (edges.tangents[of] @ pose[:3, :3].T))
        along = onward - pixels
        with np.errstate(invalid="ignore", divide="ignore"):
            along = along / np.linalg.norm(along, axis=1, keepdims=True)
        good = np.isfinite(pixels).all(axis=1) & np.isfinite(along).all(axis=1)
        if np.count_nonzero(good) < 2:
            continue
        pairs = cKDTree(pixels[good]).query_pairs(reach_px + 2.0, output_type="ndarray")
        if not len(pairs):
            continue
        index = np.flatnonzero(good)
        first, second = index[pairs[:, 0]], index[pairs[:, 1]]
        _note(result, of, first, second=second, pixels=pixels, along=along, reach_px=reach_px, same_px=same_px)
        _note(result, of, second, second=first, pixels=pixels, along=along, reach_px=reach_px, same_px=same_px)
    return result


def _note(
    result: Array,
    of: NDArray[np.int64],
    first: NDArray[np.int64],
    second: NDArray[np.int64],
    pixels: Array,
    along: Array,
    reach_px: float,
    same_px: float,
) -> None:
    """Take over the offsets of the first points of pairs where the second ones are on a nearer edge beside theirs."""
    apart = pixels[second] - pixels[first]
    normal = np.stack([-along[first, 1], along[first, 0]], axis=1)
    signed = np.sum(normal * apart, axis=1)
    across, onward = np.abs(signed), np.abs(np.sum(along[first] * apart, axis=1))
    parallel = np.abs(np.sum(along[first] * along[second], axis=1)) > 0.8
    beside = parallel & (onward < 2.5) & (across > same_px) & (across < reach_px)
    beside &= across < np.hypot(*result[of[first]].T)
    # The nearest is written last.
    order = np.flatnonzero(beside)[np.argsort(-across[beside], kind="stable")]
    result[of[first[order]]] = normal[order] * signed[order, None]


def merged_shift_px(gap_px: Array, blur_px: float) -> Array:
    """(N,) by how much a step of the same height beside a step may shift it, px; 0 where there is none.

    Two blurred steps attract each other if both get brighter the same way, and repel each other if not, as the two
    edges of a thin sheet do (Steger, "Unbiased extraction of curvilinear structures from 2D and 3D images", 1998, for
    lines). To first order the steepest place moves by ``gap exp(-gap² / 2 blur²)`` for steps of the same height.

    Args:
        gap_px: (N,) signed distance from the step to the other one; inf where there is none.
        blur_px: standard deviation of the blur of a step.
    """
    near = np.isfinite(gap_px)
    gap = np.where(near, gap_px, 0.0)
    return gap * np.exp(-0.5 * (gap / blur_px) ** 2)
