"""One part tracked by several fixed, synchronous cameras at once: one pose, as exact in depth as across.

A camera measures what lies across its axis well and depth badly; another camera beside it measures that depth across.
The first camera is followed by a whole session, with detection, identity and presence. Each of the others only
refines the pose that the session found. The mean of both is taken by their covariances, as that of a `PosePrior`: both
are about the same point of the part and so in the same coordinates. (Stoiber et al., "A Multi-body Tracking
Framework", 2022, join the equations of several cameras instead, which costs each of them a whole search.)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from arview.camera import Camera
from arview.errors import InputError
from arview.geometry import Array, check_rigid, invert
from arview.pose import Pose
from arview.refinement import NEAR_STAGES, Appearance, PoseRefiner, RefinementPyramid, apply_twist, relative_twist
from arview.tracking.covariance import POINTS_OF_FRAME, common_covariance, covariance_of
from arview.tracking.estimate import PosePrior
from arview.tracking.session import TrackingSession
from arview.tracking.tracker import VELOCITY_DECAY

MIN_QUALITY = 0.5
"""Quality in another camera from which its pose counts; below, the part is covered there or elsewhere."""


class RigSession:
    """A session of the first camera that takes over what other cameras see.

    Args:
        session: of the first camera, with one specimen.
        others: intrinsics of each other camera, and its (4,4) ``cam_from_first``.

    Raises:
        InputError: the session has several specimens, or a pose is no rigid transform.
    """

    def __init__(self, session: TrackingSession, others: Sequence[tuple[Camera, Array]]) -> None:
        if len(session.specimens) != 1:
            raise InputError(f"several cameras track one specimen, not {len(session.specimens)}")
        self.session = session
        tracker = session.specimens[0].tracker
        self._part = tracker.refiner.part
        self._refiners = [PoseRefiner(self._part, camera, tracker.options) for camera, _ in others]
        self._cams_from_first = [check_rigid(pose, "RigSession: cam_from_first") for _, pose in others]
        self._colors = [Appearance() for _ in others]
        self._last: tuple[Array, Array] | None = None  # pose of the body in the first camera, and expected twist

    def process(
        self, images: Sequence[NDArray[np.uint8]], index: int | None = None, time_s: float | None = None
    ) -> Pose:
        """The pose in the first camera, from the pictures (H,W,3) uint8 RGB of all cameras, the first one's first."""
        pose = self.session.process(images[0], index, time_s)[0]
        if pose.cam_from_model is None or pose.covariance is None:
            self._last = None
            return pose
        body, covariance = pose.cam_from_model @ self._part.model_from_body, pose.covariance
        prior = self._prior(images[1:], body, np.zeros(6) if self._last is None else self._last[1])
        if prior is not None:
            body, covariance = prior.joined(body, self._part.body_from_model, covariance)
            pose = replace(pose, cam_from_model=body @ self._part.body_from_model, covariance=covariance)
        motion = np.zeros(6) if self._last is None else VELOCITY_DECAY * relative_twist(self._last[0], body)
        self._last = body, motion
        return pose

    def _prior(self, images: Sequence[NDArray[np.uint8]], expected: Array, motion: Array) -> PosePrior | None:
        """The mean of what the other cameras see, weighted by its covariance; None if none sees the part well."""
        information, pull = np.zeros((6, 6)), np.zeros(6)
        for image, refiner, cam_from_first, colors in zip(
            images, self._refiners, self._cams_from_first, self._colors, strict=True
        ):
            start = cam_from_first @ expected
            levels = RefinementPyramid(refiner, image, [start])
            body, found = levels.refine(start, NEAR_STAGES[-2:], colors, first=-1)
            quality = levels.finest.evidence(body, colors).quality
            if quality < MIN_QUALITY:
                continue
            covariance = covariance_of(found, quality, refiner.diameter_mm, POINTS_OF_FRAME)
            covariance += common_covariance(body, refiner.radius_px(body), refiner.diameter_mm, motion)
            own = np.linalg.inv(covariance)
            information += own
            pull += own @ relative_twist(expected, invert(cam_from_first) @ body)
        if not information.any():
            return None
        covariance = np.asarray(np.linalg.inv(information))
        mean = apply_twist(expected, covariance @ pull)
        return PosePrior(mean @ self._part.body_from_model, covariance)
