"""A tracking session that does not track: for tests of what surrounds it."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from arview.geometry import look_at
from arview.pose import Pose, TrackingState
from arview.tracking import TrackedPart
from arview.tracking.self_calibration.camera_estimate import CameraEstimate

POSE = look_at([320.0, 30.0, 250.0], [30.0, 30.0, 5.0], [0.0, 0.0, 1.0])


class FakeSession:
    """Stands still where it is told to, or at POSE; takes the time of a slow tracker when asked to."""

    def __init__(
        self, parts: Sequence[TrackedPart], camera: Any, options: Any = None, is_guessed: bool = False
    ) -> None:
        self.pose = POSE if parts[0].initial_cam_from_model is None else parts[0].initial_cam_from_model
        self.camera = camera
        self.camera_estimate = CameraEstimate(parts[0].views, camera) if is_guessed else None
        self.seconds = float(os.environ.get("FAKE_SESSION_S", "0"))

    def process(self, image: object, index: int, time_s: float) -> tuple[Pose, ...]:
        time.sleep(self.seconds)
        return (Pose(self.pose, np.eye(6), 0.9, TrackingState.TRACKED, time_s, index, 1.0),)

    def camera_of(self, index: int) -> Any:
        return self.camera

    def finish(self) -> None:
        """Nothing is estimated."""
