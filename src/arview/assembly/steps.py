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

from arview.assembly.monitor_state import MonitorState
from arview.assembly.observation import ComponentObserver, Glimpse, Known
from arview.cad import Model
from arview.core.messages import sentence
from arview.pose import Presence, StepReport

INTERVAL_S = 0.1
"""Time from one picture that is looked at to the next."""
SEEN_LOG_ODDS, UNSEEN_LOG_ODDS = -2.5, 0.0
"""A component with less by its edges is seen at its place, and by how much less is the weight of the picture; one with
more is not seen."""
MAX_SEEN = 2.0
"""Largest weight of one picture for a component."""
BARE, OCCUPIED = 0.6, 0.5
"""Share of a place that looks bare, above which it is, and below which something stands there."""
UNKNOWN = -0.2
"""What a picture that does not show a place takes from the evidence that something stands there."""
STEADY, MAX_SUM = 5.0, 10.0
"""Sum from which on a statement is sure, three clear pictures of a component or five of a place; and its bound."""
STEADY_S, EARLY_S = 1.0, 0.4
"""Time for which something else must stand at a place before it is named: a component may be held in a hand. Time after
which a place that is seen bare shows that a component of a later step was mounted too early."""
THERE, IS_BARE, OTHER = range(3)
"""Statements on a component: it is at its place, the place is bare, something else stands there."""


class StepMonitor:
    """Follows the steps of one part.

    Args:
        model: with steps.
        base: index of the component that carries the pose: it is there from the start.

    Attributes:
        report: how far the assembly is, after the last frame.
    """

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
        found = np.where(self.is_watched, np.where(self._is_wrong, Presence.WRONG, Presence.NEXT), Presence.LATER)
        return tuple(Presence(one) if awaited else None for one, awaited in zip(found, self.is_awaited, strict=True))

    def forget(self) -> None:
        """Another specimen follows: nothing has been mounted on it yet."""
        self._seen_s = np.where(self._is_there, -np.inf, np.nan)
        self._started_s, self._done_s = np.full((2, len(self._steps)), np.nan)
        self._faults: dict[tuple[str, int], tuple[str, float]] = {}
        self._ended: list[tuple[str, float, float | None]] = []
        self.restart()
        self._make_report()

    def restart(self) -> None:
        """Forget the evidence of pictures before the part was lost, but not what it has shown."""
        # (3,C) sums of the evidence for each statement, and since when each has grown.
        self._sums, self._since_s = np.zeros((2, 3, len(self._names)))
        self._is_wrong = np.zeros(len(self._names), dtype=bool)
        # (C,) since when each is not denied, and when its place was last seen bare.
        self._shown_s, self._bare_s = np.full((2, len(self._names)), np.nan)
        self._time_s = -np.inf

    def follow(
        self,
        observer: ComponentObserver,
        state: MonitorState,
        image: NDArray[np.uint8] | None,
        time_s: float,
        is_sharp: bool,
    ) -> None:
        """Look, at intervals, for components that were mounted; what was known of their places is void then.

        Args:
            observer: of the components.
            state: of the components; its last pose is that of the frame.
            image: (H,W,3) uint8 RGB of the camera's size; None: its pose is not sure.
            time_s: time stamp of the frame.
            is_sharp: see `add`.
        """
        is_due = self.is_awaited.any() and not 0.0 <= time_s - self._time_s < INTERVAL_S
        if image is not None and state.last_pose is not None and is_due:
            known = Known(state.is_verified, self.is_awaited, np.zeros_like(self._is_there), ~self.is_watched)
            state.assume(self.add(observer.glimpse(image, state.last_pose, known), time_s, is_sharp), is_there=True)
        state.assume(self.is_awaited, is_there=False)
        self.update(time_s, state.is_missing)

    def add(self, glimpse: Glimpse | None, time_s: float, is_sharp: bool = True) -> NDArray[np.bool_]:
        """Add what a picture shows; returns (C,) the components that are known to be there from now on.

        Args:
            glimpse: what is seen; None: the pose may be wrong.
            time_s: time stamp of the picture.
            is_sharp: edges that are not found in it are not there.
        """
        self._time_s = time_s
        if glimpse is None:
            return np.zeros(len(self._names), dtype=bool)
        is_covered = (glimpse.bare >= 0.0) & ~glimpse.is_open
        is_seen, is_unseen = glimpse.by_edges < SEEN_LOG_ODDS, (glimpse.by_edges > UNSEEN_LOG_ODDS) & ~is_covered
        is_clear = is_unseen & is_sharp & (glimpse.bare >= 0.0)
        is_bare, is_other = is_clear & (glimpse.bare > BARE), is_clear & (glimpse.bare < OCCUPIED)
        gains = np.stack(
            [
                np.where(
                    (glimpse.by_edges == 0.0) | (is_covered & ~is_seen),
                    0.0,
                    np.clip(SEEN_LOG_ODDS - glimpse.by_edges, -2.0 * MAX_SEEN, MAX_SEEN),
                ),
                np.select([is_bare, is_other | is_seen], [1.0, -2.0], 0.0),
                np.select([is_other, is_bare | is_seen], [1.0, -2.0], UNKNOWN),
            ]
        )
        self._bare_s[is_bare] = time_s
        self._since_s = np.where((self._sums <= 0.0) & (gains > 0.0), time_s, self._since_s)
        self._sums = np.clip(self._sums + gains, 0.0, MAX_SUM)
        self._is_wrong &= self._sums[OTHER] > 0.0
        self._is_wrong |= (self._sums[OTHER] >= STEADY) & (time_s - self._since_s[OTHER] >= STEADY_S)
        # Of one that is partly hidden several pictures are needed, but the first that did not deny it counts.
        self._shown_s[np.isnan(self._shown_s) & (glimpse.by_edges < UNSEEN_LOG_ODDS)] = time_s
        self._shown_s[is_unseen] = np.nan
        is_new = np.asarray(self.is_awaited & (self._sums[THERE] >= STEADY))
        self._seen_s[is_new] = self._shown_s[is_new]
        return is_new

    def update(self, time_s: float, is_gone: NDArray[np.bool_]) -> None:
        """Take what is known into account; to be called for each frame.

        Args:
            time_s: time stamp of the frame.
            is_gone: (C,) components that were seen not to be at their places any longer.
        """
        for k in np.flatnonzero(np.isnan(self._done_s)):
            before_s = self._done_s[self._before[k]]
            if not np.isnan(before_s).any():
                start_s = np.max(before_s) if len(before_s) else np.fmin(self._started_s[k], time_s)
                seen_s = np.max(self._seen_s[self._mounts[k]])
                self._done_s[k] = time_s if np.isinf(seen_s) else seen_s
                self._started_s[k] = np.fmin(start_s, self._done_s[k])
        now = {(kind, c): (text, began_s) for kind, c, text, began_s in self._faults_now(time_s, is_gone)}
        self._ended += [(*self._faults[fault], time_s) for fault in self._faults.keys() - now.keys()]
        self._faults = {fault: self._faults.get(fault, said) for fault, said in now.items()}
        self._make_report()

    def _faults_now(self, time_s: float, is_gone: NDArray[np.bool_]) -> Iterator[tuple[str, int, str, float]]:
        """What is wrong in a frame: its kind and component, a sentence, and since when."""
        is_open = np.isnan(self._done_s)
        bare_s = np.where(self._sums[IS_BARE] >= STEADY, self._bare_s, np.where(self._is_wrong, time_s, np.nan))
        for k in np.flatnonzero(is_open):
            lacking = self._mounts[self._before[k] & is_open].any(axis=0) & self.is_awaited
            for c in np.flatnonzero(self._mounts[k] & np.isfinite(self._seen_s)).tolist():
                # What was named stays named until it is put right, whatever hides the place meanwhile.
                is_early = (bare_s >= self._seen_s[c] + EARLY_S) | (("order", c) in self._faults)
                if (lacking & is_early).any():
                    others = ", ".join(self._names[other] for other in np.flatnonzero(lacking))
                    said = sentence("steps.wrong_order", name=self._names[c], others=others)
                    yield "order", c, said, float(self._seen_s[c])
        for c in np.flatnonzero(self.is_watched & self._is_wrong).tolist():
            yield "part", c, sentence("steps.wrong_part", name=self._names[c]), float(self._since_s[OTHER, c])
        for c in np.flatnonzero(is_gone & np.isfinite(self._seen_s)).tolist():
            yield "gone", c, sentence("steps.missing", name=self._names[c]), time_s

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
            faults=tuple(text for text, _ in self._faults.values()),
            history=(*self._ended, *((text, began_s, None) for text, began_s in self._faults.values())),
        )
