"""A frame with what searches make of it at many scales, made when first needed, by all cores."""

from __future__ import annotations

import copy
from collections.abc import Iterable
from functools import cached_property
from threading import Lock
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.camera import Camera
from arview.core.parallel import pool
from arview.detection.features.edge_net import EdgeNet, halve_responses, resize_responses
from arview.detection.features.response_maps import (
    ORIENTATIONS,
    colour_gradients,
    response_maps,
)
from arview.geometry import Array
from arview.refinement.modalities.edge import smoothed
from arview.refinement.projection import intrinsics_of

STEPS_PER_OCTAVE = 4
"""Scales at which response maps are made: the distances of the templates, shared by all levels of the search."""
SPREAD_PX = 1
"""How far edges may lie from where a pose has them, in pixels of the maps."""
NO_LINES = np.zeros((ORIENTATIONS + 1, 1, 1), dtype=np.uint8)
"""Nothing is seen anywhere."""


class PyramidLevel(NamedTuple):
    """A picture as the judge takes it, see `judge`.

    Attributes:
        across, down: (H,W) float32, of each pixel's channel with the strongest gradient, grey levels per pixel.
        colours: (H,W,3) uint8, smoothed.
        lines: (9,h,w) uint8, what the line network sees there, see `EdgeNet.predict`; zero without one.
        intrinsics: (10,) of it.
    """

    across: NDArray[np.float32]
    down: NDArray[np.float32]
    colours: NDArray[np.uint8]
    lines: NDArray[np.uint8]
    intrinsics: Array


class EdgeResponses(NamedTuple):
    """What the line network sees in a picture.

    Attributes:
        maps: (8,h,w) uint8, spread as the response maps are, but without a rim.
        intrinsics: (10,) of them.
    """

    maps: NDArray[np.uint8]
    intrinsics: Array


def step_for(radius_px: float, wanted_px: float) -> float:
    """Scale step, not rounded, that brings a size to another."""
    return STEPS_PER_OCTAVE * float(np.log2(wanted_px / radius_px))


def steps_to(radius_px: float, radii_px: Array) -> NDArray[np.int64]:
    """Scale steps (N,) that bring sizes (N,) to about another: half octaves are near enough, nothing is enlarged."""
    half = STEPS_PER_OCTAVE // 2
    return half * np.minimum(np.round(STEPS_PER_OCTAVE / half * np.log2(radius_px / radii_px)), 0).astype(np.int64)


def make_level(image: NDArray[np.uint8], lines: NDArray[np.uint8], intrinsics: Array) -> PyramidLevel:
    """The gradients of an RGB picture, with the lines seen in it."""
    smooth, across, down, _ = colour_gradients(image)
    quarter = np.float32(0.25)  # of Sobel's sum
    return PyramidLevel(quarter * across, quarter * down, smooth, lines, intrinsics)


class ImagePyramid:
    """A frame with what was made from it: response maps and gradients by scale, kept until the frame is done with.

    Args:
        image: (H,W,3) uint8 RGB.
        camera: of it.
        pad_px: empty rim of the maps.
        network: the lines that it sees count in the maps as much as gradients; None: these alone count.
    """

    def __init__(self, image: NDArray[np.uint8], camera: Camera, pad_px: int, network: EdgeNet | None = None) -> None:
        self.image = image
        self.gray = smoothed(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
        self.pad_px = pad_px
        self.focal_px = 0.5 * (camera.fx + camera.fy)
        self._camera = camera
        self._network = network
        self._halved = _halved(image)
        self._lines: list[NDArray[np.uint8]] = []
        self._lock = Lock()
        self._seen: EdgeResponses | None = None
        self._maps: dict[int, tuple[NDArray[np.uint8], Array]] = {}
        self._gradients: dict[int, PyramidLevel] = {}

    @cached_property
    def without_edge_net(self) -> ImagePyramid:
        """The same, but that gradients alone count in its maps."""
        other = copy.copy(self)
        other._network, other._lines, other._seen, other._maps, other._gradients = None, [], None, {}, {}
        return other

    def radii_px(self, diameter_mm: float, poses: Array) -> Array:
        """Half the diameter (N,) of a part in the picture at poses (N,4,4) about its centre."""
        return np.asarray(self.focal_px * 0.5 * diameter_mm / np.linalg.norm(poses[:, :3, 3], axis=1))

    def make(self, steps: Iterable[int]) -> None:
        """Make the maps of several scales at once."""
        # The large ones first: they take longest.
        missing = sorted({step for step in steps if step not in self._maps}, reverse=True)
        if missing:
            self._see_lines()
        self._maps.update(zip(missing, pool().map(self._make, missing), strict=True))

    def maps(self, step: int) -> tuple[NDArray[np.uint8], Array]:
        """Response maps (8,H,W) at a scale, padded, and the intrinsics (10,) that belong to them."""
        if step not in self._maps:
            self._see_lines()
            self._maps[step] = self._make(step)
        return self._maps[step]

    def edge_responses(self) -> EdgeResponses:
        """What the network alone sees; nothing without a network."""
        self._see_lines()
        if self._seen is None:
            height, width = self._camera.height // 2, self._camera.width // 2
            if self._lines:
                height, width = self._lines[0].shape[1:]
            intrinsics = intrinsics_of(self._camera.scaled(width, height))
            self._seen = EdgeResponses(self._lines_at(width, height), intrinsics)
        return self._seen

    def _see_lines(self) -> None:
        with self._lock:
            if self._network is not None and not self._lines:
                self._lines = halve_responses(self._network.predict(self.image))

    def _lines_at(self, width: int, height: int) -> NDArray[np.uint8]:
        """What the network sees, spread (8,H,W)."""
        if not self._lines:
            return np.zeros((ORIENTATIONS, height, width), dtype=np.uint8)
        return resize_responses(_smallest(self._lines, width, 2), width, height, SPREAD_PX)

    def gradients(self, step: int) -> PyramidLevel:
        """PyramidLevel and colours of the picture at a scale, and the lines in it."""
        if step not in self._gradients:
            width, height = self._size(step)
            self._see_lines()
            lines = _smallest(self._lines, width, 2) if self._lines else NO_LINES
            image = self._resized(width, height)
            self._gradients[step] = make_level(image, lines, intrinsics_of(self._camera.scaled(width, height)))
        return self._gradients[step]

    def _make(self, step: int) -> tuple[NDArray[np.uint8], Array]:
        width, height = self._size(step)
        # Edges are found at twice the resolution as long as the picture has it.
        per_map = 2 if 2.0 ** (step / STEPS_PER_OCTAVE) <= 0.5 else 1
        intrinsics = intrinsics_of(self._camera.scaled(width, height))
        intrinsics[2:4] += self.pad_px
        maps = response_maps(self._resized(per_map * width, per_map * height), SPREAD_PX, self.pad_px, per_map)
        if self._lines:
            inside = maps[:, self.pad_px : self.pad_px + height, self.pad_px : self.pad_px + width]
            for plane, lines in zip(inside, self._lines_at(width, height), strict=True):
                cv2.addWeighted(plane, 0.5, lines, 0.5, 0.0, dst=plane)
        return maps, intrinsics

    def _size(self, step: int) -> tuple[int, int]:
        scale = 2.0 ** (step / STEPS_PER_OCTAVE)
        return max(8, round(self._camera.width * scale)), max(8, round(self._camera.height * scale))

    def _resized(self, width: int, height: int) -> NDArray[np.uint8]:
        image = _smallest(self._halved, width, 1)
        if (width, height) == image.shape[1::-1]:
            return image
        way = cv2.INTER_AREA if width < 0.6 * image.shape[1] else cv2.INTER_LINEAR
        return np.asarray(cv2.resize(image, (width, height), interpolation=way))


def _halved(image: NDArray[np.uint8]) -> list[NDArray[np.uint8]]:
    """A picture, and again at half the size and so on as long as that is even: what smaller ones are made from."""
    levels = [image]
    while levels[-1].shape[0] % 2 == 0 and levels[-1].shape[1] % 2 == 0:
        levels.append(np.asarray(cv2.resize(levels[-1], None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)))
    return levels


def _smallest(levels: list[NDArray[np.uint8]], width: int, axis: int) -> NDArray[np.uint8]:
    """Of smaller and smaller arrays the last that need not be enlarged to a width, if there is one."""
    return next((level for level in reversed(levels) if level.shape[axis] >= width), levels[0])
