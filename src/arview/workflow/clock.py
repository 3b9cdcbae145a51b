"""How far a whole inspection is, and how long it will still take."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

STEPS: tuple[tuple[str, float], ...] = (
    ("frames", 5.0),
    ("photos", 1.5),
    ("features", 14.0),
    ("matching", 4.0),
    ("placing", 5.0),
    ("matching again", 12.0),
    ("adjusting", 11.0),
    ("guide views", 1.0),
    ("finding the part", 2.0),
    ("reading photos", 1.0),
    ("fitting the CAD", 1.0),
    ("depth maps", 32.0),
    ("polishing", 9.0),
    ("fusion", 4.0),
    ("components", 19.0),
    ("cloud", 9.0),
    ("datums", 2.0),
    ("uncertainty", 1.0),
    ("distance map", 3.0),
    ("pictures", 4.0),
    ("charts", 2.0),
    ("3D view", 2.0),
    ("PDF", 5.0),
    ("film", 12.0),
)
"""Steps in their order, as the stages call them, and what they take of each other's time (24 photos, two cores)."""


@dataclass(frozen=True)
class Moment:
    """How far the work is: the step, ``share`` of all (0 to 1), seconds passed and, once it can be told, left."""

    step: str
    share: float
    passed_s: float
    left_s: float | None


class Clock:
    """Turns what the stages report, each with its own counts, into one share of all.

    Steps that are passed over, as they were done before, count for nothing. The time left follows from the time that
    the share so far has taken.
    """

    def __init__(
        self, show: Callable[[Moment], None], has_video_frames: bool = True, has_film: bool = True,
        has_pdf: bool = True, now: Callable[[], float] = time.monotonic,
    ) -> None:  # fmt: skip
        left_out = {"frames": not has_video_frames, "film": not has_film, "PDF": not has_pdf}
        self._steps = [(name, cost) for name, cost in STEPS if not left_out.get(name, False)]
        self._show, self._now = show, now
        self._began = now()
        self._done: dict[int, float] = {}  # share of each step that has reported
        self._at = -1

    def tell(self, what: str, done: int, total: int) -> None:
        """What a stage reports: its step, and how much of it."""
        at = self._index(what)
        if at is not None:
            share = min(done / total, 1.0) if total > 0 else 0.0
            depth = what.split()
            if len(depth) == 5 and depth[3] == "of":  # "depth maps 2 of 4"
                share = (int(depth[2]) - 1 + share) / int(depth[4])
            for earlier in self._done:
                if earlier < at:
                    self._done[earlier] = 1.0
            self._done[at] = max(share, self._done.get(at, 0.0))
            self._at = max(at, self._at)
        self._show(self.moment(what))

    def moment(self, step: str) -> Moment:
        """The state now."""
        done = sum(self._steps[i][1] * share for i, share in self._done.items())
        ahead = sum(cost for i, (_, cost) in enumerate(self._steps) if i > self._at or i in self._done)
        passed = self._now() - self._began
        share = done / ahead if ahead > 0 else 0.0
        left = passed * (1.0 - share) / share if share > 0.02 and passed > 1.0 else None
        return Moment(step, share, passed, left)

    def _index(self, what: str) -> int | None:
        return next((i for i, (name, _) in enumerate(self._steps)
                     if what == name or (name == "depth maps" and what.startswith(name))), None)  # fmt: skip


def clock_text(moment: Moment) -> str:
    """``1:05, 0:50 left``: minutes and seconds passed and left."""
    left = "" if moment.left_s is None else f", {_minutes(moment.left_s)} left"
    return f"{_minutes(moment.passed_s)}{left}"


def _minutes(seconds: float) -> str:
    whole = round(seconds)
    return f"{whole // 60}:{whole % 60:02d}"
