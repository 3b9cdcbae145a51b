"""StepMonitor: the order of work. Which step is to be done now, when each was done, and what was done wrong.

Each picture adds evidence on the components that are not mounted yet: they are seen at their places, the places are
bare, or something else stands there. The evidence is summed from the last picture on that said the contrary (Page's
test, 1954), so that a change is noticed within a few pictures, and dated by the first of them. A place that no picture
shows says nothing.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from arview.assembly.observation import Glance
from arview.cad import Model
from arview.core.messages import sentence
from arview.geometry import Array
from arview.pose import Presence, StepReport

GLANCE_S = 0.1
"""Time from one picture that is looked at to the next."""
SEEN_LOG_ODDS = -3.0
"""A picture in which a component has less by its edges is evidence that it is there; by how much less is its weight."""
MAX_SEEN = 2.0
"""Largest weight of one picture for a component."""
SEEN = 5.0
"""Sum from which on a component is there: three clear pictures."""
NOT_SEEN_LOG_ODDS = 0.0
"""Components with more are not seen at their places."""
BARE, OCCUPIED = 0.6, 0.5
"""Share of a place that looks bare, above which it is, and below which something stands there."""
STEADY = 5.0
"""Pictures of a bare place, or of one at which something else stands, after which this is sure."""
STEADY_S = 1.0
"""Time for which something must be wrong before it is named: a component may be held in a hand, or moved."""


class _Sums:
    """Sums of evidence for one statement on each component, and when each sum has last begun to grow; all (C,)."""

    def __init__(self, count: int) -> None:
        self.sums, self.since_s = np.zeros(count), np.zeros(count)

    def add(self, gains: Array, time_s: float, limit: float) -> None:
        """Add the evidence of one picture."""
        self.since_s = np.where((self.sums <= 0.0) & (gains > 0.0), time_s, self.since_s)
        self.sums = np.clip(self.sums + gains, 0.0, limit)


class StepMonitor:
    """Follows the steps of one part.

    Args:
        model: with steps.
        base: index of the component that carries the pose: it is there from the start.

    Attributes:
        report: how far the assembly is, after the last picture.
    """

    report: StepReport

    def __init__(self, model: Model, base: int) -> None:
        self._steps, self._names = model.steps, tuple(component.name for component in model.components)
        # (S,C) which components each step mounts, and (S,S) which steps must be done before it, at any remove.
        self._mounts = np.array([[name in step.mount for name in self._names] for step in model.steps])
        self._before = np.zeros((len(model.steps), len(model.steps)), dtype=bool)
        for k, step in enumerate(model.steps):
            for j in (j for j, other in enumerate(model.steps) if other.name in step.after):
                self._before[k] |= self._before[j] | (np.arange(len(model.steps)) == j)
        self._is_there = ~self._mounts.any(axis=0) | (np.arange(len(self._names)) == base)
        self.forget()

    @property
    def is_awaited(self) -> NDArray[np.bool_]:
        """(C,) components that have not been seen at their places yet."""
        return np.isnan(self._seen_s)

    @property
    def is_watched(self) -> NDArray[np.bool_]:
        """(C,) awaited components of the steps that are to be done now."""
        return np.asarray(self._mounts[self._is_current()].any(axis=0) & self.is_awaited)

    @property
    def presences(self) -> tuple[Presence | None, ...]:
        """Presence of each component that is awaited; None of the others."""
        is_wrong = self._is_other(STEADY_S)
        now = np.where(is_wrong, Presence.WRONG, Presence.NEXT)
        found = np.where(self.is_watched, now, Presence.LATER)
        return tuple(Presence(one) if awaited else None for one, awaited in zip(found, self.is_awaited, strict=True))

    def forget(self) -> None:
        """Another specimen follows: nothing has been mounted on it yet."""
        self._seen_s = np.where(self._is_there, -np.inf, np.nan)
        self._started_s, self._done_s = np.full((2, len(self._steps)), np.nan)
        self._history: dict[tuple[str, int], tuple[str, float]] = {}
        self._ended: list[tuple[str, float, float | None]] = []
        self.restart()
        self._make_report()

    def restart(self) -> None:
        """Forget the evidence of pictures before the part was lost, but not what it has shown."""
        count = len(self._names)
        self._there, self._bare, self._other = _Sums(count), _Sums(count), _Sums(count)
        self._shown_s, self._time_s = np.full(count, np.nan), -np.inf

    def is_due(self, time_s: float) -> bool:
        """Whether a picture is to be looked at: while components are awaited, at intervals."""
        return bool(self.is_awaited.any()) and not 0.0 <= time_s - self._time_s < GLANCE_S

    def add(self, glance: Glance | None, time_s: float, is_sharp: bool = True) -> NDArray[np.bool_]:
        """Add what a picture shows; returns (C,) the components that are known to be there by now.

        Args:
            glance: what is seen; None: the pose may be wrong.
            time_s: time stamp of the picture.
            is_sharp: edges that are not found in it are not there.
        """
        self._time_s = time_s
        if glance is None:
            return np.zeros(len(self._names), dtype=bool)
        is_seen, is_unseen = glance.by_edges < SEEN_LOG_ODDS, glance.by_edges > NOT_SEEN_LOG_ODDS
        gains = np.clip(SEEN_LOG_ODDS - glance.by_edges, -2.0 * MAX_SEEN, MAX_SEEN)
        self._there.add(np.where(glance.by_edges == 0.0, 0.0, gains), time_s, SEEN)
        # Of one that is partly hidden several pictures are needed, but the first that did not deny it counts.
        begins = np.isnan(self._shown_s) & (glance.by_edges < NOT_SEEN_LOG_ODDS)
        self._shown_s = np.where(is_unseen, np.nan, np.where(begins, time_s, self._shown_s))
        is_clear = is_unseen & glance.is_open & is_sharp & (glance.bare >= 0.0)
        is_bare, is_other = is_clear & (glance.bare > BARE), is_clear & (glance.bare < OCCUPIED)
        self._bare.add(np.select([is_bare, is_other | is_seen], [1.0, -2.0], 0.0), time_s, STEADY)
        self._other.add(np.select([is_other, is_bare | is_seen], [1.0, -2.0], -0.2), time_s, STEADY)
        is_new = self.is_awaited & (self._there.sums >= SEEN)
        self._seen_s = np.where(is_new, self._shown_s, self._seen_s)
        return np.asarray(is_new)

    def update(self, time_s: float, is_gone: NDArray[np.bool_]) -> None:
        """Take what is known into account; to be called for each frame.

        Args:
            time_s: time stamp of the frame.
            is_gone: (C,) components that were seen not to be at their places any longer.
        """
        for k in range(len(self._steps)):
            before_s = self._done_s[self._before[k]]
            if not np.isnan(before_s).any():
                if np.isnan(self._started_s[k]):
                    self._started_s[k] = np.max(before_s) if len(before_s) else time_s
                seen_s = float(np.max(self._seen_s[self._mounts[k]]))
                if np.isnan(self._done_s[k]) and not np.isnan(seen_s):
                    self._done_s[k] = time_s if np.isinf(seen_s) else seen_s
                    self._started_s[k] = min(self._started_s[k], self._done_s[k])
        faults = {(key, c): (text, began_s) for key, c, text, began_s in self._faults(time_s, is_gone)}
        for fault in self._history.keys() - faults.keys():
            self._ended.append((*self._history.pop(fault), time_s))
        self._history = faults | self._history
        self._make_report()

    def _faults(self, time_s: float, is_gone: NDArray[np.bool_]) -> Iterator[tuple[str, int, str, float]]:
        """What is wrong in a frame: its kind and component, a sentence, and since when."""
        is_done, is_other = ~np.isnan(self._done_s), self._is_other(STEADY_S)
        for k in np.flatnonzero(~is_done):
            lacking = self._mounts[self._before[k] & ~is_done].any(axis=0) & self.is_awaited
            lacking &= (self._bare.sums >= STEADY) | is_other
            for c in np.flatnonzero(self._mounts[k] & (time_s - self._seen_s >= STEADY_S) & np.isfinite(self._seen_s)):
                if lacking.any():
                    others = ", ".join(self._names[other] for other in np.flatnonzero(lacking))
                    text = sentence("steps.wrong_order", name=self._names[c], others=others)
                    yield "order", int(c), text, float(self._seen_s[c])
        for c in np.flatnonzero(self.is_watched & is_other):
            yield "part", int(c), sentence("steps.wrong_part", name=self._names[c]), float(self._other.since_s[c])
        for c in np.flatnonzero(is_gone & np.isfinite(self._seen_s)):
            yield "gone", int(c), sentence("steps.missing", name=self._names[c]), time_s

    def _is_other(self, steady_s: float) -> NDArray[np.bool_]:
        """(C,) components at whose places something else has stood for a time."""
        return np.asarray((self._other.sums >= STEADY) & (self._time_s - self._other.since_s >= steady_s))

    def _is_current(self) -> NDArray[np.bool_]:
        """(S,) steps that are to be done now."""
        is_open = np.isnan(self._done_s)
        return np.asarray(is_open & ~(self._before & is_open).any(axis=1))

    def _make_report(self) -> None:
        started_s, done_s = (
            tuple(None if np.isnan(one) else float(one) for one in times) for times in (self._started_s, self._done_s)
        )
        self.report = StepReport(
            names=tuple(step.name for step in self._steps),
            components=tuple(step.mount for step in self._steps),
            is_current=tuple(self._is_current().tolist()),
            started_s=started_s,
            done_s=done_s,
            faults=tuple(text for text, _ in self._history.values()),
            history=(*self._ended, *((text, began_s, None) for text, began_s in self._history.values())),
        )
