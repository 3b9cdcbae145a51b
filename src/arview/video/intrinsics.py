"""The camera of a source's frames, also where their pixels were made square."""

from __future__ import annotations

import math
from pathlib import Path

from arview.camera import Camera, load_camera
from arview.errors import MismatchError
from arview.video.pictures import PictureSource
from arview.video.source import FrameSource


def load_camera_of(frames: FrameSource, spec: str | Path, source: str | Path | None = None) -> Camera:
    """The camera for the frames of a source as they come out of it, see `load_square_camera`.

    Args:
        frames: the opened source.
        spec: file, ``fov:DEG``, ``exif``, ``profile`` or ``profile:NAME``.
        source: as the user gave it, for ``exif`` and ``profile``.

    Raises:
        InputError, MismatchError: the camera cannot be read or is not for these frames.
    """
    size = (frames.width, frames.height)
    if isinstance(frames, PictureSource):
        source = frames.first_path
    return load_square_camera(spec, size, frames.unsquared_size, frames.quarter_turns_clockwise, source)


def load_square_camera(
    spec: str | Path,
    size: tuple[int, int],
    unsquared_size: tuple[int, int] | None,
    quarter_turns_clockwise: int,
    source: str | Path | None = None,
) -> Camera:
    """The camera for frames whose pixels may have been made square, see `arview.camera.read.load_camera`.

    A camera file of an anamorphic film may have been made for the stored frames or for those with square pixels. Its
    size tells which; without one, the focal lengths do, which are equal where pixels are square.

    Args:
        spec: file, ``fov:DEG``, ``exif``, ``profile`` or ``profile:NAME``.
        size: width and height of the upright frames, px.
        unsquared_size: the same before pixels were made square; None where they were square.
        quarter_turns_clockwise: rotation that was applied to the frames.
        source: as the user gave it, for ``exif`` and ``profile``.

    Raises:
        InputError, MismatchError: the camera cannot be read or is not for these frames.
    """
    is_angle = str(spec) == "exif" or str(spec).startswith("fov:")
    found: list[Camera] = []
    mismatches: list[MismatchError] = []
    for width, height in [size] if unsquared_size is None or is_angle else [size, unsquared_size]:
        try:
            camera = load_camera(spec, width, height, source=source, quarter_turns_clockwise=quarter_turns_clockwise)
            found.append(camera.scaled(*size))
        except MismatchError as error:
            mismatches.append(error)
    if not found:
        raise mismatches[0]
    return min(found, key=lambda camera: abs(math.log(camera.fx / camera.fy)))
