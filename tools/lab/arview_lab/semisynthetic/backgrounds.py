"""Real photos as backgrounds, and crops that move over them like a hand-held camera."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.errors import InputError
from arview.geometry import Array
from arview.video import Image
from arview_lab.evaluation.bop import PICTURE_SUFFIXES
from arview_lab.semisynthetic.trajectory import smooth_noise

MIN_SIDE_PX = 200
"""Smallest side of a background; smaller pictures are too coarse."""
_CROP_SHARE = (0.72, 0.92)
"""Range of the crop's width, as a share of the widest that fits."""
_MAX_MAGNIFIED = 1.7
"""A photo is repeated rather than magnified more than this."""
_TILT_DEG = 4.0
"""Range of the crop's rotation."""


def photos_in(folder: Path) -> list[Path]:
    """All pictures below a folder, sorted by name.

    Raises:
        InputError: no such folder, or no picture in it.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder of background photos")
    photos = sorted(p for p in folder.rglob("*") if p.suffix.lower() in PICTURE_SUFFIXES and p.is_file())
    if not photos:
        raise InputError(f"{folder}: contains no photos ({' '.join(PICTURE_SUFFIXES)}); give another folder")
    return photos


def read_photo(path: Path) -> Image:
    """Picture (H,W,3) uint8 RGB of a file.

    Raises:
        InputError: it cannot be read, or is too small for a background.
    """
    data = np.fromfile(path, dtype=np.uint8) if path.is_file() else np.zeros(0, np.uint8)
    bgr = cv2.imdecode(data, cv2.IMREAD_COLOR) if data.size else None
    if bgr is None:
        raise InputError(f"{path}: cannot be read as a picture; take it out of the backgrounds")
    if min(bgr.shape[:2]) < MIN_SIDE_PX:
        size = f"{bgr.shape[1]}×{bgr.shape[0]}"
        raise InputError(f"{path}: {size} px is too small for a background; give photos of {MIN_SIDE_PX} px or more")
    return np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB))


def moving_crops(
    photo: Image, width: int, height: int, count: int, rng: np.random.Generator, smooth_frames: float = 14.0
) -> Iterator[Image]:
    """Crops (height,width,3) of a photo that move, rotate and zoom smoothly, like a hand-held camera."""
    path = CropPath(photo, width, height, count, rng, smooth_frames)
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    for number in range(count):
        crop = cv2.warpAffine(
            path.photo, path.photo_from_crop(number), (width, height), flags=flags, borderMode=cv2.BORDER_REFLECT_101
        )
        yield np.asarray(crop)


class CropPath:
    """A crop that moves, rotates and zooms smoothly over a photo, at any time.

    Attributes:
        photo: (H,W,3), shrunk to about the crop's resolution.
    """

    def __init__(
        self, photo: Image, width: int, height: int, count: int, rng: np.random.Generator, smooth_frames: float = 14.0
    ) -> None:
        self.photo = _shrunk(photo, width, height)
        self._size = (width, height)
        self._noise = np.tanh(smooth_noise(count, 4, smooth_frames, rng))

    def photo_from_crop(self, number: int) -> Array:
        """(2,3) affine map from the crop of a frame to the photo, px."""
        return self._map(self._noise[number])

    def photo_from_crop_at(self, time: float) -> Array:
        """The same at a time between frames, in frames."""
        place = min(max(time, 0.0), len(self._noise) - 1.0)
        before = min(int(place), max(len(self._noise) - 2, 0))
        after = min(before + 1, len(self._noise) - 1)
        share = place - before
        return self._map((1.0 - share) * self._noise[before] + share * self._noise[after])

    def _map(self, noise: Array) -> Array:
        across, down, zoom, tilt = noise
        rows, columns = self.photo.shape[:2]
        width, height = self._size
        widest = min(columns, rows * width / height)
        low, high = _CROP_SHARE
        middle, half = 0.5 * (low + high), 0.5 * (high - low)
        scale = widest * (middle + half * zoom) / width
        angle = np.deg2rad(_TILT_DEG * tilt)
        linear = scale * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        # The rotated crop must stay inside the photo on all sides.
        reach = 0.5 * np.abs(linear) @ [width, height]
        free = np.maximum(0.5 * np.array([columns, rows]) - reach - 1.0, 0.0)
        center = 0.5 * np.array([columns - 1, rows - 1]) + free * [across, down]
        shift = center - linear @ [0.5 * (width - 1), 0.5 * (height - 1)]
        return np.column_stack([linear, shift])


def mosaic(photo: Image, width: int, height: int) -> Image:
    """The photo, repeated and mirrored at its borders until a crop of a size has as many pixels as the photo."""
    rows = -(-height // max(1, round(_MAX_MAGNIFIED * _CROP_SHARE[0] * photo.shape[0])))
    columns = -(-width // max(1, round(_MAX_MAGNIFIED * _CROP_SHARE[0] * photo.shape[1])))
    line = np.concatenate([photo if k % 2 == 0 else photo[:, ::-1] for k in range(columns)], axis=1)
    return np.concatenate([line if k % 2 == 0 else line[::-1] for k in range(rows)])


def surroundings(photo: Image) -> NDArray[np.float32]:
    """Environment map (32,64,3) in 0–1 for reflections: a blurred photo wrapped around the scene."""
    small = cv2.resize(photo, (32, 32), interpolation=cv2.INTER_AREA).astype(np.float32) / 255.0
    round_about = np.concatenate([small, small[:, ::-1]], axis=1)
    return np.asarray(cv2.GaussianBlur(round_about, (0, 0), 1.2, borderType=cv2.BORDER_REFLECT_101))


def _shrunk(photo: Image, width: int, height: int) -> Image:
    """The photo, shrunk so that a crop has hardly more pixels than the picture."""
    share = 1.25 * max(width / photo.shape[1], height / photo.shape[0]) / _CROP_SHARE[0]
    if share >= 1.0:
        return photo
    size = (round(photo.shape[1] * share), round(photo.shape[0] * share))
    return np.asarray(cv2.resize(photo, size, interpolation=cv2.INTER_AREA))
