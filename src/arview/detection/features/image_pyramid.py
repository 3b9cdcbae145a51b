"""Image pyramid: one frame with its response maps, gradients and edge responses at many scales, made on demand."""

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
from arview.refinement import intrinsics_of, smoothed

STEPS_PER_OCTAVE = 4
"""Scale steps per factor of two; also the spacing of the template distances."""


class PyramidLevel(NamedTuple):
    """An image at one scale, as the scoring networks take it.

    Attributes:
        gradient_x, gradient_y: (H,W) float32 gradient of each pixel's strongest channel, grey levels per pixel.
        colours: (H,W,3) uint8, smoothed.
        edge_responses: (9,h,w) uint8 of `EdgeNet.predict`; zero without a network.
        intrinsics: (10,) of ``colours``.
    """

    gradient_x: NDArray[np.float32]
    gradient_y: NDArray[np.float32]
    colours: NDArray[np.uint8]
    edge_responses: NDArray[np.uint8]
    intrinsics: Array


class WorkPicture(NamedTuple):
    """An image at the scale at which poses are refined and their evidence is measured.

    Attributes:
        image: (H,W,3) uint8 RGB.
        gray: (H,W) uint8, smoothed by `smoothed`.
        camera: of both.
    """

    image: NDArray[np.uint8]
    gray: NDArray[np.uint8]
    camera: Camera


class EdgeResponses(NamedTuple):
    """Edge responses of an image.

    Attributes:
        maps: (8,h,w) uint8, dilated like the response maps but without a border.
        intrinsics: (10,) of the maps.
    """

    maps: NDArray[np.uint8]
    intrinsics: Array


def step_for(radius_px: float, wanted_px: float) -> float:
    """Scale step, not rounded, that changes one size into another."""
    return STEPS_PER_OCTAVE * float(np.log2(wanted_px / radius_px))


def steps_to(radius_px: float, radii_px: Array) -> NDArray[np.int64]:
    """Scale steps (N,), whole half octaves and at most 0, that bring sizes (N,) closest to ``radius_px``."""
    half = STEPS_PER_OCTAVE // 2
    return half * np.minimum(np.round(STEPS_PER_OCTAVE / half * np.log2(radius_px / radii_px)), 0).astype(np.int64)


def make_level(image: NDArray[np.uint8], edge_responses: NDArray[np.uint8], intrinsics: Array) -> PyramidLevel:
    """A level from an RGB image (H,W,3) and its edge responses."""
    smooth, x, y, _ = colour_gradients(image)
    quarter = np.float32(0.25)  # normalises Sobel's sum
    return PyramidLevel(quarter * x, quarter * y, smooth, edge_responses, intrinsics)


class ImagePyramid:
    """A frame with everything made from it by scale; keep it only as long as the frame.

    Args:
        image: (H,W,3) uint8 RGB.
        camera: of the image.
        pad_px: empty border of the response maps.
        edge_net: its edge responses weigh as much as gradients in the response maps; None: gradients alone count.
        spread_px: radius by which responses are dilated, in pixels of the maps, which tolerates small errors of a pose.

    Attributes:
        image: of the pyramid, RGB.
        finest: the image at the finest resolution known and its camera, for found poses.
    """

    def __init__(
        self,
        image: NDArray[np.uint8],
        camera: Camera,
        pad_px: int,
        edge_net: EdgeNet | None = None,
        spread_px: int = 1,
    ) -> None:
        self.image = image
        self.finest: tuple[NDArray[np.uint8], Camera] = (image, camera)
        self.pad_px = pad_px
        self.focal_px = 0.5 * (camera.fx + camera.fy)
        self._camera = camera
        self._edge_net = edge_net
        self._spread_px = spread_px
        self._halved = _halve_image(image)
        self._responses: list[NDArray[np.uint8]] = []
        self._lock = Lock()
        self._edge_responses: dict[int, EdgeResponses] = {}
        self._maps: dict[int, tuple[NDArray[np.uint8], Array]] = {}
        self._levels: dict[int, PyramidLevel] = {}
        self._pictures: dict[int, WorkPicture] = {}

    @cached_property
    def without_edge_net(self) -> ImagePyramid:
        """The same image with response maps made from gradients alone."""
        other = copy.copy(self)
        other._edge_net, other._responses, other._edge_responses, other._maps, other._levels = None, [], {}, {}, {}
        return other

    def radii_px(self, diameter_mm: float, poses: Array) -> Array:
        """Half the diameter (N,) of a part in the image, at poses (N,4,4) about its centre."""
        return np.asarray(self.focal_px * 0.5 * diameter_mm / np.linalg.norm(poses[:, :3, 3], axis=1))

    def picture(self, step: int) -> WorkPicture:
        """The image at a scale step, as refinement and evidence take it."""
        if step not in self._pictures:
            width, height = self._size(step)
            image = self._resized(width, height)
            gray = smoothed(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
            self._pictures[step] = WorkPicture(image, gray, self._camera.scaled(width, height))
        return self._pictures[step]

    def make_maps(self, steps: Iterable[int]) -> None:
        """Make the response maps of several scale steps in parallel."""
        # The largest first, because they take longest.
        missing = sorted({step for step in steps if step not in self._maps}, reverse=True)
        if missing:
            self._predict()
        self._maps.update(zip(missing, pool().map(self._make_maps, missing), strict=True))

    def maps(self, step: int) -> tuple[NDArray[np.uint8], Array]:
        """Padded response maps (8,H,W) at a scale step, and their intrinsics (10,), padding included."""
        if step not in self._maps:
            self._predict()
            self._maps[step] = self._make_maps(step)
        return self._maps[step]

    def edge_responses(self, step: int = 0) -> EdgeResponses:
        """The responses of the edge network alone for a scale step, at half its size; zero without a network."""
        self._predict()
        if step not in self._edge_responses:
            width, height = (side // 2 for side in self._size(step))
            if self._responses and self._responses[0].shape[2] < width:
                height, width = self._responses[0].shape[1:]
            intrinsics = intrinsics_of(self._camera.scaled(width, height))
            self._edge_responses[step] = EdgeResponses(self._responses_at(width, height), intrinsics)
        return self._edge_responses[step]

    def level(self, step: int) -> PyramidLevel:
        """Gradients, colours and edge responses at a scale step."""
        if step not in self._levels:
            width, height = self._size(step)
            self._predict()
            none = np.zeros((ORIENTATIONS + 1, 1, 1), dtype=np.uint8)
            responses = _smallest_covering(self._responses, width, 2) if self._responses else none
            image = self._resized(width, height)
            self._levels[step] = make_level(image, responses, intrinsics_of(self._camera.scaled(width, height)))
        return self._levels[step]

    def _predict(self) -> None:
        """Run the edge network once."""
        with self._lock:
            if self._edge_net is not None and not self._responses:
                self._responses = halve_responses(self._edge_net.predict(self.image))

    def _responses_at(self, width: int, height: int) -> NDArray[np.uint8]:
        """Dilated edge responses (8,height,width)."""
        if not self._responses:
            return np.zeros((ORIENTATIONS, height, width), dtype=np.uint8)
        return resize_responses(_smallest_covering(self._responses, width, 2), width, height, self._spread_px)

    def _make_maps(self, step: int) -> tuple[NDArray[np.uint8], Array]:
        width, height = self._size(step)
        # Edges are found at twice the resolution as long as the image has it.
        per_map = 2 if 2.0 ** (step / STEPS_PER_OCTAVE) <= 0.5 else 1
        intrinsics = intrinsics_of(self._camera.scaled(width, height))
        intrinsics[2:4] += self.pad_px
        maps = response_maps(self._resized(per_map * width, per_map * height), self._spread_px, self.pad_px, per_map)
        if self._responses:
            inside = maps[:, self.pad_px : self.pad_px + height, self.pad_px : self.pad_px + width]
            for plane, responses in zip(inside, self._responses_at(width, height), strict=True):
                cv2.addWeighted(plane, 0.5, responses, 0.5, 0.0, dst=plane)
        return maps, intrinsics

    def _size(self, step: int) -> tuple[int, int]:
        scale = 2.0 ** (step / STEPS_PER_OCTAVE)
        return max(8, round(self._camera.width * scale)), max(8, round(self._camera.height * scale))

    def _resized(self, width: int, height: int) -> NDArray[np.uint8]:
        image = _smallest_covering(self._halved, width, 1)
        if (width, height) == image.shape[1::-1]:
            return image
        interpolation = cv2.INTER_AREA if width < 0.6 * image.shape[1] else cv2.INTER_LINEAR
        return np.asarray(cv2.resize(image, (width, height), interpolation=interpolation))


def _halve_image(image: NDArray[np.uint8]) -> list[NDArray[np.uint8]]:
    """An image at full size, half size and so on, down to an odd size."""
    levels = [image]
    while levels[-1].shape[0] % 2 == 0 and levels[-1].shape[1] % 2 == 0:
        levels.append(np.asarray(cv2.resize(levels[-1], None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)))
    return levels


def _smallest_covering(levels: list[NDArray[np.uint8]], width: int, axis: int) -> NDArray[np.uint8]:
    """The smallest level that is at least ``width`` along an axis, or the first if none is."""
    return next((level for level in reversed(levels) if level.shape[axis] >= width), levels[0])
