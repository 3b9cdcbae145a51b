"""Working pictures: the picture around the part at the scales at which poses are refined and scored.

Steps, tolerances and reaches of the measures are in pixels, so they only mean the same in every picture where the part
has about the same size. Every picture is therefore brought to the same sizes of the part: a small one, in which poses
are judged, and larger ones up to the finest that its sharpness allows, in which they are refined. A pose is then worth
the same at 320 px as at 4K, and the cost hardly grows with the number of pixels. Small pictures are enlarged: on a
larger part the same reach is narrower, which keeps other edges beside the right one out.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.camera import Camera
from arview.core.kernel import kernel
from arview.geometry import Array
from arview.refinement.modalities.edge import smoothed
from arview.refinement.modalities.texture import TextureMatches

SOFT_RADIUS_PX = 50.0
"""A soft picture is not reduced below this half diameter, because too few points would be left."""
MAX_SPREAD_PX = 1.5
"""Standard deviation of the edges' blur in the working picture above which it is reduced further."""
FINE_RADIUS_PX = 400.0
"""Half the part's diameter in the finest picture."""
MAX_FINE_SPREAD_PX = 2.5
"""Standard deviation of the edges' blur in the finest picture above which it is smaller."""
LEVEL_RATIO = 2.0
"""Largest ratio of the scales of successive pictures, from which a pose is refined to the next."""
STEPS_PER_OCTAVE = 2
"""Scales are powers of two with this many steps in between, so that they seldom change."""
REACH = 1.15
"""Half size of the window, in half diameters of the part."""
MARGIN_PX = 24.0
"""Border that is added to the window, px of the reduced picture."""


@dataclass(frozen=True)
class WorkingScaleOptions:
    """Options of the working scale.

    Attributes:
        radius_px: half the part's diameter in the working picture, in which poses are judged.
        max_enlargement: largest scale; more pixels than that only repeat what the camera saw.
    """

    radius_px: float = 100.0
    max_enlargement: float = 4.0

    def scales(self, radius_px: float, spread_px: float = 0.0) -> tuple[float, ...]:
        """Scales of the pictures, from the working picture to the finest.

        Args:
            radius_px: half the part's diameter in the picture.
            spread_px: standard deviation of the blur of its edges in the picture; 0 where it is not known.
        """
        finest = min(self.max_enlargement, FINE_RADIUS_PX / radius_px)
        if spread_px * finest > MAX_FINE_SPREAD_PX:
            finest = MAX_FINE_SPREAD_PX / spread_px
        first, last = math.log2(self.working_scale(radius_px, spread_px)), self._quantised(math.log2(finest))
        count = max(0, math.ceil((last - first) / math.log2(LEVEL_RATIO) - 1e-6))
        between = [self._quantised(first + k * (last - first) / count) for k in range(1, count)]
        return tuple(float(2.0**x) for x in (first, *between, *([last] if count else [])))

    def working_scale(self, radius_px: float, spread_px: float = 0.0) -> float:
        """Scale of the working picture, at most 1; arguments as of `scales`."""
        scale = min(1.0, self.radius_px / radius_px)
        if spread_px * scale > MAX_SPREAD_PX:
            scale = max(MAX_SPREAD_PX / spread_px, min(scale, SOFT_RADIUS_PX / radius_px))
        return float(2.0 ** self._quantised(math.log2(scale)))

    def _quantised(self, octaves: float) -> float:
        """The nearest scale of the series; both are logarithms to base 2."""
        return round(octaves * STEPS_PER_OCTAVE) / STEPS_PER_OCTAVE


DEFAULT = WorkingScaleOptions()


def gray_of(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Grey levels (H,W) uint8 of a picture (H,W,3) uint8 RGB, by the weights of ITU-R BT.601."""
    if not image.flags.c_contiguous:
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
    gray = np.empty(image.shape[:2], dtype=np.uint8)
    _fill_gray(image.reshape(-1), gray.reshape(-1))
    return gray


@kernel
def _fill_gray(rgb: NDArray[np.uint8], gray: NDArray[np.uint8]) -> None:
    """Fill grey levels (N,) of colours (3N,); OpenCV takes more processor time for it, in several threads."""
    for i in range(gray.shape[0]):
        red, green, blue = np.uint32(rgb[3 * i]), np.uint32(rgb[3 * i + 1]), np.uint32(rgb[3 * i + 2])
        total = red * np.uint32(4899) + green * np.uint32(9617) + blue * np.uint32(1868) + np.uint32(8192)
        gray[i] = np.uint8(total >> np.uint32(14))


class WorkingPicture(NamedTuple):
    """A window of a picture at a scale, of which only what is measured is interpolated.

    Colours and grey levels are those of the window reduced by a power of two, to less than twice its scale.

    Attributes:
        image: (h,w,3) uint8 RGB; empty in a picture made for edges only.
        smooth: (h,w) uint8 grey levels, smoothed for the edge modality.
        camera: intrinsics of the window at its scale.
        pitch: size of the camera's pixels in pixels of ``image`` and ``smooth``.
        scale: of the window, relative to the picture.
        left, top, right, bottom: borders of the window in the picture, px.
    """

    image: NDArray[np.uint8]
    smooth: NDArray[np.uint8]
    camera: Camera
    pitch: float
    scale: float
    left: int
    top: int
    right: int
    bottom: int

    @property
    def has_colors(self) -> bool:
        """Whether colours can be measured in it."""
        return self.image.shape[0] > 0

    def covers(self, center: Array, reach_px: float, camera: Camera) -> bool:
        """Whether the window holds all that a picture of ``camera`` shows around a pixel (2,) within a reach."""
        u, v = center
        return bool(
            max(u - reach_px, 0) >= self.left
            and max(v - reach_px, 0) >= self.top
            and min(u + reach_px, camera.width) <= self.right
            and min(v + reach_px, camera.height) <= self.bottom
        )


def working_picture(
    image: NDArray[np.uint8],
    camera: Camera,
    scale: float,
    window: tuple[float, float, float, float] | None = None,
    has_colors: bool = True,
    gray: NDArray[np.uint8] | None = None,
) -> WorkingPicture:
    """A window of a picture at a scale.

    Args:
        image: (H,W,3) uint8 RGB of the camera's size.
        camera: of the picture.
        scale: of the result.
        window: left, upper, right and lower border, px; parts outside the picture are left out. None, or a window with
            too little of the picture: the whole picture.
        has_colors: make the colours, too; the grey picture alone takes less time.
        gray: (H,W) uint8, `gray_of` of the picture, if it is known.
    """
    height, width = image.shape[:2]
    # Windows whose sides are multiples of the halvings are reduced by exactly two at each of them.
    halvings = max(0, math.floor(-math.log2(scale) + 1e-6))
    unit = 2**halvings
    left, top, right, bottom = 0, 0, width, height
    if window is not None and all(map(math.isfinite, window)):
        first = [
            min(max(math.floor(value / unit) * unit, 0), size)
            for value, size in zip(window[:2], (width, height), strict=True)
        ]
        last = [
            min(max(math.ceil(value / unit) * unit, 0), size)
            for value, size in zip(window[2:], (width, height), strict=True)
        ]
        if min(last[0] - first[0], last[1] - first[1]) >= max(16, 16 / scale):
            (left, top), (right, bottom) = first, last
    right, bottom = left + (right - left) // unit * unit, top + (bottom - top) // unit * unit
    size = ((right - left) // unit, (bottom - top) // unit)
    own = camera.cropped(left, top, right - left, bottom - top).scaled(*size)
    window_gray = gray_of(image[top:bottom, left:right]) if gray is None else gray[top:bottom, left:right]
    for _ in range(halvings):
        half = (window_gray.shape[1] // 2, window_gray.shape[0] // 2)
        window_gray = cv2.resize(window_gray, half, interpolation=cv2.INTER_AREA)
    colors = np.zeros((0, 0, 3), dtype=np.uint8)
    if has_colors:
        colors = image[top:bottom, left:right]
        # Four pixels of each square: histograms of colours need no more.
        colors = np.asarray(cv2.resize(colors, size)) if halvings else np.ascontiguousarray(colors)
    pitch = 1.0 / (scale * unit)
    return WorkingPicture(
        colors, smoothed(window_gray, 1.0 / pitch), own.magnified(1.0 / pitch), pitch, scale, left, top, right, bottom
    )


def matches_in(picture: WorkingPicture, matches: TextureMatches) -> TextureMatches:
    """Texture matches of a frame in the pixels of a working picture.

    In a reduced picture their precision stays that in the frame; in an enlarged one that of all modalities is less.
    """
    if (picture.scale, picture.left, picture.top) == (1.0, 0, 0):
        return matches
    pixels = (matches.pixels - (picture.left - 0.5, picture.top - 0.5)) * picture.scale - 0.5
    return matches._replace(pixels=pixels, weights=matches.weights / min(picture.scale, 1.0) ** 2)


def window_around(
    camera: Camera, poses: Sequence[Array], diameter_mm: float, margin_px: float, reach: float = REACH
) -> tuple[float, float, float, float] | None:
    """Borders of the window around a part at some poses (4,4) about its centre; None where one is not in front.

    Args:
        camera: of the picture.
        poses: ``cam_from_body``.
        diameter_mm: diameter of the part.
        margin_px: added on every side, px of the picture.
        reach: half size of the window, in half diameters of the part.
    """
    if any(pose[2, 3] <= 0 for pose in poses):
        return None
    us, vs = zip(*(camera.project(pose[:3, 3]).tolist() for pose in poses), strict=True)
    if not all(map(math.isfinite, (*us, *vs))):
        return None
    around = reach * 0.5 * diameter_mm * camera.fx / min(float(pose[2, 3]) for pose in poses) + margin_px
    return min(us) - around, min(vs) - around, max(us) + around + 1.0, max(vs) + around + 1.0
