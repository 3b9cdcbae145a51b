"""The worker of a job as a process: one for a job, ended by SIGTERM at any moment.

With a cluster it only waits for the work that is done there, and does it itself when the cluster is gone.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import traceback
from collections.abc import Sequence
from pathlib import Path
from threading import Thread
from typing import Any

from arview import reconstruction, workflow
from arview.errors import ArviewError
from arview.station.walk.cluster import run_on_cluster
from arview.station.walk.job import JobFolder
from arview.station.walk.recheck import RecheckWorker
from arview.station.walk.worker import WalkWorker

NICENESS = 5
"""Niceness of the process while the user waits …."""


def main(arguments: Sequence[str]) -> int:
    """Run the worker of a job's folder; returns the exit status."""
    if len(arguments) not in (1, 2):
        print("usage: python -m arview.station.walk JOB [CLUSTER.json as text]", file=sys.stderr)
        return 2
    folder = Path(arguments[0])
    cluster: dict[str, Any] = json.loads(arguments[1]) if len(arguments) == 2 else {}
    # Files appear complete or not at all and stages are recorded when they are finished, so that the process may end
    # at any moment. The work has a thread of its own, because signals are handled only between steps of the main one.
    reconstruction.import_pycolmap()  # here, because its logging takes over the signals when it is loaded
    signal.signal(signal.SIGTERM, lambda number, frame: os._exit(143))
    result: list[int] = []
    thread = Thread(target=lambda: result.append(_run_somewhere(folder, cluster)), name="walk", daemon=True)
    thread.start()
    while thread.is_alive():
        thread.join(0.5)
    return result[0] if result else 1


def _run_somewhere(folder: Path, cluster: dict[str, Any]) -> int:
    if cluster:
        code = run_on_cluster(folder, cluster["scheduler"], cluster["resources"])
        if code is not None:
            return code
        print(f"no cluster at {cluster['scheduler']}: the job is measured here", file=sys.stderr)
    return _run(folder)


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
