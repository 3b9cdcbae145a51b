"""The worker of a job as a process: one for a job, ended by SIGTERM at any moment."""

from __future__ import annotations

import os
import signal
import sys
import traceback
from collections.abc import Sequence
from pathlib import Path
from threading import Thread

from arview import reconstruction, workflow
from arview.errors import ArviewError
from arview.station.walk.job import JobFolder
from arview.station.walk.recheck import RecheckWorker
from arview.station.walk.worker import WalkWorker

NICENESS = 5
"""Niceness of the process while the user waits …."""


def main(arguments: Sequence[str]) -> int:
    """Run the worker of a job's folder; returns the exit status."""
    if len(arguments) != 1:
        print("usage: python -m arview.station.walk JOB", file=sys.stderr)
        return 2
    # Files appear complete or not at all and stages are recorded when they are finished, so that the process may end
    # at any moment. The work has a thread of its own, because signals are handled only between steps of the main one.
    reconstruction.import_pycolmap()  # here, because its logging takes over the signals when it is loaded
    signal.signal(signal.SIGTERM, lambda number, frame: os._exit(143))
    result: list[int] = []
    thread = Thread(target=lambda: result.append(_run(Path(arguments[0]))), name="walk", daemon=True)
    thread.start()
    while thread.is_alive():
        thread.join(0.5)
    return result[0] if result else 1


def _run(folder: Path) -> int:
    try:
        job = JobFolder.open(folder)
        os.nice(max(0, NICENESS - os.nice(0)))
        with workflow.exclusive_access(job.path, ".worker.lock", waits=False), reconstruction.keeping_photos():
            return 0 if worker_of(job).run() else 3
    except ArviewError as error:
        print(error, file=sys.stderr)
        return 2
    except Exception:
        traceback.print_exc()
        return 1


def worker_of(job: JobFolder) -> WalkWorker:
    """The worker for a first measurement or a re-check."""
    return WalkWorker(job) if job.components is None else RecheckWorker(job)
