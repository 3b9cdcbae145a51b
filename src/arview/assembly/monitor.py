"""Is every component where the CAD has it? A similar part is tracked as well, though one component is wrong.

The base and all other components determine the pose, so a component that is missing, misplaced or replaced leaves its
own edges unsupported. Observations of single pictures (`observation`) give log odds that each component is not at its
nominal placement; here they add up over pictures from different directions until a threshold is passed, as in Wald's
sequential test (1945). One set of fitted weights serves all parts.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from arview.assembly.direction_evidence import DirectionEvidence, DirectionOptions
from arview.assembly.observation import ComponentObserver, Observation, ObservationOptions
from arview.cad.model import Model
from arview.camera import Camera
from arview.geometry import Array
from arview.guideviews import GuideViewSet


@dataclass(frozen=True)
class MonitorOptions:
    """When components are called mismatched or verified, and how often frames are observed.

    Attributes:
        mismatch_log_odds: a component with more becomes mismatched.
        cleared_log_odds: a mismatched component with less is cleared; other components with more are uncertain.
        verified_log_odds: a component with less is verified: the odds that it is not there are below 1 to 50.
        open_log_odds: a component with more is open: it is observed sooner, and at alternative placements too.
        single_log_odds: a component with more in a single picture is a mismatch of that picture.
        max_added: cap on the log odds that one observation adds against a component, because one entering the view is
            at first only partly visible.
        max_log_odds: bound on the summed log odds, in both directions.
        forgetting: share of the summed log odds that is lost with each observation.
        first_observations: frames after a lock that are all observed. No component is called mismatched before the
            last of them, because noise differs between frames.
        suspect_frames: frames between observations while a component is suspect, or while an open one becomes visible.
        open_frames: frames between observations while a component is open.
        rest_frames: frames between observations while all components are as expected. All three are for new
            directions; from a known direction the next longer interval is used.
        fresh_observations: observations from a direction before it counts as known while a component is suspect,
            because the first ones may have been blurred.
        observation: options of a single observation.
        directions: options of combining observations from one direction.
    """

    mismatch_log_odds: float = 2.4
    cleared_log_odds: float = 0.1
    verified_log_odds: float = -4.0
    open_log_odds: float = -1.0
    single_log_odds: float = 1.8
    max_added: float = 2.3
    max_log_odds: float = 6.0
    forgetting: float = 0.01
    first_observations: int = 2
    suspect_frames: int = 6
    open_frames: int = 15
    rest_frames: int = 45
    fresh_observations: int = 6
    observation: ObservationOptions = field(default_factory=ObservationOptions)
    directions: DirectionOptions = field(default_factory=DirectionOptions)


@dataclass
class MonitorState:
    """State of the components of the part in view.

    Attributes:
        log_odds: (C,) summed log odds that each is not at its nominal placement.
        directions: evidence added from each direction.
        is_mismatched: (C,) mismatched.
        is_verified: (C,) confirmed at its nominal placement.
        was_visible: (C,) visible in the last observation.
        has_suspects: the last observation had suspects.
        observations: made so far.
        frames_since: frames since the last observation.
    """

    log_odds: Array
    directions: DirectionEvidence
    is_mismatched: NDArray[np.bool_]
    is_verified: NDArray[np.bool_]
    was_visible: NDArray[np.bool_]
    has_suspects: bool = False
    observations: int = 0
    frames_since: int = 0


class AssemblyMonitor:
    """Monitors whether the components of one part are where the CAD has them, for one camera.

    Args:
        views: guide views; their directions and camera are used.
        camera: of the pictures.
        model: of the guide views.
        options: see `MonitorOptions`.
    """

    def __init__(
        self, views: GuideViewSet, camera: Camera, model: Model, options: MonitorOptions | None = None
    ) -> None:
        self.options = options or MonitorOptions()
        self._views = views
        self._has_components = len(model.components) > 1
        self._observer = ComponentObserver(views, camera, model, self.options.observation)
        self.reset()

    @property
    def mismatches(self) -> tuple[str, ...]:
        """One message for each component that is not where the CAD has it."""
        return self._messages(self._state.is_mismatched)

    @property
    def uncertain(self) -> tuple[str, ...]:
        """Names of components that must be observed again before the part is called right."""
        state = self._state
        return self._names((state.log_odds > self.options.cleared_log_odds) & ~state.is_mismatched)

    @property
    def unverified(self) -> tuple[str, ...]:
        """Names of components not yet confirmed at their nominal placement; none of a part of one component."""
        return self._names(~self._state.is_verified) if self._has_components else ()

    def reset(self) -> None:
        """Forget all observations: another part may be in view."""
        count = len(self._views.component_names)
        self._state = MonitorState(
            log_odds=np.zeros(count),
            directions=DirectionEvidence(count, self._views.center_in_model, self.options.directions),
            is_mismatched=np.zeros(count, dtype=bool),
            is_verified=np.zeros(count, dtype=bool),
            was_visible=np.zeros(count, dtype=bool),
        )

    def update(self, image: NDArray[np.uint8], cam_from_model: Array) -> None:
        """Process a frame with a good pose; it is observed only if it may add evidence.

        Args:
            image: (H,W,3) uint8 RGB of the camera's size.
            cam_from_model: (4,4) mm.
        """
        o, state = self.options, self._state
        state.frames_since += 1
        if not self._has_components or not self._is_due(cam_from_model):
            return
        observation = self.observe(image, cam_from_model, self._searched())
        state.observations += 1
        state.frames_since = 0
        state.has_suspects, state.was_visible = bool(observation.is_suspect.any()), observation.is_visible
        capped = np.minimum(observation.log_odds, o.max_added)
        added = state.directions.add(cam_from_model, capped, state.is_mismatched)
        state.log_odds = np.clip((1.0 - o.forgetting) * state.log_odds + added, -o.max_log_odds, o.max_log_odds)
        verified_below = np.where(state.is_verified, o.cleared_log_odds, o.verified_log_odds)
        state.is_verified = state.log_odds < verified_below
        if state.observations >= o.first_observations:
            mismatched_above = np.where(state.is_mismatched, o.cleared_log_odds, o.mismatch_log_odds)
            state.is_mismatched = state.log_odds > mismatched_above

    def observe(
        self, image: NDArray[np.uint8], cam_from_model: Array, is_searched: NDArray[np.bool_] | None = None
    ) -> Observation:
        """Observe all components in one picture, whatever was observed before; see `ComponentObserver.observe`."""
        return self._observer.observe(image, cam_from_model, is_searched)

    def mismatches_in(self, image: NDArray[np.uint8], cam_from_model: Array) -> tuple[str, ...]:
        """Mismatches by one picture alone; the state of the monitor is neither used nor changed."""
        if not self._has_components:
            return ()
        return self._messages(self.observe(image, cam_from_model).log_odds > self.options.single_log_odds)

    def _searched(self) -> NDArray[np.bool_]:
        """(C,) components to search for elsewhere: at first all that are open, then one after another."""
        state = self._state
        is_open = state.log_odds > self.options.open_log_odds
        if state.observations < self.options.first_observations or not is_open.any():
            return is_open
        open_indices = np.flatnonzero(is_open)
        return np.asarray(np.arange(len(is_open)) == open_indices[state.observations % len(open_indices)])

    def _is_due(self, cam_from_model: Array) -> bool:
        """Whether a frame may add evidence: the sooner, the more components are open."""
        o, state = self.options, self._state
        if state.observations < o.first_observations:
            return True
        if state.frames_since < o.suspect_frames:
            return False
        highest = float(state.log_odds.max())
        waits = (o.suspect_frames, o.open_frames, o.rest_frames, o.rest_frames)
        step = 0 if state.has_suspects or highest > o.cleared_log_odds else 1 if highest > o.open_log_odds else 2
        if step == 1 and self._shows_new(cam_from_model):
            step = 0
        if state.frames_since < waits[step]:
            return False
        is_fresh = state.directions.is_new(cam_from_model) or (
            step == 0 and state.directions.observations_from(cam_from_model) < o.fresh_observations
        )
        return is_fresh or state.frames_since >= waits[step + 1]

    def _shows_new(self, cam_from_model: Array) -> bool:
        """Whether this direction shows an open component that the last observation could not show."""
        state = self._state
        is_visible = self._observer.visible_from(cam_from_model)
        return bool(np.any((state.log_odds > self.options.open_log_odds) & ~state.was_visible & is_visible))

    def _names(self, is_meant: NDArray[np.bool_]) -> tuple[str, ...]:
        return tuple(self._views.component_names[index] for index in np.flatnonzero(is_meant))

    def _messages(self, is_wrong: NDArray[np.bool_]) -> tuple[str, ...]:
        return tuple(f"mismatch: {name} not seen where expected" for name in self._names(is_wrong))
