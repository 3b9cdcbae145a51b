"""The folder of all jobs: finding them, starting them, and what was measured, read when it changes."""

from __future__ import annotations

import logging
import threading
import time
from collections import OrderedDict
from contextlib import suppress
from pathlib import Path
from statistics import median

from arview.cad import Model
from arview.errors import ArviewError, InputError, OutputError
from arview.inspection import Inspection, load_inspection
from arview.station import walk
from arview.station.live.jobs.uploads import PhotoSpace, Uploads
from arview.station.live.options import JobOptions
from arview.station.live.security.refusals import Refusal
from arview.station.live.stream.subject import Subject

MAX_JOBS = 5000
"""Jobs that the folder may hold."""

logger = logging.getLogger("arview.station.live")

KEPT_INSPECTIONS = 64
"""Inspections that are kept in memory."""
KEPT_TIMES = 12
"""Last jobs of a part by which the time of the next one is estimated."""
_FileState = tuple[int, int, int]


class JobBoard:
    """The jobs of a station; safe to use from several threads. Its methods read files: call them in threads.

    Args:
        options: folder and bounds.

    Attributes:
        space: room for photos.
    """

    def __init__(self, options: JobOptions) -> None:
        self.options = options
        self.space = PhotoSpace(options)
        self._lock = threading.RLock()
        self._known: dict[str, walk.JobFolder] = {}
        self._uploads: dict[str, Uploads] = {}
        self._inspections: OrderedDict[Path, tuple[_FileState, Inspection | None]] = OrderedDict()

    def jobs(self) -> list[walk.JobFolder]:
        """All jobs, oldest first, each followed by its re-checks."""
        if not self.options.folder.is_dir():
            return []
        found = walk.jobs_in(self.options.folder)
        with self._lock:
            self._known = {job.id: job for job in found}
        return found

    def archive(self) -> None:
        """Move jobs that were signed, and then left alone for long enough, to ``archive/``, out of the list."""
        folder, days = self.options.folder, self.options.archive_days
        if days is None:
            return
        for job in self.jobs():
            if job.components is not None or not job.is_signed:
                continue
            changed = max(job.path.stat().st_mtime, (job.path / "decisions.jsonl").stat().st_mtime)
            if time.time() - changed > days * 86400.0:
                try:
                    (folder / "archive").mkdir(exist_ok=True)
                    job.path.rename(folder / "archive" / job.path.name)
                    logger.info("inspection %s is moved to %s", job.id, folder / "archive")
                except OSError as error:
                    logger.warning("inspection %s cannot be moved to the archive: %s", job.id, error)

    def find(self, job_id: str) -> walk.JobFolder:
        """The job of a name.

        Raises:
            Refusal: there is none.
        """
        with self._lock:
            job = self._known.get(job_id)
        if job is None or not (job.path / "job.json").is_file():
            job = next((one for one in self.jobs() if one.id == job_id), None)
        if job is None:
            raise Refusal(404, "no_such_job", "there is no such inspection at this station")
        return job

    def start(self, subject: Subject, serial: str, camera: str | None) -> tuple[walk.JobFolder, bool]:
        """Start a job for a specimen, or find the one that is not finished; returns it and whether it is new.

        Raises:
            Refusal: the serial number cannot be one, there are too many jobs, or the disk is full.
        """
        serial, model = serial.strip(), subject.part.model.source_hash
        with self._lock:
            jobs = self.jobs()
            for job in reversed(jobs):
                is_of_it = job.serial == serial and job.document["model_hash"] == model
                if is_of_it and job.components is None and job.state().stage in ("collecting", "measuring"):
                    return job, False
            if len(jobs) >= MAX_JOBS:
                raise Refusal(
                    507,
                    "disk_full",
                    f"the station holds {len(jobs)} inspections; start arview live with --archive DAYS",
                )
            self.space.check(0)
            try:
                job = walk.JobFolder.create(self.options.folder, subject.part, subject.path or "", serial, camera)
            except InputError as error:
                raise Refusal(400, "bad_request", str(error)) from error
            except OutputError as error:
                raise Refusal(507, "disk_full", "the inspection cannot be stored at the station") from error
            self._known[job.id] = job
        logger.info("inspection %s started", job.id)
        return job, True

    def recheck(self, job: walk.JobFolder, components: list[str]) -> walk.JobFolder:
        """Make the job of a re-check.

        Raises:
            Refusal: the first measurement is not finished, or a component is unknown.
        """
        first = job.parent or job
        if first.state().stage != "done":
            raise Refusal(409, "not_done", "this part is not measured yet")
        try:
            made = first.recheck(components)
        except InputError as error:
            raise Refusal(400, "bad_request", str(error)) from error
        except OutputError as error:
            raise Refusal(507, "disk_full", "the inspection cannot be stored at the station") from error
        with self._lock:
            self._known[made.id] = made
        return made

    def uploads(self, job: walk.JobFolder) -> Uploads:
        """The uploads of a job; there is one object for each, because it holds a lock."""
        with self._lock:
            if job.id not in self._uploads:
                self._uploads[job.id] = Uploads(job, self.options, self.space)
            return self._uploads[job.id]

    def expected_s(self, job: walk.JobFolder) -> float | None:
        """Time from the end of the photos to the verdict, s, by the last jobs of this part; None without one."""
        with self._lock:
            known = list(self._known.values())
        alike = [
            one
            for one in known
            if one.document["model_hash"] == job.document["model_hash"]
            and (one.components is None) is (job.components is None)
        ]
        states = (one.state() for one in alike[-KEPT_TIMES:])
        shares = [seconds / one.photos for one in states if one.photos and (seconds := one.seconds_after_last_photo)]
        return median(shares) * len(job.photos()) if shares else None

    def inspection(self, job: walk.JobFolder, model: Model | None = None) -> Inspection | None:
        """What was measured of a job, rough or final; None while nothing was, or where it cannot be read."""
        path = job.inspection_path
        if path is None:
            return None
        with suppress(OSError):
            stat = path.stat()
            state = stat.st_mtime_ns, stat.st_size, stat.st_ino
            with self._lock:
                kept = self._inspections.get(path)
            if kept is None or kept[0] != state:
                kept = state, _load(path)
                with self._lock:
                    self._inspections[path] = kept
                    while len(self._inspections) > KEPT_INSPECTIONS:
                        self._inspections.popitem(last=False)
            inspection = kept[1]
            if inspection is not None and model is not None:
                try:
                    inspection.check_model(model)
                except ArviewError as error:
                    logger.warning("%s: %s", job.id, error)
                    return None
            return inspection
        return None


def _load(path: Path) -> Inspection | None:
    try:
        return load_inspection(path)
    except ArviewError as error:
        logger.warning("%s", error)
        return None
