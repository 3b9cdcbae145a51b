"""The package's convolutional networks, as `cv2.dnn` runs them."""

from __future__ import annotations

from importlib.resources import files

import cv2
import numpy as np
from numpy.typing import NDArray


def read_network(name: str) -> cv2.dnn.Net:
    """A network of the package by the name of its file; it serves one thread at a time."""
    model = files("arview.tracking").joinpath(name).read_bytes()
    return cv2.dnn.readNetFromONNX(np.frombuffer(model, dtype=np.uint8))


def extended(image: NDArray[np.uint8], cell_px: int) -> NDArray[np.uint8]:
    """A picture (H,W,3) with its last rows and columns repeated until its sides are multiples of a cell's."""
    height, width = image.shape[:2]
    return np.asarray(
        cv2.copyMakeBorder(image, 0, -height % cell_px, 0, -width % cell_px, cv2.BORDER_REPLICATE), dtype=np.uint8
    )
