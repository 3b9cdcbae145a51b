"""Pictures of lenses that the engine's kernels do not know, as pictures of a lens that they know.

The kernels project with Brown's five terms. Where these describe a lens exactly enough they replace it; other pictures
are resampled once to those of a pinhole camera that sees as much of the scene as fits.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from arview.camera.lens import LensModel
from arview.camera.model import Camera
from arview.errors import InputError
from arview.geometry import Array

MAX_FIT_ERROR_PX = 0.03
"""Largest deviation of Brown's terms from a lens that they replace, px of the picture."""
GRID = 40
"""Points across and down of the picture at which the terms are fitted; they are checked at twice as many."""
MAX_HALF_ANGLE_DEG = 75.0
"""The pinhole camera sees at most this far to each side."""


@dataclass(frozen=True)
class UndistortOptions:
    """How a lens is replaced.

    Attributes:
        max_growth: sides of the pinhole's picture by those of the original; a lens that needs more loses resolution
            and, from ``min_scale`` of it on, the rim of the picture.
        min_scale: smallest resolution of the pinhole's picture by that at the centre of the original.
    """

    max_growth: float = 2.5
    min_scale: float = 0.6


def brown_camera(camera: Camera) -> Camera | None:
    """The camera with Brown's five terms for its lens; None where these are not exact over the whole picture.

    The terms are the linear least-squares fit, with the same calibration matrix, to rays of a grid of pixels.
    """
    if camera.lens is None:
        return camera
    rays = _rays(camera, GRID)
    if not np.isfinite(rays).all():
        return None
    x, y = rays[:, 0], rays[:, 1]
    xd, yd = camera.lens.distort(x, y)
    r2 = x * x + y * y
    columns = [
        (x * r2, y * r2),
        (x * r2**2, y * r2**2),
        (2 * x * y, r2 + 2 * y * y),
        (r2 + 2 * x * x, 2 * x * y),
        (x * r2**3, y * r2**3),
    ]
    matrix = np.stack([np.concatenate(column) for column in columns], axis=1)
    scale = np.abs(matrix).max(axis=0)
    terms = np.linalg.lstsq(matrix / scale, np.concatenate([xd - x, yd - y]), rcond=None)[0] / scale
    fitted = replace(camera, dist=terms, lens=None)
    fine = _rays(camera, 2 * GRID)
    off = np.hypot(*np.moveaxis(fitted.project(fine) - camera.project(fine), -1, 0))
    return fitted if np.isfinite(off).all() and off.max() <= MAX_FIT_ERROR_PX else None


def require_brown(camera: Camera, what: str) -> Camera:
    """The camera with Brown's five terms.

    Args:
        camera: the camera.
        what: for the message, what can use no other lens.

    Raises:
        InputError: these terms do not describe its lens.
    """
    found = brown_camera(camera)
    if found is None and camera.lens is not None:
        raise InputError(
            f"{what}: the lens model {camera.lens.model} of the camera is not supported here; undistort the pictures "
            "and give the camera of the undistorted ones"
        )
    return found or camera


def _rays(camera: Camera, count: int) -> Array:
    """Rays (N,3) of a grid of pixels, from border to border."""
    u, v = np.linspace(-0.5, camera.width - 0.5, count), np.linspace(-0.5, camera.height - 0.5, count)
    return camera.unproject(np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2))


class Undistorter:
    """Resamples pictures of a camera to those of a pinhole camera, as far as less than 75° off the axis.

    Attributes:
        camera: of the pictures that are resampled.
        ideal: the pinhole camera; rays and poses are the same in both.
        maps: OpenCV's fixed-point maps from pixels of the ideal picture to the original, of 1/32 px.
    """

    def __init__(self, camera: Camera, options: UndistortOptions | None = None) -> None:
        """Prepare the maps for a camera; raises InputError when its lens sees nothing in front of it."""
        self.camera = camera
        self.ideal = _covering_pinhole(camera, options or UndistortOptions())
        self.maps = _maps(self.ideal, camera)

    def undistort(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The picture (H,W,3) uint8 of the ideal camera; outside the original the nearest border goes on."""
        import cv2

        resampled: NDArray[np.uint8] = cv2.remap(image, *self.maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return resampled

    def to_ideal(self, pixels: Array) -> Array:
        """Pixels (..., 2) of the ideal picture for those of the original; NaN where it does not show them."""
        return self.ideal.project(self.camera.unproject(pixels))


def _covering_pinhole(camera: Camera, options: UndistortOptions) -> Camera:
    """A pinhole camera with the resolution of the picture's centre, for all of the picture that fits."""
    rays = _rays(camera, GRID)
    rays = rays[np.isfinite(rays).all(axis=1), :2]
    if not len(rays):
        raise InputError("camera: the lens sees nothing in front of the camera; check its distortion terms")
    limit = math.tan(math.radians(MAX_HALF_ANGLE_DEG))
    low, high = np.maximum(rays.min(axis=0), -limit), np.minimum(rays.max(axis=0), limit)
    # Where the picture reaches 90° or more, there are no rays at its border.
    is_wide = camera.lens is not None and camera.lens.model is not LensModel.RATIONAL
    if is_wide and len(rays) < GRID**2:
        low, high = np.full(2, -limit), np.full(2, limit)
    step = 1e-4
    fx, fy = (camera.project(np.array([[step, 0.0, 1.0], [0.0, step, 1.0]])) - [camera.cx, camera.cy]).max(
        axis=1
    ) / step
    largest = options.max_growth * np.array([camera.width, camera.height])
    shrink = min(1.0, max(options.min_scale, float(np.min(largest / ((high - low) * [fx, fy])))))
    fx, fy = fx * shrink, fy * shrink
    half = 0.5 * largest / [fx, fy]
    low, high = np.maximum(low, -half), np.minimum(high, half)
    width, height = (int(side) for side in np.ceil((high - low) * [fx, fy]))
    return Camera(width, height, float(fx), float(fy), float(-low[0] * fx - 0.5), float(-low[1] * fy - 0.5))


def _maps(ideal: Camera, camera: Camera) -> tuple[Array, Array]:
    """OpenCV's fixed-point maps from pixels of the ideal picture to the original."""
    import cv2

    pixels = np.stack(np.meshgrid(np.arange(ideal.width), np.arange(ideal.height)), axis=-1).astype(np.float64)
    seen = np.nan_to_num(camera.project(ideal.unproject(pixels)), nan=-1e4).clip(-1e4, 3e4).astype(np.float32)
    maps: tuple[Array, Array] = cv2.convertMaps(seen[..., 0], seen[..., 1], cv2.CV_16SC2)
    return maps


class FrameView:
    """How the frames of a camera become pictures that the engine's kernels can use; rays and poses are the same.

    Attributes:
        camera: of the frames.
        tracked_camera: of the pictures: the same, with Brown's terms for its lens, or a pinhole camera.
    """

    def __init__(self, camera: Camera, options: UndistortOptions | None = None) -> None:
        self.camera = camera
        brown = brown_camera(camera)
        self._undistorter = Undistorter(camera, options) if brown is None else None
        self.tracked_camera = self._undistorter.ideal if self._undistorter is not None else brown or camera

    @property
    def is_resampling(self) -> bool:
        """Whether pictures differ from the frames."""
        return self._undistorter is not None

    def picture(self, frame: NDArray[np.uint8], index: int) -> NDArray[np.uint8]:
        """The picture (h,w,3) of a frame (H,W,3) uint8 RGB; raises InputError for a frame of another size or type."""
        if frame.shape != (self.camera.height, self.camera.width, 3) or frame.dtype != np.uint8:
            raise InputError(
                f"frame {index}: {frame.shape} {frame.dtype}, expected "
                f"({self.camera.height}, {self.camera.width}, 3) uint8 as the camera says"
            )
        return frame if self._undistorter is None else self._undistorter.undistort(frame)

    def pixel(self, pixel: tuple[float, float]) -> tuple[float, float]:
        """The pixel of the picture for one of the frame; raises InputError where the picture does not show it."""
        u, v = pixel
        if not (0 <= u < self.camera.width and 0 <= v < self.camera.height):
            raise InputError(f"pixel {u:g},{v:g}: outside the picture of {self.camera.width} × {self.camera.height} px")
        if self._undistorter is None:
            return pixel
        x, y = self._undistorter.to_ideal(np.array(pixel, dtype=np.float64)).tolist()
        if not (0 <= x < self.tracked_camera.width and 0 <= y < self.tracked_camera.height):
            raise InputError(f"pixel {u:g},{v:g}: too far off the axis of the lens for a part to be tracked there")
        return x, y
