"""Working picture: the picture around the part, reduced to the scale at which poses are refined and scored.

Steps, tolerances and reaches of the measures are in pixels, so they only mean the same in every picture where the part
has about the same size and its edges are about as sharp. A large or soft picture is therefore reduced until this holds;
a pose is then worth the same at 320 px as at 4K, and the cost hardly grows with the number of pixels. Where the picture
is sharp at a finer scale, the last stages measure there, because precision comes from fine pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.camera import Camera
from arview.geometry import Array
from arview.refinement.modalities.edge import smoothed
from arview.refinement.modalities.texture import TextureMatches


@dataclass(frozen=True)
class WorkingScaleOptions:
    """Options of the working scale.

    Attributes:
        radius_px: half the part's diameter in the working picture; smaller parts are not enlarged.
        soft_radius_px: a soft picture is not reduced below this half diameter, because too few points would be left.
        max_spread_px: standard deviation of the edges' blur above which a picture is reduced.
        fine_radius_px: largest half diameter in the fine picture.
        fine_gain: how much larger than the working picture the fine one must be to be worth its time.
        steps_per_octave: scales are powers of two with this many steps in between, so that they seldom change.
        reach: half size of the window, in half diameters of the part.
        margin_px: pixels of the working picture added to it.
    """

    radius_px: float = 100.0
    soft_radius_px: float = 50.0
    max_spread_px: float = 1.5
    fine_radius_px: float = 400.0
    fine_gain: float = 1.3
    steps_per_octave: int = 2
    reach: float = 1.15
    margin_px: float = 24.0

    def quantised(self, scale: float) -> float:
        """The nearest scale of the series, at most 1."""
        return float(min(1.0, 2.0 ** (np.round(self.steps_per_octave * np.log2(scale)) / self.steps_per_octave)))

    def working_scale(self, radius_px: float, spread_px: float = 0.0) -> float:
        """Scale of the working picture, at most 1.

        Args:
            radius_px: half the part's diameter in the picture.
            spread_px: standard deviation of the blur of its edges in the picture; 0 where it is not known.
        """
        scale = self.radius_px / radius_px
        if spread_px * scale > self.max_spread_px:
            scale = max(self.max_spread_px / spread_px, min(scale, self.soft_radius_px / radius_px))
        return self.quantised(scale)

    def finest(self, radius_px: float) -> float:
        """Scale of the fine picture of a sharp picture in which half the part's diameter is ``radius_px``."""
        return self.quantised(self.fine_radius_px / radius_px)

    def fine_scale(self, radius_px: float, spread_px: float) -> float | None:
        """Scale of the fine picture; None where the working picture is as fine. Arguments as of `working_scale`."""
        scale = min(1.0, self.fine_radius_px / radius_px, self.max_spread_px / max(spread_px, 1e-6))
        scale = self.quantised(scale)
        return scale if scale > self.fine_gain * self.working_scale(radius_px, spread_px) else None


DEFAULT = WorkingScaleOptions()


class WorkingPicture(NamedTuple):
    """A window of a picture at a reduced scale.

    Attributes:
        image: (h,w,3) uint8 RGB.
        smooth: (h,w) uint8 grey levels, smoothed for the edge modality.
        camera: intrinsics of the window at this scale.
        scale: of the window, relative to the picture.
        left, top, right, bottom: borders of the window in the picture, px.
    """

    image: NDArray[np.uint8]
    smooth: NDArray[np.uint8]
    camera: Camera
    scale: float
    left: int
    top: int
    right: int
    bottom: int

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
    image: NDArray[np.uint8], camera: Camera, scale: float, window: tuple[float, float, float, float] | None = None
) -> WorkingPicture:
    """A window of a picture, reduced.

    Args:
        image: (H,W,3) uint8 RGB of the camera's size.
        camera: of the picture.
        scale: at most 1.
        window: left, upper, right and lower border, px; parts outside the picture are left out. None, or a window with
            too little of the picture: the whole picture.
    """
    height, width = image.shape[:2]
    # Windows whose sides are multiples of the halvings are reduced by exactly two at each of them.
    halvings = max(0, int(np.floor(-np.log2(scale) + 1e-6)))
    unit = 2**halvings
    left, top, right, bottom = 0, 0, width, height
    if window is not None and np.all(np.isfinite(window)):
        first = np.clip(np.floor(np.array(window[:2]) / unit).astype(np.int64) * unit, 0, (width, height))
        last = np.clip(np.ceil(np.array(window[2:]) / unit).astype(np.int64) * unit, 0, (width, height))
        if np.all(last - first >= max(16, 16 / scale)):
            left, top, right, bottom = int(first[0]), int(first[1]), int(last[0]), int(last[1])
    right, bottom = left + (right - left) // unit * unit, top + (bottom - top) // unit * unit
    small = image[top:bottom, left:right]
    for _ in range(halvings):
        small = cv2.resize(small, (small.shape[1] // 2, small.shape[0] // 2), interpolation=cv2.INTER_AREA)
    rest = scale * unit
    if rest < 1.0 - 1e-6:
        size = round(small.shape[1] * rest), round(small.shape[0] * rest)
        small = cv2.resize(small, size, interpolation=cv2.INTER_AREA)
    is_whole = (left, top, right, bottom) == (0, 0, width, height)
    own = camera if is_whole else camera.cropped(left, top, right - left, bottom - top)
    if scale < 1.0:
        own = own.scaled(small.shape[1], small.shape[0])
    smooth = smoothed(cv2.cvtColor(small, cv2.COLOR_RGB2GRAY))
    return WorkingPicture(np.asarray(small), smooth, own, scale, left, top, right, bottom)


def matches_in(picture: WorkingPicture, matches: TextureMatches) -> TextureMatches:
    """Texture matches of a frame in the pixels of a working picture; their precision stays that in the frame."""
    if (picture.scale, picture.left, picture.top) == (1.0, 0, 0):
        return matches
    pixels = (matches.pixels - (picture.left - 0.5, picture.top - 0.5)) * picture.scale - 0.5
    return matches._replace(pixels=pixels, weights=matches.weights / picture.scale**2)


def window_around(
    camera: Camera, poses: Sequence[Array], diameter_mm: float, margin_px: float, reach: float = DEFAULT.reach
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
    centers = np.array([camera.project(pose[:3, 3]) for pose in poses])
    if not np.all(np.isfinite(centers)):
        return None
    around = reach * 0.5 * diameter_mm * camera.fx / min(float(pose[2, 3]) for pose in poses) + margin_px
    first, last = centers.min(axis=0) - around, centers.max(axis=0) + around
    return float(first[0]), float(first[1]), float(last[0]) + 1.0, float(last[1]) + 1.0
