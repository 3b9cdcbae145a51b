"""The program is killed again and again while two phones upload: what it confirmed is there, and nothing is mixed."""

from __future__ import annotations

import http.client
import json
import os
import random
import re
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import pytest

from arview.station.live.security.addresses import LOOPBACK, bind
from arview.station.walk.job import JobFolder, jobs_in
from helpers.live_client import Http, paired_cookie, wait
from helpers.live_jobs import about, measured, photo
from helpers.live_sample import PART

pytestmark = pytest.mark.slow

LINK = re.compile(r"http://127\.0\.0\.1:\d+/\?token=(\S+)")
PHOTOS, PIECE = 6, 40_000


def free_port() -> int:
    taken = bind(LOOPBACK, 0)
    port = int(taken.getsockname()[1])
    taken.close()
    return port


class Program:
    """`arview live`, started again and again in one folder."""

    def __init__(self, folder: Path, port: int) -> None:
        self.folder, self.port, self.token = folder, port, ""
        self.process: subprocess.Popen[str] | None = None

    def start(self) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-m", "arview.cli", "live", "--part", str(PART), "--http", "--port", str(self.port)],
            cwd=self.folder,
            env={**os.environ, "ARVIEW_DATA": str(self.folder / "data")},
            text=True,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
        )
        assert self.process.stdout is not None
        for line in self.process.stdout:
            if match := LINK.search(line):
                self.token = match.group(1)
                return
        raise AssertionError("the program has ended")

    def kill(self, number: signal.Signals = signal.SIGKILL) -> None:
        assert self.process is not None
        self.process.send_signal(number)
        self.process.communicate(timeout=30)


class Phone(threading.Thread):
    """A page that uploads photos of one specimen, and tries again for as long as it takes."""

    def __init__(self, port: int, cookie: str, serial: str, first: int) -> None:
        super().__init__(daemon=True)
        self.port, self.cookie, self.serial, self.first = port, cookie, serial, first
        self.confirmed: dict[str, bytes] = {}
        self.failures: list[BaseException] = []
        self.faults = 0

    def run(self) -> None:
        try:
            job = self.until(lambda: self.ask("POST", "/api/jobs", {"part": 0, "serial": self.serial}))["id"]
            for number in range(self.first, self.first + PHOTOS):
                content = photo(number)
                name = self.until(lambda content=content: self.upload(job, content))  # type: ignore[misc]
                self.confirmed[str(name)] = content
        except BaseException as error:
            self.failures.append(error)

    def until(self, work: Any) -> Any:
        ends_s = time.monotonic() + 240
        while time.monotonic() < ends_s:
            try:
                return work()
            except (OSError, http.client.HTTPException, ConnectionError):
                self.faults += 1
                time.sleep(0.05)
        raise AssertionError("the server did not come back")

    def upload(self, job: str, content: bytes) -> str:
        answer = self.ask("POST", f"/api/jobs/{job}/uploads", about(content))
        while "photo" not in answer:
            offset = answer["offset"]
            path = f"/api/jobs/{job}/uploads/{about(content)['sha256'][:32]}?offset={offset}"
            answer = self.ask("PATCH", path, content[offset : offset + PIECE])
            time.sleep(0.03)
        return str(answer["photo"])

    def ask(self, method: str, path: str, content: Any) -> Any:
        headers = {"Cookie": self.cookie, "Origin": f"http://{LOOPBACK}:{self.port}"}
        if not isinstance(content, bytes):
            content, headers["Content-Type"] = json.dumps(content).encode(), "application/json"
        line = http.client.HTTPConnection(LOOPBACK, self.port, timeout=20)
        try:
            line.request(method, path, content, headers)
            answer = line.getresponse()
            document = json.loads(answer.read())
        finally:
            line.close()
        if answer.status == 503:  # the part is being loaded
            raise ConnectionError
        assert answer.status in (200, 201), (answer.status, document)
        return document


def test_everything_confirmed_is_there_after_the_program_was_killed(tmp_path: Path) -> None:
    rng = random.Random(5)
    program = Program(tmp_path, free_port())
    program.start()
    cookie = paired_cookie(program.port, program.token)
    phones = [Phone(program.port, cookie, f"BP-{k}", 100 * k) for k in (1, 2)]
    for phone in phones:
        phone.start()
    kills = 0
    while kills < 3 and any(phone.is_alive() for phone in phones):
        count = sum(len(phone.confirmed) for phone in phones)
        ends_s = time.monotonic() + 60
        while sum(len(phone.confirmed) for phone in phones) == count and time.monotonic() < ends_s:
            time.sleep(0.005)  # at least one photo comes through in each run
        time.sleep(0.2 * rng.random())
        program.kill()
        kills += 1
        program.start()  # the pages stay paired: they go on with the same cookie
    for phone in phones:
        phone.join(240)
        assert not phone.is_alive() and phone.failures == []
    assert kills == 3 and all(phone.faults > 0 for phone in phones)
    folder = tmp_path / "arview_jobs"
    jobs = {job.serial: job for job in jobs_in(folder)}
    assert sorted(jobs) == ["BP-1", "BP-2"]
    for phone in phones:
        job = jobs[phone.serial]
        stored = {one.name: (job.path / "photos" / one.name).read_bytes() for one in job.photos()}
        assert stored == phone.confirmed  # each once, and none of the other specimen
        assert len(stored) == PHOTOS
    decisions_survive(program, jobs["BP-1"], cookie)
    program.kill(signal.SIGTERM)


def loaded(program: Program, cookie: str) -> Http:
    """A page of the program, when the part is loaded."""
    page = Http(program.port, program.token)
    page.headers["Cookie"] = cookie
    wait(lambda: page.json("GET", "/api/jobs")[0] != 503, 120.0)
    return page


def decisions_survive(program: Program, job: JobFolder, cookie: str) -> None:
    """Decisions that were confirmed are there after the program was killed."""
    program.kill(signal.SIGTERM)  # its workers end with it: one that still ran would write its own state
    job.end()
    measured(job)
    program.start()
    page = loaded(program, cookie)
    kept = []
    for number in range(3):
        decision = {"component": "post_1", "is_ok": True, "reason": f"reason {number}", "by": "Ada"}
        status, answer = page.json("POST", f"/api/jobs/{job.id}/decisions", decision)
        assert status == 201, answer
        kept.append(answer["reason"])
    program.kill()
    program.start()
    status, told = loaded(program, cookie).json("GET", f"/api/jobs/{job.id}")
    assert status == 200, told
    assert [one["reason"] for one in told["decisions"]] == kept == ["reason 0", "reason 1", "reason 2"]
    assert told["record"]["faults"] == []
