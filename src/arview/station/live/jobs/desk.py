"""What the server keeps of jobs in a run: the board, the workers, and what each bound client shows."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from arview.cad import Part
from arview.core.messages import sentence
from arview.pose import Identity, Pose
from arview.station import walk
from arview.station.live.jobs.board import JobBoard
from arview.station.live.jobs.guiding import Guiding
from arview.station.live.jobs.records import tell_report_and_history
from arview.station.live.jobs.subject import JobSubject
from arview.station.live.jobs.workers import Start, WorkerQueue
from arview.station.live.options import JobOptions
from arview.station.live.security.refusals import Refusal
from arview.station.live.stream.documents import Document
from arview.station.live.stream.feed import TrackedFrame
from arview.station.live.stream.subject import Subject
from arview.station.live.stream.subjects import Subjects

WATCHED = ("state.json", "photos.jsonl", "inspection.json", "rough/inspection.json", "uploads")
"""Files and folders of a job that are read again when they change."""


class JobView:
    """What all clients that are bound to a job show: the parts, one of them with the numbers of the job.

    Args:
        subjects: the parts as the server shows them without a job.
        number: of the part that the job measures.
        subject: that part with the job.

    Attributes:
        subjects: the parts as bound clients see them.
        status: ``job`` of *Status*, of the last `refresh`.
        clients: number of clients that are bound to it.
    """

    def __init__(self, subjects: Subjects, number: int, subject: JobSubject) -> None:
        self.number, self.subject = number, subject
        self.subjects = Subjects([subject if place == number else one for place, one in enumerate(subjects)])
        self.status: Document = {}
        self.clients = 0
        self._files: tuple[object, ...] = ()
        self._last: tuple[TrackedFrame, TrackedFrame] | None = None

    @property
    def job(self) -> walk.JobFolder:
        """The job."""
        return self.subject.job

    def refresh(self, board: JobBoard, workers: WorkerQueue) -> None:
        """Read what has changed of the job; not in the event loop."""
        job, worker = self.job, workers.state(self.job.id)
        paths = [*(job.path / name for name in WATCHED), *sorted((job.parent or job).path.glob("recheck/*/state.json"))]
        files = worker, *map(_changed_ns, paths)
        if files == self._files:
            return
        self._files = files
        self.subject.reload()
        state = self.subject.state
        self.status = {
            "id": job.id,
            "serial": job.serial,
            "part": self.number,
            "stage": state.stage,
            "text": state.text,
            "state": state.document(),
            "photos": len(job.photos()),
            "uploads": len(board.uploads(job).listed()),
            "revision": self.subjects.revision,
            "worker": worker,
        }

    def shown(self, tracked: TrackedFrame) -> TrackedFrame:
        """A tracked frame as bound clients see it: labels of the job, withheld when a code names another specimen."""
        last = self._last
        revision = self.subjects.revision
        if last is not None and last[0] is tracked and last[1].revision == revision:
            return last[1]
        poses = tuple(self._checked(pose) if place == self.number else pose for place, pose in enumerate(tracked.poses))
        shown = replace(tracked, poses=poses, subjects=self.subjects, revision=revision)
        self._last = tracked, shown
        return shown

    def _checked(self, pose: Pose) -> Pose:
        """The pose; where a code in the picture names another specimen than the job, nothing measured is shown."""
        if not pose.serial or pose.serial == self.job.serial or pose.identity is Identity.OTHER:
            return pose
        reason = sentence("identity.code", serial=pose.serial, inspected=self.job.serial)
        return replace(pose, identity=Identity.OTHER, identity_reason=reason)


def _tell_others(job: walk.JobFolder) -> None:
    """A re-check that is measured is shown in the report of the first measurement."""
    if job.components is not None:
        tell_report_and_history(job)


def _changed_ns(path: Path) -> tuple[int, int] | None:
    """Time of the last change and size of a file or folder; None where there is none."""
    try:
        stat = path.stat()
    except OSError:
        return None
    return stat.st_mtime_ns, stat.st_size


class Binding:
    """The job of one client.

    Args:
        view: of the job.
        guiding: guided capture, while the page wants it.
    """

    def __init__(self, view: JobView, guiding: Guiding | None = None) -> None:
        self.view, self.guiding = view, guiding


class JobDesk:
    """The jobs of a run; safe to use from several threads. Its methods read files: call them in threads.

    Args:
        options: folder and bounds.
        start: starts the worker of a job; default: `start_worker`.

    Attributes:
        board: the jobs in their folder.
        workers: which jobs are measured.
    """

    def __init__(self, options: JobOptions, start: Start | None = None) -> None:
        self.board = JobBoard(options)
        self.workers = WorkerQueue(options, start, _tell_others)
        self._lock = threading.Lock()
        self._subjects: Subjects | None = None
        self._parts: dict[str, int] = {}
        self._views: dict[str, JobView] = {}
        self._guides: dict[str, list[Guiding]] = {}

    def begin(self, subjects: Subjects) -> None:
        """Continue with the jobs of earlier runs, and drop what is left of old uploads."""
        self._subjects = subjects
        self.board.archive()
        jobs = self.board.jobs()
        self.workers.resume(jobs)
        for job in jobs:
            if (job.path / "uploads").is_dir():
                self.board.uploads(job).drop_old()

    def look_up(self) -> None:
        """Regular work: workers, and the jobs that clients show."""
        self.workers.tick()
        with self._lock:
            views = list(self._views.values())
        for view in views:
            view.refresh(self.board, self.workers)

    def start(self, part: int, serial: str, camera: str | None) -> tuple[walk.JobFolder, bool]:
        """Start a job of a part, or find the one that is not finished. Raises Refusal, see `JobBoard.start`."""
        subjects = self._loaded()
        if not 0 <= part < len(subjects):
            raise Refusal(400, "bad_request", f"part: expected a number from 0 to {len(subjects) - 1}")
        job, is_new = self.board.start(subjects[part], serial, camera)
        with self._lock:
            self._parts[job.id] = part
        return job, is_new

    def view(self, job_id: str) -> JobView:
        """What clients show that are bound to a job.

        Raises:
            Refusal: there is no such job, or none of the parts is the one that it measures.
        """
        job = self.board.find(job_id)
        with self._lock:
            known = self._views.get(job_id)
        if known is not None:
            return known
        subjects = self._loaded()
        number = self.part_of(job)
        if number is None:
            raise Refusal(
                409, "other_part", f"this inspection is of {job.document['part_name']}, which is not shown here"
            )
        made = JobView(subjects, number, JobSubject(subjects[number], job, self.board))
        made.refresh(self.board, self.workers)
        return made

    def retain(self, view: JobView) -> None:
        """A client is bound to a job: it is read again when it changes."""
        with self._lock:
            view.clients += 1
            self._views[view.job.id] = view

    def release(self, view: JobView) -> None:
        """A client is no longer bound to a job."""
        with self._lock:
            view.clients -= 1
            if view.clients <= 0:
                self._views.pop(view.job.id, None)

    def part_of(self, job: walk.JobFolder) -> int | None:
        """Number of the part that a job measures; None where it is not shown."""
        subjects, model = self._loaded(), job.document["model_hash"]
        fitting = [number for number, one in enumerate(subjects) if one.part.model.source_hash == model]
        chosen = self._parts.get(job.id, self._parts.get((job.parent or job).id))
        return chosen if chosen in fitting else next(iter(fitting), None)

    def subject(self, job: walk.JobFolder) -> Subject | None:
        """The part that a job measures, as the server shows it without a job; None where it is not shown."""
        number = self.part_of(job)
        return None if number is None else self._loaded()[number]

    def part(self, job: walk.JobFolder) -> Part | None:
        """The part that a job measures; None where it is not shown."""
        subject = self.subject(job)
        return None if subject is None else subject.part

    def guide(self, view: JobView) -> Guiding:
        """Begin guided capture of a client for a job."""
        guiding = Guiding(view.subject, view.number, self.board)
        with self._lock:
            self._guides.setdefault(view.job.id, []).append(guiding)
        return guiding

    def unguide(self, guiding: Guiding, view: JobView) -> None:
        """End guided capture of a client."""
        with self._lock:
            if guiding in (guides := self._guides.get(view.job.id, [])):
                guides.remove(guiding)

    def guides(self, job: walk.JobFolder) -> list[Guiding]:
        """Guided capture of all clients of a job."""
        with self._lock:
            return list(self._guides.get(job.id, []))

    def announced(self, job: walk.JobFolder, hint: Mapping[str, Any] | None) -> None:
        """A photo was taken; it need not have arrived."""
        given = None if hint is None else hint.get("cam_from_model")
        if given is not None:
            for guiding in self.guides(job):
                guiding.photo_taken(np.array(given, dtype=np.float64).reshape(4, 4))

    def lost(self, job: walk.JobFolder) -> None:
        """A photo that was announced does not come."""
        for guiding in self.guides(job):
            guiding.start_again()

    def changed(self, job: walk.JobFolder) -> None:
        """A photo was stored, or the walk has ended or was reopened."""
        self.workers.ask(job)
        self.workers.tick()
        with self._lock:
            view = self._views.get(job.id)
        if view is not None:
            view.refresh(self.board, self.workers)

    def reopen(self, job: walk.JobFolder) -> None:
        """More photos come after all: a measurement that runs is ended, and begins anew after the next end."""
        job.reopen()
        self.workers.stop(job)
        job.write_state(walk.WalkState(photos=len(job.photos())))
        self.changed(job)

    def close(self) -> Callable[[], None]:
        """Tell the workers to end; returns what waits for it."""
        return self.workers.close()

    def _loaded(self) -> Subjects:
        if self._subjects is None:
            raise Refusal(503, "loading", "the part is being loaded; wait a moment", {"Retry-After": "1"})
        return self._subjects
