"""IdentityMonitor: follows one specimen through losses and jumps of its pose, and says when it may be another one.

A specimen that is tracked from frame to frame stays the same. After a gap, or a jump, its pose is compared with the
place at which it should be (`followed_place`). There it is the same specimen. Elsewhere it was moved, or it is another
one: until that is settled (`doubt`) labels are withheld. The user, or a code on the part, settles it at once.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from arview.camera import Camera
from arview.core.messages import sentence
from arview.errors import InputError
from arview.fiducials import SerialCodeReader, SerialNumbers
from arview.geometry import Array
from arview.guideviews import GuideViewSet
from arview.pose import Identity, Pose
from arview.tracking.estimate import Estimate
from arview.tracking.identity.doubt import MOVED, Doubt, DoubtExamination
from arview.tracking.identity.followed_place import FollowedPlace, Placement
from arview.tracking.identity.part_outline import PartOutline
from arview.tracking.identity.specimen_search import PIXEL_MARGIN, FindsAnywhere, FindsNear, SpecimenSearch

IS_USED = True
"""Look after the identity at all; without it every pose is ``followed``."""
MIN_QUALITY = 0.5
"""Quality from which a pose counts as tracked."""
RETURN_S = 10.0
"""Time after the doubt arose for which the old place is followed."""

CHECKING = sentence("identity.checking")


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


class IdentityMonitor:
    """Says of every pose of a session whether it is that of the specimen that was followed.

    Args:
        views: guide views of the part.
        camera: intrinsics of the frames.
        find_near: the search for the part around a pose.
        find_anywhere: the search for it in a whole picture.
        serials: serial number of the followed specimen, and which codes name one; None: codes are not read.
    """

    def __init__(
        self,
        views: GuideViewSet,
        camera: Camera,
        find_near: FindsNear,
        find_anywhere: FindsAnywhere,
        serials: SerialNumbers | None = None,
    ) -> None:
        self.outline = PartOutline(views, camera)
        self._search = SpecimenSearch(self.outline, find_near, find_anywhere)
        self._place = FollowedPlace(self.outline)
        self._examination = DoubtExamination(self.outline, self._place, self._search)
        self._serials = serials
        self._reader = None if serials is None else SerialCodeReader(serials)
        self._named_at: tuple[int, Array] | None = None
        self.reset()

    @property
    def last_pose(self) -> Array | None:
        """The last pose (4,4) of the followed specimen without doubt; None without one."""
        return None if self._place.kept is None else self._place.kept.cam_from_model

    def reset(self) -> None:
        """Forget the followed specimen; the next one that is tracked is it."""
        self._known, self._known_reason, self._serial = Identity.FOLLOWED, "", ""
        self._is_confirmed_by_user = False
        self._doubt: Doubt | None = None
        self._place.reset()

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
            self._place.release()

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
        others: tuple[Array, ...] = (),
        is_confirmed: bool = True,
    ) -> IdentityResult:
        """Identity of the specimen in a frame.

        Args:
            image: (H,W,3) uint8 RGB.
            estimate: of the tracker; None without a pose.
            index: of the frame.
            time_s: time stamp of the frame.
            others: poses (4,4) of other specimens that are tracked.
            is_confirmed: whether the pose has been supported clearly since it was found.
        """
        if not IS_USED:
            return IdentityResult()
        self._place.begin_frame(None if estimate is None else estimate.cam_from_model)
        moved_to = self._at_named_pixel(image, estimate, index)
        if moved_to is not None or estimate is None:
            if self._doubt is not None and not self._doubt.reason:
                self._doubt = None
            self._place.miss(image)
            return self._result(moved_to)
        pose = estimate.cam_from_model
        is_sure = is_confirmed and estimate.quality >= MIN_QUALITY and not estimate.is_restless
        if self._doubt is not None:
            self._go_on_doubting(image, pose, self._doubt, time_s)
        elif self._place.placement(image, pose, is_sure) is Placement.SAME:
            self._place.follow(image, estimate, is_sure, others)
        else:
            self._doubt = Doubt(time_s, time_s)
        if self._doubt is not None:
            moved_to = self._examination.examine(image, pose, is_sure, self._doubt, time_s, others)
            if self._doubt.is_settled:
                self._settle(self._known)
        self._read_code(image, pose, is_sure)
        return self._result(moved_to)

    def _go_on_doubting(self, image: NDArray[np.uint8], pose: Array, doubt: Doubt, time_s: float) -> None:
        """Follow the old place in one more frame of a doubt; a pose found anew, or a jump, begins a doubt anew."""
        is_new = self._place.is_new
        if is_new:
            self._doubt = Doubt(time_s, time_s, reason=doubt.reason)
        elif time_s - doubt.since_s > RETURN_S:
            self._place.stop_background()
            return
        self._place.follow_background(image, pose)
        if is_new:
            self._place.background.match(pose)

    def _settle(self, identity: Identity, reason: str = "") -> None:
        """The identity is known again; the next sure frame is kept."""
        self._known, self._known_reason = identity, reason
        self._doubt = None
        self._place.release()

    # --- What the user and codes say ----------------------------------------------------------------------

    def _at_named_pixel(self, image: NDArray[np.uint8], estimate: Estimate | None, index: int) -> Array | None:
        """Confirm the specimen at the named pixel; a pose (4,4) if it is another than the tracked one."""
        if self._named_at is None or index < self._named_at[0] or estimate is None:
            return None
        first, pixel = self._named_at
        if self.outline.contains(estimate.cam_from_model, pixel, PIXEL_MARGIN):
            self.confirm()
            return None
        self._named_at = None
        other = self._search.at_pixel(image, estimate.cam_from_model, pixel)
        if other is not None:
            self.confirm()
            return other
        self._place.release()
        reason = sentence("identity.not_found", place=f"{pixel[0]:g},{pixel[1]:g}", frame=first)
        self._doubt = Doubt(math.inf, math.inf, reason=reason)
        return None

    def _read_code(self, image: NDArray[np.uint8], pose: Array, is_sure: bool) -> None:
        """Read a serial code on the part, now and then."""
        if self._reader is None or self._serials is None or not is_sure or self._is_confirmed_by_user:
            return
        is_settled = bool(self._serial) and self._doubt is None
        if not self._reader.is_due(self._place.frame, is_settled):
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
            reason = sentence("identity.code", serial=serial, inspected=str(serials.serial))
            self._settle(Identity.OTHER, reason)

    def _result(self, moved_to: Array | None) -> IdentityResult:
        if self._named_at is not None:
            index, (x, y) = self._named_at
            reason = sentence("identity.belongs", place=f"{x:g},{y:g}", frame=index)
            return IdentityResult(Identity.UNCONFIRMED, reason, self._serial, moved_to)
        if self._doubt is not None:
            return IdentityResult(Identity.UNCONFIRMED, self._doubt.reason or CHECKING, self._serial, moved_to)
        return IdentityResult(self._known, self._known_reason, self._serial, moved_to)
