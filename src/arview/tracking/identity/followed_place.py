"""FollowedPlace: where the followed specimen was last seen without doubt, and where it should be now.

The last sure picture of the specimen is kept. The motion of the background since then, or the specimen's own motion
over a short gap, says where it should be; a pose is compared with that place.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from arview.geometry import Array
from arview.tracking.estimate import Estimate
from arview.tracking.identity.background_motion import MAX_SIDE_PX, BackgroundMotion, reduced
from arview.tracking.identity.own_motion import OwnMotion
from arview.tracking.identity.part_outline import PartOutline, PartPlace, transfer
from arview.tracking.identity.specimen_search import SAME_DEPTH, SAME_DEPTH_SHARE

QUALITY_RATE = 0.1
"""Share by which the usual quality of the followed specimen follows each frame, from 0."""
SURE_QUALITY = 0.6
"""Usual quality from which the pose of the followed specimen is certainly right; below, the detector is asked."""
MAX_JUMP = 0.35
"""Shift between two frames, in diameters of the part in the picture, from which a pose is compared with the place at
which the background says that the part was."""
SAME_PLACE = 0.35
"""Shift from that place, in diameters of the part in the picture, up to which a pose is the same part, because two
specimens do not stand in one place."""
MAX_UNKNOWN_FRAMES = 5
"""Frames without a sure pose up to which a pose near the last one is the same part although the motion of the
background is not known."""
KEPT_EVERY = 4
"""Frames from one kept view to the next, because copies of large frames take time."""


class Placement(Enum):
    """Where a pose is, compared with the place at which the background says that the part was."""

    SAME = "same"
    AWAY = "away"
    UNKNOWN = "unknown"


@dataclass(frozen=True)
class KeptView:
    """The last picture in which the followed specimen was tracked without doubt.

    Attributes:
        image: (H,W,3) uint8 RGB.
        cam_from_model: (4,4) its pose there.
        others: poses (4,4) of specimens that were tracked beside it there.
    """

    image: NDArray[np.uint8]
    cam_from_model: Array
    others: tuple[Array, ...] = ()


class FollowedPlace:
    """Where the followed specimen was, and where the background says that it is now.

    Args:
        outline: of the part.

    Attributes:
        kept: the last sure view of the specimen; None without one.
        background: motion of the background since then.
        frame: number of the present frame since the last reset.
    """

    def __init__(self, outline: PartOutline) -> None:
        self._outline = outline
        self.background = BackgroundMotion(outline)
        self._own_motion = OwnMotion(outline)
        self.reset()

    def reset(self) -> None:
        """Forget the specimen."""
        self.release()
        self._buffer: NDArray[np.uint8] | None = None
        self._is_followed = False
        self._own_motion.reset()
        self._last: PartPlace | None = None
        self._present: PartPlace | None = None
        self.frame = 0

    def release(self) -> None:
        """Forget the kept view; the next sure frame is kept."""
        self.kept: KeptView | None = None
        self._kept_quality = 0.0
        self._frames_unsure = 0

    def begin_frame(self, cam_from_model: Array | None) -> None:
        """A new frame, with the tracked pose (4,4) if there is one."""
        self.frame += 1
        self._last, self._present = self._present, None
        if cam_from_model is not None:
            self._present = self._outline.place(cam_from_model)

    def miss(self, image: NDArray[np.uint8]) -> None:
        """A frame (H,W,3) without a pose: the background is followed, and the next pose is compared with the last."""
        self._present = None
        self._frames_unsure += 1
        self.follow_background(image, None)

    def follow(self, image: NDArray[np.uint8], estimate: Estimate, is_sure: bool, others: tuple[Array, ...]) -> None:
        """Go on with the followed specimen; a sure frame (H,W,3) becomes the kept view."""
        self._frames_unsure = 0 if is_sure else self._frames_unsure + 1
        if not is_sure:
            return
        self._own_motion.add(self.frame, estimate.cam_from_model)
        self._kept_quality += QUALITY_RATE * (estimate.quality - self._kept_quality)
        if self.kept is not None and not self._is_followed and self.frame % KEPT_EVERY:
            return
        if self._buffer is None:
            self._buffer = np.empty_like(image)
        # Copied, because a source may use the memory of its frames again.
        np.copyto(self._buffer, image)
        self.kept = KeptView(self._buffer, estimate.cam_from_model, others)
        self._is_followed = False

    def follow_background(self, image: NDArray[np.uint8], pose: Array | None) -> None:
        """Follow the background into this frame, with the part at a pose (4,4) if it is known."""
        if self.kept is None:
            return
        if not self._is_followed:
            picture = reduced(self.kept.image, MAX_SIDE_PX)
            self.background.start(picture, self.kept.cam_from_model)
            self._is_followed = True
        self.background.follow(image, pose)

    def stop_background(self) -> None:
        """Where the specimen should be is not known any longer."""
        self.background.homography = None

    @property
    def is_certain(self) -> bool:
        """Whether the pose of the kept view is certainly right."""
        return self._kept_quality >= SURE_QUALITY

    @property
    def is_new(self) -> bool:
        """Whether the pose of this frame was found anew, or is far from that of the frame before."""
        return self._last is None or self._is_jump()

    def placement(self, image: NDArray[np.uint8], pose: Array, is_sure: bool) -> Placement:
        """Whether the followed specimen would be at a pose (4,4) of this frame."""
        if self.kept is None:
            return Placement.SAME
        if is_sure and self._frames_unsure == 0 and not self._is_jump():
            return Placement.SAME
        self.follow_background(image, pose)
        if self.is_new:
            self.background.match(pose)
        placement = self.compared(pose)
        is_brief = self._frames_unsure <= MAX_UNKNOWN_FRAMES
        if placement is Placement.UNKNOWN and (is_brief or self._last is not None):
            near = self._last or self._outline.place(self.kept.cam_from_model)
            if self._present is not None and not self._is_shifted(near, self._present):
                return Placement.SAME
        return Placement.SAME if self.is_on_way(pose) else placement

    def is_on_way(self, pose: Array) -> bool:
        """Whether the specimen's own motion before a short gap leads to a pose (4,4)."""
        return self._own_motion.leads_to(self.frame, pose)

    def compared(self, pose: Array) -> Placement:
        """Where a pose (4,4) is, compared with the place to which the background takes the followed specimen."""
        homography = self.background.homography
        if homography is None or self.kept is None:
            return Placement.UNKNOWN
        before, now = self._outline.place(self.kept.cam_from_model), self._outline.place(pose)
        pixel, scale, _ = transfer(homography, before.center_px)
        expected_mm = before.distance_mm / scale
        diameter_px = max(now.diameter_px, before.diameter_px * scale)
        is_aside = np.linalg.norm(pixel - now.center_px) > SAME_PLACE * diameter_px
        is_along = abs(now.distance_mm - expected_mm) > self._max_depth_mm(expected_mm)
        return Placement.AWAY if is_aside or is_along else Placement.SAME

    def _is_jump(self) -> bool:
        """Whether the pose of this frame is far from that of the frame before."""
        if self._last is None or self._present is None:
            return False
        return self._is_shifted(self._last, self._present)

    def _is_shifted(self, a: PartPlace, b: PartPlace) -> bool:
        """Whether two places are farther apart than a part moves between two frames."""
        shift = np.linalg.norm(a.center_px - b.center_px) / max(a.diameter_px, b.diameter_px)
        depth_mm = abs(a.distance_mm - b.distance_mm)
        return bool(shift > MAX_JUMP or depth_mm > self._max_depth_mm(a.distance_mm))

    def _max_depth_mm(self, distance_mm: float) -> float:
        """Difference in distance up to which two poses are in one place."""
        return max(SAME_DEPTH * self._outline.views.diameter_mm, SAME_DEPTH_SHARE * distance_mm)
