"""A part as one job shows it: with the numbers of that job, from the first rough ones to the final ones."""

from __future__ import annotations

import itertools
import logging
from dataclasses import replace

from arview.core.messages import sentence
from arview.errors import ArviewError
from arview.inspection import ComponentDeviation, Finding, Inspection, Verdict
from arview.station import walk
from arview.station.live.jobs.board import JobBoard
from arview.station.live.stream.inspection_file import age_notices
from arview.station.live.stream.notices import Notice
from arview.station.live.stream.subject import Subject
from arview.station.walk.merged import merged

logger = logging.getLogger("arview.station.live")

_REVISIONS = itertools.count(1 << 20)
"""Revisions of all jobs: none is that of another job, or of a part without one."""


class JobSubject(Subject):
    """A part with the inspection of a job; safe to use from several threads.

    While the job is measured, a component without a number has none of an earlier measurement either. The components
    that a re-check leaves out keep their newest numbers.

    Args:
        base: the part as the server shows it without a job.
        job: the job.
        board: reads what was measured.

    Attributes:
        state: of the measurement.
    """

    def __init__(self, base: Subject, job: walk.JobFolder, board: JobBoard) -> None:
        super().__init__(base.part, base.views, base.options, base.name, path=base.path)
        self.job, self.serial, self._board = job, job.serial, board
        self.revision = next(_REVISIONS)
        self.state: walk.WalkState = job.state()
        self._shown: Inspection | None = None
        self._faults: tuple[str, ...] = ()
        self.reload()

    @property
    def inspection(self) -> Inspection | None:
        """What was measured so far."""
        with self._lock:
            return self._shown

    def reload(self) -> bool:
        """Read state and inspection of the job again; returns whether something else is shown now."""
        state = self.job.state()
        shown = self._merged(state)
        pending = self._being_measured() if is_open(state) else frozenset[str]()
        faults = self.job.faults()
        with self._lock:
            is_new = (shown, pending) != (self._shown, self.pending)
            self.state, self._shown, self.pending, self._faults = state, shown, pending, faults
            if is_new:
                self.revision = next(_REVISIONS)
        return is_new

    def notices(self) -> list[Notice]:
        """The notices about the job and what was measured in it."""
        with self._lock:
            state, shown, faults = self.state, self._shown, self._faults
        notices = [Notice("job_damaged", "warning", text) for text in faults]
        if state.stage == "failed":
            notices.append(Notice("job_failed", "error", f"not measured: {state.text}"))
        if shown is not None and state.is_rough:
            notices.append(Notice("inspection_rough", "info", sentence("told.inspection_rough")))
        if shown is not None and state.stage == "done":
            notices += age_notices(shown, self.options.max_age_s)
        return notices

    def _being_measured(self) -> frozenset[str]:
        """Names of the components that the job measures: all of them, but of a re-check those that it is about."""
        checked = self.job.components
        return frozenset(one.name for one in self.part.model.components) if checked is None else frozenset(checked)

    def _merged(self, state: walk.WalkState) -> Inspection | None:
        """What is shown: of an unfinished job only components with a number, else the newest value of each."""
        model = self.part.model
        own = self._board.inspection(self.job, model)
        if own is not None and is_open(state):
            own = replace(
                own,
                components=tuple(_provisional(one) for one in own.components if _has_number(one)),
                provenance=replace(own.provenance, note=sentence("told.inspection_rough")),
            )
        first = self.job.parent
        if first is None and is_open(state):
            return own
        try:
            newest = merged(self.job, model)
        except ArviewError as error:
            logger.warning("%s: %s", self.job.id, error)
            return own
        if newest is None or not is_open(state):
            return own if newest is None else newest.inspection
        # A re-check that is measured: what is checked again has no number of before.
        checked = self.job.components or ()
        latest = () if own is None else tuple(one for one in own.components if one.name in checked)
        kept = tuple(one for one in newest.inspection.components if one.name not in checked)
        return replace(newest.inspection, components=(*latest, *kept))


def is_open(state: walk.WalkState) -> bool:
    """Whether numbers are still to come."""
    return state.stage in ("collecting", "measuring")


def _provisional(component: ComponentDeviation) -> ComponentDeviation:
    """A component whose number is still to change: measured, not yet compared with its tolerance."""
    return (
        component if component.distance_mm is None else replace(component, verdict=Verdict.MEASURED, tolerance_mm=None)
    )


def _has_number(component: ComponentDeviation) -> bool:
    return component.distance_mm is not None or component.finding is Finding.MISSING
