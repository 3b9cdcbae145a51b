"""SeveralSessions: tracks several parts, or several specimens of one part, in one stream.

Each has a session of its own. Two specimens are never at one place: what is tracked is hidden from the search for the
others, and of two sessions that meet the younger one gives way. Other parts that are tracked are hidden only in every
second round of searches, because a part may stand on another. At most one session searches in a frame, in turn, and
rarely while others are tracked, so that a frame takes about as long as with one part.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace

import numpy as np
from numpy.typing import NDArray

from arview.errors import InputError
from arview.geometry import Array
from arview.pose import Pose, TrackingState
from arview.tracking.session import TrackingSession
from arview.tracking.several.specimens import CoveredPlace, is_same_specimen


class SeveralSessions:
    """Tracks several specimens, each by a session of its own.

    Args:
        sessions: by the names of the specimens, which are the `Pose.instance` of their poses. Sessions of the same
            guide views track specimens of the same part.
        search_every: while any of them is tracked, the others search only in every n-th frame.
        eager_frames: frames without a pose in which they may search in every frame all the same.

    Raises:
        InputError: no session, or sessions of different cameras.
    """

    def __init__(self, sessions: Mapping[str, TrackingSession], search_every: int = 3, eager_frames: int = 6) -> None:
        if not sessions:
            raise InputError("several parts: no session given")
        first = next(iter(sessions.values()))
        if not all(is_equal(one.frames.camera, first.frames.camera) for one in sessions.values()):
            raise InputError("several parts: the sessions have different cameras; make them all for the same camera")
        self.sessions = dict(sessions)
        self._search_every, self._eager_frames = search_every, eager_frames
        self._poses: dict[str, Pose] = {}
        self._age = dict.fromkeys(self.sessions, 0)
        self._missing = dict.fromkeys(self.sessions, 0)
        self._turn = self._frames = 0

    def process(self, image: NDArray[np.uint8], index: int, time_s: float) -> tuple[Pose, ...]:
        """Poses of all specimens in the next frame, in the order of the sessions.

        Args:
            image: (H,W,3) uint8 RGB of the camera's size.
            index: index of the frame, copied into the poses.
            time_s: time stamp of the frame, copied into the poses.

        Raises:
            InputError: an image of another size or type.
        """
        searching = self._searching()
        # What is tracked comes first, because it is hidden from the search.
        for name in (*(one for one in self.sessions if one not in self._without_pose()), *searching):
            session = self.sessions[name]
            session.others, session.covers = self._others(name), self._covers(name)
            self._poses[name] = replace(session.process(image, index, time_s), instance=name)
        for name in self._without_pose():
            if name not in searching:
                self._poses[name] = self._waiting(name, index, time_s)
        self._separate()
        for name, pose in self._poses.items():
            is_followed = pose.cam_from_model is not None
            self._age[name] = self._age[name] + 1 if is_followed else 0
            self._missing[name] = 0 if is_followed else self._missing[name] + 1
        return tuple(self._poses[name] for name in self.sessions)

    def _without_pose(self) -> list[str]:
        return [name for name, session in self.sessions.items() if not session.has_pose]

    def _searching(self) -> list[str]:
        """The session without a pose whose turn it is to search in this frame; none if all have one."""
        waiting = self._without_pose()
        self._frames += 1
        if len(waiting) < len(self.sessions) and self._frames % self._search_every:
            waiting = [name for name in waiting if self._missing[name] < self._eager_frames]
        if not waiting:
            return []
        self._turn += 1
        return [waiting[(self._turn - 1) % len(waiting)]]

    def _waiting(self, name: str, index: int, time_s: float) -> Pose:
        """Result of a session that does not search in this frame, because another one does."""
        session = self.sessions[name]
        reason = self._poses[name].reason if name in self._poses else "another part is searched for first"
        return Pose(None, None, 0.0, session.state, time_s, index, reason=reason, instance=name)

    def _others(self, name: str) -> tuple[Array, ...]:
        """Poses (4,4) of the other specimens of the same part."""
        own = self.sessions[name].views
        poses = (self._poses.get(other) for other, one in self.sessions.items() if other != name and one.views is own)
        return tuple(pose.cam_from_model for pose in poses if pose is not None and pose.cam_from_model is not None)

    def _covers(self, name: str) -> tuple[CoveredPlace, ...]:
        """Where other parts are tracked without doubt, which need not be searched for this one."""
        own = self.sessions[name].views
        found = []
        for other, one in self.sessions.items():
            pose = self._poses.get(other)
            is_sure = pose is not None and pose.state is TrackingState.TRACKED
            if other != name and one.views is not own and pose is not None and is_sure:
                assert pose.cam_from_model is not None
                found.append(CoveredPlace(pose.cam_from_model, one.views))
        return tuple(found)

    def _separate(self) -> None:
        """Where two sessions follow one specimen, the one that has followed for longer keeps it."""
        names = sorted(self.sessions, key=lambda one: -self._age[one])
        for number, name in enumerate(names):
            session, pose = self.sessions[name], self._poses[name].cam_from_model
            if pose is None:
                continue
            for other in names[:number]:
                kept = self._poses[other].cam_from_model
                if kept is None or self.sessions[other].views is not session.views:
                    continue
                if is_same_specimen(pose, kept, session.views):
                    session.give_up("another specimen is where it was followed to")
                    last = self._poses[name]
                    self._poses[name] = replace(
                        self._waiting(name, last.index, last.time_s), ms=last.ms, reason=session.reason
                    )
                    break


def is_equal(one: object, other: object) -> bool:
    """Whether two cameras have the same values; arrays in dataclasses cannot be compared by ``==``."""
    if one is other:
        return True
    if is_dataclass(one) and is_dataclass(other) and type(one) is type(other):
        return all(is_equal(getattr(one, of.name), getattr(other, of.name)) for of in fields(one))
    return bool(np.array_equal(np.asarray(one), np.asarray(other)))
