"""Times of frames relative to the first one, whatever the time stamps of the file are like."""

from __future__ import annotations

from fractions import Fraction

CLOCK_RESTART_S = 1.0
"""A step back of at least this is a clock that was set anew; a smaller one is jitter."""
DEFAULT_FPS = 30.0


class FrameClock:
    """Turns time stamps into times that begin at 0 with the first frame and always increase.

    A frame without a stamp lies one frame interval after the one before it. A stamp that does not increase is moved to
    just after it; where the clock was set back, as by two recordings in one file, time goes on by one frame interval.

    Args:
        fps: nominal frames per second; None takes 30.
    """

    def __init__(self, fps: float | None) -> None:
        self.first_stamp_s = 0.0
        self.restarts = 0
        self._interval_s = 1.0 / (fps or DEFAULT_FPS)
        self._offset_s: float | None = None
        self._last: tuple[int, float] | None = None

    def time_s(self, index: int, stamp_s: float | None) -> float:
        """Time of the frame of an index, seconds; to be called for all frames in order.

        Args:
            index: position in the file, which counts frames that could not be decoded.
            stamp_s: time stamp in the file, or None.
        """
        if self._last is None:
            time_s = 0.0
            self.first_stamp_s = stamp_s or 0.0
        else:
            last_index, last_s = self._last
            expected_s = last_s + max(index - last_index, 1) * self._interval_s
            if stamp_s is None:
                time_s = expected_s
            else:
                time_s = expected_s if self._offset_s is None else stamp_s - self._offset_s
                if time_s <= last_s - CLOCK_RESTART_S:
                    self.restarts += 1
                    self._offset_s = None
                    time_s = expected_s
                elif time_s <= last_s:
                    time_s = last_s + 0.25 * self._interval_s
        if stamp_s is not None and self._offset_s is None:
            self._offset_s = stamp_s - time_s
        self._last = (index, time_s)
        return time_s


def plausible_fps(*rates: float | Fraction | None) -> float | None:
    """The first of some frame rates that a camera can have, 0.01 to 1000 per second; None if there is none."""
    for rate in rates:
        if rate is not None and 0.01 <= rate <= 1000.0:
            return float(rate)
    return None
