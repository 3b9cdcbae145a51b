"""Whether a frame is still and sharp enough for a photo."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from arview import reconstruction
from arview.camera import Camera
from arview.geometry import Array, apply
from arview.station.capture.options import TriggerOptions

GYRO_RAD_S = (0.12, 0.2)
"""Rotation rates below which a hand begins to hold still, and above which it no longer does; one that holds still
trembles with about 0.05 rad/s."""
WINDOW_S = 0.12
"""Time over which motion is measured: a tracker's noise is small beside it."""
MAX_GAP_S = 0.8
"""Longest gap between two frames; after a longer one the motion is unknown."""
FOCUS_MEMORY_S = 2.0
"""Sharpness is compared with the frames of this time before."""
MAX_BLUR_PX = 2.5
"""Edge spread of a frame that is out of focus …."""
MAX_BLUR_RATIO = 1.6
"""… unless no frame of this stream was much sharper."""


@dataclass
class Hysteresis:
    """A state that is entered at one limit of a value and left at another.

    Attributes:
        enter, leave: the limits; with ``enter`` above ``leave`` large values are good, else small ones.
        is_on: the state.
    """

    enter: float
    leave: float
    is_on: bool = False

    def update(self, value: float) -> bool:
        """The state after a value."""
        limit = self.leave if self.is_on else self.enter
        self.is_on = value >= limit if self.enter > self.leave else value <= limit
        return self.is_on


class MotionMonitor:
    """How fast the part moves in the picture, by the corners of its bounding box, and how fast the camera turns."""

    def __init__(self, corners_in_model: Array, camera: Camera, options: TriggerOptions) -> None:
        self._corners = corners_in_model
        self._camera = camera.without_distortion()
        self._options = options
        self._seen: deque[tuple[float, Array]] = deque()
        self._motion = Hysteresis(*options.motion_per_s)
        self._gyro = Hysteresis(*GYRO_RAD_S, is_on=True)
        self._still_since_s: float | None = None

    def forget(self) -> None:
        """Start anew: the part was not tracked."""
        self._seen.clear()
        self._motion.is_on = False
        self._still_since_s = None

    def update(self, cam_from_model: Array, time_s: float, gyro_rad_s: float | None) -> bool:
        """Whether the camera is still, and has been for long enough.

        Args:
            cam_from_model: (4,4) pose of the frame.
            time_s: time stamp of the frame.
            gyro_rad_s: rate of turn by the gyroscope, None without one.
        """
        o = self._options
        if self._seen and not 0.0 < time_s - self._seen[-1][0] <= MAX_GAP_S:
            self.forget()
        pixels = self._camera.project(apply(cam_from_model, self._corners))
        self._seen.append((time_s, pixels))
        # The frames of the window, and one before it.
        while len(self._seen) > 2 and time_s - self._seen[1][0] >= WINDOW_S:
            self._seen.popleft()
        then_s, then = self._seen[0]
        if time_s <= then_s:
            return False
        moved = np.linalg.norm(pixels - then, axis=1)
        moved = moved[np.isfinite(moved)]
        longer_px = max(self._camera.width, self._camera.height)
        speed = float(np.median(moved)) / longer_px / (time_s - then_s) if len(moved) else np.inf
        is_still = self._motion.update(speed)
        if gyro_rad_s is not None and np.isfinite(gyro_rad_s):
            is_still &= self._gyro.update(abs(gyro_rad_s))
        if not is_still:
            self._still_since_s = None
            return False
        if self._still_since_s is None:
            self._still_since_s = then_s
        return time_s - self._still_since_s >= o.still_s - 1e-9


class FocusMonitor:
    """How sharp the part is in a frame, beside the frames shortly before it and the sharpest of the stream."""

    def __init__(self, options: TriggerOptions) -> None:
        self._options = options
        self._recent: deque[tuple[float, float]] = deque()
        self._smallest_blur_px = np.inf

    def update(self, gray: NDArray[np.uint8], time_s: float) -> bool:
        """Whether the middle of the part (H,W) uint8 is as sharp as in recent frames.

        Sharpness is the variance of the Laplacian over that of the picture (Pech-Pacheco et al. 2000), so that it does
        not depend on exposure.
        """
        o = self._options
        contrast = float(gray.var())
        sharpness = float(cv2.Laplacian(gray, cv2.CV_32F).var()) / max(contrast, 1.0)
        while self._recent and not 0.0 <= time_s - self._recent[0][0] <= FOCUS_MEMORY_S:
            self._recent.popleft()
        self._recent.append((time_s, sharpness))
        usual = float(np.percentile([value for _, value in self._recent], 80))
        return sharpness >= o.min_focus * usual

    def is_in_focus(self, gray: NDArray[np.uint8]) -> bool:
        """Whether edges are sharp in themselves, as far as this stream ever shows sharp ones.

        It takes some milliseconds, so it is asked only before a photo.
        """
        blur_px, _ = reconstruction.blur_and_texture(gray)
        if not np.isfinite(blur_px):  # too few edges to tell
            return True
        self._smallest_blur_px = min(self._smallest_blur_px, blur_px)
        return blur_px <= max(MAX_BLUR_PX, MAX_BLUR_RATIO * self._smallest_blur_px)


def middle_of_part(image_rgb: NDArray[np.uint8], pixels: Array, side_px: int) -> NDArray[np.uint8]:
    """(h,w) uint8 grey picture of the middle of a part, at full resolution.

    Args:
        image_rgb: (H,W,3) uint8 frame.
        pixels: (N,2) of the part's bounding box.
        side_px: largest side of the picture.
    """
    height, width = image_rgb.shape[:2]
    finite = pixels[np.isfinite(pixels).all(axis=1)]
    if len(finite) == 0:
        finite = np.array([[0.5 * width, 0.5 * height]])
    middle = 0.5 * (finite.min(axis=0) + finite.max(axis=0))
    half = 0.5 * np.minimum(np.maximum(np.ptp(finite, axis=0), 64.0), side_px)
    left, top = (int(np.clip(v, 0, limit - 1)) for v, limit in zip(middle - half, (width, height), strict=True))
    right, bottom = (
        int(np.clip(v, low + 1, limit))
        for v, low, limit in zip(middle + half, (left, top), (width, height), strict=True)
    )
    patch = np.ascontiguousarray(image_rgb[top:bottom, left:right])
    return np.asarray(cv2.cvtColor(patch, cv2.COLOR_RGB2GRAY))
