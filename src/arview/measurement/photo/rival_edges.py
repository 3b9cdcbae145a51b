"""Predicted edge points, and how near another edge runs beside them: then a step may be that of either."""

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


def rival_px(edges: EdgePoints, views: PhotoViews, reach_px: float, same_px: float = 0.3) -> Array:
    """(N,) distance in the photo from each edge point to the nearest other edge that runs beside it; inf beyond reach.

    Args:
        edges: all visible edge points of a component in the photos.
        views: the photos.
        reach_px: distance within which another edge is looked for.
        same_px: points nearer than this across the edge are on the same line in the photo, and no rivals.
    """
    from scipy.spatial import cKDTree

    result = np.full(len(edges.points), np.inf)
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
        _note(result, of, first, second, pixels, along, reach_px, same_px)
        _note(result, of, second, first, pixels, along, reach_px, same_px)
    return result


def _note(
    result: Array, of: NDArray[np.int64], first: NDArray[np.int64], second: NDArray[np.int64], pixels: Array,
    along: Array, reach_px: float, same_px: float,
) -> None:  # fmt: skip
    """Lower the distance of the first points of pairs where the second ones are on an edge beside theirs."""
    apart = pixels[second] - pixels[first]
    across = np.abs(along[first, 0] * apart[:, 1] - along[first, 1] * apart[:, 0])
    onward = np.abs(np.sum(along[first] * apart, axis=1))
    parallel = np.abs(np.sum(along[first] * along[second], axis=1)) > 0.8
    beside = parallel & (onward < 2.5) & (across > same_px) & (across < reach_px)
    np.minimum.at(result, of[first[beside]], across[beside])
