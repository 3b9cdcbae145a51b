"""FocalWatch: whether the focal length of a given camera fits the pictures, from single frames of a tracked part.

A part with depth shows the focal length in a single frame: with another one, its edges near to and far from the camera
do not fit together. The stabilisation of a phone crops, its zoom changes lenses, and a camera file may be of another
mode; poses then are as wrong in depth as the focal length is, although every edge lies on its line.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from arview.camera import Camera
from arview.core.messages import Message, sentence
from arview.guideviews import GuideViewSet
from arview.pose import Pose, TrackingState
from arview.refinement import PartView
from arview.tracking.self_calibration.adjustment import FocalAdjustment
from arview.tracking.self_calibration.frame_set import cropped_frame

FIRST_EVERY, EVERY = 6, 60
"""Frames between the first two looks, and the most that they grow to, twofold each time: a look costs as much as
tracking three frames."""
MAX_STD = 0.015
"""Relative standard uncertainty above which a frame says too little: flat parts, and small ones."""
MIN_DIFFERENCE, SMALL_DIFFERENCE = 0.12, 0.035
"""Relative difference below which nothing is said; and where the frame shows `MANY_LINES` and none agreed before …."""
CONTRADICTION = 3.5
"""… and the same in standard uncertainties of the frame."""
MANY_LINES = 15
"""Lines of the part among which errors of the CAD average out: a box that is 1 % longer than its CAD shows 5 %."""
MIN_QUALITY = 0.5
"""Quality of a pose below which its frame is not looked at."""


@dataclass(frozen=True)
class FrameFocal:
    """The focal length that one frame shows.

    Attributes:
        log_ratio: logarithm of its ratio to the given one.
        std: standard uncertainty of that.
        lines: of the part that show it.
    """

    log_ratio: float
    std: float
    lines: int

    def contradicts(self, is_settled: bool) -> bool:
        """Whether the frame contradicts the given focal length; one that others agreed with needs more."""
        least = SMALL_DIFFERENCE if self.lines >= MANY_LINES and not is_settled else MIN_DIFFERENCE
        return abs(self.log_ratio) > max(least, CONTRADICTION * self.std)

    def agrees(self, other: FrameFocal) -> bool:
        """Whether two frames show the same focal length."""
        return abs(self.log_ratio - other.log_ratio) < max(SMALL_DIFFERENCE, CONTRADICTION * self.std)


class FocalWatch:
    """Watches the focal length of one camera while a part is tracked.

    Two looks in a row decide, so that one frame with a wrong pose does not.

    Args:
        views: guide views of the part.
        camera: as it was given.

    Attributes:
        contradiction: what the last frame showed, while the pictures contradict the focal length; otherwise None.
        has_changed: whether they agreed with it before.
        due: number of frames from which on the next look is due.
    """

    def __init__(self, views: GuideViewSet, camera: Camera) -> None:
        self.contradiction: FrameFocal | None = None
        self.has_changed = False
        self.due = 3
        self._camera = camera
        self._part = PartView.of(views)
        self._adjustment = FocalAdjustment(self._part, camera)
        self._last: FrameFocal | None = None
        self._wait = FIRST_EVERY

    def checked(self, image: NDArray[np.uint8], pose: Pose, frames: int, has_jumped: bool = False) -> Pose:
        """The pose of a frame (H,W,3); where the focal length is contradicted it is critical, and says by how much.

        Args:
            image: the frame.
            pose: of the part in it.
            frames: number of frames so far.
            has_jumped: the part seems to have, so that the frame is looked at before its turn.
        """
        if pose.cam_from_model is None:
            return pose
        if pose.quality >= MIN_QUALITY and (has_jumped or frames >= self.due):
            self._watch(image, pose, frames)
        if self.contradiction is None:
            return pose
        state = TrackingState.CRITICAL if pose.state is TrackingState.TRACKED else pose.state
        return replace(pose, state=state, reason=pose.reason or self.text)

    @property
    def text(self) -> Message:
        """What is said while the focal length is contradicted."""
        found = self.contradiction or FrameFocal(0.0, 0.0, 0)
        ratio = float(np.exp(found.log_ratio))
        key = "tracking.focal_changed" if self.has_changed else "tracking.focal_wrong"
        given, seen = f"{self._camera.fx:.0f}", f"{self._camera.fx * ratio:.0f}"
        return sentence(key, given=given, seen=seen, percent=f"{100 * (ratio - 1.0):+.0f}")

    def _watch(self, image: NDArray[np.uint8], pose: Pose, frames: int) -> None:
        """Look at a frame, and decide by this look and the one before."""
        shown = self._estimate(image, pose)
        self.due, self._wait = frames + self._wait, min(2 * self._wait, EVERY)
        if shown is None:
            return
        before, self._last = self._last, shown
        is_against = shown.contradicts(self.has_changed)
        if is_against and (before is None or not shown.agrees(before)):
            self.due = frames + 1  # the next frame confirms it
            return
        self.has_changed |= not is_against
        self.contradiction = shown if is_against else None

    def _estimate(self, image: NDArray[np.uint8], pose: Pose) -> FrameFocal | None:
        """The focal length that a frame shows; None where it shows too little."""
        assert pose.cam_from_model is not None
        body = pose.cam_from_model @ self._part.model_from_body
        frame = cropped_frame(image, body, self._camera, self._part.views.diameter_mm)
        if frame is None:
            return None
        try:
            found = self._adjustment.solve([frame], self._camera)
        except np.linalg.LinAlgError:
            return None
        if found is None or found.log_focal_std > MAX_STD:
            return None
        log_ratio = float(np.log(found.camera.fx / self._camera.fx))
        return FrameFocal(log_ratio, found.log_focal_std, self._adjustment.lines(frame, self._camera))
