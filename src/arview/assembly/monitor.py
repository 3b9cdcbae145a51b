"""Is every component where the CAD has it? Presence of each, by all pictures since the part was found.

The base carries the pose; of the other components any number may be absent. Observations of single pictures
(`observation`) give log odds that each component is not at its nominal placement; they add up in `monitor_state`, are
made when `observation_schedule` says, and are put into words by `presence_report`. One set of fitted weights serves all
parts.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from arview.assembly.loss_memory import CARRIED_SHARE, KnownBefore, LossMemory
from arview.assembly.monitor_state import MonitorState
from arview.assembly.observation import ComponentObserver, Known, base_of
from arview.assembly.observation_schedule import INCOMPLETE_QUALITY, ObservationSchedule
from arview.assembly.presence_report import PresenceReport
from arview.assembly.present_lines import PresentLines
from arview.assembly.steps import StepMonitor
from arview.assembly.turned_poses import Turn, TurnedPoses
from arview.cad import Model
from arview.camera import Camera
from arview.core.messages import sentence
from arview.geometry import Array, are_near
from arview.guideviews import GuideViewSet
from arview.pose import ComponentPresence
from arview.refinement import PartView

SINGLE_LOG_ODDS = 1.5
"""A component with more in a single picture is a mismatch of that picture."""
MOTION_PX = (25.0, 45.0)
"""Motion from one frame to the next, in pixels of the observed picture, up to which a picture is sharp, and from which
on it is so blurred that edges that are not found say nothing."""


class AssemblyMonitor:
    """Monitors whether the components of one part are where the CAD has them, for one camera.

    Args:
        views: guide views; their directions and camera are used.
        camera: of the pictures.
        model: of the guide views.
        like: another monitor of the same part with the same options, whose preparation is shared.

    Attributes:
        observer: observes the components in single pictures.
        is_placed: whether the pose is known to be that of the part; of one that rests on the base alone nothing is
            called missing.
        steps: follows the steps of the assembly; None of a part without steps.
    """

    _state: MonitorState
    _is_resumed: bool

    def __init__(
        self,
        views: GuideViewSet,
        camera: Camera,
        model: Model,
        like: AssemblyMonitor | None = None,
    ) -> None:
        self._views, self._model = views, model
        self._lines: PresentLines | None = None
        self._turned: TurnedPoses = TurnedPoses(
            model.components, base_of(model), None if like is None else like._turned
        )
        self._has_components = len(model.components) > 1
        self.observer = ComponentObserver(views, camera, model)
        self._is_base = np.arange(len(model.components)) == self.observer.base
        self._schedule = ObservationSchedule(self.observer)
        self._report = PresenceReport(model, camera, self.observer, self._turned)
        self.steps = StepMonitor(model, self.observer.base) if model.steps else None
        self.forget()

    @property
    def mismatches(self) -> tuple[str, ...]:
        """One message for each component that is not where the CAD has it."""
        return _messages(self._views.component_names, self._state.is_mismatched & ~self._is_awaited)

    @property
    def uncertain(self) -> tuple[str, ...]:
        """Names of components that must be observed again before the part is called right."""
        return _named(self._views.component_names, self._state.is_uncertain & ~self._is_awaited)

    @property
    def unverified(self) -> tuple[str, ...]:
        """Names of components not yet confirmed at their nominal placement; none of a part of one component."""
        is_open = ~self._state.is_verified & ~self._is_awaited
        return _named(self._views.component_names, is_open) if self._has_components else ()

    @property
    def is_bare(self) -> bool:
        """Whether components were observed, and none but the base was seen at its nominal placement."""
        state = self._state
        return self._has_components and state.observations > 0 and not np.any(state.is_verified & ~self._is_base)

    @property
    def rests_on_base(self) -> bool:
        """Whether the pose was found by the base alone, and nothing else of the part has confirmed it since."""
        return not self.is_placed and not np.any(self._state.is_verified & ~self._is_base)

    @property
    def has_absent(self) -> bool:
        """Whether a component probably is not where the CAD has it."""
        return bool(self._state.is_suspect.any())

    @property
    def may_be_bare(self) -> bool:
        """Whether most of the components may be absent: of those about which something is known no more are present."""
        known = self._memory.aside or self._state
        return int((known.is_mismatched & ~self._is_base).sum()) >= int((known.is_verified & ~self._is_base).sum())

    @property
    def better_turn(self) -> Turn | None:
        """The turn to a pose that fits clearly better; None: no other does."""
        return self._turned.better

    def turn(self, turn: Turn | None = None) -> None:
        """Take a turned pose, the better one if none is given: what was seen of a place is known of the component that
        belongs there now.

        If the part was lost before, and this turn had been ruled out by then, what was known then holds again.
        """
        turn = turn or self._turned.better
        assert turn is not None
        before, was_resumed = self._state, self._is_resumed
        known = self._memory.before_turn(self._turned.index_of(turn)) if was_resumed else None
        self.reset()
        if known is not None:
            self._state, self._is_resumed = known, True
        elif before.observations:
            self._state = before.turned(turn, CARRIED_SHARE)

    def other_poses(self, cam_from_model: Array) -> tuple[Array, ...]:
        """Poses (4,4) in which the base looks the same, and of which nothing has yet shown that they are wrong."""
        if not self._state.is_suspect.any():
            return ()
        turns = self._turned.open_turns(self._state.is_verified)
        return tuple(cam_from_model @ turn.model_from_model for turn in turns)

    def set_aside(self, last_pose: Array | None = None) -> None:
        """Keep what is known while the part is lost, for `resume`; the last pose (4,4) that was supported, if known."""
        if self._state.observations:
            excluded, ruled_out = self._turned.excluded, self._turned.ruled_out(self._state.is_verified)
            self._memory.set_aside(KnownBefore(self._state, excluded, ruled_out, self.is_placed), last_pose)

    def resume(self, cam_from_model: Array | None = None, frames_lost: int = 0) -> None:
        """Take up what was known before the part was lost: the same specimen was found again.

        Args:
            cam_from_model: (4,4) where it was found; None: it is not known how it lies.
            frames_lost: frames without a pose.
        """
        before, now = self._memory.aside, self._state
        self._memory.aside = None
        if before is None or before is now:
            return
        share = CARRIED_SHARE
        self._state = before.followed_by(now, share)
        self._is_resumed = True
        if cam_from_model is not None:
            excluded, was_placed = self._memory.still_known(cam_from_model, frames_lost)
            self._turned.exclude(excluded)
            self.is_placed |= was_placed

    def forget(self) -> None:
        """Forget all observations, those set aside too."""
        self._memory = LossMemory()
        if self.steps is not None:
            self.steps.forget()
        self.reset()

    def reset(self, is_placed: bool = True) -> None:
        """Forget the observations since the part was found: another part may be in view.

        Args:
            is_placed: whether the pose is known to be that of the part.
        """
        self._turned.reset()
        self.is_placed, self._is_resumed = is_placed, False
        self._report.forget()
        self._state = MonitorState.unknown(len(self._views.component_names), self._views.center_in_model)
        self._is_awaited = np.zeros_like(self._is_base)
        if self.steps is not None:
            self.steps.restart()
            self._is_awaited = self.steps.is_awaited

    def update(
        self,
        image: NDArray[np.uint8],
        cam_from_model: Array,
        quality: float = 1.0,
        is_supported: bool = True,
        time_s: float = 0.0,
    ) -> None:
        """Process a frame; it is observed only if its pose is good and it may add evidence.

        Args:
            image: (H,W,3) uint8 RGB of the camera's size.
            cam_from_model: (4,4) mm.
            quality: of the pose; if it is low, perhaps further components are absent.
            is_supported: the pose is sure.
            time_s: time stamp of the frame.
        """
        state = self._state
        state.frames_since += 1
        before, state.last_pose = state.last_pose, cam_from_model
        slow, fast = MOTION_PX
        sharp = float(np.clip((fast - self.observer.motion_px(before, cam_from_model)) / (fast - slow), 0.0, 1.0))
        if self.steps is not None:
            self.steps.follow(self.observer, state, image if is_supported else None, time_s, is_sharp=sharp == 1.0)
            self._is_awaited = self.steps.is_awaited
        # From a new direction the lines of absent components that were not seen before are missed.
        is_urgent = quality < INCOMPLETE_QUALITY and bool((state.is_suspect & ~self._is_awaited).any())
        if not self._has_components or not (is_supported or is_urgent):
            return
        if not self._schedule.is_due(state, cam_from_model, is_urgent):
            return
        searched = self._schedule.searched(state, self._memory.aside is not None)
        known = Known(state.is_verified, state.is_mismatched, searched & ~self._is_awaited, self._is_awaited)
        observation = self.observer.observe(image, cam_from_model, known)
        state.add(observation, cam_from_model, sharp, self._views.diameter_mm)
        state.assume(self._is_awaited, is_there=False)
        if is_supported and state.is_suspect.any():
            self._turned.compare(cam_from_model, lambda pose: self.observer.pose_evidence(image, pose))

    def lines(
        self, part: PartView, cam_from_model: Array, base_part: PartView | None = None, is_base_only: bool = False
    ) -> PartView:
        """The guide views of the part without the lines of components that probably are not where the CAD has them.

        Args:
            part: all guide views, always the same.
            cam_from_model: (4,4) mm pose of the present frame.
            base_part: guide views of the base alone in the frame of the part's; None: there are none.
            is_base_only: only the base was found: the other components are left out until they are seen.
        """
        self._lines = self._lines or PresentLines(self._model, part, self.observer.base)
        absent = ~self._is_base if is_base_only else self._state.is_suspect
        present = self._is_base if is_base_only else self._state.is_verified
        return self._lines.update(absent, present, cam_from_model, base_part)

    def is_same_but_turned(self, a: Array, b: Array, same_mm: float, same_deg: float) -> bool:
        """Whether two poses (4,4) are the same within bounds, or would be if the base had no other components."""
        turns = [np.eye(4), *(turn.model_from_model for turn in self._turned.turns)]
        return any(are_near(a @ turn, b, same_mm, same_deg) for turn in turns)

    def best_turned(self, image: NDArray[np.uint8], cam_from_model: Array, frames_lost: int | None = None) -> Array:
        """Of a pose (4,4) and those in which the base looks the same, the one of which a picture shows most.

        Args:
            image: (H,W,3) uint8 RGB of the camera's size.
            cam_from_model: (4,4) mm.
            frames_lost: frames since the part was lost: if they are few it still lies as it did; None: it was not.
        """
        return self._turned.best(
            cam_from_model,
            lambda pose: self.observer.pose_evidence(image, pose),
            lambda pose: frames_lost is not None and self._memory.is_as_before(pose, frames_lost),
        )

    def presence(self, cam_from_model: Array, is_ambiguous: bool = False) -> Mapping[str, ComponentPresence]:
        """Presence of each component by its name; empty for a part of one component.

        Args:
            cam_from_model: (4,4) mm pose of the present frame, for the visibility.
            is_ambiguous: other poses fit as well, in which components other than the base would be elsewhere.
        """
        if not self._has_components:
            return {}
        may_be_missing = self.is_placed or not self.is_bare
        awaited = () if self.steps is None else self.steps.presences
        return self._report.presence(self._state, cam_from_model, is_ambiguous, may_be_missing, awaited)

    def mismatches_in(self, image: NDArray[np.uint8], cam_from_model: Array) -> tuple[str, ...]:
        """Mismatches by one picture alone; the state of the monitor is neither used nor changed."""
        if not self._has_components:
            return ()
        return _messages(
            self._views.component_names, self.observer.observe(image, cam_from_model).log_odds > SINGLE_LOG_ODDS
        )


def _named(names: Sequence[str], is_meant: NDArray[np.bool_]) -> tuple[str, ...]:
    return tuple(name for name, is_it in zip(names, is_meant, strict=True) if is_it)


def _messages(names: Sequence[str], is_wrong: NDArray[np.bool_]) -> tuple[str, ...]:
    return tuple(sentence("tracking.mismatch", name=name) for name in _named(names, is_wrong))
