"""Progress of a whole inspection and its remaining time."""

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
    ("components", 12.0),
    ("datums", 2.0),
    ("uncertainty", 1.0),
    ("depth maps", 32.0),
    ("polishing", 9.0),
    ("fusion", 4.0),
    ("cloud", 9.0),
    ("distance map", 3.0),
    ("halves", 12.0),
    ("pictures", 4.0),
    ("charts", 2.0),
    ("3D view", 2.0),
    ("PDF", 5.0),
    ("film", 12.0),
)
"""Steps in their order, named as the stages report them, and their relative durations (24 photos, two cores)."""


@dataclass(frozen=True)
class ProgressEstimate:
    """The progress at one time.

    Attributes:
        step: the current step.
        share: fraction of the whole work that is done, 0 to 1.
        passed_s: time since the start.
        left_s: estimated remaining time; None while it cannot be estimated.
    """

    step: str
    share: float
    passed_s: float
    left_s: float | None


class ProgressEstimator:
    """Combines the reports of the stages, each with its own counts, into the progress of the whole.

    Steps that are skipped, because an earlier run finished them, do not count. The remaining time is extrapolated from
    the time that the work so far has taken.

    Args:
        show: called with each estimate.
        has_video_frames, has_film, has_pdf, has_cloud: whether these steps belong to the run.
        now: clock, seconds.
    """

    def __init__(
        self,
        show: Callable[[ProgressEstimate], None],
        has_video_frames: bool = True,
        has_film: bool = True,
        has_pdf: bool = True,
        has_cloud: bool = True,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        left_out = {"frames": not has_video_frames, "film": not has_film, "PDF": not has_pdf}
        left_out |= dict.fromkeys(("depth maps", "polishing", "fusion", "cloud", "distance map"), not has_cloud)
        self._steps = [(name, cost) for name, cost in STEPS if not left_out.get(name, False)]
        self._show, self._now = show, now
        self._began = now()
        self._done: dict[int, float] = {}  # share of each step that has reported
        self._at = -1

    def update(self, what: str, done: int, total: int) -> None:
        """Report progress of a stage: the name of its step, and how many of its parts are done."""
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
        self._show(self.estimate(what))

    def estimate(self, step: str) -> ProgressEstimate:
        """The present progress."""
        done = sum(self._steps[i][1] * share for i, share in self._done.items())
        total = sum(cost for i, (_, cost) in enumerate(self._steps) if i > self._at or i in self._done)
        passed = self._now() - self._began
        share = done / total if total > 0 else 0.0
        left = passed * (1.0 - share) / share if share > 0.02 and passed > 1.0 else None
        return ProgressEstimate(step, share, passed, left)

    def _index(self, what: str) -> int | None:
        return next(
            (
                i
                for i, (name, _) in enumerate(self._steps)
                if what == name or (name == "depth maps" and what.startswith(name))
            ),
            None,
        )


def time_text(estimate: ProgressEstimate) -> str:
    """Elapsed and remaining minutes and seconds, as in ``1:05, 0:50 left``."""
    left = "" if estimate.left_s is None else f", {_minutes(estimate.left_s)} left"
    return f"{_minutes(estimate.passed_s)}{left}"


def _minutes(seconds: float) -> str:
    whole = round(seconds)
    return f"{whole // 60}:{whole % 60:02d}"
