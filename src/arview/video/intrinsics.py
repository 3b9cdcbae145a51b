"""The camera of a source's frames, also where their pixels were made square."""

from __future__ import annotations

import math
from pathlib import Path

from arview.camera import Camera
from arview.camera.read import load_camera
from arview.errors import MismatchError
from arview.video.source import FrameSource


def load_camera_of(frames: FrameSource, spec: str | Path, source: str | Path | None = None) -> Camera:
    """The camera for the frames of a source as they come out of it, see `arview.camera.load_camera`.

    A camera file of an anamorphic film may have been made for the stored frames or for those with square pixels. Its
    size tells which; without one, the focal lengths do, which are equal where pixels are square.

    Args:
        frames: the opened source.
        spec: file, ``fov:DEG``, ``exif``, ``profile`` or ``profile:NAME``.
        source: as the user gave it, for ``exif`` and ``profile``.

    Raises:
        InputError, MismatchError: the camera cannot be read or is not for these frames.
    """
    turns = frames.quarter_turns_clockwise
    sizes = [(frames.width, frames.height)]
    is_angle = str(spec) == "exif" or str(spec).startswith("fov:")
    if frames.unsquared_size is not None and not is_angle:
        sizes.append(frames.unsquared_size)
    found: list[Camera] = []
    mismatches: list[MismatchError] = []
    for width, height in sizes:
        try:
            camera = load_camera(spec, width, height, source=source, quarter_turns_clockwise=turns)
            found.append(camera.scaled(frames.width, frames.height))
        except MismatchError as error:
            mismatches.append(error)
    if not found:
        raise mismatches[0]
    return min(found, key=lambda camera: abs(math.log(camera.fx / camera.fy)))
