"""A small convolutional network that sees where lines of a part may run in a picture, and in which direction.

Gradients respond to noise, to the texture of what lies around and to shadows as they do to the part. The network, shown
a whole neighbourhood, answers to what looks like the outline or an edge of a solid, as learned edge detectors do (Xie &
Tu, "Holistically-Nested Edge Detection", ICCV 2015); the layout is that of Ronneberger et al., "U-Net" (MICCAI 2015),
but that levels are added. It knows nothing of a part: it was fitted to random solids before photos, see
``tools/training/fit.py``.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.core.kernel import kernel
from arview.core.onnx_session import padded_to_multiple
from arview.detection.features.response_maps import ORIENTATIONS
from arview.guideviews.mesh_edges import EDGE_CONTOUR, EDGE_SHARP
from arview.refinement.kernels import nearest_view
from arview.refinement.projection import project_lines
from arview.weights import load_network

LONGEST_SIDE_PX = 640
"""Larger pictures are shrunk to this. In pictures of this size it was fitted to half diameters of 30 to 300 px."""
SHRINK = 2
"""The network's maps are so many times smaller than what it is shown."""
CELL_PX = 32
"""It takes pictures of multiples of this."""
AROUND_PX, CLEAR_SHARE, LEAST_CLEAR = 49, 0.9, 0.15
"""Answers count relative to such a share of the strongest one this near (side of a square of the maps, smoothed), if
that is not weaker than the last."""
INSIDE = ORIENTATIONS
"""Of its maps that which says where solids are."""
CONTRAST = 64.0
"""Grey levels less their mean are shown in units of this."""


class EdgeNet:
    """The network; threads may share it."""

    def __init__(self) -> None:
        self._network = load_network("edge_net.onnx")

    def predict(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """How likely each place of an RGB picture (H,W,3) is on a line of each orientation, and on a solid.

        Where it is sure of few lines, as of materials that it does not know or before some textures, its answers are
        brought up to those elsewhere.

        Returns:
            (9,h,w) 0–255, the orientations and `INSIDE`, of half the picture's size, or of half of `LONGEST_SIDE_PX`.
        """
        height, width = image.shape[:2]
        share = min(1.0, LONGEST_SIDE_PX / max(height, width))
        if share < 1.0:
            image = cv2.resize(image, None, fx=share, fy=share, interpolation=cv2.INTER_AREA)
            height, width = image.shape[:2]
        mean = sum(cv2.mean(image)[:3]) / 3.0
        image = padded_to_multiple(image, CELL_PX)
        answers = self._network(picture=cv2.dnn.blobFromImage(image, 1.0 / CONTRAST, mean=(mean, mean, mean)))
        seen = answers[0, :, : -(-height // SHRINK), : -(-width // SHRINK)]
        lines = seen[:INSIDE]
        around = cv2.dilate(lines.max(axis=0), np.ones((AROUND_PX, AROUND_PX), dtype=np.uint8))
        clear = np.maximum(CLEAR_SHARE * cv2.blur(around, (AROUND_PX // 2, AROUND_PX // 2)), LEAST_CLEAR)
        np.minimum(lines / clear, 1.0, out=lines)
        return np.asarray(np.round(255.0 * seen).astype(np.uint8))


def halve_responses(lines: NDArray[np.uint8]) -> list[NDArray[np.uint8]]:
    """Maps (9,h,w), and again at half the size and so on as long as that is even; the strongest of four pixels."""
    levels = [lines]
    block = np.ones((2, 2), dtype=np.uint8)
    while levels[-1].shape[1] % 2 == 0 and levels[-1].shape[2] % 2 == 0:
        # Each place has the strongest of itself and of what is above and to the left of it.
        levels.append(np.stack([cv2.dilate(plane, block)[1::2, 1::2] for plane in levels[-1]]))
    return levels


def resize_responses(lines: NDArray[np.uint8], width: int, height: int, spread_px: int) -> NDArray[np.uint8]:
    """Maps (8,H,W) of lines from `EdgeNet.predict`; the strongest of the pixels that one stands for, and spread."""
    lines = lines[:ORIENTATIONS]
    shrunk = lines.shape[2] / width
    side = max(1, int(shrunk + 0.5))
    merged = np.ones((side, side), dtype=np.uint8)
    spread = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * spread_px + 1, 2 * spread_px + 1))
    way = cv2.INTER_AREA if shrunk > 1.6 else cv2.INTER_LINEAR
    sized = np.empty((len(lines), height, width), dtype=np.uint8)
    for plane, out in zip(lines, sized, strict=True):
        strongest = cv2.dilate(plane, merged) if side > 1 else plane
        cv2.dilate(cv2.resize(strongest, (width, height), interpolation=way), spread, dst=out)
    return sized


@kernel
def mean_edge_response(maps, part, pose, intrinsics, step_mm):  # type: ignore[no-untyped-def]
    """Mean answer 0–1 of the network under the outline and the design edges of a part; these count half at most.

    Args:
        maps: (8,H,W) uint8, see `EdgeResponses`; intrinsics: (10,) that belong to them.
        part: arrays of all guide views, see `PartView.arrays`; pose: (4,4) ``cam_from_body``.
        step_mm: length over which directions are projected.
    """
    directions, c_start, c_points, c_normals, _, e_start, e_points, e_tangents, e_kinds = part
    height, width = maps.shape[1], maps.shape[2]
    view = nearest_view(directions, pose)
    sums = np.zeros(2)
    counts = np.zeros(2)
    for group in range(2):
        starts = c_start if group == 0 else e_start
        first, last = starts[view], starts[view + 1]
        if group == 0:
            px, normals, depths = project_lines(
                c_points[first:last], c_normals[first:last], False, pose, intrinsics, step_mm
            )
        else:
            px, normals, depths = project_lines(
                e_points[first:last], e_tangents[first:last], True, pose, intrinsics, step_mm
            )
        for i in range(px.shape[0]):
            if group == 1:
                kind = e_kinds[first + i]
                if (kind & EDGE_CONTOUR) > 0 or (kind & EDGE_SHARP) == 0:
                    continue
            if depths[i] <= 0.0:
                continue
            column, row = int(np.round(px[i, 0])), int(np.round(px[i, 1]))
            if 0 <= column < width and 0 <= row < height:
                turn = np.arctan2(normals[i, 1], normals[i, 0]) / np.pi * ORIENTATIONS
                sums[group] += maps[int(np.round(turn)) % ORIENTATIONS, row, column] / 255.0
                counts[group] += 1.0
    means = sums / np.maximum(counts, 1.0)
    share = min(0.5, counts[1] / max(counts[0] + counts[1], 1.0))
    return (1.0 - share) * means[0] + share * means[1]
