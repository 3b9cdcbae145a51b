"""ObservationSchedule: in which frames components are observed, and which of them are searched for elsewhere."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from arview.assembly.monitor_state import CLEARED_LOG_ODDS, FIRST_OBSERVATIONS, MonitorState
from arview.assembly.observation import ComponentObserver
from arview.geometry import Array

OPEN_LOG_ODDS = -1.0
"""A component with more is open: it is observed sooner, and at alternative placements too."""
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


class ObservationSchedule:
    """Chooses the frames that may add evidence.

    Args:
        observer: of the components.
    """

    def __init__(self, observer: ComponentObserver) -> None:
        self._observer = observer

    def is_due(self, state: MonitorState, cam_from_model: Array, is_urgent: bool) -> bool:
        """Whether a frame may add evidence: the sooner, the more components are open."""
        if is_urgent and state.frames_since >= URGENT_FRAMES:
            return True
        if state.observations < FIRST_OBSERVATIONS:
            return True
        if state.frames_since < SUSPECT_FRAMES:
            return False
        highest = float(np.where(state.is_settled, 0.0, state.log_odds).max())
        waits = (SUSPECT_FRAMES, OPEN_FRAMES, REST_FRAMES, REST_FRAMES)
        is_open = highest > OPEN_LOG_ODDS or bool(np.any(state.was_visible & ~state.is_verified & ~state.is_missing))
        step = 0 if state.has_suspects or highest > CLEARED_LOG_ODDS else 1 if is_open else 2
        if step == 1 and self._shows_new(state, cam_from_model):
            step = 0
        if state.frames_since < waits[step]:
            return False
        is_fresh = state.directions.is_new(cam_from_model) or (
            step == 0 and state.directions.observations_from(cam_from_model) < FRESH_OBSERVATIONS
        )
        return is_fresh or state.frames_since >= waits[step + 1]

    def searched(self, state: MonitorState, was_lost: bool) -> NDArray[np.bool_]:
        """(C,) components to search for elsewhere: at first all that are open, then one after another.

        After a loss it is one after another from the start, because more was known before.
        """
        is_open = state.log_odds > OPEN_LOG_ODDS
        is_new = state.observations < FIRST_OBSERVATIONS and not was_lost
        if is_new or not is_open.any():
            return is_open
        open_indices = np.flatnonzero(is_open)
        return np.asarray(np.arange(len(is_open)) == open_indices[state.observations % len(open_indices)])

    def _shows_new(self, state: MonitorState, cam_from_model: Array) -> bool:
        """Whether this direction shows an open component that the last observation could not show."""
        is_visible = self._observer.visible_from(cam_from_model, state.is_mismatched)
        return bool(np.any((state.log_odds > OPEN_LOG_ODDS) & ~state.was_visible & is_visible))
