"""The processes that measure jobs: how many run, who waits for whom, what happens when they break or are ended."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from arview.cad import load_part
from arview.cad.part import Part
from arview.station.live.jobs import workers as workers_module
from arview.station.live.jobs.workers import WorkerQueue, running_worker
from arview.station.live.options import JobOptions
from arview.station.walk.job import JobFolder
from arview.station.walk.records import WalkState
from helpers.live_client import wait
from helpers.live_jobs import job_options, measured, photo, quiet_worker
from helpers.live_sample import PART

pytestmark = pytest.mark.slow  # each starts processes


@pytest.fixture(scope="module")
def part() -> Part:
    return load_part(str(PART), None)


class Workers:
    """A queue whose workers are started here, and ended at the end."""

    def __init__(self, options: JobOptions, code: str | None = None) -> None:
        self.started: list[str] = []
        self.processes: dict[str, subprocess.Popen[bytes]] = {}
        self.code = code
        self.done: list[str] = []
        self.queue = WorkerQueue(options, self.start, lambda job: self.done.append(job.id))

    def start(self, job: JobFolder) -> subprocess.Popen[bytes]:
        self.started.append(job.id)
        process = quiet_worker(job)
        if self.code is not None:
            process.kill()
            process.wait()
            process = subprocess.Popen([sys.executable, "-c", self.code, str(job.path)], stdin=subprocess.DEVNULL)
        self.processes[job.id] = process
        return process

    def tick_until(self, condition: Any, timeout_s: float = 20.0) -> None:
        def check() -> Any:
            self.queue.tick()
            return condition()

        wait(check, timeout_s)


@pytest.fixture
def made(part: Part, tmp_path: Path) -> Iterator[Any]:
    all_workers: list[Workers] = []

    def make(code: str | None = None, **more: Any) -> Workers:
        all_workers.append(Workers(job_options(tmp_path, **more), code))
        return all_workers[-1]

    yield make
    for one in all_workers:
        one.queue.close()()
        for process in one.processes.values():
            if process.poll() is None:
                process.kill()
            process.wait()


def job_with_photos(part: Part, folder: Path, serial: str, count: int = 1, is_ended: bool = True) -> JobFolder:
    import hashlib

    job = JobFolder.create(folder / "jobs", part, PART, serial)
    for number in range(count):
        content = photo(number, 120)
        job.add_photo(content, hashlib.sha256(content).hexdigest())
    if is_ended:
        job.end()
    return job


def test_one_runs_at_a_time_and_the_next_follows(part: Part, tmp_path: Path, made: Any) -> None:
    one, two = (job_with_photos(part, tmp_path, f"BP-{k}") for k in (1, 2))
    workers = made()
    for job in (one, two):
        workers.queue.ask(job)
    workers.queue.tick()
    assert workers.started == [two.id] and workers.queue.state(one.id) == "waiting"
    assert workers.queue.state(two.id) == "running" and workers.queue.state("other") == "none"
    measured(two)
    workers.processes[two.id].kill()
    workers.tick_until(lambda: workers.started == [two.id, one.id])
    assert workers.queue.state(two.id) == "none"
    wait(lambda: workers.done == [two.id])


def test_a_worker_that_only_waits_makes_room_and_is_started_again(
    part: Part, tmp_path: Path, made: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(workers_module, "PATIENCE_S", 0.3)
    walking = job_with_photos(part, tmp_path, "BP-1", is_ended=False)
    ended = job_with_photos(part, tmp_path, "BP-2")
    workers = made()
    workers.queue.ask(walking)
    workers.queue.tick()
    workers.queue.ask(ended)
    workers.queue.tick()
    assert workers.started == [walking.id]  # it was asked a moment ago
    workers.tick_until(lambda: workers.started == [walking.id, ended.id])
    assert workers.processes[walking.id].returncode == -signal.SIGTERM
    measured(ended)
    workers.processes[ended.id].kill()
    workers.tick_until(lambda: workers.queue.state(ended.id) == "none")
    workers.queue.tick()
    assert len(workers.started) == 2  # nothing was asked of it since
    workers.queue.ask(walking)
    workers.tick_until(lambda: workers.started == [walking.id, ended.id, walking.id])


def test_a_cloud_makes_room_at_once_and_comes_last(part: Part, tmp_path: Path, made: Any) -> None:
    cloud, other = (job_with_photos(part, tmp_path, f"BP-{k}") for k in (1, 2))
    workers = made()
    workers.queue.ask(cloud)
    workers.queue.tick()
    time.sleep(0.01)
    cloud.write_state(WalkState("done", "measured", 1, 1, cloud="running"))
    workers.queue.ask(other)
    workers.tick_until(lambda: workers.started == [cloud.id, other.id])
    measured(other)
    workers.processes[other.id].kill()
    workers.tick_until(lambda: workers.started == [cloud.id, other.id, cloud.id])
    assert workers.started.count(cloud.id) == 2 and workers.started[-1] == cloud.id


def test_one_that_breaks_is_started_again_a_few_times(
    part: Part, tmp_path: Path, made: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(workers_module, "WORKER_PAUSES_S", (0.05, 0.1))
    job = job_with_photos(part, tmp_path, "BP-1")
    workers = made("import sys; sys.exit(3)")
    workers.queue.ask(job)
    workers.tick_until(lambda: workers.queue.state(job.id) == "failed")
    assert len(workers.started) == 3
    workers.queue.ask(job)  # a further photo, or the user tries again
    workers.tick_until(lambda: len(workers.started) == 4)


def test_one_that_fails_is_told_and_not_started_again(part: Part, tmp_path: Path, made: Any) -> None:
    job = job_with_photos(part, tmp_path, "BP-1")
    workers = made()
    workers.queue.ask(job)
    workers.queue.tick()
    job.write_state(WalkState("failed", "the photos do not overlap", 1))
    workers.processes[job.id].kill()
    workers.tick_until(lambda: workers.queue.state(job.id) == "none")
    workers.queue.tick()
    assert workers.started == [job.id]


def test_the_end_of_a_walk_is_no_reason_to_measure_twice_and_a_late_photo_is(
    part: Part, tmp_path: Path, made: Any
) -> None:
    import hashlib

    job = job_with_photos(part, tmp_path, "BP-1", is_ended=False)
    workers = made("import sys; sys.stdin.read()")
    workers.queue.ask(job)
    workers.queue.tick()
    job.end()
    workers.queue.ask(job)
    measured(job)
    workers.tick_until(lambda: workers.queue.state(job.id) == "none")
    assert workers.started == [job.id]
    content = photo(50, 120)
    job.reopen()
    workers.queue.ask(job)
    workers.queue.tick()
    job.add_photo(content, hashlib.sha256(content).hexdigest())
    job.end()
    time.sleep(0.01)
    workers.queue.ask(job)
    workers.tick_until(lambda: len(workers.started) == 3)  # the second one did not know of the photo
    workers.tick_until(lambda: workers.queue.state(job.id) == "none")
    assert len(workers.started) == 3


def test_a_measurement_is_stopped_and_begins_anew_when_asked(part: Part, tmp_path: Path, made: Any) -> None:
    job = job_with_photos(part, tmp_path, "BP-1")
    workers = made()
    workers.queue.ask(job)
    workers.queue.tick()
    job.reopen()
    workers.queue.stop(job)
    assert workers.processes[job.id].poll() is not None, "it has ended when this returns"
    workers.queue.ask(job)
    workers.tick_until(lambda: len(workers.started) == 2)
    assert workers.queue.state(job.id) == "running"


def test_workers_end_with_the_server_also_those_that_do_not_listen(
    part: Part, tmp_path: Path, made: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(workers_module, "WORKER_STOP_S", 0.4)
    deaf = "import signal, time\nsignal.signal(signal.SIGTERM, signal.SIG_IGN)\nwhile True: time.sleep(0.1)"
    one, two = (job_with_photos(part, tmp_path, f"BP-{k}") for k in (1, 2))
    workers = made(workers=2)
    workers.queue.ask(one)
    workers.queue.tick()
    workers.code = deaf
    workers.queue.ask(two)
    workers.queue.tick()
    time.sleep(0.5)
    began_s = time.monotonic()
    workers.queue.close()()
    assert time.monotonic() - began_s < 2.0
    assert workers.processes[one.id].returncode == -signal.SIGTERM
    assert workers.processes[two.id].returncode == -signal.SIGKILL
    assert not (one.path / "worker.json").exists()
    workers.queue.ask(one)
    workers.queue.tick()
    assert len(workers.started) == 2  # none is started after the end


def test_the_next_server_continues_and_takes_over_what_runs(part: Part, tmp_path: Path, made: Any) -> None:
    running, open_walk, done, empty = (
        job_with_photos(part, tmp_path, "BP-1"),
        job_with_photos(part, tmp_path, "BP-2", is_ended=False),
        job_with_photos(part, tmp_path, "BP-3"),
        job_with_photos(part, tmp_path, "BP-4", count=0),
    )
    old = job_with_photos(part, tmp_path, "BP-5", is_ended=False)
    os.utime(old.path / "photos.jsonl", (1e9, 1e9))
    measured(done)
    first = made()
    first.queue.ask(running)
    first.queue.tick()
    pid = first.processes[running.id].pid
    wait(lambda: running_worker(running) == pid)  # the server is killed: its worker goes on
    second = made(workers=3)
    second.queue.resume([running, open_walk, done, empty, old])
    second.queue.tick()
    assert second.queue.state(running.id) == "running" and second.started == [open_walk.id]
    assert [second.queue.state(job.id) for job in (done, empty, old)] == ["none"] * 3
    second.queue.close()()
    assert first.processes[running.id].wait(5) == -signal.SIGTERM
    assert running_worker(running) is None


def test_a_number_of_a_process_that_is_another_one_is_not_taken(part: Part, tmp_path: Path) -> None:
    job = job_with_photos(part, tmp_path, "BP-1")
    for content in (json.dumps({"pid": os.getpid()}), "{", "[]", json.dumps({"pid": "x"}), json.dumps({"pid": -1})):
        (job.path / "worker.json").write_text(content)
        assert running_worker(job) is None
