"""A frame with what searches make of it at many scales, made when first needed, by all cores."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.camera import Camera
from arview.geometry import Array
from arview.tracking.matching import response_maps
from arview.tracking.threads import pool
from arview.tracking.tracker import intrinsics_of, smoothed

STEPS_PER_OCTAVE = 4
"""Scales at which response maps are made: the distances of the templates, shared by all levels of the search."""
SPREAD_PX = 1
"""How far edges may lie from where a pose has them, in pixels of the maps."""


COLOUR_BITS = 3
COLOURS = 1 << (3 * COLOUR_BITS)
"""So many bits of each channel make so many colours."""


class Surroundings(NamedTuple):
    """A picture as the kernels take it.

    Attributes:
        colours: (H,W) uint16, one of 512.
        steps: (H,W) float32 gradient in grey levels per pixel.
        intrinsics: (10,) of it.
    """

    colours: NDArray[np.uint16]
    steps: NDArray[np.float32]
    intrinsics: Array


def make_surroundings(image: NDArray[np.uint8], intrinsics: Array) -> Surroundings:
    """The surroundings of an RGB picture."""
    red, green, blue = (plane.astype(np.uint16) >> (8 - COLOUR_BITS) for plane in cv2.split(image))
    gray = cv2.GaussianBlur(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), (3, 3), 0)
    gx, gy = (cv2.Sobel(gray, cv2.CV_32F, 1 - along, along, ksize=3, scale=0.25) for along in (0, 1))
    colours = (red << (2 * COLOUR_BITS)) | (green << COLOUR_BITS) | blue
    return Surroundings(colours, np.asarray(cv2.magnitude(gx, gy), dtype=np.float32), intrinsics)


class Picture:
    """A frame with what was made from it: response maps and surroundings by scale, kept until the frame is done with.

    Args:
        image: (H,W,3) uint8 RGB.
        camera: of it.
        pad_px: empty rim of the maps.
    """

    def __init__(self, image: NDArray[np.uint8], camera: Camera, pad_px: int) -> None:
        self.image = image
        self.gray = smoothed(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
        self.pad_px = pad_px
        self.focal_px = 0.5 * (camera.fx + camera.fy)
        self._camera = camera
        self._maps: dict[int, tuple[NDArray[np.uint8], Array]] = {}
        self._surroundings: dict[int, Surroundings] = {}

    def make(self, steps: Iterable[int]) -> None:
        """Make the maps of several scales at once."""
        # The large ones first: they take longest.
        missing = sorted({step for step in steps if step not in self._maps}, reverse=True)
        self._maps.update(zip(missing, pool().map(self._make, missing), strict=True))

    def maps(self, step: int) -> tuple[NDArray[np.uint8], Array]:
        """Response maps (8,H,W) at a scale, padded, and the intrinsics (10,) that belong to them."""
        if step not in self._maps:
            self._maps[step] = self._make(step)
        return self._maps[step]

    def surroundings(self, step: int) -> Surroundings:
        """Colours and steps of the picture at a scale."""
        if step not in self._surroundings:
            width, height = self._size(step)
            image = self._resized(width, height)
            self._surroundings[step] = make_surroundings(image, intrinsics_of(self._camera.scaled(width, height)))
        return self._surroundings[step]

    def _make(self, step: int) -> tuple[NDArray[np.uint8], Array]:
        width, height = self._size(step)
        # Edges are found at twice the resolution as long as the picture has it.
        per_map = 2 if 2.0 ** (step / STEPS_PER_OCTAVE) <= 0.5 else 1
        intrinsics = intrinsics_of(self._camera.scaled(width, height))
        intrinsics[2:4] += self.pad_px
        return response_maps(
            self._resized(per_map * width, per_map * height), SPREAD_PX, self.pad_px, per_map
        ), intrinsics

    def _size(self, step: int) -> tuple[int, int]:
        scale = 2.0 ** (step / STEPS_PER_OCTAVE)
        return max(8, round(self._camera.width * scale)), max(8, round(self._camera.height * scale))

    def _resized(self, width: int, height: int) -> NDArray[np.uint8]:
        if (width, height) == (self._camera.width, self._camera.height):
            return self.image
        way = cv2.INTER_AREA if width < 0.6 * self._camera.width else cv2.INTER_LINEAR
        return np.asarray(cv2.resize(self.image, (width, height), interpolation=way))
