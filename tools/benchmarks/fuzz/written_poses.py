"""Lines of ``poses.jsonl`` of any pose: valid JSON by the standard, one line each, with the numbers of the pose."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from guard import Fault, guarded
from hypothesis import strategies as st

from arview.camera import Camera
from arview.pose import Pose, TrackingState
from arview.pose_file import PoseWriter

_ANY = st.floats(width=64)
_TEXTS = st.text(max_size=40)
POSES = st.tuples(
    st.one_of(st.none(), st.lists(st.floats(-1e9, 1e9), min_size=16, max_size=16)),
    st.one_of(st.none(), st.lists(_ANY, min_size=36, max_size=36)),
    st.floats(0.0, 1.0),
    st.sampled_from(list(TrackingState)),
    st.floats(0.0, 1e6),
    st.tuples(_TEXTS, _TEXTS, st.lists(_TEXTS, max_size=3), _TEXTS),
)


def _not_json(name: str) -> NoReturn:
    raise Fault("poses.jsonl is not JSON", name)


def fuzz_poses(folder: Path) -> tuple[Callable[[Any], None], st.SearchStrategy[Any]]:
    """The attempt on the writer and the strategy of its argument."""
    path = folder / "poses" / "poses.jsonl"
    camera = Camera(640, 480, 600.0, 601.0, 319.5, 239.5)

    def attempt(argument: tuple[Any, ...]) -> None:
        place, covariance, quality, state, time_s, (reason, file, names, serial) = argument
        matrix = None if place is None else np.array(place).reshape(4, 4)
        spread = None if covariance is None else np.array(covariance).reshape(6, 6)
        pose = Pose(
            matrix, spread, quality, state, time_s, 7, 1.5, reason=reason, mismatches=tuple(names), serial=serial
        )
        with guarded("poses.jsonl", folder / "poses" / "native.txt"):
            writer = PoseWriter(path, lambda index: camera)
            writer.write(pose, file)
            writer.close()
            lines = path.read_bytes().decode("utf-8").split("\n")
            if len(lines) != 2 or lines[1]:
                raise Fault("poses.jsonl is not one line", repr(lines))
            entry = json.loads(lines[0], parse_constant=_not_json)
            if matrix is not None and not np.array_equal(entry["cam_from_model"], matrix):
                raise Fault("poses.jsonl another pose", f"{entry['cam_from_model']} instead of {matrix.tolist()}")
            if (entry["quality"], entry["time_s"], entry["reason"]) != (quality, time_s, reason):
                raise Fault("poses.jsonl other numbers", lines[0])

    return attempt, POSES
