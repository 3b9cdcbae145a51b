"""What is known of the components of the part in view."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from arview.assembly.direction_evidence import DirectionEvidence
from arview.assembly.turned_poses import Turn
from arview.geometry import Array


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

    def followed_by(
        self, later: MonitorState, share: float, max_log_odds: float, cleared_log_odds: float
    ) -> MonitorState:
        """Evidence of this state and a later one of the same specimen say together.

        Args:
            later: since the part was found again.
            share: of the log odds of this state, that counts.
            max_log_odds: bound on the summed log odds.
            cleared_log_odds: a component with more is not verified, one with less not mismatched.
        """
        summed = np.clip(share * self.log_odds + later.log_odds, -max_log_odds, max_log_odds)
        is_wrong = summed > cleared_log_odds
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
