"""A frame with what searches make of it: response maps at many scales, made when first needed, by all cores."""

from __future__ import annotations

from collections.abc import Iterable

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


class Picture:
    """A frame with what was made from it: response maps by scale, kept until the frame is done with.

    Args:
        image: (H,W,3) uint8 RGB.
        camera: of it.
        pad_px: empty rim of the maps.
    """

    def __init__(self, image: NDArray[np.uint8], camera: Camera, pad_px: int) -> None:
        self.image = image
        self.gray = smoothed(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
        self.pad_px = pad_px
        self._camera = camera
        self._maps: dict[int, tuple[NDArray[np.uint8], Array]] = {}

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

    def _make(self, step: int) -> tuple[NDArray[np.uint8], Array]:
        camera = self._camera
        scale = 2.0 ** (step / STEPS_PER_OCTAVE)
        width, height = max(8, round(camera.width * scale)), max(8, round(camera.height * scale))
        # Edges are found at twice the resolution as long as the picture has it.
        per_map = 2 if scale <= 0.5 else 1
        way = cv2.INTER_AREA if per_map * scale < 0.6 else cv2.INTER_LINEAR
        size = (per_map * width, per_map * height)
        image = self.image if size == (camera.width, camera.height) else cv2.resize(self.image, size, interpolation=way)
        intrinsics = intrinsics_of(camera.scaled(width, height))
        intrinsics[2:4] += self.pad_px
        return response_maps(np.asarray(image), SPREAD_PX, self.pad_px, per_map), intrinsics
