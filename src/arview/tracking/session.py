"""TrackingSession: tracks one part, several parts, or several specimens of one, in one stream.

Two specimens are never at one place: what is tracked is hidden from the search for the others, and of two specimens
that meet the younger one gives way. Other parts that are tracked are hidden only in every second round of searches,
because a part may stand on another. At most one specimen is searched for in a frame, in turn, and rarely while others
are tracked, so that a frame takes about as long as with one part. A guessed camera is replaced, while one part is
tracked, once its focal length has been determined.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from arview.cad import Model
from arview.camera import Camera
from arview.core.messages import sentence
from arview.errors import InputError
from arview.fiducials import SerialNumbers
from arview.geometry import Array, check_rigid
from arview.guideviews import GuideViewSet
from arview.pose import Pose, TrackingState
from arview.tracking.estimate import PosePrior
from arview.tracking.self_calibration.camera_estimate import CameraEstimate
from arview.tracking.self_calibration.estimator import FocalEstimate
from arview.tracking.self_calibration.focal_watch import FocalWatch
from arview.tracking.session_options import SessionOptions
from arview.tracking.several.specimens import CoveredPlace, is_same_specimen
from arview.tracking.specimen import SpecimenTracking

DEPTH_JUMP = 0.06
"""Relative change of the distance between two frames after which the focal length is looked at anew."""
SEARCH_EVERY = 3
"""While any specimen is tracked, the others are searched for only in every n-th frame."""
EAGER_FRAMES = 6
"""Frames without a pose in which they may be searched for in every frame all the same."""


@dataclass(frozen=True, eq=False)
class TrackedPart:
    """A specimen to be tracked.

    Attributes:
        views: guide views of the part; specimens with the same ones are of one part.
        model: of the guide views.
        name: tells the specimen from the others, see `Pose.instance`; empty for the only one.
        serials: serial number to which its labels belong, to be read from codes in the frames; None: codes are not
            read.
        initial_cam_from_model: (4,4) mm, rough pose in the first frame, which is refined instead of a search.
        guide_cam_from_model: (4,4) mm, pose near which the part is first found, when it is brought there.
        labels_at: index of a frame, and pixel in it, at which the specimen is to which the labels belong; None: it is
            the one that is tracked.
    """

    views: GuideViewSet
    model: Model
    name: str = ""
    serials: SerialNumbers | None = None
    initial_cam_from_model: Array | None = None
    guide_cam_from_model: Array | None = None
    labels_at: tuple[int, tuple[float, float]] | None = None


class TrackingSession:
    """Tracks specimens through a stream of frames; they are numbered from 0.

    Args:
        parts: the specimens.
        camera: of the frames.
        options: see `SessionOptions`.
        is_guessed: whether the focal length is estimated and the camera replaced; with several parts it is kept.

    Attributes:
        specimens: the tracking of each specimen.
        camera_estimate: the estimation of a guessed camera; None where it is kept.

    Raises:
        MismatchError: guide views belong to another model.
        InputError: no part, a pose that is not a rigid transform, or a pixel outside the picture.
    """

    def __init__(
        self,
        parts: Sequence[TrackedPart],
        camera: Camera,
        options: SessionOptions | None = None,
        *,
        is_guessed: bool = False,
    ) -> None:
        if not parts:
            raise InputError("TrackingSession: no part given")
        self._parts, self._given_camera, self._options = tuple(parts), camera, options
        first: dict[int, SpecimenTracking] = {}
        specimens = []
        for part in parts:
            specimen = self._start(part, camera, part.initial_cam_from_model, first.get(id(part.views)))
            first.setdefault(id(part.views), specimen)
            specimens.append(specimen)
        self.specimens = tuple(specimens)
        is_estimated = is_guessed and len(parts) == 1
        self.camera_estimate = CameraEstimate(parts[0].views, camera) if is_estimated else None
        self.focal_watch = None if is_guessed else FocalWatch(parts[0].views, camera)
        self._poses: dict[int, Pose] = {}
        self._followed_frames = [0] * len(parts)
        self._missing_frames = [0] * len(parts)
        self._turn = self._frames = 0
        self._began_s: float | None = None
        self._depth_mm = 0.0

    @classmethod
    def of(
        cls,
        views: GuideViewSet,
        camera: Camera,
        model: Model,
        options: SessionOptions | None = None,
        *,
        initial_cam_from_model: Array | None = None,
        guide_cam_from_model: Array | None = None,
        serials: SerialNumbers | None = None,
        is_guessed: bool = False,
    ) -> TrackingSession:
        """A session for one part; see `TrackedPart` and `TrackingSession` for the arguments."""
        part = TrackedPart(
            views,
            model,
            serials=serials,
            initial_cam_from_model=initial_cam_from_model,
            guide_cam_from_model=guide_cam_from_model,
        )
        return cls([part], camera, options, is_guessed=is_guessed)

    def __repr__(self) -> str:
        states = ", ".join(
            f"{part.model.name} {one.state}" for part, one in zip(self._parts, self.specimens, strict=True)
        )
        return f"<TrackingSession {states}, {self.camera!r}>"

    @property
    def camera(self) -> Camera:
        """The camera in use."""
        return self._given_camera if self.camera_estimate is None else self.camera_estimate.camera

    @property
    def estimate(self) -> FocalEstimate | None:
        """The last estimate of a guessed camera; None without one."""
        return None if self.camera_estimate is None else self.camera_estimate.last

    def camera_of(self, index: int) -> Camera:
        """The camera with which the frame of an index was tracked."""
        return self._given_camera if self.camera_estimate is None else self.camera_estimate.camera_of(index)

    def expect(self, serials: Sequence[SerialNumbers | None]) -> None:
        """Serial numbers to which the labels of the specimens belong from now on."""
        for specimen, numbers in zip(self.specimens, serials, strict=True):
            specimen.identity.expect(numbers)

    def reset(self, number: int | None = None) -> None:
        """Forget the pose of a specimen, or of all of them, and search again; camera and appearance are kept."""
        for specimen in self.specimens if number is None else [self.specimens[number]]:
            specimen.reset()

    def confirm(self, number: int | None = None) -> None:
        """The user says that a specimen tracked now is the one to which its labels belong, see `Identity`.

        Without a number it is the only specimen; of several none is confirmed, as it is not known which one is meant.
        """
        if number is not None or len(self.specimens) == 1:
            self.specimens[number or 0].confirm()

    def process(
        self,
        image: NDArray[np.uint8],
        index: int | None = None,
        time_s: float | None = None,
        *,
        prior: PosePrior | None = None,
    ) -> tuple[Pose, ...]:
        """Pose and state of each specimen in the next frame.

        Args:
            image: (H,W,3) uint8 RGB of the camera's size.
            index: index of the frame, copied into the poses; default: the number of frames before it.
            time_s: time stamp of the frame, copied into the poses; default: since the first frame, by the clock.
            prior: what a robot, a station or the phone itself knows of the pose of the only specimen in this frame. The
                part is followed from there, too, and searched for there first; by the covariances the pose becomes the
                mean of both, unless they contradict each other.

        Raises:
            InputError: an image of another size or type, or a prior that is no pose, or of which of several specimens
                is not known.
        """
        self._began_s = time.monotonic() if self._began_s is None else self._began_s
        index = self._frames if index is None else index
        prior = None if prior is None else self._checked_prior(prior)
        time_s = time.monotonic() - self._began_s if time_s is None else time_s
        searched = self._searched()
        # What is tracked comes first, because it is hidden from the search.
        examined = [*(number for number, one in enumerate(self.specimens) if one.has_pose), *searched]
        for number in examined:
            others, covers = self._others(number), self._covers(number)
            pose = self.specimens[number].process(image, index, time_s, others, covers, prior)
            name = self._parts[number].name
            self._poses[number] = replace(pose, instance=name) if name else pose
        for number in set(range(len(self.specimens))).difference(examined):
            self._poses[number] = self._waiting(number, index, time_s)
        self._separate()
        if self.camera_estimate is not None:
            self._poses[0] = self._calibrated(image, self._poses[0], self.camera_estimate)
        self._poses[0] = self._checked(image, self._poses[0])
        for number, pose in self._poses.items():
            is_followed = pose.cam_from_model is not None
            self._followed_frames[number] = self._followed_frames[number] + 1 if is_followed else 0
            self._missing_frames[number] = 0 if is_followed else self._missing_frames[number] + 1
        return tuple(self._poses[number] for number in range(len(self.specimens)))

    def _checked_prior(self, prior: PosePrior) -> PosePrior:
        """A prior as float64; raises InputError where it cannot be used."""
        if len(self.specimens) > 1:
            raise InputError("prior: several specimens are tracked, so that it is not known which one it is of")
        pose, covariance = check_rigid(prior.cam_from_model, "prior"), prior.covariance
        if covariance is not None:
            covariance = np.asarray(covariance, dtype=np.float64)
            is_sound = covariance.shape == (6, 6) and bool(np.isfinite(covariance).all())
            if not is_sound or np.linalg.eigvalsh(covariance)[0] < 0.0:
                raise InputError(
                    "prior: its covariance must be 6×6 (rad, mm), finite and positive; leave it out instead"
                )
        return PosePrior(pose, covariance)

    def finish(self) -> FocalEstimate | None:
        """The estimate of a guessed camera from all frames, after the last one; None where it is not estimated."""
        return None if self.camera_estimate is None else self.camera_estimate.finish()

    def _start(
        self, part: TrackedPart, camera: Camera, start: Array | None, like: SpecimenTracking | None
    ) -> SpecimenTracking:
        """The tracking of a specimen with a camera, from a rough pose (4,4) on if there is one."""
        specimen = SpecimenTracking(
            part.views,
            camera,
            part.model,
            self._options,
            initial_cam_from_model=start,
            guide_cam_from_model=part.guide_cam_from_model,
            like=like,
            serials=part.serials,
        )
        if part.labels_at is not None:
            specimen.name_at(*part.labels_at)
        return specimen

    def _calibrated(self, image: NDArray[np.uint8], pose: Pose, estimate: CameraEstimate) -> Pose:
        """The pose of the only specimen, with a better camera from this frame on if there is one."""
        camera = estimate.better_camera()
        if camera is not None and pose.cam_from_model is not None:
            # A specimen is bound to its camera: another one goes on from the pose that shows the same picture.
            start = estimate.equal_pose(pose.cam_from_model, camera)
            specimen = self._start(self._parts[0], camera, start, None)
            found = specimen.process(image, pose.index, pose.time_s)
            if specimen.has_pose:
                specimen.identity.take_over(self.specimens[0].identity)
                pose = replace(specimen.identity.stated(found), instance=pose.instance)
                self.specimens = (specimen,)
                estimate.replace(pose.index, camera)
        estimate.add(image, pose)
        return pose

    def _checked(self, image: NDArray[np.uint8], pose: Pose) -> Pose:
        """The pose of the first specimen, critical where the picture contradicts the focal length."""
        watch, before_mm = self.focal_watch, self._depth_mm
        if watch is None or pose.cam_from_model is None:
            return pose
        self._depth_mm = float(pose.cam_from_model[2, 3])
        has_jumped = before_mm > 0.0 and abs(math.log(max(self._depth_mm, 1.0) / before_mm)) > DEPTH_JUMP
        if watch.contradiction is None and not has_jumped and self._frames < watch.due:
            return pose
        return watch.checked(image, pose, self._frames, has_jumped)

    def _searched(self) -> list[int]:
        """The specimen without a pose whose turn it is to be searched for in this frame; none if all have one."""
        waiting = [number for number, one in enumerate(self.specimens) if not one.has_pose]
        self._frames += 1
        if len(waiting) < len(self.specimens) and self._frames % SEARCH_EVERY:
            waiting = [number for number in waiting if self._missing_frames[number] < EAGER_FRAMES]
        if not waiting:
            return []
        self._turn += 1
        return [waiting[(self._turn - 1) % len(waiting)]]

    def _waiting(self, number: int, index: int, time_s: float) -> Pose:
        """Result of a specimen that is not searched for in this frame, because another one is."""
        last = self._poses.get(number)
        reason = sentence("tracking.other_first") if last is None else last.reason
        state, name = self.specimens[number].state, self._parts[number].name
        return Pose(None, None, 0.0, state, time_s, index, reason=reason, instance=name)

    def _others(self, number: int) -> tuple[Array, ...]:
        """Poses (4,4) of the other specimens of the same part."""
        poses = [pose for other, pose in self._poses.items() if other != number and self._is_same_part(other, number)]
        return tuple(pose.cam_from_model for pose in poses if pose.cam_from_model is not None)

    def _covers(self, number: int) -> tuple[CoveredPlace, ...]:
        """Where other parts are tracked without doubt, which need not be searched for this one."""
        return tuple(
            CoveredPlace(pose.cam_from_model, self._parts[other].views)
            for other, pose in sorted(self._poses.items())
            if pose.state is TrackingState.TRACKED
            and pose.cam_from_model is not None
            and not self._is_same_part(other, number)
        )

    def _is_same_part(self, a: int, b: int) -> bool:
        """Whether two specimens are of one part."""
        return self._parts[a].views is self._parts[b].views

    def _separate(self) -> None:
        """Where two specimens are followed to one place, the one that was followed for longer keeps it."""
        numbers = sorted(range(len(self.specimens)), key=lambda number: -self._followed_frames[number])
        for position, number in enumerate(numbers):
            pose = self._poses[number]
            kept = [self._poses[other] for other in numbers[:position] if self._is_same_part(other, number)]
            if pose.cam_from_model is None or not any(self._is_at(pose.cam_from_model, one, number) for one in kept):
                continue
            specimen = self.specimens[number]
            specimen.give_up("another specimen is where it was followed to")
            waiting = self._waiting(number, pose.index, pose.time_s)
            self._poses[number] = replace(waiting, ms=pose.ms, reason=specimen.reason)

    def _is_at(self, cam_from_model: Array, other: Pose, number: int) -> bool:
        """Whether a pose (4,4) of a specimen is at the place of another specimen."""
        place = other.cam_from_model
        return place is not None and is_same_specimen(cam_from_model, place, self._parts[number].views)
