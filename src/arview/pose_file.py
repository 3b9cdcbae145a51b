"""The file of poses, ``poses.jsonl``: one JSON object a line for each frame."""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from arview.camera import Camera
from arview.core.atomic import begin_unfinished
from arview.errors import OutputError
from arview.pose import Pose


class PoseWriter:
    """Writes poses as JSON lines under a temporary name; `close` gives the file its name.

    A line holds ``index``, ``time_s``, ``state``, ``quality``, ``cam_from_model`` (4×4 row-major, mm, or
    null), ``covariance`` (6×6 or null), ``ms``, ``reason`` (why not ``tracked``, or empty), ``mismatches``
    (list), ``unverified`` (names of components not yet confirmed), ``alternatives`` (list of 4×4 poses that fit as
    well), and of a pose what `Pose.to_dict` says of components and
    identity. Frames that are picture files have ``file``, its name. Where the
    camera was not given, it also holds ``camera`` (fx, fy, cx, cy in px and dist).

    Args:
        path: of the file.
        camera_of: camera of the frame of an index; None leaves it out.

    Raises:
        OutputError: the file cannot be written.
    """

    def __init__(self, path: str | Path, camera_of: Callable[[int], Camera] | None = None) -> None:
        self.path = Path(path)
        self._camera_of = camera_of
        self._part = begin_unfinished(self.path)
        if self.path.is_dir():
            raise OutputError(f"{path}: is a folder; give the name of a file")
        try:
            self._file = self._part.open("w", buffering=1, encoding="utf-8")  # a crash cuts at most one line
        except OSError as error:
            raise self._explained(error) from error

    def write(self, pose: Pose, file: str = "") -> None:
        """Add a line; ``file`` is the name of the picture file of the frame, or empty."""
        try:
            camera = None if self._camera_of is None else self._camera_of(pose.index)
            self._file.write(pose_line(pose, camera, file) + "\n")
        except OSError as error:
            raise self._explained(error) from error

    def close(self) -> None:
        """Complete the file."""
        try:
            self._file.close()
            self._part.replace(self.path)
        except OSError as error:
            raise self._explained(error) from error

    def abort(self) -> None:
        """Remove what was written; an older file of the same name stays."""
        with suppress(OSError):
            self._file.close()
        with suppress(OSError):
            self._part.unlink(missing_ok=True)

    def _explained(self, error: OSError) -> OutputError:
        return OutputError(f"{self.path}: cannot write the poses: {error.strerror or error}")


def pose_line(pose: Pose, camera: Camera | None = None, file: str = "") -> str:
    """A pose, and its camera and picture file if they are given, as a line of ``poses.jsonl``, see `PoseWriter`."""
    stated = {}
    if camera is not None:
        values = {name: float(getattr(camera, name)) for name in ("fx", "fy", "cx", "cy")}
        stated = {"camera": {**values, "dist": camera.dist.tolist()}}
    return json.dumps(
        {
            **pose.to_dict(),
            **({"file": file} if file else {}),
            **stated,
        },
        allow_nan=False,
    )
