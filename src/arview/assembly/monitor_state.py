"""What is known of the components of the part in view: the sum of the evidence of single pictures.

Log odds add up over pictures from different directions until a threshold is passed, as in Wald's sequential test
(1945).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from arview.assembly.direction_evidence import DirectionEvidence
from arview.assembly.observation import Observation
from arview.assembly.turned_poses import Turn
from arview.geometry import Array

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
SETTLED_LOG_ODDS = 4.5
"""A mismatched component with more is no reason to observe sooner."""
SAME_SHIFT = 0.05
"""Alternative placements that differ by less than this share of the part's diameter are the same."""
MAX_ADDED = 1.6
"""Cap on the log odds that one observation adds against a component, because one entering the view is at first only
partly visible."""
MAX_LOG_ODDS = 6.0
"""Bound on the summed log odds, in both directions."""
FORGETTING = 0.01
"""Share of the summed log odds that is lost with each observation."""
FIRST_OBSERVATIONS = 2
"""Frames after a lock that are all observed. No component is called mismatched before the last of them, because noise
differs between frames."""


@dataclass
class MonitorState:
    """State of the components of the part in view.

    Attributes:
        log_odds: (C,) summed log odds that each is not at its nominal placement.
        directions: evidence added from each direction.
        is_mismatched: (C,) mismatched.
        is_missing: (C,) mismatched, and surely so.
        is_verified: (C,) confirmed at its nominal placement.
        was_visible: (C,) visible in the last observation.
        was_occluded: (C,) behind something in the last observation.
        alternative: (C,) summed log odds of "at an alternative placement".
        shifts: (C,3) mm in the model frame to that placement.
        last_pose: (4,4) of the last frame; None before the first.
        has_suspects: the last observation had suspects.
        observations: made so far.
        frames_since: frames since the last observation.
    """

    log_odds: Array
    directions: DirectionEvidence
    is_mismatched: NDArray[np.bool_]
    is_missing: NDArray[np.bool_]
    is_verified: NDArray[np.bool_]
    was_visible: NDArray[np.bool_]
    was_occluded: NDArray[np.bool_]
    alternative: Array
    shifts: Array
    last_pose: Array | None = None
    has_suspects: bool = False
    observations: int = 0
    frames_since: int = 0

    @classmethod
    def unknown(cls, count: int, center_in_model: Array) -> MonitorState:
        """Nothing is known of the components, whose number is given, of a part with its centre (3,) in mm."""
        return cls(
            log_odds=np.zeros(count),
            directions=DirectionEvidence(count, center_in_model),
            is_mismatched=np.zeros(count, dtype=bool),
            is_missing=np.zeros(count, dtype=bool),
            is_verified=np.zeros(count, dtype=bool),
            was_visible=np.zeros(count, dtype=bool),
            was_occluded=np.zeros(count, dtype=bool),
            alternative=np.zeros(count),
            shifts=np.zeros((count, 3)),
        )

    @property
    def is_uncertain(self) -> NDArray[np.bool_]:
        """(C,) components against which there is some evidence, but not enough."""
        return np.asarray((self.log_odds > CLEARED_LOG_ODDS) & ~self.is_mismatched)

    @property
    def is_suspect(self) -> NDArray[np.bool_]:
        """(C,) components that probably are not where the CAD has them."""
        return self.is_mismatched | (self.log_odds > SUSPECT_LOG_ODDS)

    @property
    def is_settled(self) -> NDArray[np.bool_]:
        """(C,) mismatched components of which no more evidence is needed soon."""
        return self.is_mismatched & (self.log_odds > SETTLED_LOG_ODDS)

    def add(self, observation: Observation, cam_from_model: Array, sharpness: float, diameter_mm: float) -> None:
        """Add the evidence of one picture.

        Args:
            observation: of all components.
            cam_from_model: (4,4) mm.
            sharpness: share of the evidence against components that counts, 0–1.
            diameter_mm: of the part.
        """
        self.observations += 1
        self.frames_since = 0
        self.has_suspects = bool((observation.is_suspect & ~self.is_settled).any())
        self.was_visible, self.was_occluded = observation.is_visible, observation.is_occluded
        capped = np.minimum(observation.log_odds, MAX_ADDED)
        capped = np.where(capped > 0.0, sharpness * capped, capped)
        added = self.directions.add(cam_from_model, capped, self.is_mismatched)
        self.log_odds = np.clip((1.0 - FORGETTING) * self.log_odds + added, -MAX_LOG_ODDS, MAX_LOG_ODDS)
        self._add_alternatives(observation, SAME_SHIFT * diameter_mm)
        verified_below = np.where(self.is_verified, CLEARED_LOG_ODDS, VERIFIED_LOG_ODDS)
        self.is_verified = self.log_odds < verified_below
        if self.observations >= FIRST_OBSERVATIONS:
            mismatched_above = np.where(self.is_mismatched, CLEARED_LOG_ODDS, MISMATCH_LOG_ODDS)
            self.is_mismatched = self.log_odds > mismatched_above
        self.is_missing = self.is_mismatched & (self.is_missing | (self.log_odds > MISSING_LOG_ODDS))

    def assume(self, is_meant: NDArray[np.bool_], is_there: bool) -> None:
        """Take some components (C,) as surely there, or not there, and forget all pictures of them before."""
        self.log_odds = np.where(
            is_meant, VERIFIED_LOG_ODDS - 0.5 if is_there else SETTLED_LOG_ODDS + 0.5, self.log_odds
        )
        self.is_verified = np.where(is_meant, is_there, self.is_verified)
        self.is_mismatched = np.where(is_meant, not is_there, self.is_mismatched)
        self.is_missing = np.where(is_meant, not is_there, self.is_missing)
        self.alternative = np.where(is_meant, 0.0, self.alternative)
        self.directions.forget(is_meant)

    def _add_alternatives(self, observation: Observation, same_mm: float) -> None:
        """Add the evidence of one observation for alternative placements, as long as these are the same."""
        is_searched = np.isfinite(observation.alternative)
        apart = np.linalg.norm(observation.shifts - self.shifts, axis=1)
        is_same = apart < same_mm
        seen = np.where(is_searched, np.clip(observation.alternative, -MAX_ADDED, MAX_ADDED), 0.0)
        before = np.where(is_same | ~is_searched, self.alternative, np.maximum(self.alternative - MAX_ADDED, 0.0))
        is_better = is_searched & (is_same | (seen > before))
        self.shifts = np.where(is_better[:, None], observation.shifts, self.shifts)
        total = np.where(is_same | ~is_searched, before + seen, np.maximum(before, seen))
        self.alternative = np.clip(total, 0.0, MAX_LOG_ODDS)

    def turned(self, turn: Turn, share: float) -> MonitorState:
        """The state after the pose is found to be turned.

        A component has what is known of the one at whose place it is now, if that has its shape; nothing is known of
        the others, whose places were not looked at.

        Args:
            turn: from the pose so far.
            share: of the log odds, that counts.
        """
        source = turn.counterparts
        is_known = source >= 0
        none = np.zeros(len(source), dtype=bool)
        return MonitorState(
            log_odds=np.where(is_known, share * self.log_odds[source], 0.0),
            directions=self.directions.turned(turn.model_from_model, source),
            is_mismatched=is_known & self.is_mismatched[source],
            is_missing=is_known & self.is_missing[source],
            is_verified=is_known & self.is_verified[source],
            was_visible=none,
            was_occluded=none.copy(),
            alternative=np.zeros(len(source)),
            shifts=np.zeros((len(source), 3)),
            observations=self.observations,
        )

    def followed_by(self, later: MonitorState, share: float) -> MonitorState:
        """Evidence of this state and a later one of the same specimen say together.

        Args:
            later: since the part was found again.
            share: of the log odds of this state, that counts.
        """
        summed = np.clip(share * self.log_odds + later.log_odds, -MAX_LOG_ODDS, MAX_LOG_ODDS)
        is_wrong = summed > CLEARED_LOG_ODDS
        is_later = later.alternative > self.alternative
        return replace(
            later,
            log_odds=summed,
            directions=self.directions,
            is_mismatched=(self.is_mismatched | later.is_mismatched) & is_wrong,
            is_missing=(self.is_missing | later.is_missing) & is_wrong,
            is_verified=(self.is_verified | later.is_verified) & ~is_wrong,
            alternative=np.maximum(self.alternative, later.alternative),
            shifts=np.where(is_later[:, None], later.shifts, self.shifts),
            observations=self.observations + later.observations,
        )
