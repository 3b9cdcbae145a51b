"""The file of poses, ``poses.jsonl``: one JSON object a line for each frame."""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.camera import Camera
from arview.core.atomic import begin_unfinished, write_file
from arview.errors import OutputError
from arview.pose import Pose, StepReport


class PoseWriter:
    """Writes poses as JSON lines under a temporary name; `close` gives the file its name.

    A line holds ``index``, ``time_s``, ``state``, ``quality``, ``cam_from_model`` (4×4 row-major, mm, or
    null), ``covariance`` (6×6 or null), ``ms``, ``reason`` (why not ``tracked``, or empty), ``mismatches``
    (list), ``unverified`` (names of components not yet confirmed), ``alternatives`` (list of 4×4 poses that fit as
    well), and of a pose what `Pose.to_dict` says of components and
    identity. Frames that are picture files have ``file``, its name. Where the
    camera was not given, it also holds ``camera`` (fx, fy, cx, cy in px and dist).

    Of a part with steps `close` writes a second file, ``NAME.steps.jsonl``: a line for each step (``step``, ``name``,
    ``components``, ``state``, ``started_s``, ``done_s``, ``photo``) and one for each fault (``fault``, ``kind``,
    ``began_s``, ``ended_s``), with ``instance`` where several specimens are tracked. The photos, the frames by which a
    step was known to be done, are in the folder ``NAME.steps``.

    Args:
        path: of the file.
        camera_of: camera of the frame of an index; None leaves it out.

    Raises:
        OutputError: the file cannot be written.
    """

    def __init__(self, path: str | Path, camera_of: Callable[[int], Camera] | None = None) -> None:
        self.path = Path(path)
        self._camera_of = camera_of
        self._steps = _StepRecord()
        self._part = begin_unfinished(self.path)
        if self.path.is_dir():
            raise OutputError(f"{path}: is a folder; give the name of a file")
        try:
            self._file = self._part.open("w", buffering=1, encoding="utf-8")  # a crash cuts at most one line
        except OSError as error:
            raise self._explained(error) from error

    def write(self, pose: Pose, file: str = "", image: NDArray[np.uint8] | None = None) -> None:
        """Add a line.

        Args:
            pose: of the frame.
            file: name of the picture file of the frame, or empty.
            image: (H,W,3) uint8 RGB, the frame, for the photo of a step; None: there will be none.
        """
        self._steps.add(pose, image)
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
            self._steps.save(self.path)
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


class _StepRecord:
    """The steps of all specimens after the last frame, and a photo (JPEG) of each that is done."""

    def __init__(self) -> None:
        self._reports: dict[str, StepReport] = {}
        self._photos: dict[tuple[str, int], bytes] = {}

    def add(self, pose: Pose, image: NDArray[np.uint8] | None) -> None:
        """Add a frame."""
        if pose.steps is not None:
            self._reports[pose.instance] = pose.steps
        for number, done_s in enumerate(() if pose.steps is None or image is None else pose.steps.done_s, 1):
            if done_s is not None and image is not None and (pose.instance, number) not in self._photos:
                self._photos[pose.instance, number] = cv2.imencode(".jpg", image[..., ::-1])[1].tobytes()

    def save(self, poses_path: Path) -> None:
        """Write the file and the photos beside the file of the poses, the photos first."""
        names = {key: f"{number:02}.jpg" for number, key in enumerate(self._photos, 1)}
        for key, jpeg in self._photos.items():
            write_file(poses_path.with_suffix(".steps") / names[key], jpeg, makes_folder=True)
        lines = [
            json.dumps(
                {
                    **row,
                    **({"photo": names.get((instance, number), "")} if "step" in row else {}),
                    **({"instance": instance} if instance else {}),
                }
            )
            for instance, report in self._reports.items()
            for number, row in enumerate(report.rows(), 1)
        ]
        if lines:
            write_file(poses_path.with_suffix(".steps.jsonl"), "".join(f"{line}\n" for line in lines).encode())


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
