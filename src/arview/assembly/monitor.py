"""Is every component where the CAD has it? Presence of each, by all pictures since the part was found.

The base carries the pose; of the other components any number may be absent. Observations of single pictures
(`observation`) give log odds that each component is not at its nominal placement; here they add up over pictures from
different directions until a threshold is passed, as in Wald's sequential test (1945). One set of fitted weights serves
all parts.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from arview.assembly.direction_evidence import DirectionEvidence
from arview.assembly.loss_memory import CARRIED_SHARE, KnownBefore, LossMemory
from arview.assembly.monitor_state import MonitorState
from arview.assembly.observation import ComponentObserver, Known, Observation, base_of
from arview.assembly.present_lines import PresentLines
from arview.assembly.turned_poses import Turn, TurnedPoses
from arview.cad import Model
from arview.camera import Camera
from arview.geometry import Array, are_near, rigid
from arview.guideviews import GuideViewSet
from arview.pose import ComponentPresence, Presence, Visibility
from arview.refinement import PartView

VISIBILITIES = (Visibility.VISIBLE, Visibility.HIDDEN, Visibility.OUTSIDE)
"""In the order in which arrays number them."""


MISMATCH_LOG_ODDS = 2.0
"""A component with more becomes mismatched: it is named, and the pose is no longer sure."""
MISSING_LOG_ODDS = 4.0
"""A mismatched component with more becomes missing, or displaced. Observations from one direction do not reach it soon:
a pose that is a little wrong looks the same for a while."""
CLEARED_LOG_ODDS = 0.1
"""A mismatched component with less is cleared; other components with more are uncertain."""
VERIFIED_LOG_ODDS = -4.0
"""A component with less is verified: the odds that it is not there are below 1 to 50."""
SUSPECT_LOG_ODDS = 1.0
"""A component with more probably is not where the CAD has it."""
OPEN_LOG_ODDS = -1.0
"""A component with more is open: it is observed sooner, and at alternative placements too."""
SETTLED_LOG_ODDS = 4.5
"""A mismatched component with more is no reason to observe sooner."""
SINGLE_LOG_ODDS = 1.5
"""A component with more in a single picture is a mismatch of that picture."""
DISPLACED_LOG_ODDS = 2.4
"""A mismatched component is displaced if its alternative placement has more."""
SAME_SHIFT = 0.05
"""Alternative placements that differ by less than this share of the part's diameter are the same."""
MAX_ADDED = 1.6
"""Cap on the log odds that one observation adds against a component, because one entering the view is at first only
partly visible."""
MOTION_PX = (25.0, 45.0)
"""Motion from one frame to the next, in pixels of the observed picture, up to which a picture is sharp, and from which
on it is so blurred that edges that are not found say nothing."""
MAX_LOG_ODDS = 6.0
"""Bound on the summed log odds, in both directions."""
FORGETTING = 0.01
"""Share of the summed log odds that is lost with each observation."""
FIRST_OBSERVATIONS = 2
"""Frames after a lock that are all observed. No component is called mismatched before the last of them, because noise
differs between frames."""
INCOMPLETE_QUALITY = 0.85
"""Poses of lower quality are observed at once while components are suspect."""
URGENT_FRAMES = 2
"""Frames between observations of a pose of low quality while components are suspect."""
SUSPECT_FRAMES = 6
"""Frames between observations while a component is suspect, or while an open one becomes visible."""
OPEN_FRAMES = 15
"""Frames between observations while a component is open, or visible but not yet verified."""
REST_FRAMES = 45
"""Frames between observations while all components are as expected. This interval, ``OPEN_FRAMES`` and
``SUSPECT_FRAMES`` are for new directions; from a known direction the next longer one is used."""
FRESH_OBSERVATIONS = 6
"""Observations from a direction before it counts as known while a component is suspect, because the first ones may have
been blurred."""
INSIDE_SHARE = 0.5
"""Share of the corners of a component's box that must be in the picture."""


class AssemblyMonitor:
    """Monitors whether the components of one part are where the CAD has them, for one camera.

    Args:
        views: guide views; their directions and camera are used.
        camera: of the pictures.
        model: of the guide views.
        like: another monitor of the same part with the same options, whose preparation is shared.

    Attributes:
        is_placed: whether the pose is known to be that of the part; of one that rests on the base alone nothing is
            called missing.
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
        self._views, self._camera, self._model = views, camera, model
        self._lines: PresentLines | None = None
        self._turned: TurnedPoses = TurnedPoses(
            model.components, base_of(model), None if like is None else like._turned
        )
        self._has_components = len(model.components) > 1
        self._observer = ComponentObserver(views, camera, model)
        self._is_base = np.arange(len(model.components)) == self._observer.base
        boxes = np.array([one.bounds_in_model for one in model.components])
        # (8 C,3) corners of the boxes of the components, and (8,3) of the part's.
        self._corners = _box_corners(boxes).reshape(-1, 3)
        low, high = boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)
        self._part_corners = _box_corners(np.array([[low, high]])).reshape(-1, 3)
        self.forget()

    @property
    def mismatches(self) -> tuple[str, ...]:
        """One message for each component that is not where the CAD has it."""
        return self._messages(self._state.is_mismatched)

    @property
    def uncertain(self) -> tuple[str, ...]:
        """Names of components that must be observed again before the part is called right."""
        return self._names(self._is_uncertain())

    @property
    def unverified(self) -> tuple[str, ...]:
        """Names of components not yet confirmed at their nominal placement; none of a part of one component."""
        return self._names(~self._state.is_verified) if self._has_components else ()

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
        return bool(self._is_suspect().any())

    @property
    def may_be_bare(self) -> bool:
        """Whether most of the components may be absent: of those about which something is known no more are present."""
        known = self._memory.aside or self._state
        return int((known.is_mismatched & ~self._is_base).sum()) >= int((known.is_verified & ~self._is_base).sum())

    @property
    def better_turn(self) -> Turn | None:
        """The turn to a pose that fits clearly better; None: no other does."""
        return self._turned.better

    def turn(self, turn: Turn) -> None:
        """Take a turned pose: what was seen of a place is known of the component that belongs there now.

        If the part was lost before, and this turn had been ruled out by then, what was known then holds again.
        """
        before, was_resumed = self._state, self._is_resumed
        known = self._memory.before_turn(self._turned.index_of(turn)) if was_resumed else None
        self.reset()
        if known is not None:
            self._state, self._is_resumed = known, True
        elif before.observations:
            self._state = before.turned(turn, CARRIED_SHARE)

    def other_poses(self, cam_from_model: Array) -> tuple[Array, ...]:
        """Poses (4,4) in which the base looks the same, and of which nothing has yet shown that they are wrong."""
        if not self._is_suspect().any():
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
        self._state = before.followed_by(now, share, MAX_LOG_ODDS, CLEARED_LOG_ODDS)
        self._is_resumed = True
        if cam_from_model is not None:
            excluded, was_placed = self._memory.still_known(cam_from_model, frames_lost)
            self._turned.exclude(excluded)
            self.is_placed |= was_placed

    def forget(self) -> None:
        """Forget all observations, those set aside too."""
        self._memory = LossMemory()
        self.reset()

    def reset(self, is_placed: bool = True) -> None:
        """Forget the observations since the part was found: another part may be in view.

        Args:
            is_placed: whether the pose is known to be that of the part.
        """
        self._turned.reset()
        self.is_placed, self._is_resumed = is_placed, False
        count = len(self._views.component_names)
        self._said: tuple[tuple[int, bool, bool, bytes], Mapping[str, ComponentPresence]] | None = None
        self._state = MonitorState(
            log_odds=np.zeros(count),
            directions=DirectionEvidence(count, self._views.center_in_model),
            is_mismatched=np.zeros(count, dtype=bool),
            is_missing=np.zeros(count, dtype=bool),
            is_verified=np.zeros(count, dtype=bool),
            was_visible=np.zeros(count, dtype=bool),
            was_occluded=np.zeros(count, dtype=bool),
            alternative=np.zeros(count),
            shifts=np.zeros((count, 3)),
        )

    def update(
        self, image: NDArray[np.uint8], cam_from_model: Array, quality: float = 1.0, is_supported: bool = True
    ) -> None:
        """Process a frame; it is observed only if its pose is good and it may add evidence.

        Args:
            image: (H,W,3) uint8 RGB of the camera's size.
            cam_from_model: (4,4) mm.
            quality: of the pose; if it is low, perhaps further components are absent.
            is_supported: the pose is sure.
        """
        state = self._state
        state.frames_since += 1
        before, state.last_pose = state.last_pose, cam_from_model
        # From a new direction the lines of absent components that were not seen before are missed.
        is_urgent = quality < INCOMPLETE_QUALITY and bool(self._is_suspect().any())
        if not self._has_components or not (is_supported or is_urgent):
            return
        if not self._is_due(cam_from_model) and not (is_urgent and state.frames_since >= URGENT_FRAMES):
            return
        known = Known(state.is_verified, state.is_mismatched, self._searched())
        observation = self.observe(image, cam_from_model, known)
        state.observations += 1
        state.frames_since = 0
        state.has_suspects = bool((observation.is_suspect & ~self._is_settled()).any())
        state.was_visible, state.was_occluded = observation.is_visible, observation.is_occluded
        slow, fast = MOTION_PX
        sharp = float(np.clip((fast - self._observer.motion_px(before, cam_from_model)) / (fast - slow), 0.0, 1.0))
        capped = np.minimum(observation.log_odds, MAX_ADDED)
        capped = np.where(capped > 0.0, sharp * capped, capped)
        added = state.directions.add(cam_from_model, capped, state.is_mismatched)
        state.log_odds = np.clip((1.0 - FORGETTING) * state.log_odds + added, -MAX_LOG_ODDS, MAX_LOG_ODDS)
        self._add_alternatives(observation)
        verified_below = np.where(state.is_verified, CLEARED_LOG_ODDS, VERIFIED_LOG_ODDS)
        state.is_verified = state.log_odds < verified_below
        if state.observations >= FIRST_OBSERVATIONS:
            mismatched_above = np.where(state.is_mismatched, CLEARED_LOG_ODDS, MISMATCH_LOG_ODDS)
            state.is_mismatched = state.log_odds > mismatched_above
        if self._is_suspect().any() and is_supported:
            self._turned.compare(cam_from_model, lambda pose: self._observer.pose_evidence(image, pose))
        state.is_missing = state.is_mismatched & (state.is_missing | (state.log_odds > MISSING_LOG_ODDS))

    def present_lines(self, part: PartView, cam_from_model: Array, base_part: PartView | None = None) -> PartView:
        """The guide views of the part without the lines of components that probably are not where the CAD has them.

        Args:
            part: all guide views, always the same.
            cam_from_model: (4,4) mm pose of the present frame.
            base_part: guide views of the base alone in the frame of the part's; None: there are none.
        """
        lines = self._lines_of(part)
        return lines.update(self._is_suspect(), self._state.is_verified, cam_from_model, base_part)

    def base_lines(self, part: PartView, cam_from_model: Array, base_part: PartView | None = None) -> PartView:
        """As `present_lines` where only the base was found: the others are left out until they are seen."""
        return self._lines_of(part).update(~self._is_base, self._is_base, cam_from_model, base_part)

    def _lines_of(self, part: PartView) -> PresentLines:
        """The lines of the part by their components, made when first needed."""
        self._lines = self._lines or PresentLines(self._model, part, self._observer.base)
        return self._lines

    def is_same_but_turned(self, a: Array, b: Array, same_mm: float, same_deg: float) -> bool:
        """Whether two poses (4,4) are the same within bounds, or would be if the base had no other components."""
        turns = [np.eye(4), *(turn.model_from_model for turn in self._turned.turns)]
        return any(are_near(a @ turn, b, same_mm, same_deg) for turn in turns)

    def shows_more(self, image: NDArray[np.uint8], pose: Array, than: Array) -> bool:
        """Whether a picture shows more components at a pose (4,4) than at another."""
        there, here = (self._observer.pose_evidence(image, one).seen.sum() for one in (pose, than))
        return bool(there > here)

    def best_turned(self, image: NDArray[np.uint8], cam_from_model: Array, frames_lost: int | None = None) -> Array:
        """Of a pose (4,4) and those in which the base looks the same, the one of which a picture shows most.

        Args:
            image: (H,W,3) uint8 RGB of the camera's size.
            cam_from_model: (4,4) mm.
            frames_lost: frames since the part was lost: if they are few it still lies as it did; None: it was not.
        """
        return self._turned.best(
            cam_from_model,
            lambda pose: self._observer.pose_evidence(image, pose),
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
        visibilities = self._visibilities(cam_from_model)
        key = (self._state.observations, is_ambiguous, self.is_placed, visibilities.tobytes())
        if self._said is None or self._said[0] != key:
            self._said = key, MappingProxyType(self._presence_now(visibilities, is_ambiguous))
        return self._said[1]

    def observe(self, image: NDArray[np.uint8], cam_from_model: Array, known: Known | None = None) -> Observation:
        """Observe all components in one picture, by default whatever was observed before; see `ComponentObserver`."""
        return self._observer.observe(image, cam_from_model, known)

    def mismatches_in(self, image: NDArray[np.uint8], cam_from_model: Array) -> tuple[str, ...]:
        """Mismatches by one picture alone; the state of the monitor is neither used nor changed."""
        if not self._has_components:
            return ()
        return self._messages(self.observe(image, cam_from_model).log_odds > SINGLE_LOG_ODDS)

    def _presence_now(self, visibilities: NDArray[np.int8], is_ambiguous: bool) -> dict[str, ComponentPresence]:
        """Presence of each component by its name, for visibilities (C,) as indices of `VISIBILITIES`."""
        state, (presences, is_open) = self._state, self._presences(is_ambiguous)
        probabilities, spreads_deg = 1.0 / (1.0 + np.exp(state.log_odds)), state.directions.spreads_deg
        return {
            name: ComponentPresence(
                presence=presences[c],
                visibility=VISIBILITIES[visibilities[c]],
                probability=0.5 if is_open[c] else float(probabilities[c]),
                observations=int(state.directions.observations[c]),
                spread_deg=float(spreads_deg[c]),
                model_from_nominal=rigid(np.eye(3), state.shifts[c]) if presences[c] is Presence.DISPLACED else None,
            )
            for c, name in enumerate(self._views.component_names)
        }

    def _presences(self, is_ambiguous: bool) -> tuple[list[Presence], NDArray[np.bool_]]:
        """Presence of each component, and (C,) those of which it depends on which of several poses is right."""
        state = self._state
        is_displaced = state.is_missing & (state.alternative > DISPLACED_LOG_ODDS)
        is_uncertain = self._is_uncertain() | state.is_mismatched
        found = np.select(
            [is_displaced, state.is_missing, state.is_verified, is_uncertain],
            [Presence.DISPLACED, Presence.MISSING, Presence.PRESENT, Presence.UNCERTAIN],
            Presence.UNVERIFIED,
        )
        is_open = np.full(len(found), is_ambiguous)
        # One that stays verified although the evidence for it has become weak does not vouch for another.
        firm = np.where(state.is_verified & (state.log_odds >= VERIFIED_LOG_ODDS), Presence.UNVERIFIED, found)
        for turn in self._turned.open_turns(state.is_verified):
            # In the turned pose each component is what was found at the place of its counterpart.
            turned = np.where(turn.counterparts >= 0, firm[turn.counterparts], Presence.UNVERIFIED)
            is_open |= (turned != found) & ((found == Presence.PRESENT) | state.is_missing)
        if not self.is_placed and self.is_bare:
            is_open |= state.is_missing
        is_open[self._observer.base] = False
        unsure = Presence.UNCERTAIN if is_ambiguous or self._is_suspect().any() else Presence.UNVERIFIED
        found[is_open] = unsure
        return [Presence(one) for one in found], is_open

    def _visibilities(self, cam_from_model: Array) -> NDArray[np.int8]:
        """(C,) visibility of each component in a frame, as indices of `VISIBILITIES`."""
        is_hidden = ~self._observer.visible_from(cam_from_model, self._state.is_mismatched) | self._state.was_occluded
        found = is_hidden.astype(np.int8)
        # Mostly the whole part is inside the picture.
        if not self._is_inside(self._part_corners, cam_from_model).all():
            is_inside = self._is_inside(self._corners, cam_from_model).reshape(8, -1)
            found[is_inside.mean(axis=0) < INSIDE_SHARE] = VISIBILITIES.index(Visibility.OUTSIDE)
        return found

    def _is_inside(self, corners: Array, cam_from_model: Array) -> NDArray[np.bool_]:
        """(N,) which points (N,3) of the model are inside the picture at a pose."""
        camera = self._camera
        in_cam = corners @ cam_from_model[:3, :3].T + cam_from_model[:3, 3]
        if in_cam[:, 2].min() <= 1.0:
            in_cam[in_cam[:, 2] <= 1.0] = [1e6, 1e6, 1.0]
        pixels = camera.project(in_cam)
        return np.asarray(((pixels >= 0) & (pixels < [camera.width, camera.height])).all(axis=1))

    def _is_uncertain(self) -> NDArray[np.bool_]:
        """(C,) components against which there is some evidence, but not enough."""
        state = self._state
        return np.asarray((state.log_odds > CLEARED_LOG_ODDS) & ~state.is_mismatched)

    def _is_suspect(self) -> NDArray[np.bool_]:
        """(C,) components that probably are not where the CAD has them."""
        return self._state.is_mismatched | (self._state.log_odds > SUSPECT_LOG_ODDS)

    def _is_settled(self) -> NDArray[np.bool_]:
        """(C,) mismatched components of which no more evidence is needed soon."""
        return self._state.is_mismatched & (self._state.log_odds > SETTLED_LOG_ODDS)

    def _add_alternatives(self, observation: Observation) -> None:
        """Add the evidence of one observation for alternative placements, as long as these are the same."""
        state = self._state
        is_searched = np.isfinite(observation.alternative)
        apart = np.linalg.norm(observation.shifts - state.shifts, axis=1)
        is_same = apart < SAME_SHIFT * self._views.diameter_mm
        seen = np.where(is_searched, np.clip(observation.alternative, -MAX_ADDED, MAX_ADDED), 0.0)
        before = np.where(is_same | ~is_searched, state.alternative, np.maximum(state.alternative - MAX_ADDED, 0.0))
        is_better = is_searched & (is_same | (seen > before))
        state.shifts = np.where(is_better[:, None], observation.shifts, state.shifts)
        total = np.where(is_same | ~is_searched, before + seen, np.maximum(before, seen))
        state.alternative = np.clip(total, 0.0, MAX_LOG_ODDS)

    def _searched(self) -> NDArray[np.bool_]:
        """(C,) components to search for elsewhere: at first all that are open, then one after another.

        After a loss it is one after another from the start, because more was known before.
        """
        state = self._state
        is_open = state.log_odds > OPEN_LOG_ODDS
        is_new = state.observations < FIRST_OBSERVATIONS and self._memory.aside is None
        if is_new or not is_open.any():
            return is_open
        open_indices = np.flatnonzero(is_open)
        return np.asarray(np.arange(len(is_open)) == open_indices[state.observations % len(open_indices)])

    def _is_due(self, cam_from_model: Array) -> bool:
        """Whether a frame may add evidence: the sooner, the more components are open."""
        state = self._state
        if state.observations < FIRST_OBSERVATIONS:
            return True
        if state.frames_since < SUSPECT_FRAMES:
            return False
        highest = float(np.where(self._is_settled(), 0.0, state.log_odds).max())
        waits = (SUSPECT_FRAMES, OPEN_FRAMES, REST_FRAMES, REST_FRAMES)
        is_open = highest > OPEN_LOG_ODDS or bool(np.any(state.was_visible & ~state.is_verified & ~state.is_missing))
        step = 0 if state.has_suspects or highest > CLEARED_LOG_ODDS else 1 if is_open else 2
        if step == 1 and self._shows_new(cam_from_model):
            step = 0
        if state.frames_since < waits[step]:
            return False
        is_fresh = state.directions.is_new(cam_from_model) or (
            step == 0 and state.directions.observations_from(cam_from_model) < FRESH_OBSERVATIONS
        )
        return is_fresh or state.frames_since >= waits[step + 1]

    def _shows_new(self, cam_from_model: Array) -> bool:
        """Whether this direction shows an open component that the last observation could not show."""
        state = self._state
        is_visible = self._observer.visible_from(cam_from_model, self._state.is_mismatched)
        return bool(np.any((state.log_odds > OPEN_LOG_ODDS) & ~state.was_visible & is_visible))

    def _names(self, is_meant: NDArray[np.bool_]) -> tuple[str, ...]:
        return tuple(self._views.component_names[index] for index in np.flatnonzero(is_meant))

    def _messages(self, is_wrong: NDArray[np.bool_]) -> tuple[str, ...]:
        return tuple(f"mismatch: {name} not seen where expected" for name in self._names(is_wrong))


def _box_corners(boxes: Array) -> Array:
    """(8,N,3) corners of boxes (N,2,3)."""
    return np.stack([np.stack([boxes[:, k >> a & 1, a] for a in range(3)], axis=1) for k in range(8)])
