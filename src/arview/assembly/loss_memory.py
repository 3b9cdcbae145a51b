"""What was known of the components when the part was lost, for when it is found again.

Where most components are absent the part may be found again turned by a symmetry of its base, and what is said then is
open. If the turns had been ruled out before, and the part lies as it did, they stay ruled out; if it turns out to have
been found turned, what was known before the loss holds again.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from arview.assembly.monitor_state import MonitorState
from arview.geometry import Array, rotation_angle_rad

CARRIED_SHARE = 0.7
"""Share of the summed log odds that counts after the part was lost and found again."""
BRIEF_FRAMES = 15
"""Frames without a pose up to which a part cannot have been turned by a quarter."""
SAME_TURN_DEG = 45.0
"""Rotation from the last pose up to which the part then lies as it did."""


class KnownBefore(NamedTuple):
    """What was known at a loss.

    Attributes:
        state: of the components.
        excluded: indices of the turns that pictures had excluded.
        ruled_out: these, and those that components seen at their places leave out.
        is_placed: whether the pose was known to be that of the part.
    """

    state: MonitorState
    excluded: frozenset[int]
    ruled_out: frozenset[int]
    is_placed: bool


class LossMemory:
    """Keeps what is known of the components while the part is lost.

    Attributes:
        aside: the state at the last loss, until it is taken up.
    """

    def __init__(self) -> None:
        self.aside: MonitorState | None = None
        self._last_pose: Array | None = None
        self._known: KnownBefore | None = None
        self._surest: KnownBefore | None = None

    def set_aside(self, known: KnownBefore, last_pose: Array | None) -> None:
        """Keep what is known, and the last pose (4,4) that the picture supported; None: there is none."""
        self.aside, self._known, self._last_pose = known.state, known, last_pose
        if self._surest is None or known.ruled_out >= self._surest.ruled_out:
            self._surest = known

    def is_as_before(self, cam_from_model: Array, frames_lost: int) -> bool:
        """Whether a part found at a pose (4,4) after some frames without one is turned as it was."""
        last = self._last_pose
        if last is None or frames_lost > BRIEF_FRAMES:
            return False
        return float(np.rad2deg(rotation_angle_rad(cam_from_model, last))) < SAME_TURN_DEG

    def still_known(self, cam_from_model: Array, frames_lost: int) -> tuple[frozenset[int], bool]:
        """What still holds of a part found at a pose (4,4), see `is_as_before`.

        Returns:
            indices of the turns that stay excluded, and whether the pose is known to be that of the part.
        """
        if self._known is None or not self.is_as_before(cam_from_model, frames_lost):
            return frozenset(), False
        return self._known.excluded, self._known.is_placed

    def before_turn(self, turn: int) -> MonitorState | None:
        """The state before the loss, after which the part was found turned; None if it may have been so before."""
        if self._surest is None or turn not in self._surest.ruled_out:
            return None
        known = self._surest.state
        return replace(known, log_odds=CARRIED_SHARE * known.log_odds, last_pose=None, frames_since=0)
