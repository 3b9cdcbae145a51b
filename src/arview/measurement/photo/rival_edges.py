"""Predicted edge points, and how near another edge runs beside them: its step shifts theirs, or is taken for it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from arview.core import subpixel_edges
from arview.core.kernel import kernel
from arview.geometry import Array
from arview.measurement.photo.views import PhotoViews

MAX_ALONG_PX = 2.5
"""Points farther apart than this along an edge are not beside each other."""
MIN_PARALLEL = 0.8
"""Cosine of the angle between edges that run beside each other."""


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
    stack = views.levels[0]
    _, pixels, normals, _ = subpixel_edges.project_edges(
        edges.points, edges.tangents, edges.view, stack.poses, stack.lenses
    )
    with np.errstate(invalid="ignore"):
        order = np.lexsort((pixels[:, 0], edges.view))
    return _nearest_beside(order, edges.view, pixels, normals, reach_px, same_px)


@kernel
def _nearest_beside(
    order: NDArray[np.int64],
    view: NDArray[np.int64],
    pixels: NDArray[np.float64],
    normals: NDArray[np.float64],
    reach_px: float,
    same_px: float,
) -> NDArray[np.float64]:
    """`rival_offsets_px` of points in ``order`` by view and column; those that are NaN have none, and are nobody's."""
    count = len(order)
    result, nearest = np.full((count, 2), np.inf), np.full(count, reach_px)
    window_px = reach_px + MAX_ALONG_PX
    for a in range(count):
        i = order[a]
        for b in range(a + 1, count):
            j = order[b]
            du, dv = pixels[j, 0] - pixels[i, 0], pixels[j, 1] - pixels[i, 1]
            if view[j] != view[i] or not du <= window_px:
                break
            if abs(normals[i, 0] * normals[j, 0] + normals[i, 1] * normals[j, 1]) <= MIN_PARALLEL:
                continue
            for k, sign in ((i, 1.0), (j, -1.0)):
                across = sign * (normals[k, 0] * du + normals[k, 1] * dv)
                along = abs(normals[k, 1] * du - normals[k, 0] * dv)
                if along < MAX_ALONG_PX and same_px < abs(across) < nearest[k]:
                    nearest[k] = abs(across)
                    result[k, 0], result[k, 1] = across * normals[k, 0], across * normals[k, 1]
    return result


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
