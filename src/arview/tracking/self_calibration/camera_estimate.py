"""CameraEstimate: the camera of a stream whose focal length is guessed, and determined while a part is tracked."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor, wait

import numpy as np
from numpy.typing import NDArray

from arview.camera import Camera
from arview.geometry import Array
from arview.guideviews import GuideViewSet
from arview.pose import Pose, TrackingState
from arview.refinement import PartView
from arview.tracking.self_calibration.estimator import FocalEstimate, FocalEstimator, pose_seen_by

MIN_CHANGE = 1.0
"""Standard uncertainties by which an estimate must differ from the camera in use to replace it."""
MAX_REPLACEMENTS = 3
"""How often the camera is replaced at most."""


class CameraEstimate:
    """The camera in use, and the estimation that replaces it.

    The estimation runs in a thread of its own, so that no frame waits for it.

    Args:
        views: guide views of the part that is tracked.
        guess: the camera to begin with.

    Attributes:
        last: the last estimate; None before the first one.
    """

    def __init__(self, views: GuideViewSet, guess: Camera) -> None:
        self.last: FocalEstimate | None = None
        self._part = PartView.of(views)
        self._estimator = FocalEstimator(self._part, guess)
        self._cameras: list[tuple[int, Camera]] = [(0, guess)]
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="arview-focal")
        self._pending: Future[FocalEstimate] | None = None

    @property
    def frames(self) -> int:
        """Number of frames kept for the estimation."""
        return self._estimator.frames

    @property
    def is_done(self) -> bool:
        """Whether the focal length is known so well that more frames are not needed."""
        return self._estimator.is_done

    @property
    def camera(self) -> Camera:
        """The camera in use."""
        return self._cameras[-1][1]

    def camera_of(self, index: int) -> Camera:
        """The camera with which the frame of an index was tracked."""
        return next((camera for first, camera in reversed(self._cameras) if first <= index), self._cameras[0][1])

    def add(self, image: NDArray[np.uint8], pose: Pose) -> None:
        """Take in a frame (H,W,3) uint8 RGB with its pose, and start an estimate when enough is new."""
        estimator = self._estimator
        if estimator.is_done or pose.state not in (TrackingState.TRACKED, TrackingState.CRITICAL):
            return
        estimator.add(image, pose, self.camera)
        if estimator.is_due and self._pending is None:
            self._pending = self._worker.submit(estimator.estimate, estimator.take_frames())

    def better_camera(self) -> Camera | None:
        """The camera of a new estimate that differs from the one in use; None without one."""
        if self._pending is None or not self._pending.done():
            return None
        self.last, self._pending = self._pending.result(), None
        if not self.last.is_determined or len(self._cameras) > MAX_REPLACEMENTS:
            return None
        change_px = abs(self.last.focal_px - self.camera.fx)
        return self.last.camera if change_px > MIN_CHANGE * self.last.std_px else None

    def equal_pose(self, cam_from_model: Array, camera: Camera) -> Array:
        """The pose (4,4) with which another camera shows what the one in use shows at a pose (4,4)."""
        body = pose_seen_by(cam_from_model @ self._part.model_from_body, self.camera, camera)
        return body @ self._part.body_from_model

    def replace(self, index: int, camera: Camera) -> None:
        """Use another camera from the frame of an index on."""
        self._cameras.append((index, camera))

    def wait(self) -> None:
        """Wait until an estimate that is being made is ready; the next frame then uses it."""
        if self._pending is not None:
            wait([self._pending])

    def finish(self) -> FocalEstimate:
        """The estimate from all frames so far, after the last one."""
        if self._pending is not None:
            self.last, self._pending = self._pending.result(), None
        if self.last is None or not self._estimator.is_done:
            self.last = self._estimator.estimate()
        self._worker.shutdown()
        return self.last
