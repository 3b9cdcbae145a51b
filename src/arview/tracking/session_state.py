"""State of a tracking session: what it keeps between frames, and the table of its transitions."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from arview.geometry import Array
from arview.pose import TrackingState
from arview.tracking.disambiguation import HypothesisSet


class Event(StrEnum):
    """What a frame says about the pose of the part."""

    SUPPORTED = "supported"
    """The picture supports the pose clearly."""
    WEAK = "weak"
    """The picture supports the pose weakly, or the pose was found in this frame and is still to be confirmed."""
    CONTRADICTED = "contradicted"
    """The pose fits, but another pose fits as well, or a component is not where the CAD has it."""
    FAILED = "failed"
    """There is no pose: none was found, or the last one is given up."""
    RETRACTED = "retracted"
    """A pose found at the guide view was not confirmed, and the part has not been tracked before."""


TRANSITIONS: dict[tuple[TrackingState, Event], TrackingState] = {
    (TrackingState.SEARCHING, Event.SUPPORTED): TrackingState.TRACKED,
    (TrackingState.SEARCHING, Event.WEAK): TrackingState.CRITICAL,
    (TrackingState.SEARCHING, Event.FAILED): TrackingState.SEARCHING,
    (TrackingState.TRACKED, Event.SUPPORTED): TrackingState.TRACKED,
    (TrackingState.TRACKED, Event.WEAK): TrackingState.CRITICAL,
    (TrackingState.TRACKED, Event.CONTRADICTED): TrackingState.CRITICAL,
    (TrackingState.TRACKED, Event.FAILED): TrackingState.LOST,
    (TrackingState.CRITICAL, Event.SUPPORTED): TrackingState.TRACKED,
    (TrackingState.CRITICAL, Event.WEAK): TrackingState.CRITICAL,
    (TrackingState.CRITICAL, Event.CONTRADICTED): TrackingState.CRITICAL,
    (TrackingState.CRITICAL, Event.FAILED): TrackingState.LOST,
    (TrackingState.CRITICAL, Event.RETRACTED): TrackingState.SEARCHING,
    (TrackingState.LOST, Event.SUPPORTED): TrackingState.TRACKED,
    (TrackingState.LOST, Event.WEAK): TrackingState.CRITICAL,
    (TrackingState.LOST, Event.FAILED): TrackingState.LOST,
}
"""The state after an event. Pairs that are not listed do not occur: only a pose can be contradicted or retracted."""


@dataclass
class SessionState:
    """What a session keeps between frames.

    Attributes:
        state: see `TrackingState`.
        poor_frames: frames in a row with hardly any support of the pose.
        critical_frames: frames in a row with weak support of the pose.
        frames_without_pose: frames since the last pose, or since the start.
        next_thorough_frame: number of frames without a pose from which the next searches are thorough; 0 after a loss.
        thorough_part: number of parts already made of a thorough search that is spread over several frames.
        last_search_frame: number of frames without a pose at the last search.
        searched_picture: reduced picture in which the part was searched, and since which nothing has changed; None:
            none since the loss.
        parts_left: parts of the thorough search that have not been made since then.
        is_confirmed: whether the present pose has been supported clearly in a frame since it was found.
        is_given: whether the present pose began at the initial pose of the session.
        is_supported: whether the last frame supported the pose clearly, whatever the components say.
        was_tracked: whether the part has been tracked since the last reset.
        recent_poses: the last poses (4,4) with support, at most two, oldest first.
        last_sure_pose: (4,4) the last pose that was ``tracked``.
        hypotheses: near-symmetric alternatives of the present pose.
        found_quality: 0–1, probability by what found the pose that it is right, until other views have confirmed it.
        found_direction: (3,) unit vector, in the model frame, from which the part was seen when it was found.
        lines_shown: largest number of distinct lines that the part has shown since it was found.
        reason: why the last search found nothing.
        loss_reason: why the part was lost.
    """

    state: TrackingState = TrackingState.SEARCHING
    poor_frames: int = 0
    critical_frames: int = 0
    frames_without_pose: int = 0
    next_thorough_frame: int = 0
    thorough_part: int = 0
    last_search_frame: int = 0
    searched_picture: NDArray[np.uint8] | None = None
    parts_left: int = 0
    is_confirmed: bool = False
    is_given: bool = False
    is_supported: bool = False
    was_tracked: bool = False
    recent_poses: tuple[Array, ...] = ()
    last_sure_pose: Array | None = None
    hypotheses: HypothesisSet = field(default_factory=lambda: HypothesisSet([]))
    found_quality: float = 1.0
    found_direction: Array | None = None
    lines_shown: float = 0.0
    reason: str = ""
    loss_reason: str = ""

    @property
    def has_pose(self) -> bool:
        """Whether there is a pose to follow."""
        return self.state in (TrackingState.TRACKED, TrackingState.CRITICAL)

    def apply(self, event: Event) -> None:
        """Go on to the next state.

        Raises:
            KeyError: the event cannot occur in this state.
        """
        self.state = TRANSITIONS[self.state, event]

    def begin(self, is_confirmed: bool, is_given: bool) -> None:
        """A pose was found, or given; unless it is confirmed or given, the next frame must support it."""
        self.poor_frames = self.critical_frames = 0
        self.is_confirmed, self.is_given, self.lines_shown = is_confirmed, is_given, 0.0
        self.was_tracked |= is_confirmed
        self.recent_poses = ()
        self.apply(Event.SUPPORTED if is_confirmed else Event.WEAK)

    def confirm(self) -> None:
        """The picture supports the pose clearly."""
        self.critical_frames = 0
        self.is_confirmed = self.was_tracked = True
        self.apply(Event.SUPPORTED)

    def lose(self, reason: str) -> None:
        """Give the pose up, for a reason in words."""
        self.hypotheses = HypothesisSet([])
        self.poor_frames = self.critical_frames = self.frames_without_pose = 0
        self.next_thorough_frame = self.thorough_part = self.last_search_frame = 0
        self.searched_picture, self.parts_left = None, 0
        self.is_confirmed = False
        self.reason = self.loss_reason = reason
        self.apply(Event.FAILED)

    def retract(self) -> None:
        """Give up a pose found at the guide view that the next frame did not confirm, and wait as before."""
        self.hypotheses = HypothesisSet([])
        self.poor_frames = self.critical_frames = 0
        self.apply(Event.FAILED if self.was_tracked else Event.RETRACTED)
