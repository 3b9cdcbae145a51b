"""The process that measures a job: ahead of the photos, roughly after the first ones, finally after the walk's end.

All stages are those of ``arview inspect`` in the job's folder. A worker that was killed is started again and continues:
finished stages and the features of photos are in the folder, and the rest depends on the photos alone.
"""

from __future__ import annotations

import os
import time
import traceback
from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime
from typing import Any

from arview import reconstruction, workflow
from arview.cad import Part
from arview.core.messages import sentence
from arview.core.progress import Progress
from arview.errors import ArviewError, InputError, MismatchError
from arview.inspection import Inspection, overall_verdict, save_inspection, verdict_sentence
from arview.quality import history
from arview.station.walk.job import JobFolder
from arview.station.walk.preparation import PhotoPreparation, photo_files, poses_of
from arview.station.walk.records import WalkState
from arview.workflow.prepare import prepare

_POLL_S = 0.1


FIRST_ROUGH = 5
"""Photos of the first provisional measurement."""
ROUGH_RETRY = 2
"""Photos more after which it is tried again when it failed."""
ROUGH_GROWTH = 2.0
"""Photos of the next provisional measurement, as a multiple of those of the last one."""
BACKGROUND_NICENESS = 15
"""… and while the cloud and the report follow."""


class WalkWorker:
    """Works on one job until it is done.

    Args:
        job: the job.
    """

    def __init__(self, job: JobFolder) -> None:
        self.job = job
        self.state = job.state()
        self.memory = reconstruction.SparseMemory(job.path / "features")
        self.threads = os.cpu_count() or 1

    def run(self) -> bool:
        """Wait for photos and measure; returns whether the job could be measured."""
        try:
            self._restart_state()
            prepared = self._wait_for_first_photo()
            self._collect(prepared)
            self._finish(prepared)
        except ArviewError as error:
            if self.state.stage == "done":  # a verdict stands whatever comes after it
                self._say(cloud="failed", text=f"{self.state.text}; no cloud: {error}", step="")
                return True
            self._say(stage="failed", text=str(error), step="")
            return False
        except Exception as error:
            traceback.print_exc()
            self._say(stage="failed", text=f"internal error ({error}); worker.log has the details", step="")
            raise
        return True

    # --- before the end ----------------------------------------------------------------------------------

    def _restart_state(self) -> None:
        """Take up the state of an earlier worker, or begin a new one."""
        if not (self.state.stage == "done" and self.job.is_ended):
            path = self.job.inspection_path
            kept = None if path is None else path.relative_to(self.job.path).as_posix()
            is_rough = kept is not None and kept != "inspection.json"
            self.state = WalkState(photos=len(self.job.photos()), is_rough=is_rough, inspection=kept)
            self._say(text=sentence("walk.starting"))

    def _wait_for_first_photo(self) -> workflow.Prepared:
        """The inputs of the measurement, which can be checked from the first photo on."""
        if self.state.stage == "collecting":
            self._say(text=sentence("walk.waiting"))
        while not self.job.photos():
            if self.job.is_ended:
                raise InputError(f"job {self.job.id}: the walk ended without a photo; reopen it and take some")
            time.sleep(_POLL_S)
        return prepared_of(self.job)

    def _collect(self, prepared: workflow.Prepared) -> None:
        """Work ahead until the walk ends, and measure roughly in between."""
        preparation = PhotoPreparation(self.job, prepared, self.memory, self.threads, self._prepare_more)
        preparation.start()
        wanted = FIRST_ROUGH
        try:
            while not self.job.is_ended:
                photos = len(self.job.photos())
                if photos != self.state.photos:
                    self._say(photos=photos, text=sentence("walk.photos", count=photos))
                if (count := len(preparation.ready)) >= wanted:
                    is_measured = self._measure_roughly(prepared, count)
                    more = round(ROUGH_GROWTH * count)
                    wanted = more if is_measured else count + ROUGH_RETRY
                time.sleep(_POLL_S)
        finally:
            preparation.end()

    def _prepare_more(self, photos: Sequence[reconstruction.Photo]) -> None:
        """What else is found as soon as photos arrive."""

    def _measure_roughly(self, prepared: workflow.Prepared, count: int) -> bool:
        """A provisional measurement of the first photos, given up when the walk ends; whether it could be made."""
        folder, photos = self.job.path / "rough", self.job.photos()[:count]
        options = replace(
            prepared.reconstruct, last_stage="scale", known=reconstruction.KnownPairs(poses=poses_of(photos))
        )

        def tell(what: str, done: int, total: int) -> None:
            # COLMAP calls back from its own code, which is not left by an exception.
            if what != "placing" and self.job.is_ended:
                raise _WalkEndedError

        try:
            found = reconstruction.reconstruct(
                photo_files(self.job, photos),
                folder,
                prepared.part,
                prepared.job.camera,
                options,
                progress=tell,
                memory=self.memory,
            )
            inspection = workflow.measured_in_photos(found, prepared, tell)
        except (_WalkEndedError, ArviewError):
            return False
        note = f"provisional: from the first {count} photos, while more are taken"
        inspection = replace(inspection, provenance=replace(inspection.provenance, note=note))
        save_inspection(inspection, folder / "inspection.json")
        placed = len(found.sparse.photos) if found.sparse is not None else 0
        self._say(
            placed=placed,
            is_rough=True,
            inspection="rough/inspection.json",
            text=sentence("walk.provisional", count=len(self.job.photos()), placed=count),
        )
        return True

    # --- after the end -----------------------------------------------------------------------------------

    def _finish(self, prepared: workflow.Prepared) -> None:
        """The measurement of all photos, its verdict, and in the background the cloud and the report."""
        self.job.remove_unconfirmed()
        photos = self.job.photos()
        prepared = replace(
            prepared, reconstruct=replace(prepared.reconstruct, known=reconstruction.KnownPairs(poses=poses_of(photos)))
        )
        was_done = self.state.stage == "done"
        if was_done and self.job.is_signed:
            self._say(cloud="failed", text=f"{self.state.text}; no cloud: the job was signed without it", step="")
            return
        first: list[Inspection] = []

        def on_verdict(inspection: Inspection) -> None:
            first.append(inspection)
            self._say_verdict(inspection, was_done)
            os.nice(max(0, BACKGROUND_NICENESS - os.nice(0)))
            if not was_done or not (self.job.path / "report.html").is_file():
                self._report(prepared.part)  # without the cloud, so that there is one to decide and sign in

        if not was_done:
            self._say(stage="measuring", text=sentence("walk.measuring"), photos=len(photos), cloud="waiting")
        try:
            outcome = workflow.inspect_prepared(
                prepared,
                self.job.path,
                progress=self._progress(),
                memory=self.memory,
                on_verdict=on_verdict,
                is_settled=was_done,
            )
        except ArviewError as error:
            if not first:
                raise
            self._say(cloud="failed", step="", text=f"{verdict_sentence(first[0])}; the cloud failed: {error}")
            return
        if not first:  # the cloud alone gave it
            on_verdict(outcome.inspection)
        self._say_cloud(first[0], outcome)
        self._add_to_history()

    def _say_verdict(self, inspection: Inspection, was_done: bool) -> None:
        seconds = self.state.seconds_after_last_photo
        ended = self.job.ended
        if not was_done and ended is not None:
            seconds = round((datetime.now(UTC) - ended).total_seconds(), 2)
        self._say(
            stage="done",
            text=verdict_sentence(inspection),
            verdict=str(overall_verdict(inspection)),
            is_rough=False,
            inspection="inspection.json",
            placed=inspection.provenance.photos,
            seconds_after_last_photo=seconds,
            cloud="running",
            step="",
        )

    def _report(self, part: Part) -> None:
        """Write the report of what is measured."""
        try:
            from arview.report import make_report

            make_report(self.job.path / "inspection.json", self.job.path / "report.html", None, part)
        except ArviewError as error:
            self._say(text=f"{self.state.text}; no report: {error}")

    def _say_cloud(self, first: Inspection, outcome: workflow.Outcome) -> None:
        """The end of the background's work; a verdict that it changed is named."""
        before = {one.name: one.verdict for one in first.components}
        changed = [
            f"{one.name}: {before[one.name].value} became {one.verdict.value}"
            for one in outcome.inspection.components
            if one.name in before and before[one.name] is not one.verdict
        ]
        text = outcome.sentence
        if changed:
            text += f"; the cloud and the comparison of halves changed {', '.join(changed)}"
        verdict = str(overall_verdict(outcome.inspection))
        self._say(cloud="done", text=text, verdict=verdict, step="", done=0, total=0)

    def _add_to_history(self) -> None:
        """Add the result to the store of ``ARVIEW_STORE``, as ``arview history add`` does."""
        store = os.environ.get("ARVIEW_STORE")
        if not store:
            return
        try:
            with history.HistoryStore(store) as opened:
                opened.add(self.job.path / "inspection.json")
        except ArviewError as error:
            self._say(text=f"{self.state.text}; not added to the history: {error}")

    def _progress(self) -> Progress:
        last = [0.0]

        def tell(what: str, done: int, total: int) -> None:
            now = time.monotonic()
            if what != self.state.step or now - last[0] > 0.5:
                last[0] = now
                self._say(step=what, done=done, total=total)

        return tell

    def _say(self, **changes: Any) -> None:
        self.state = replace(self.state, **changes)
        self.job.write_state(self.state)


def prepared_of(job: JobFolder) -> workflow.Prepared:
    """Inputs of a job's measurement.

    Raises:
        InputError: the part file or the camera cannot be used.
        MismatchError: the part has changed since the job was made.
    """
    document = job.document
    prepared = prepare(
        workflow.InspectJob(
            str(job.part_file),
            str(job.path / "photos"),
            serial=job.serial,
            camera=document.get("camera"),
            makes_pdf=False,
        ),
        job.path,
    )
    if prepared.part.model.source_hash != document["model_hash"]:
        raise MismatchError(f"{job.part_file}: has changed since job {job.id} was made; make a new job")
    return prepared


class _WalkEndedError(Exception):
    """The walk ended while it was measured roughly."""
