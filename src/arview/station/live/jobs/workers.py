"""The processes that measure jobs: a bounded number at once, started again when they break, ended with the server.

A worker measures one job and ends when that is done. It may be stopped at any time and continues where it was, so one
that only waits for photos, or only makes a cloud, makes room for a job that has work. Workers that a killed server left
behind are found by their process numbers in ``worker.json`` and taken over.
"""

from __future__ import annotations

import json
import logging
import os
import signal
import subprocess
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Literal

from arview.errors import ArviewError
from arview.station import walk
from arview.station.live.options import JobOptions

WORKER_PAUSES_S: tuple[float, ...] = (2.0, 10.0, 60.0)
"""Pauses before a measurement that broke is started again; after the last one it has failed."""
WORKER_STOP_S = 2.5
"""Time for a measurement to end in good order."""
PATIENCE_S = 30.0
"""A measurement that only waits for photos makes room for others after so long."""
IDLE_S = 900.0
"""A measurement that only waits for photos ends after so long, until a photo comes."""
RECENT_S = 86400.0
"""A walk of an earlier run that was not ended is continued if it is younger than this."""

logger = logging.getLogger("arview.station.live")

WorkerState = Literal["none", "waiting", "running", "failed"]
Start = Callable[[walk.JobFolder], "subprocess.Popen[bytes]"]


@dataclass
class _Entry:
    """A job that is to be measured.

    Attributes:
        asked_s: monotonic time at which something was last asked of it.
        served_s: the same of when its worker last had nothing left to do but wait.
        process: its worker, started by this server; ``pid`` alone if it was taken over.
        breaks: how often the worker broke since something was asked.
        retry_s: monotonic time before which it is not started again.
    """

    job: walk.JobFolder
    asked_s: float
    served_s: float = -1.0
    process: subprocess.Popen[bytes] | None = None
    pid: int | None = None
    breaks: int = 0
    retry_s: float = 0.0
    started_s: float = 0.0
    stopping: bool = field(default=False)

    @property
    def is_running(self) -> bool:
        return self.pid is not None


class WorkerQueue:
    """Decides which jobs are measured; safe to use from several threads.

    Args:
        options: bounds.
        start: starts the worker of a job; default: `start_worker`.
        on_done: called with a job that is measured, in a thread of its own.
    """

    def __init__(
        self, options: JobOptions, start: Start | None = None, on_done: Callable[[walk.JobFolder], None] | None = None
    ) -> None:
        if start is None and options.scheduler is not None:
            start = partial(walk.start_worker, scheduler=options.scheduler, resources=options.resources)
        self._options, self._start, self._on_done = options, start or walk.start_worker, on_done
        self._lock = threading.RLock()
        self._entries: dict[str, _Entry] = {}
        self._is_closed = False

    def resume(self, jobs: list[walk.JobFolder]) -> None:
        """Continue with jobs of an earlier run: those that are not finished, and workers that still run."""
        now_s, recent = time.monotonic(), time.time() - RECENT_S
        with self._lock:
            for job in jobs:
                pid = running_worker(job)
                if pid is None and not _has_work(job, recent):
                    continue
                self._entries[job.id] = _Entry(job, now_s, pid=pid, started_s=now_s)
                logger.info("inspection %s %s", job.id, "is continued" if pid is None else "is still measured")

    def ask(self, job: walk.JobFolder) -> None:
        """Something has changed: a photo has come, the walk has ended, or it was reopened."""
        with self._lock:
            entry = self._entries.setdefault(job.id, _Entry(job, 0.0))
            entry.asked_s, entry.breaks, entry.retry_s = time.monotonic(), 0, 0.0

    def state(self, job_id: str) -> WorkerState:
        """What the worker of a job does."""
        with self._lock:
            entry = self._entries.get(job_id)
            if entry is None:
                return "none"
            if entry.is_running:
                return "running"
            return "failed" if entry.breaks > len(WORKER_PAUSES_S) else "waiting"

    @property
    def pending(self) -> int:
        """Number of jobs that are measured or wait for photos or a worker."""
        return len(self._entries)

    def tick(self) -> None:
        """Notice which workers have ended, make room, start others. To be called about twice a second, in a thread."""
        with self._lock:
            if self._is_closed:
                return
            for entry in list(self._entries.values()):
                if entry.is_running and not _is_alive(entry):
                    self._ended(entry)
            running = [entry for entry in self._entries.values() if entry.is_running]
            waiting = [entry for entry in self._entries.values() if not entry.is_running and self._may_start(entry)]
            self._rest(running, bool(waiting), any(not _is_only_cloud(one) for one in waiting))
            free = self._options.workers - len(running)
            for entry in sorted(waiting, key=_urgency)[: max(0, free)]:
                self._begin(entry)

    def close(self) -> Callable[[], None]:
        """Tell all workers to end; returns what waits for it, and ends them anyway when they take too long."""
        with self._lock:
            self._is_closed = True
            running = [entry for entry in self._entries.values() if entry.is_running]
            for entry in running:
                _signal(entry, signal.SIGTERM)

        def wait() -> None:
            _wait_for_end(running)
            for entry in running:
                if entry.process is not None:
                    with suppress(subprocess.TimeoutExpired):
                        entry.process.wait(0.5)
                _forget_pid(entry.job)

        return wait

    def stop(self, job: walk.JobFolder) -> None:
        """End the worker of a job, and wait for it; it is started again when something is asked of it."""
        with self._lock:
            running = [one for one in self._entries.values() if one.job.id == job.id and one.is_running]
            for entry in running:
                entry.stopping = True
                _signal(entry, signal.SIGTERM)
        _wait_for_end(running)

    def _may_start(self, entry: _Entry) -> bool:
        if entry.breaks > len(WORKER_PAUSES_S) or time.monotonic() < entry.retry_s:
            return False
        return entry.asked_s > entry.served_s or _is_only_cloud(entry)

    def _rest(self, running: list[_Entry], others_wait: bool, others_measure: bool) -> None:
        """Stop workers that only wait when others have work, and those that only make a cloud when others measure.

        One that makes a cloud goes on beside others of its kind: they would stop each other without end. All that
        wait for long are stopped, too.
        """
        now_s = time.monotonic()
        for entry in running:
            state = entry.job.state()
            quiet_s = now_s - max(entry.asked_s, entry.started_s)
            is_idle = state.stage == "collecting" and not entry.job.is_ended
            is_patient = is_idle and quiet_s > PATIENCE_S
            makes_room = (others_measure and _is_only_cloud(entry)) or (others_wait and is_patient)
            if not entry.stopping and (makes_room or (is_idle and quiet_s > IDLE_S)):
                logger.info("the measurement of %s is set aside", entry.job.id)
                entry.stopping = True
                if is_idle:
                    entry.served_s = entry.asked_s
                _signal(entry, signal.SIGTERM)

    def _begin(self, entry: _Entry) -> None:
        try:
            entry.process = self._start(entry.job)
        except ArviewError as error:
            logger.error("%s", error)
            self._broke(entry)
            return
        entry.pid, entry.started_s, entry.stopping = entry.process.pid, time.monotonic(), False
        document = {"pid": entry.pid, "started": datetime.now(UTC).isoformat()}
        with suppress(OSError):
            _pid_path(entry.job).write_text(json.dumps(document), encoding="utf-8")

    def _ended(self, entry: _Entry) -> None:
        """A worker has ended: it is done, was set aside, or broke."""
        code = None if entry.process is None else entry.process.returncode
        entry.process = entry.pid = None
        _forget_pid(entry.job)
        state = entry.job.state()
        knows_all = state.photos >= len(entry.job.photos()) or entry.asked_s <= entry.started_s
        is_finished = state.stage == "failed" or (state.stage == "done" and (code == 0 or not _has_cloud(state)))
        if entry.stopping:
            entry.stopping = False
        elif is_finished and knows_all:
            del self._entries[entry.job.id]
            if self._on_done is not None and state.stage == "done":
                threading.Thread(target=self._on_done, args=(entry.job,), name="arview-done", daemon=True).start()
        elif is_finished or (code == 0 and not knows_all):
            pass  # a photo came while it was ending: it is started once more
        else:
            logger.warning("the measurement of %s broke off (exit code %s); see worker.log", entry.job.id, code)
            self._broke(entry)

    def _broke(self, entry: _Entry) -> None:
        pauses_s = WORKER_PAUSES_S
        if entry.breaks < len(pauses_s):
            entry.retry_s = time.monotonic() + pauses_s[entry.breaks]
        entry.breaks += 1


def running_worker(job: walk.JobFolder) -> int | None:
    """Process number of the worker of a job that an earlier server started, if it still runs."""
    try:
        pid = int(json.loads(_pid_path(job).read_text(encoding="utf-8"))["pid"])
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return pid if _is_worker(pid, job) else None


def _pid_path(job: walk.JobFolder) -> Path:
    return job.path / "worker.json"


def _forget_pid(job: walk.JobFolder) -> None:
    with suppress(OSError):
        _pid_path(job).unlink(missing_ok=True)


def _is_worker(pid: int, job: walk.JobFolder) -> bool:
    """Whether a process is the worker of a job: numbers of processes are used again."""
    try:
        arguments = Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0")
    except OSError:
        return False
    return os.fsencode(str(job.path)) in arguments or os.fsencode(str(job.path.resolve())) in arguments


def _is_alive(entry: _Entry) -> bool:
    if entry.process is not None:
        return entry.process.poll() is None
    return entry.pid is not None and _is_worker(entry.pid, entry.job)


def _wait_for_end(entries: list[_Entry]) -> None:
    """Wait for workers that were told to end, and end them anyway when they take too long."""
    ends_s = time.monotonic() + WORKER_STOP_S
    while time.monotonic() < ends_s and any(map(_is_alive, entries)):
        time.sleep(0.02)
    for entry in filter(_is_alive, entries):
        logger.warning("the measurement of %s did not end in time", entry.job.id)
        _signal(entry, signal.SIGKILL)


def _signal(entry: _Entry, number: signal.Signals) -> None:
    with suppress(OSError):
        if entry.process is not None:
            entry.process.send_signal(number)
        elif entry.pid is not None:
            os.kill(entry.pid, number)


def _is_only_cloud(entry: _Entry) -> bool:
    """Whether nothing is left of a job but its cloud, which can wait."""
    state = entry.job.state()
    return state.stage == "done" and _has_cloud(state) and state.photos >= len(entry.job.photos())


def _has_cloud(state: walk.WalkState) -> bool:
    """Whether the cloud of a measured job is still to be made."""
    return state.cloud in ("waiting", "running")


def _urgency(entry: _Entry) -> tuple[bool, bool, float]:
    """Order of waiting jobs: clouds last, walks that have ended first, then the one that was asked last."""
    return _is_only_cloud(entry), not entry.job.is_ended, -entry.asked_s


def _has_work(job: walk.JobFolder, recent: float) -> bool:
    """Whether a job of an earlier run is to be continued; a walk that was left open only if it is recent."""
    state = job.state()
    if not job.photos():
        return False
    if state.stage in ("collecting", "measuring"):
        with suppress(OSError):
            return job.is_ended or (job.path / "photos.jsonl").stat().st_mtime > recent
    return state.stage == "done" and _has_cloud(state)
