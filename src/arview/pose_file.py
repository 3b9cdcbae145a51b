"""The file of poses, ``poses.jsonl``: one JSON object a line for each frame."""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np

from arview.camera import Camera
from arview.core.atomic import begin_unfinished
from arview.errors import OutputError
from arview.pose import Pose


class PoseWriter:
    """Writes poses as JSON lines under a temporary name; `close` gives the file its name.

    A line holds ``index``, ``time_s``, ``state``, ``quality``, ``cam_from_model`` (4×4 row-major, mm, or
    null), ``covariance`` (6×6 or null), ``ms``, ``reason`` (why not ``tracked``, or empty), ``mismatches``
    (list), ``unverified`` (names of components not yet confirmed), ``alternatives`` (list of 4×4 poses that fit as
    well), and what `presence_record` adds to a pose. Frames that are picture files have ``file``, its name. Where the
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


def presence_record(pose: Pose) -> dict[str, object]:
    """Components and identity of a pose as JSON values; empty without a pose.

    ``presence`` maps each component to its `Presence`, ``presence_details`` to its visibility, probability,
    observations, spread_deg and, if it is displaced, model_from_nominal (4×4). ``completeness`` is a summary;
    ``identity``, ``identity_reason``, ``serial`` and ``instance`` say which specimen is meant.
    """
    if pose.cam_from_model is None:
        return {"instance": pose.instance} if pose.instance else {}
    details = {}
    for name, one in pose.components.items():
        moved = {} if one.model_from_nominal is None else {"model_from_nominal": one.model_from_nominal.tolist()}
        details[name] = {
            "visibility": str(one.visibility),
            "probability": round(one.probability, 4),
            "observations": one.observations,
            "spread_deg": round(one.spread_deg, 1),
            **moved,
        }
    return {
        "completeness": str(pose.completeness),
        "presence": {name: str(one.presence) for name, one in pose.components.items()},
        "presence_details": details,
        "identity": str(pose.identity),
        "identity_reason": pose.identity_reason,
        "serial": pose.serial,
        "instance": pose.instance,
    }


def pose_line(pose: Pose, camera: Camera | None = None, file: str = "") -> str:
    """A pose, and its camera and picture file if they are given, as a line of ``poses.jsonl``, see `PoseWriter`.

    A covariance that is not finite becomes null.
    """
    covariance = pose.covariance
    is_known = covariance is not None and bool(np.all(np.isfinite(covariance)))
    stated = {}
    if camera is not None:
        values = {name: float(getattr(camera, name)) for name in ("fx", "fy", "cx", "cy")}
        stated = {"camera": {**values, "dist": camera.dist.tolist()}}
    return json.dumps(
        {
            "index": pose.index,
            **({"file": file} if file else {}),
            "time_s": pose.time_s,
            "state": str(pose.state),
            "quality": pose.quality,
            "cam_from_model": None if pose.cam_from_model is None else pose.cam_from_model.tolist(),
            "covariance": covariance.tolist() if covariance is not None and is_known else None,
            "ms": round(pose.ms, 4),
            "reason": pose.reason,
            "mismatches": list(pose.mismatches),
            "unverified": list(pose.unverified),
            "alternatives": [alternative.tolist() for alternative in pose.alternatives],
            **presence_record(pose),
            **stated,
        },
        allow_nan=False,
    )
