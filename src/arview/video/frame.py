"""Frame: one picture of a source."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]


@dataclass(frozen=True)
class Frame:
    """One picture.

    Attributes:
        image: (H,W,3) uint8 RGB, upright, contiguous.
        index: place in the source counted from 0, frames that were skipped or left out included.
        time_s: time stamp in the source; for live sources seconds since its first frame.
    """

    image: Image
    index: int
    time_s: float
