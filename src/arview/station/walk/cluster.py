"""A job measured on a Dask cluster that sees the folder of the jobs under the same path, and here when it is gone.

What measures a job works from the files of its folder alone and locks it, so that it may end anywhere at any time and
go on elsewhere, and two never work at once. The station renews a lease in the folder: work whose lease is not renewed
ends, because the station has ended or works on the job itself.
"""

from __future__ import annotations

import ctypes
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

from arview.core.extras import require

LEASE = ".lease"
LEASE_S = 20.0
"""Time after which work on the cluster ends whose lease is not renewed."""
POLL_S = 1.0
CONNECT_S = 10.0
RETRIES = 3
"""Workers to which a job is given, one after another, when they die."""
ENDED = 143
"""Exit status of work that was told to end."""


def run_on_cluster(folder: Path, scheduler: str, resources: dict[str, float]) -> int | None:
    """Measure a job on the cluster; returns the exit status, or None where there is no cluster, or none any more.

    Args:
        folder: of the job.
        scheduler: ``tcp://host:port``.
        resources: that a worker must have, such as ``{"GPU": 1}``.
    """
    require("a cluster", "distributed")
    import dask
    from distributed import Client

    folder = folder.resolve()
    try:
        with dask.config.set({"distributed.scheduler.allowed-failures": RETRIES}):
            client = Client(scheduler, timeout=f"{CONNECT_S} s", set_as_default=False)
    except (OSError, ValueError, TimeoutError):
        return None
    with suppress(OSError, TimeoutError), client:
        if not client.nthreads():
            return None
        work = client.submit(
            work_on, str(folder), key=f"arview-{folder.name}-{time.time_ns()}", resources=resources or None, pure=False
        )
        while not work.done():
            (folder / LEASE).touch()
            if client.status != "running" or not client.nthreads():
                return None
            time.sleep(POLL_S)
        if work.status == "finished":
            return int(work.result())
    return None


def work_on(folder: str) -> int:
    """Measure a job on this worker of the cluster, in a process of its own that ends with the worker."""
    process = subprocess.Popen(
        [sys.executable, "-m", "arview.station.walk", folder],
        stdin=subprocess.DEVNULL,
        preexec_fn=_end_with_parent if sys.platform == "linux" else None,
    )
    renewed, since_s = -1, time.monotonic()
    while process.poll() is None:
        time.sleep(POLL_S)
        with suppress(OSError):
            now = (Path(folder) / LEASE).stat().st_mtime_ns
            if now != renewed:
                renewed, since_s = now, time.monotonic()
        if time.monotonic() - since_s > LEASE_S:
            process.terminate()
            process.wait()
            return ENDED
    return process.returncode


def _end_with_parent() -> None:
    """The kernel ends this process when the worker that started it is gone (prctl, PR_SET_PDEATHSIG)."""
    ctypes.CDLL(None).prctl(1, signal.SIGTERM)
