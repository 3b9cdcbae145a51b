"""SelfCalibratingSession: a tracking session whose guessed camera is replaced once tracking has determined it.

A session is bound to its camera. When the focal length has been determined, a new session goes on from the pose with
which the new camera shows the same picture. Of a film, a first pass determines the camera before anything is written.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait

import numpy as np
from numpy.typing import NDArray

from arview.camera import Camera
from arview.geometry import Array
from arview.guideviews import GuideViewSet
from arview.pose import Pose, TrackingState
from arview.refinement import PartView
from arview.tracking.identity import IdentityMonitor
from arview.tracking.self_calibration.estimator import FocalEstimate, FocalEstimator, pose_seen_by
from arview.tracking.session import TrackingSession

MakeSession = Callable[[Camera, Array | None], TrackingSession]
"""Makes a session from a camera and, where tracking goes on, the pose (4,4) in its first frame."""


MIN_CHANGE = 1.0
"""Standard uncertainties by which an estimate must differ from the camera in use to replace it."""
MAX_REPLACEMENTS = 3
"""How often the camera is replaced at most."""


class SelfCalibratingSession:
    """Tracks with a guessed camera and replaces it once the frames have determined the focal length.

    The estimation runs in a thread of its own, so that no frame waits for it.

    Args:
        make_session: makes the sessions, see `MakeSession`.
        views: guide views of the part.
        guess: the camera to begin with.

    Attributes:
        session: the tracking session in use.
        estimate: the last estimate; None before the first one.
    """

    def __init__(
        self,
        make_session: MakeSession,
        views: GuideViewSet,
        guess: Camera,
    ) -> None:
        self.session = make_session(guess, None)
        self.estimate: FocalEstimate | None = None
        self._make_session = make_session
        self._part = PartView(views)
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

    def reset(self) -> None:
        """Forget the part's pose and search again; the camera is kept."""
        self.session.reset()

    @property
    def identity(self) -> IdentityMonitor:
        """Says whether the specimen in view is the one that was followed."""
        return self.session.identity

    def confirm(self) -> None:
        """Say that the specimen tracked now is the one to which the labels belong, see `Identity`."""
        self.session.confirm()

    def process(self, image: NDArray[np.uint8], index: int, time_s: float) -> Pose:
        """Pose and state of the next frame (H,W,3) uint8 RGB, see `TrackingSession.process`."""
        pose = self.session.process(image, index, time_s)
        replaced = self._finished()
        if replaced is not None and pose.cam_from_model is not None:
            before, after = self.camera, replaced.camera
            body = pose_seen_by(pose.cam_from_model @ self._part.model_from_body, before, after)
            session = self._make_session(after, body @ self._part.body_from_model)
            again = session.process(image, index, time_s)
            if again.state in (TrackingState.TRACKED, TrackingState.CRITICAL):
                session.identity.take_over(self.session.identity)
                pose = session.identity.stated(again)
                self.session = session
                self._cameras.append((index, after))
        self._collect(image, pose)
        return pose

    def wait(self) -> None:
        """Wait until an estimate that is being made is ready; the next frame then uses it."""
        if self._pending is not None:
            wait([self._pending])

    def finish(self) -> FocalEstimate:
        """The estimate from all frames so far, after the last one."""
        if self._pending is not None:
            self._finished(is_waiting=True)
        if self.estimate is None or not self._estimator.is_done:
            self.estimate = self._estimator.estimate()
        self._worker.shutdown()
        return self.estimate

    def _collect(self, image: NDArray[np.uint8], pose: Pose) -> None:
        """Take in a frame, and start an estimate when enough is new."""
        estimator = self._estimator
        if estimator.is_done or pose.state not in (TrackingState.TRACKED, TrackingState.CRITICAL):
            return
        estimator.add(image, pose, self.camera)
        if estimator.is_due and self._pending is None:
            self._pending = self._worker.submit(estimator.estimate, estimator.take_frames())

    def _finished(self, is_waiting: bool = False) -> FocalEstimate | None:
        """A new estimate that calls for another camera; None without one."""
        if self._pending is None or not (is_waiting or self._pending.done()):
            return None
        estimate, self._pending = self._pending.result(), None
        self.estimate = estimate
        if not estimate.is_determined or len(self._cameras) > MAX_REPLACEMENTS:
            return None
        change_px = abs(estimate.focal_px - self.camera.fx)
        return estimate if change_px > MIN_CHANGE * estimate.std_px else None
