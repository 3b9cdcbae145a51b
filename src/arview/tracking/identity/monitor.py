"""IdentityMonitor: follows one specimen through losses and jumps of its pose, and says when it may be another one.

A specimen that is tracked from frame to frame stays the same. After a gap, or a jump, its pose is compared with the
place at which the background says that it was. There it is the same specimen. Elsewhere it was moved, or it is another
one: the last picture before the gap tells whether a part was already seen at that place, this picture whether two
are in view, and the next frames whether the old place still shows one. Until that is settled labels are withheld.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from arview.camera import Camera
from arview.errors import InputError
from arview.fiducials import SerialCodeReader, SerialNumbers
from arview.geometry import Array
from arview.guideviews import GuideViewSet
from arview.pose import Identity, Pose
from arview.tracking.estimate import Estimate
from arview.tracking.identity.background_motion import MAX_SIDE_PX, BackgroundMotion, reduced
from arview.tracking.identity.own_motion import OwnMotion
from arview.tracking.identity.part_outline import PartOutline, PartPlace, transfer
from arview.tracking.identity.specimen_search import PIXEL_MARGIN, SAME_DEPTH, SAME_DEPTH_SHARE, Finders, SpecimenSearch

IS_USED = True
"""Look after the identity at all; without it every pose is ``followed``."""
QUALITY_RATE = 0.1
"""Share by which the usual quality of the followed specimen follows each frame, from 0."""
SURE_QUALITY = 0.6
"""Usual quality from which the pose of the followed specimen is certainly right; below, the detector is asked."""
MIN_QUALITY = 0.5
"""Quality from which a pose counts as tracked."""
MAX_JUMP = 0.35
"""Shift between two frames, in diameters of the part in the picture, from which a pose is compared with the place at
which the background says that the part was."""
SAME_PLACE = 0.35
"""Shift from that place, in diameters of the part in the picture, up to which a pose is the same part, because two
specimens do not stand in one place."""
MAX_UNKNOWN_FRAMES = 5
"""Frames without a sure pose up to which a pose near the last one is the same part although the motion of the
background is not known."""
WATCH_S = 0.75
"""Time for which the old place is watched before a part that was found elsewhere has its labels back."""
WATCH_EVERY_S = 0.25
"""Time between two checks of the old place."""
MIN_ROOM = 0.7
"""Share of the part's box that must lie in the picture for its place to count as seen."""
RETURN_EVERY_S = 0.35
"""Time between two checks whether the followed part is seen at its old place again."""
RETURN_S = 10.0
"""Time after the doubt arose for which the old place is followed."""

CHECKING = "checking that this is the part that was followed before"
ANOTHER_IN_VIEW = "another part of this kind is in view; confirm that this is the one"
MOVED = "this part is not where the last one was; confirm that this is the one"


class Placement(Enum):
    """Where a pose is, compared with the place at which the background says that the part was."""

    SAME = "same"
    AWAY = "away"
    UNKNOWN = "unknown"


@dataclass(frozen=True)
class IdentityResult:
    """What a frame says of the identity.

    Attributes:
        identity: see `Identity`.
        reason: why it is unconfirmed or another, or empty.
        serial: read from a code on the part, or empty.
        cam_from_model: (4,4) where the followed specimen was found instead, to be tracked from now on; None: go on.
    """

    identity: Identity = Identity.FOLLOWED
    reason: str = ""
    serial: str = ""
    cam_from_model: Array | None = None


@dataclass(frozen=True)
class KeptView:
    """The last picture in which the followed specimen was tracked without doubt.

    Attributes:
        image: (H,W,3) uint8 RGB.
        cam_from_model: (4,4) its pose there.
        others: poses (4,4) of specimens that other sessions tracked there.
    """

    image: NDArray[np.uint8]
    cam_from_model: Array
    others: tuple[Array, ...] = ()


@dataclass
class Doubt:
    """An open question whether the tracked specimen is the followed one.

    Attributes:
        since_s: time stamp of the frame in which it arose.
        next_check_s: time stamp from which the old place is checked again.
        stage: checks done: 0 none, 1 the picture before, 2 this picture.
        reason: what is known against it; empty while it is checked.
        has_seen_place: whether the place of the tracked specimen was in the picture before and showed none.
        is_placed: whether the background said where the followed specimen should be.
    """

    since_s: float
    next_check_s: float
    stage: int = 0
    reason: str = ""
    has_seen_place: bool = False
    is_placed: bool = False


class IdentityMonitor:
    """Says of every pose of a session whether it is that of the specimen that was followed.

    Args:
        views: guide views of the part.
        camera: intrinsics of the frames.
        serials: serial number of the followed specimen, and which codes name one; None: codes are not read.
    """

    def __init__(
        self,
        views: GuideViewSet,
        camera: Camera,
        serials: SerialNumbers | None = None,
    ) -> None:
        self.outline = PartOutline(views, camera)
        self._search = SpecimenSearch(self.outline)
        self._motion = BackgroundMotion(self.outline)
        self._own_motion = OwnMotion(self.outline)
        self._serials = serials
        self._reader = None if serials is None else SerialCodeReader(serials)
        self._named_at: tuple[int, Array] | None = None
        self.reset()

    @property
    def last_pose(self) -> Array | None:
        """The last pose (4,4) of the followed specimen without doubt; None without one."""
        return None if self._kept is None else self._kept.cam_from_model

    def reset(self) -> None:
        """Forget the followed specimen; the next one that is tracked is it."""
        self._known, self._known_reason, self._serial = Identity.FOLLOWED, "", ""
        self._is_confirmed_by_user = False
        self._kept: KeptView | None = None
        self._kept_quality = 0.0
        self._buffer: NDArray[np.uint8] | None = None
        self._is_followed = False
        self._others_before: list[Array] | None = None
        self._doubt: Doubt | None = None
        self._own_motion.reset()
        self._last_place: PartPlace | None = None
        self._frames_unsure = 0
        self._frame = 0

    def confirm(self) -> None:
        """The user says that the specimen tracked now is the one to which the labels belong."""
        self._settle(Identity.CONFIRMED)
        self._is_confirmed_by_user = True
        self._named_at = None

    def name_at(self, index: int, pixel: tuple[float, float]) -> None:
        """The labels belong to the specimen at a pixel of the frame of an index; they are withheld until then.

        Raises:
            InputError: the pixel is outside the picture.
        """
        camera = self.outline.camera
        x, y = pixel
        if not (0 <= x < camera.width and 0 <= y < camera.height):
            raise InputError(f"serial at {x:g},{y:g}: outside the picture of {camera.width} × {camera.height} px")
        self._named_at = (index, np.array([x, y], dtype=np.float64))

    def take_over(self, other: IdentityMonitor) -> None:
        """Go on with what another monitor knows, when the camera of a session is replaced."""
        self._known, self._known_reason, self._serial = other._known, other._known_reason, other._serial
        self._is_confirmed_by_user, self._named_at = other._is_confirmed_by_user, other._named_at
        self._serials, self._reader = other._serials, other._reader
        self._doubt = None
        if other._doubt is not None:
            # The views kept so far belong to the other camera: what is not settled by now the user must settle.
            self._doubt = Doubt(math.inf, math.inf, reason=other._doubt.reason or MOVED)
            self._kept = None

    def stated(self, pose: Pose) -> Pose:
        """A pose with the identity that is known now."""
        known = self._result(None)
        return replace(pose, identity=known.identity, identity_reason=known.reason, serial=known.serial)

    def expect(self, serials: SerialNumbers | None) -> None:
        """Read codes for another serial number from now on, as when another inspection is shown."""
        if serials == self._serials:
            return
        self._serials = serials
        self._reader = None if serials is None else SerialCodeReader(serials)
        if not self._serial:
            return
        # What was read from the part is still true; what it means is not.
        serial, self._serial = self._serial, ""
        if self._known in (Identity.OTHER, Identity.CONFIRMED) and not self._is_confirmed_by_user:
            self._known, self._known_reason = Identity.FOLLOWED, ""
        if serials is not None and serials.is_serial(serial):
            self._take_serial(serial, serials)

    def update(
        self,
        image: NDArray[np.uint8],
        estimate: Estimate | None,
        index: int,
        time_s: float,
        finders: Finders,
        is_confirmed: bool = True,
    ) -> IdentityResult:
        """Identity of the specimen in a frame.

        Args:
            image: (H,W,3) uint8 RGB.
            estimate: of the tracker; None without a pose.
            index: of the frame.
            time_s: time stamp of the frame.
            finders: the searches of the session.
            is_confirmed: whether the pose has been supported clearly since it was found.
        """
        if not IS_USED:
            return IdentityResult()
        self._frame += 1
        moved_to = self._at_named_pixel(image, estimate, index, finders)
        if moved_to is not None or estimate is None:
            self._miss(image)
            return self._result(moved_to)
        pose = estimate.cam_from_model
        self._place = self.outline.place(pose)
        is_sure = is_confirmed and estimate.quality >= MIN_QUALITY and not estimate.is_restless
        if self._doubt is None:
            placement = self._placement(image, pose, is_sure)
            self._follow(image, estimate, is_sure, placement, time_s, finders.others)
        else:
            self._go_on_doubting(image, pose, self._doubt, time_s)
        if self._doubt is not None:
            moved_to = self._examine(image, pose, is_sure, self._doubt, time_s, finders)
        self._read_code(image, pose, is_sure)
        self._last_place = self._place
        return self._result(moved_to)

    # --- Follow -------------------------------------------------------------------------------------------

    def _miss(self, image: NDArray[np.uint8]) -> None:
        """A frame without a pose: the background is followed, and a new pose is compared with the last one."""
        self._last_place = None
        self._frames_unsure += 1
        if self._doubt is not None and not self._doubt.reason:
            self._doubt = None
        self._follow_background(image, None)

    def _placement(self, image: NDArray[np.uint8], pose: Array, is_sure: bool) -> Placement:
        """Whether the followed specimen would be at a pose (4,4) of this frame."""
        if self._kept is None:
            return Placement.SAME
        if is_sure and self._frames_unsure == 0 and not self._is_jump():
            return Placement.SAME
        self._follow_background(image, pose)
        if self._last_place is None or self._is_jump():
            self._motion.match(pose)
        placement = self._compared(pose, self._motion.homography)
        is_brief = self._frames_unsure <= MAX_UNKNOWN_FRAMES
        if placement is Placement.UNKNOWN and (is_brief or self._last_place is not None):
            near = self._last_place or self.outline.place(self._kept.cam_from_model)
            if not self._is_shifted(near, self._place):
                return Placement.SAME
        return Placement.SAME if self._own_motion.leads_to(self._frame, pose) else placement

    def _follow(
        self,
        image: NDArray[np.uint8],
        estimate: Estimate,
        is_sure: bool,
        placement: Placement,
        time_s: float,
        others: tuple[Array, ...],
    ) -> None:
        """Go on with the followed specimen, or begin to doubt that this is it."""
        if placement is not Placement.SAME:
            self._doubt = Doubt(time_s, time_s)
            return
        self._frames_unsure = 0 if is_sure else self._frames_unsure + 1
        if is_sure:
            self._own_motion.add(self._frame, estimate.cam_from_model)
            self._keep(image, estimate.cam_from_model, estimate.quality, others)

    def _keep(self, image: NDArray[np.uint8], pose: Array, quality: float, others: tuple[Array, ...]) -> None:
        """Keep this picture as the last one of the followed specimen."""
        if self._buffer is None:
            self._buffer = np.empty_like(image)
        # Copied, because a source may use the memory of its frames again.
        np.copyto(self._buffer, image)
        self._kept = KeptView(self._buffer, pose, others)
        self._kept_quality += QUALITY_RATE * (quality - self._kept_quality)
        self._others_before = None
        self._is_followed = False

    def _follow_background(self, image: NDArray[np.uint8], pose: Array | None) -> None:
        """Follow the background into this frame, with the part at a pose (4,4) if it is known."""
        if self._kept is None:
            return
        if not self._is_followed:
            picture = reduced(self._kept.image, MAX_SIDE_PX)
            self._motion.start(picture, self._kept.cam_from_model)
            self._is_followed = True
        self._motion.follow(image, pose)

    def _is_jump(self) -> bool:
        """Whether the pose of this frame is far from that of the frame before."""
        return self._last_place is not None and self._is_shifted(self._last_place, self._place)

    def _is_shifted(self, a: PartPlace, b: PartPlace) -> bool:
        """Whether two places are farther apart than a part moves between two frames."""
        shift = np.linalg.norm(a.center_px - b.center_px) / max(a.diameter_px, b.diameter_px)
        depth_mm = abs(a.distance_mm - b.distance_mm)
        return bool(shift > MAX_JUMP or depth_mm > self._max_depth_mm(a.distance_mm))

    def _compared(self, pose: Array, homography: Array | None) -> Placement:
        """Where a pose (4,4) is, compared with the place to which a homography takes the followed specimen."""
        if homography is None or self._kept is None:
            return Placement.UNKNOWN
        before, now = self.outline.place(self._kept.cam_from_model), self.outline.place(pose)
        pixel, scale, _ = transfer(homography, before.center_px)
        expected_mm = before.distance_mm / scale
        diameter_px = max(now.diameter_px, before.diameter_px * scale)
        is_aside = np.linalg.norm(pixel - now.center_px) > SAME_PLACE * diameter_px
        is_along = abs(now.distance_mm - expected_mm) > self._max_depth_mm(expected_mm)
        return Placement.AWAY if is_aside or is_along else Placement.SAME

    def _max_depth_mm(self, distance_mm: float) -> float:
        """Difference in distance up to which two poses are in one place."""
        return max(SAME_DEPTH * self.outline.views.diameter_mm, SAME_DEPTH_SHARE * distance_mm)

    # --- Doubt --------------------------------------------------------------------------------------------

    def _go_on_doubting(self, image: NDArray[np.uint8], pose: Array, doubt: Doubt, time_s: float) -> None:
        """Follow the old place in one more frame of a doubt; a pose found anew, or a jump, begins a doubt anew."""
        is_new = self._last_place is None or self._is_jump()
        if is_new:
            self._doubt = Doubt(time_s, time_s, reason=doubt.reason)
        elif time_s - doubt.since_s > RETURN_S:
            self._motion.homography = None
            return
        self._follow_background(image, pose)
        if is_new:
            self._motion.match(pose)

    def _examine(
        self,
        image: NDArray[np.uint8],
        pose: Array,
        is_sure: bool,
        doubt: Doubt,
        time_s: float,
        finders: Finders,
    ) -> Array | None:
        """One step to settle a doubt; a pose (4,4) where the followed specimen is seen instead, or None."""
        placement = self._compared(pose, self._motion.homography)
        is_on_way = not doubt.reason and self._own_motion.leads_to(self._frame, pose)
        if is_sure and (placement is Placement.SAME or is_on_way):
            self._settle(self._known)
            return None
        if not is_sure or self._kept is None:
            return None
        if not doubt.reason and doubt.stage < 2:
            self._search_once(image, pose, doubt, finders)
            if doubt.stage < 2 and not doubt.is_placed and not doubt.reason:
                # Without the background the two pictures say all that can be known: both are looked at now.
                self._search_once(image, pose, doubt, finders)
            if doubt.is_placed or doubt.reason:
                return None
        if self._motion.homography is not None and time_s >= doubt.next_check_s:
            doubt.next_check_s = time_s + (RETURN_EVERY_S if doubt.reason else WATCH_EVERY_S)
            seen = self._seen_at_old_place(image, pose, finders)
            if seen is not None:
                doubt.reason = ANOTHER_IN_VIEW
                return seen if self._compared(seen, self._motion.homography) is Placement.SAME else None
        if not doubt.reason:
            self._conclude(doubt, time_s)
        return None

    def _search_once(self, image: NDArray[np.uint8], pose: Array, doubt: Doubt, finders: Finders) -> None:
        """Look for another specimen in the picture before the gap, and the next time in the present one."""
        assert self._kept is not None
        if doubt.stage == 0:
            doubt.is_placed = self._motion.homography is not None and self._motion.is_chained
            is_other = self._is_other_before(pose, doubt, finders)
        else:
            is_other = self._is_any_new(self._search.others(image, pose, finders), finders.others)
        doubt.stage += 1
        if is_other:
            doubt.reason = ANOTHER_IN_VIEW

    def _is_other_before(self, pose: Array, doubt: Doubt, finders: Finders) -> bool:
        """Whether the last picture of the followed specimen shows another one too."""
        kept = self._kept
        assert kept is not None
        homography = np.eye(3) if self._motion.homography is None else self._motion.homography
        there = self.outline.moved(pose, np.asarray(np.linalg.inv(homography), dtype=np.float64))
        if self.outline.is_in_picture(self.outline.place(there), MIN_ROOM):
            seen = self._search.at_place(kept.image, there, finders, is_turned=True)
            if seen is not None and self._is_apart(seen, kept.cam_from_model):
                return self._is_kept_right(kept, finders)
            doubt.has_seen_place = True
        if doubt.is_placed:
            return False
        if self._others_before is None:
            self._others_before = self._search.others(kept.image, kept.cam_from_model, finders)
        # A specimen that another session tracked and still tracks is not this one.
        tracked = kept.others if len(finders.others) >= len(kept.others) else ()
        return self._is_any_new(self._others_before, tracked) and self._is_kept_right(kept, finders)

    def _is_any_new(self, found: list[Array], tracked: tuple[Array, ...]) -> bool:
        """Whether any pose (4,4) found is none of those of specimens that other sessions track."""
        return any(all(self._is_apart(pose, other) for other in tracked) for pose in found)

    def _is_kept_right(self, kept: KeptView, finders: Finders) -> bool:
        """Whether the followed specimen is really there in its last picture; a wrong pose is no specimen."""
        if self._kept_quality >= SURE_QUALITY:
            return True
        return self._search.at_place(kept.image, kept.cam_from_model, finders) is not None

    def _seen_at_old_place(self, image: NDArray[np.uint8], pose: Array, finders: Finders) -> Array | None:
        """The pose (4,4) of a specimen where the background says that the followed one was; None without one."""
        if self._kept is None or self._motion.homography is None:
            return None
        guess = self.outline.moved(self._kept.cam_from_model, self._motion.homography)
        place = self.outline.place(guess)
        if not self.outline.is_in_picture(place, MIN_ROOM):
            return None
        seen = self._search.at_place(image, guess, finders)
        return seen if seen is not None and self._is_apart(seen, pose) else None

    def _is_apart(self, a: Array, b: Array) -> bool:
        """Whether two poses (4,4) of one picture are those of different specimens."""
        return self._search.is_apart(self.outline.place(a), self.outline.place(b))

    def _conclude(self, doubt: Doubt, time_s: float) -> None:
        """Settle a doubt when all checks are done: no other specimen was seen, before or now."""
        if not doubt.is_placed:
            # Nothing is known of the scene, and only one part was in view before and is in view now.
            self._settle(self._known)
        elif not doubt.has_seen_place:
            doubt.reason = MOVED
        elif time_s - doubt.since_s >= WATCH_S:
            self._settle(self._known)

    def _settle(self, identity: Identity, reason: str = "") -> None:
        """The identity is known again; the next sure frame is kept."""
        self._known, self._known_reason = identity, reason
        self._doubt = None
        self._frames_unsure = 0
        self._kept = None
        self._kept_quality = 0.0

    # --- What the user and codes say ----------------------------------------------------------------------

    def _at_named_pixel(
        self, image: NDArray[np.uint8], estimate: Estimate | None, index: int, finders: Finders
    ) -> Array | None:
        """Confirm the specimen at the named pixel; a pose (4,4) if it is another than the tracked one."""
        if self._named_at is None or index < self._named_at[0] or estimate is None:
            return None
        first, pixel = self._named_at
        if self.outline.contains(estimate.cam_from_model, pixel, PIXEL_MARGIN):
            self.confirm()
            return None
        self._named_at = None
        other = self._search.at_pixel(image, estimate.cam_from_model, pixel, finders)
        if other is not None:
            self.confirm()
            return other
        self._kept = None
        reason = f"no part of this kind found at {pixel[0]:g},{pixel[1]:g} in frame {first}; confirm the part"
        self._doubt = Doubt(math.inf, math.inf, reason=reason)
        return None

    def _read_code(self, image: NDArray[np.uint8], pose: Array, is_sure: bool) -> None:
        """Read a serial code on the part, now and then."""
        if self._reader is None or self._serials is None or not is_sure or self._is_confirmed_by_user:
            return
        is_settled = bool(self._serial) and self._doubt is None
        if not self._reader.is_due(self._frame, is_settled):
            return
        hull = self.outline.hull_px(pose)
        serial = self._reader.read(image, hull)
        if serial:
            self._take_serial(serial, self._serials)

    def _take_serial(self, serial: str, serials: SerialNumbers) -> None:
        """The part carries a serial number: it is the expected one or another."""
        self._serial = serial
        if serial == serials.serial:
            self._settle(Identity.CONFIRMED)
        elif serials.serial:
            reason = f"the code on this part says {serial}, the inspection is of {serials.serial}"
            self._settle(Identity.OTHER, reason)

    def _result(self, moved_to: Array | None) -> IdentityResult:
        if self._named_at is not None:
            index, (x, y) = self._named_at
            reason = f"the labels belong to the part at {x:g},{y:g} in frame {index}"
            return IdentityResult(Identity.UNCONFIRMED, reason, self._serial, moved_to)
        if self._doubt is not None:
            return IdentityResult(Identity.UNCONFIRMED, self._doubt.reason or CHECKING, self._serial, moved_to)
        return IdentityResult(self._known, self._known_reason, self._serial, moved_to)
