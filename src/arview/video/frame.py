"""Frame: one picture of a source."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]


@dataclass(frozen=True)
class Frame:
    """One picture with its time stamp.

    Attributes:
        image: (H,W,3) uint8 RGB, upright, contiguous.
        index: position in the source, from 0, counting skipped frames as well; of numbered pictures their number.
        time_s: time since the first frame of the source, seconds.
        file: name of the picture file; empty for frames of videos and cameras.
    """

    image: Image
    index: int
    time_s: float
    file: str = ""

    def _repr_png_(self) -> bytes:
        """The picture, as notebooks show it."""
        return bytes(cv2.imencode(".png", self.image[..., ::-1])[1])
