"""FocalEstimator: collects tracked frames of a video and estimates the focal length of its camera from them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from arview.camera import Camera
from arview.core.messages import sentence
from arview.geometry import Array
from arview.pose import Pose
from arview.refinement import PartView
from arview.tracking.self_calibration.adjustment import Adjusted, FocalAdjustment
from arview.tracking.self_calibration.frame_set import CalibrationFrame, FrameSet, cropped_frame

MIN_QUALITY = 0.5
"""Quality of a pose below which its frame is not used."""
MIN_FRAMES = 8
"""Frames without which nothing is estimated."""
NEW_FRAMES = 3
"""Frames that must have been added for a second estimate; each later one takes one more."""
MAX_STD = 0.05
"""Relative standard uncertainty above which the focal length counts as undetermined."""
SURE_STD = 0.025
"""Relative standard uncertainty above which ``MANY_FRAMES`` frames are needed as well."""
MANY_FRAMES = 20
"""Frames needed while the standard uncertainty is above ``SURE_STD``."""
ENOUGH_STD = 0.006
"""Relative standard uncertainty at which more frames are not needed."""
INFLATION = 1.5
"""Factor of the standard uncertainty, for errors that all edges share and no jackknife shows."""
AGREEMENT = 2.0
"""Standard uncertainties within which two estimates in a row must agree to be believed."""


@dataclass(frozen=True)
class FocalEstimate:
    """An estimate of the focal length.

    Attributes:
        camera: with the estimated focal length, and with principal point and distortion as far as the edges tell them.
        std_px: standard uncertainty of the focal length.
        guessed_px: the focal length that was assumed before.
        frames: frames that it was estimated from.
        is_determined: whether the views determine the focal length; otherwise the guess is to be kept.
    """

    camera: Camera
    std_px: float
    guessed_px: float
    frames: int
    is_determined: bool

    @property
    def focal_px(self) -> float:
        """The estimated focal length."""
        return self.camera.fx

    @property
    def text(self) -> str:
        """The estimate in one line, with expanded uncertainty (k = 2)."""
        if not self.is_determined:
            return sentence("told.focal_open", guessed=f"{self.guessed_px:.0f}")
        u_px = f"{2.0 * self.std_px:.0f}"
        return sentence("told.focal", focal=f"{self.focal_px:.0f}", u=u_px, guessed=f"{self.guessed_px:.0f}")


class FocalEstimator:
    """Estimates the focal length of one camera from frames in which one part is tracked.

    Args:
        part: the part in the form of the kernels.
        guess: the camera assumed before.
    """

    def __init__(self, part: PartView, guess: Camera) -> None:
        self.guess = guess
        self._part = part
        self._set = FrameSet(guess)
        self._adjustment = FocalAdjustment(part, guess)
        self._added = self._estimates = 0
        self._last: FocalEstimate | None = None

    @property
    def frames(self) -> int:
        """Number of frames kept."""
        return len(self._set.frames)

    @property
    def is_due(self) -> bool:
        """Whether there are enough new frames for another estimate."""
        return self.frames >= MIN_FRAMES and self._added >= NEW_FRAMES + self._estimates

    @property
    def is_done(self) -> bool:
        """Whether more frames are not needed."""
        last = self._last
        return last is not None and last.is_determined and last.std_px <= ENOUGH_STD * last.focal_px

    def add(self, image: NDArray[np.uint8], pose: Pose, camera: Camera) -> bool:
        """Take in a tracked frame (H,W,3) if it shows something new; returns whether it is kept.

        Args:
            image: uint8 RGB.
            pose: of the part, found with ``camera``.
            camera: the camera with which this frame was tracked.
        """
        if pose.cam_from_model is None or pose.quality < MIN_QUALITY:
            return False
        cam_from_body = pose.cam_from_model @ self._part.model_from_body
        if not self._set.is_new(cam_from_body, camera.fx):
            return False
        frame = cropped_frame(image, cam_from_body, camera, self._part.views.diameter_mm)
        if frame is None:
            return False
        frame.information = self._adjustment.information(frame, camera)
        is_kept = frame.information > 0.0 and self._set.add(frame)
        self._added += is_kept
        return is_kept

    def take_frames(self) -> list[CalibrationFrame]:
        """The frames kept, for `estimate` in another thread."""
        self._added = 0
        self._estimates += 1
        return list(self._set.frames)

    def estimate(self, frames: list[CalibrationFrame] | None = None) -> FocalEstimate:
        """The focal length from the frames of `take_frames`, or from all frames kept now.

        It is determined when it is precise enough, and agrees with the estimate before, which had fewer frames. The
        first estimate is compared with one from two thirds of its frames.
        """
        frames = self.take_frames() if frames is None else frames
        if self._last is None and 2 * len(frames) >= 3 * MIN_FRAMES:
            self.estimate(frames[: 2 * len(frames) // 3])
        found = self._solve(frames) if len(frames) >= MIN_FRAMES else None
        if found is None or len(found.used) < MIN_FRAMES:
            return FocalEstimate(self.guess, float("inf"), self.guess.fx, len(frames), False)
        std = INFLATION * found.log_focal_std
        is_precise = std <= (MAX_STD if len(found.used) >= MANY_FRAMES else SURE_STD)
        is_determined = is_precise and self._agrees(found, std)
        estimate = FocalEstimate(found.camera, std * found.camera.fx, self.guess.fx, len(found.used), is_determined)
        self._last = estimate
        return estimate

    def _solve(self, frames: list[CalibrationFrame]) -> Adjusted | None:
        """The adjustment of some frames; None where they leave it singular."""
        try:
            return self._adjustment.solve(frames, self._start())
        except np.linalg.LinAlgError:
            return None

    def _agrees(self, found: Adjusted, std: float) -> bool:
        """Whether an estimate agrees with the one before."""
        last = self._last
        if last is None:
            return False
        limit = AGREEMENT * float(np.hypot(std, last.std_px / last.focal_px))
        return abs(float(np.log(found.camera.fx / last.focal_px))) <= limit

    def _start(self) -> Camera:
        """Camera from which the adjustment starts."""
        return self.guess if self._last is None else self._last.camera


def pose_seen_by(cam_from_body: Array, before: Camera, after: Camera) -> Array:
    """The pose (4,4) about the part's centre with which one camera shows what another one showed.

    The centre keeps its place in the picture and its size, and the part its orientation towards the line of sight.
    """
    center = cam_from_body[:3, 3]
    old = center / center[2]
    new = after.unproject(before.project(center))
    turn = _rotation_between(old, new)
    moved = cam_from_body.copy()
    moved[:3, :3] = turn @ cam_from_body[:3, :3]
    moved[:3, 3] = new * center[2] * after.fx / before.fx
    return moved


def _rotation_between(a: Array, b: Array) -> Array:
    """Smallest rotation (3,3) from the direction of a vector (3,) to that of another, less than 180° away."""
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    axis = np.cross(a, b)
    skewed = np.array([[0.0, -axis[2], axis[1]], [axis[2], 0.0, -axis[0]], [-axis[1], axis[0], 0.0]])
    return np.asarray(np.eye(3) + skewed + skewed @ skewed / (1.0 + a @ b))
