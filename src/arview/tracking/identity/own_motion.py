"""Where a part that moves before the background goes on to, for a moment in which it is not seen.

A part in the hand leaves the place at which the background says it was. After a short gap it is the same one where it
is found on its way, and too near to the last place for another specimen to stand there.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from arview.geometry import Array, rotation_angle_rad
from arview.tracking.identity.part_outline import PartOutline

FRAMES = 7
"""Frames before the gap over which the motion is taken."""
MAX_BREAK = 3
"""Frames from one sure pose to the next up to which the motion between them is taken."""
WRONG_FRAMES = 2
"""The last of them whose poses may have been wrong."""
MAX_GAP = 15
"""Frames without a sure pose up to which it is continued."""
NEAR = 0.2
"""Shift in diameters from the expected place, across the line of sight, up to which the part is there."""
NEAR_DEPTH = 0.6
"""The same along the line of sight."""
REACH = 0.6
"""Shift in diameters from the last place beyond which another specimen may stand."""
MAX_TURN_DEG = 45.0
"""Rotation since the last pose up to which it is the same part."""


class OwnMotion:
    """Follows the motion of the part itself over the last frames in which it was tracked without doubt.

    Args:
        outline: of the part.
    """

    def __init__(self, outline: PartOutline) -> None:
        self._outline = outline
        self._recent: deque[tuple[int, Array]] = deque(maxlen=FRAMES)

    def reset(self) -> None:
        """Forget all poses."""
        self._recent.clear()

    def add(self, frame: int, cam_from_model: Array) -> None:
        """A pose (4,4) without doubt in a frame, by its number; the motion goes on over a short break."""
        if self._recent and frame - self._recent[-1][0] > MAX_BREAK:
            self._recent.clear()
        self._recent.append((frame, cam_from_model))

    def leads_to(self, frame: int, cam_from_model: Array) -> bool:
        """Whether the part may have gone on to a pose (4,4) in a frame.

        The last poses before a loss may have been wrong already: it is enough that those before them lead there.
        """
        shown = list(self._recent)
        ends = range(len(shown), max(len(shown) - WRONG_FRAMES - 1, 1), -1)
        return any(self._is_on_way(shown[0], shown[end - 1], (frame, cam_from_model)) for end in ends)

    def _is_on_way(self, before: tuple[int, Array], last: tuple[int, Array], found: tuple[int, Array]) -> bool:
        """Whether the motion between two frames, each by its number and pose (4,4), leads on to a third."""
        gap = found[0] - last[0]
        if not 0 < gap <= MAX_GAP or np.rad2deg(rotation_angle_rad(found[1], last[1])) > MAX_TURN_DEG:
            return False
        start, end, place = (self._outline.center_in_cam(pose) for _, pose in (before, last, found))
        expected = end + (end - start) * (gap / (last[0] - before[0]))
        if expected[2] <= 0.0:
            return False
        is_near = self._across(place, expected) < NEAR and self._across(place, end) < REACH
        along_mm = abs(float(np.linalg.norm(place) - np.linalg.norm(expected)))
        return is_near and along_mm < NEAR_DEPTH * self._outline.views.diameter_mm

    def _across(self, a: Array, b: Array) -> float:
        """Distance of two centres (3,) across the line of sight, at the mean distance, in diameters."""
        far_a, far_b = np.linalg.norm(a), np.linalg.norm(b)
        apart = np.linalg.norm(a / far_a - b / far_b) * 0.5 * (far_a + far_b)
        return float(apart / self._outline.views.diameter_mm)
