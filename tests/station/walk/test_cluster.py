"""Jobs on a real Dask cluster: measured there, given to another worker, and here when the cluster is gone."""

from __future__ import annotations

import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from arview.cad import load_part
from arview.core.atomic import write_file
from arview.station.walk import cluster
from arview.station.walk.job import JobFolder, start_worker
from helpers.walk_bench import write_part

pytest.importorskip("distributed")
pytestmark = pytest.mark.slow  # schedulers and workers are programs of their own


class Cluster:
    """A scheduler, and workers that can be killed."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.workers, self.log = folder, list[subprocess.Popen[bytes]](), folder / "scheduler.log"
        self.scheduler = self._start("scheduler", "--port", "0", "--no-dashboard", "--host", "127.0.0.1")
        self.url = until(lambda: re.search(r"Scheduler at:\s+(tcp://[\d.:]+)", self.log.read_text()))[1]

    def add_worker(self, *options: str) -> subprocess.Popen[bytes]:
        """One more worker, without a nanny that would start it again."""
        number = len(self.workers)
        self.workers.append(
            self._start("worker", self.url, "--nthreads", "1", "--no-nanny", "--no-dashboard", *options, number=number)
        )
        log = self.folder / f"worker{number}.log"
        until(lambda: "Registered to" in log.read_text())
        return self.workers[-1]

    def close(self) -> None:
        for process in (*self.workers, self.scheduler):
            process.kill()
            process.wait()

    def _start(self, kind: str, *arguments: str, number: int | str = "") -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", f"distributed.cli.dask_{kind}", *arguments]
        with (self.folder / f"{kind}{number}.log").open("wb") as log:
            return subprocess.Popen(command, cwd=self.folder, stdout=log, stderr=log)


def until(found: Callable[[], Any], timeout_s: float = 180.0) -> Any:
    """What a function returns as soon as it is something."""
    ends = time.monotonic() + timeout_s
    while not (value := found()):
        assert time.monotonic() < ends, "waited in vain"
        time.sleep(0.1)
    return value


@pytest.fixture
def dask(tmp_path: Path) -> Iterator[Cluster]:
    one = Cluster(tmp_path)
    yield one
    one.close()


def new_job(folder: Path, serial: str) -> JobFolder:
    write_part(folder)
    return JobFolder.create(folder / "jobs", load_part(folder / "part.toml"), folder / "part.toml", serial)


def working(job: JobFolder) -> list[int]:
    """Process numbers of those that measure the job, here or on a worker: they were started with its folder alone."""
    found = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            arguments = path.read_bytes().split(b"\0")
        except OSError:
            continue
        if arguments[1:3] == [b"-m", b"arview.station.walk"] and arguments[3:] == [
            str(job.path.resolve()).encode(),
            b"",
        ]:
            found.append(int(path.parent.name))
    return found


def test_a_job_is_measured_on_the_cluster(dask: Cluster, tmp_path: Path) -> None:
    """It has no photo, which is found out there; the exit status comes back."""
    dask.add_worker("--resources", "GPU=1")
    job = new_job(tmp_path, "A-1")
    job.end()
    with start_worker(job, dask.url, {"GPU": 1}) as asking:
        assert asking.wait(300.0) == 3
    assert job.state().stage == "failed" and "without a photo" in job.state().text
    assert "measured here" not in (job.path / "worker.log").read_text()


def test_killed_workers_and_a_killed_scheduler_lose_nothing(dask: Cluster, tmp_path: Path) -> None:
    """The job waits for photos: first on one worker, then on another, then here; never in two places."""
    first, job = dask.add_worker(), new_job(tmp_path, "A-2")
    with start_worker(job, dask.url) as asking:
        (there,) = until(lambda: working(job))
        dask.add_worker()
        first.kill()
        (again,) = until(lambda: [one for one in working(job) if one != there])
        assert until(lambda: working(job) == [again])
        dask.scheduler.kill()
        job.end()
        assert asking.wait(300.0) == 3
    assert job.state().stage == "failed" and "without a photo" in job.state().text
    until(lambda: not working(job))


def test_without_a_cluster_the_job_is_measured_here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster, "CONNECT_S", 1.0)
    assert cluster.run_on_cluster(tmp_path, "tcp://127.0.0.1:9", {}) is None
    job = new_job(tmp_path, "A-3")
    job.end()
    with start_worker(job, "tcp://127.0.0.1:9") as asking:
        assert asking.wait(300.0) == 3
    assert "no cluster at tcp://127.0.0.1:9: the job is measured here" in (job.path / "worker.log").read_text()


def test_work_whose_lease_is_not_renewed_ends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The station was killed: what works on its job on the cluster ends by itself."""
    monkeypatch.setattr(cluster, "LEASE_S", 3.0)
    job = new_job(tmp_path, "A-4")
    write_file(job.path / cluster.LEASE, b"")
    began = time.monotonic()
    assert cluster.work_on(str(job.path.resolve())) == cluster.ENDED
    assert 2.0 < time.monotonic() - began < 60.0 and not working(job)
