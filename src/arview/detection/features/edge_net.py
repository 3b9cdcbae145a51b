"""A small convolutional network that predicts where edges of solids run in an image, and in which direction.

Gradients respond to noise, background texture and shadows as much as to the part. The network sees a neighbourhood and
responds to what looks like the outline or an edge of a solid, as learned edge detectors do (Xie & Tu,
"Holistically-Nested Edge Detection", ICCV 2015). Its layout is that of Ronneberger et al., "U-Net" (MICCAI 2015), with
skip connections that add instead of concatenate. It is not specific to a part: it was trained on random solids before
photos, see ``tools/training/fit.py``.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.core.kernel import kernel
from arview.core.onnx_session import padded_to_multiple
from arview.detection.features.response_maps import ORIENTATIONS
from arview.refinement import ViewArrays, nearest_view, project_lines
from arview.rendering import EDGE_CONTOUR, EDGE_SHARP
from arview.weights import load_network

MAX_SIDE_PX = 640
"""Longer side of the images that the network was trained on; larger images are reduced to this."""
SHRINK = 2
"""Factor by which the predicted maps are smaller than the input."""
CELL_PX = 32
"""The network takes images whose sides are multiples of this."""
SOLID_CHANNEL = ORIENTATIONS
"""Index of the predicted map of solids; the maps before it are edge responses by orientation."""
INPUT_SCALE = 64.0
"""Grey levels that the input is divided by after its mean is subtracted."""


NEIGHBOURHOOD_PX = 49
"""Side of the square of map pixels over which the strongest response is taken and smoothed."""
REFERENCE_SHARE = 0.9
"""Share of the strongest response nearby that becomes a full response."""
MIN_REFERENCE = 0.15
"""Lower bound on that reference, so that weak responses to clutter stay weak."""


class EdgeNet:
    """The edge network; threads may share it."""

    def __init__(self) -> None:
        self._network = load_network("edge_net.onnx")

    def predict(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Edge responses by orientation and solidness of an RGB image (H,W,3).

        Edge responses are normalised by the strongest ones nearby, because the network responds weakly to unknown
        materials and before some textures.

        Returns:
            (9,h,w) 0–255: `ORIENTATIONS` edge maps and `SOLID_CHANNEL`, at half the size of the image after its longer
            side is reduced to `MAX_SIDE_PX`.
        """
        height, width = image.shape[:2]
        share = min(1.0, MAX_SIDE_PX / max(height, width))
        if share < 1.0:
            image = cv2.resize(image, None, fx=share, fy=share, interpolation=cv2.INTER_AREA)
            height, width = image.shape[:2]
        mean = sum(cv2.mean(image)[:3]) / 3.0
        image = padded_to_multiple(image, CELL_PX)
        predicted = self._network(picture=cv2.dnn.blobFromImage(image, 1.0 / INPUT_SCALE, mean=(mean, mean, mean)))
        maps = predicted[0, :, : -(-height // SHRINK), : -(-width // SHRINK)]
        edges = maps[:SOLID_CHANNEL]
        side = NEIGHBOURHOOD_PX
        strongest = cv2.dilate(edges.max(axis=0), np.ones((side, side), dtype=np.uint8))
        reference = np.maximum(REFERENCE_SHARE * cv2.blur(strongest, (side // 2, side // 2)), MIN_REFERENCE)
        np.minimum(edges / reference, 1.0, out=edges)
        return np.asarray(np.round(255.0 * maps).astype(np.uint8))


def halve_responses(maps: NDArray[np.uint8]) -> list[NDArray[np.uint8]]:
    """Pyramid of maps (9,h,w): each level has half the size and the maxima of 2×2 pixels, down to an odd size."""
    levels = [maps]
    block = np.ones((2, 2), dtype=np.uint8)
    while levels[-1].shape[1] % 2 == 0 and levels[-1].shape[2] % 2 == 0:
        # The dilation takes the maximum of a pixel and those above and to the left of it.
        levels.append(np.stack([cv2.dilate(plane, block)[1::2, 1::2] for plane in levels[-1]]))
    return levels


def resize_responses(maps: NDArray[np.uint8], width: int, height: int, spread_px: int) -> NDArray[np.uint8]:
    """Edge responses (8,height,width) from `EdgeNet.predict`: maxima of merged pixels, dilated by ``spread_px``."""
    maps = maps[:ORIENTATIONS]
    shrunk = maps.shape[2] / width
    side = max(1, int(shrunk + 0.5))
    merged = np.ones((side, side), dtype=np.uint8)
    spread = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * spread_px + 1, 2 * spread_px + 1))
    interpolation = cv2.INTER_AREA if shrunk > 1.6 else cv2.INTER_LINEAR
    sized = np.empty((len(maps), height, width), dtype=np.uint8)
    for plane, out in zip(maps, sized, strict=True):
        strongest = cv2.dilate(plane, merged) if side > 1 else plane
        cv2.dilate(cv2.resize(strongest, (width, height), interpolation=interpolation), spread, dst=out)
    return sized


@kernel
def mean_edge_response(
    maps: NDArray[np.uint8],
    part: ViewArrays,
    pose: NDArray[np.float64],
    intrinsics: NDArray[np.float64],
    step_mm: float,
) -> float:
    """Mean edge response 0–1 under the outline and the design edges of a part, which weigh at most half.

    Args:
        maps: (8,H,W) uint8, see `EdgeResponses`.
        part: arrays of all guide views, see `PartView.arrays`.
        pose: (4,4) ``cam_from_body``.
        intrinsics: (10,) of the maps.
        step_mm: length over which directions are projected.
    """
    height, width = maps.shape[1], maps.shape[2]
    view = nearest_view(part.directions, pose)
    sums = np.zeros(2)
    counts = np.zeros(2)
    for group in range(2):
        starts = part.contour_starts if group == 0 else part.edge_starts
        first, last = starts[view], starts[view + 1]
        if group == 0:
            px, normals, depths = project_lines(
                part.contour_points[first:last], part.contour_normals[first:last], False, pose, intrinsics, step_mm
            )
        else:
            px, normals, depths = project_lines(
                part.edge_points[first:last], part.edge_tangents[first:last], True, pose, intrinsics, step_mm
            )
        for i in range(px.shape[0]):
            if group == 1:
                kind = part.edge_kinds[first + i]
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
