"""A small convolutional network that sees where lines of a part may run in a picture, and in which direction.

Gradients answer to noise, to the texture of what lies around and to shadows as they do to the part. The network, shown
a whole neighbourhood, answers to what looks like the outline or an edge of a solid, as learned edge detectors do (Xie &
Tu, "Holistically-Nested Edge Detection", ICCV 2015); the layout is that of Ronneberger et al., "U-Net" (MICCAI 2015),
but that levels are added. It knows nothing of a part: it was fitted to random solids before photos, see
``tools/fit_judge``.
"""

from __future__ import annotations

from importlib.resources import files

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.tracking.matching import ORIENTATIONS

LONGEST_SIDE_PX = 640
"""Larger pictures are shrunk to this. In pictures of this size it was fitted to half diameters of 30 to 300 px."""
SHRINK = 2
"""The network's maps are so many times smaller than what it is shown."""
CELL_PX = 32
"""It takes pictures of multiples of this."""
CONTRAST = 64.0
"""Grey levels less their mean are shown in units of this."""


class LineNetwork:
    """The network; one picture at a time."""

    def __init__(self) -> None:
        model = files("arview.tracking").joinpath("lines.onnx").read_bytes()
        self._network = cv2.dnn.readNetFromONNX(np.frombuffer(model, dtype=np.uint8))

    def lines(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """How likely a line of each orientation runs through each place of an RGB picture (H,W,3).

        Returns:
            (8,h,w) 0–255, of half the picture's size, or of half of `LONGEST_SIDE_PX`.
        """
        height, width = image.shape[:2]
        share = min(1.0, LONGEST_SIDE_PX / max(height, width))
        if share < 1.0:
            image = cv2.resize(image, None, fx=share, fy=share, interpolation=cv2.INTER_AREA)
            height, width = image.shape[:2]
        shown = (image.astype(np.float32) - np.float32(image.mean())) / np.float32(CONTRAST)
        shown = cv2.copyMakeBorder(shown, 0, -height % CELL_PX, 0, -width % CELL_PX, cv2.BORDER_REPLICATE)
        self._network.setInput(np.ascontiguousarray(shown.transpose(2, 0, 1))[None])
        seen = self._network.forward()[0, :ORIENTATIONS, : -(-height // SHRINK), : -(-width // SHRINK)]
        return np.asarray(np.round(255.0 * seen).astype(np.uint8))


def lines_at(lines: NDArray[np.uint8], width: int, height: int, spread_px: int) -> NDArray[np.uint8]:
    """Maps (8,H,W) from those of `LineNetwork.lines`; the strongest of the pixels that one stands for, and spread."""
    shrunk = lines.shape[2] / width
    side = max(1, int(shrunk + 0.5))
    merged = np.ones((side, side), dtype=np.uint8)
    spread = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * spread_px + 1, 2 * spread_px + 1))
    way = cv2.INTER_AREA if shrunk > 1.0 else cv2.INTER_LINEAR
    sized = np.empty((len(lines), height, width), dtype=np.uint8)
    for plane, out in zip(lines, sized, strict=True):
        strongest = cv2.dilate(plane, merged) if side > 1 else plane
        cv2.dilate(cv2.resize(strongest, (width, height), interpolation=way), spread, dst=out)
    return sized
