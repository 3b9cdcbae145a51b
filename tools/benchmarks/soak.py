#!/usr/bin/env python
"""Soak test of the live server: do its memory or the age of its frames grow?

The server runs in a process of its own. A phone (WebRTC, annotated video back) sends the sample clip at 30 fps for some
minutes, and a screen watches by motion JPEG, in the middle third at 5 pictures a second only; both run here, on the
loopback interface. Then fifty phones connect, send for a moment and vanish.

With ``--job`` it is the plate with its film, and the phone inspects one specimen after another: guided capture,
24 photos at the pace of a walk, measurement in the worker, verdict, next job.
"""

from __future__ import annotations

import argparse
import asyncio
import http.client
import json
import os
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import cv2
import numpy as np

ROOT = Path(__file__).resolve().parents[2]
SAMPLE = ROOT / "samples" / "bracket_plate"
sys.path.insert(0, str(ROOT / "tests"))  # the tests' client

from arview.station.live.security.addresses import LOOPBACK
from arview.video import Image, open_source
from helpers.live_client import Camera, Http, Phone, paired_cookie
from helpers.live_jobs import send
from live_server import live_server

FPS, WIDTH, HEIGHT = 30.0, 640, 360
PLATE = ROOT / "samples" / "plate"
PLATE_SIZE = 640, 480
PACE_S = 2.5  # between two photos of a job
JOB_TIMEOUT_S = 900.0
WARM_UP_SHARE = 0.2  # of the time, until kernels are compiled and buffers filled
MIN_DROPS = 10
MAX_GROWTH_MB, MAX_AGE_MS = 20.0, 500.0
SLOW_FPS = 5.0
MEDIANS = 10


@dataclass(frozen=True)
class Station:
    """The server under test: its process, its port and the token of the run."""

    pid: int
    port: int
    token: str


@dataclass
class Screen:
    """A screen that watches by motion JPEG in a thread, slowly when told so."""

    port: int
    token: str
    is_slow: bool = False
    is_on: bool = True
    pictures: int = 0
    _thread: threading.Thread | None = field(default=None, repr=False)

    def start(self) -> None:
        """Start to watch."""
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        connection = http.client.HTTPConnection(LOOPBACK, self.port, timeout=20)
        connection.request("GET", "/watch.mjpg", headers={"Cookie": paired_cookie(self.port, self.token)})
        answer = connection.getresponse()
        while self.is_on:
            line = answer.readline()
            if not line:
                return
            if line.lower().startswith(b"content-length:"):
                length = int(line.split(b":")[1])
                answer.readline()
                answer.read(length)
                self.pictures += 1
                if self.is_slow:
                    time.sleep(1.0 / SLOW_FPS)


@dataclass
class Jobs:
    """Inspections of one specimen after another, in a thread, for a phone that shows them.

    Attributes:
        finished: for each job its number of photos, the verdict or what failed, and its duration, s.
        worker_mb: largest resident memory of a worker.
        trouble: why it stopped before its end, or empty.
        running: serial number, photos and stage of the job that is not finished.
    """

    pid: int
    port: int
    token: str
    folder: Path
    client: str
    finished: list[tuple[int, str, float]] = field(default_factory=list)
    worker_mb: float = 0.0
    trouble: str = ""
    running: str = ""
    is_on: bool = True
    _thread: threading.Thread | None = field(default=None, repr=False)

    def start(self) -> None:
        """Start with the first one."""
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End with the job that runs."""
        self.is_on = False
        if self._thread is not None:
            self._thread.join(30)

    def _run(self) -> None:
        page = Http(self.port, self.token)
        photos = [path.read_bytes() for path in sorted((PLATE / "photos").glob("*.jpg"))]
        while self.is_on and not self.trouble:
            try:
                self._inspect(page, f"SOAK-{len(self.finished) + 1}", photos)
            except (AssertionError, OSError, KeyError) as error:
                self.trouble = f"{type(error).__name__}: {error}"

    def _inspect(self, page: Http, serial: str, photos: Sequence[bytes]) -> None:
        began_s = time.monotonic()
        status, job = page.json("POST", "/api/jobs", {"part": 0, "serial": serial})
        assert status == 201, job
        name = job["id"]
        self._control(page, job=name, capture=name)
        for content in photos:
            due_s = time.monotonic() + PACE_S
            send(page, name, content, hint=None)
            while self.is_on and time.monotonic() < due_s:
                self._note_worker(name)
                time.sleep(0.2)
            if not self.is_on:
                return
        page.json("POST", f"/api/jobs/{name}/end")
        self._control(page, capture=None)
        while self.is_on and time.monotonic() - began_s < JOB_TIMEOUT_S:
            self._note_worker(name)
            job = page.json("GET", f"/api/jobs/{name}")[1]
            state = job["state"]
            self.running = (
                f"{serial}: {len(job['photos'])} photos, {state['stage']}, {state['step']}, cloud {state['cloud']}"
            )
            if job["state"]["stage"] == "failed" or (job["state"]["stage"] == "done" and job["worker"] == "none"):
                verdict = "" if job["inspection"] is None else str(job["inspection"]["verdict"])
                told = verdict or str(job["state"]["text"])
                self.finished.append((len(job["photos"]), told, time.monotonic() - began_s))
                self.running = ""
                return
            time.sleep(0.5)
        assert not self.is_on, f"the job was not done within {JOB_TIMEOUT_S:.0f} s"

    def _control(self, page: Http, **wanted: object) -> None:
        status, answer = page.json("POST", f"/api/clients/{self.client}/control", wanted)
        assert status == 200, answer

    def _note_worker(self, name: str) -> None:
        with suppress(OSError, ValueError, KeyError, IndexError):
            pid = json.loads((self.folder / name / "worker.json").read_text())["pid"]
            self.worker_mb = max(self.worker_mb, _memory_mb(pid))


@dataclass
class Sample:
    """Measurements of one second."""

    at_s: float
    memory_mb: float
    answers: int
    age_p95_ms: float
    server_p95_ms: float
    dropped: int
    is_slow: bool


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    drops = f"number of phones that connect and vanish at the end: 0, or at least {MIN_DROPS} (default: 50)"
    parser.add_argument("--drops", type=int, default=50, help=drops)
    parser.add_argument("--minutes", type=float, default=10.0, help="how long (default: 10)")
    parser.add_argument("--job", action="store_true", help="inspect specimens of the sample plate meanwhile")
    chosen = parser.parse_args()
    if chosen.drops and chosen.drops < MIN_DROPS:
        parser.error(f"--drops {chosen.drops}: memory is compared with that after the first ten; give 0 or at least 10")
    with tempfile.TemporaryDirectory(prefix="arview-soak-") as folder:
        sample, (width, height) = (PLATE, PLATE_SIZE) if chosen.job else (SAMPLE, (WIDTH, HEIGHT))
        inspection = [] if chosen.job else ["--inspection", sample / "inspection.json"]
        arguments = [
            "--part", sample / "part.toml", "--camera", sample / "camera.json", *inspection,
            "--http", "--port", "0", "--size", f"{width}x{height}", "--jobs", Path(folder) / "jobs",
        ]  # fmt: skip
        with live_server(arguments) as (pid, link):
            page = urlsplit(link)
            station = Station(pid, page.port or 80, parse_qs(page.query)["token"][0])
            jobs = Path(folder) / "jobs" if chosen.job else None
            is_good = asyncio.run(_soak(station, _images(sample, (width, height)), 60.0 * chosen.minutes, jobs))
            if chosen.drops:
                few = _images(sample, (width, height), 30)
                is_good &= asyncio.run(_drop(station, few, chosen.drops))
    sys.exit(0 if is_good else 1)


async def _soak(station: Station, images: list[Image], seconds: float, jobs_folder: Path | None) -> bool:
    """Run the phone, the screen and the jobs; True when memory stayed flat, frames young and jobs were measured."""
    pid, port, token = station.pid, station.port, station.token
    samples: list[Sample] = []
    jobs: Jobs | None = None
    screen = Screen(port, token)
    print(f"{'s':>5} {'memory MB':>10} {'answers/s':>10} {'age p95 ms':>11} {'server p95 ms':>14} {'dropped':>8}")
    async with Phone(Http(port, token), Camera(images, FPS), mode="video") as phone:
        assert phone.camera is not None
        await phone.until(lambda: phone.answers, 180)
        screen.start()
        if jobs_folder is not None:
            jobs = Jobs(pid, port, token, jobs_folder, phone.name)
            jobs.start()
        began_s = time.monotonic()
        while (passed_s := time.monotonic() - began_s) < seconds:
            screen.is_slow = 1 / 3 < passed_s / seconds < 2 / 3
            phone.answers.clear()
            phone.shown.clear()
            await asyncio.sleep(1.0)
            answers = list(phone.answers)
            sent_s = phone.camera.sent_s
            ages = [1e3 * (moment - sent_s[one["id"]]) for moment, one in answers if one["id"] in sent_s]
            for old in [number for number in sent_s if number < phone.camera.next_id - 600]:
                del sent_s[old]
            server_ms = [one["server_ms"] for _, one in answers]
            dropped = answers[-1][1]["dropped"] if answers else 0
            phone.statuses.clear()
            one = Sample(passed_s, _memory_mb(pid), len(answers), _p95(ages), _p95(server_ms), dropped, screen.is_slow)
            samples.append(one)
            if len(samples) % max(1, round(seconds / 20)) == 0:
                print(
                    f"{one.at_s:5.0f} {one.memory_mb:10.1f} {one.answers:10d} {one.age_p95_ms:11.0f} "
                    f"{one.server_p95_ms:14.0f} {one.dropped:8d} {'slow screen' if one.is_slow else ''}",
                    flush=True,
                )
        if jobs is not None:
            await asyncio.to_thread(jobs.stop)
    screen.is_on = False
    print(f"the screen took {screen.pictures} pictures")
    is_good = _evaluate(samples)
    return is_good if jobs is None else _told(jobs) and is_good


def _told(jobs: Jobs) -> bool:
    """Print what became of the jobs; True when at least one was measured and none failed."""
    for number, (photos, told, seconds) in enumerate(jobs.finished, 1):
        print(f"job {number}: {photos} photos, {told}, {seconds:.0f} s with cloud and report")
    print(f"{len(jobs.finished)} jobs finished; a worker took at most {jobs.worker_mb:.0f} MB")
    if jobs.running:
        print(f"not finished: {jobs.running}")
    if jobs.trouble:
        print(f"JOBS STOPPED: {jobs.trouble}")
    if not jobs.finished:
        print("NO JOB WAS FINISHED: give more minutes")
    verdicts = {told for _, told, _ in jobs.finished}
    return not jobs.trouble and verdicts == {"fail"}  # the sample has components out of tolerance


async def _drop(station: Station, images: list[Image], count: int) -> bool:
    """Connect phones that vanish without closing; True when the server released all of them and their memory."""
    pid, port, token = station.pid, station.port, station.token
    memory_mb = []
    for number in range(count):
        phone = Phone(Http(port, token), Camera(images, FPS))
        await phone.__aenter__()
        await phone.until(partial(getattr, phone, "answers"), 60)
        await phone.vanish()
        await asyncio.sleep(0.5)
        memory_mb.append(_memory_mb(pid))
        if number == 0 or (number + 1) % 10 == 0:
            print(f"{number + 1:3d} phones connected and vanished: {memory_mb[-1]:.1f} MB", flush=True)
    clients = Http(port, token).json("GET", "/api/status")[1]["clients"]
    growth_mb = float(np.median(memory_mb[-5:]) - np.median(memory_mb[5:10]))
    print(f"{clients} of them are still connected; memory {growth_mb:+.1f} MB since the first ten")
    return clients == 0 and growth_mb <= MAX_GROWTH_MB


def _evaluate(samples: list[Sample]) -> bool:
    """Print the figures; True when memory stayed flat and frames young."""
    warm = [one for one in samples if one.at_s >= WARM_UP_SHARE * samples[-1].at_s]
    memory = np.array([one.memory_mb for one in warm])
    # A search for a lost part allocates some 50 MB for a second: medians show what stays allocated.
    medians = np.array([np.median(part) for part in np.array_split(memory, MEDIANS)])
    growth_mb = float(np.polyfit([one.at_s for one in warm], memory, 1)[0] * (warm[-1].at_s - warm[0].at_s))
    print(f"memory after warm-up {memory.min():.1f} to {memory.max():.1f} MB in single seconds")
    print(
        f"{MEDIANS} medians over {len(warm) / MEDIANS:.0f} s each: {medians.min():.1f} to {medians.max():.1f} MB, "
        f"trend {growth_mb:+.1f} MB over the rest"
    )
    tenth = max(1, len(memory) // MEDIANS)
    first_mb, last_mb = float(np.median(memory[:tenth])), float(np.median(memory[-tenth:]))
    print(f"memory {first_mb:.1f} MB after warm-up, {last_mb:.1f} MB at the end: {last_mb - first_mb:+.1f} MB")
    ages = np.array([one.age_p95_ms for one in warm if one.answers])
    print(f"age of answers, p95 of each second: median {np.median(ages):.0f} ms, largest {ages.max():.0f} ms")
    is_flat = abs(growth_mb) <= MAX_GROWTH_MB and float(np.ptp(medians)) <= 2 * MAX_GROWTH_MB
    is_young = float(np.median(ages)) <= MAX_AGE_MS
    print("flat" if is_flat else f"NOT FLAT: more than ±{MAX_GROWTH_MB:.0f} MB", end=", ")
    print("young" if is_young else f"OLD: more than {MAX_AGE_MS:.0f} ms")
    return is_flat and is_young


def _images(sample: Path, size: tuple[int, int], count: int | None = None) -> list[Image]:
    """Frames of the clip of a sample, in a size (width, height)."""
    frames = open_source(sample / "clip.mp4", end=count)
    return [np.asarray(cv2.resize(frame.image, size, interpolation=cv2.INTER_AREA)) for frame in frames]


def _memory_mb(pid: int) -> float:
    """Resident memory of a process."""
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def _p95(values: list[float]) -> float:
    return float(np.percentile(values, 95)) if values else 0.0


if __name__ == "__main__":
    main()
