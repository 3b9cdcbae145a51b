#!/usr/bin/env python
"""Soak test of the live server: do its memory or the age of its frames grow?

The server runs in a process of its own. A phone (WebRTC, annotated video back) sends the sample clip at 30 fps for some
minutes, and a screen watches by motion JPEG, in the middle third at 5 pictures a second only; both run here, on the
loopback interface. Then fifty phones connect, send for a moment and vanish.
"""

from __future__ import annotations

import argparse
import asyncio
import http.client
import os
import sys
import threading
import time
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import cv2
import numpy as np

ROOT = Path(__file__).resolve().parents[2]
SAMPLE = ROOT / "samples" / "bracket_plate"
sys.path.insert(0, str(ROOT / "tests"))  # the tests' client

from arview.live.security.addresses import LOOPBACK
from arview.video import Image, open_source
from helpers.live_client import Camera, Http, Phone, paired_cookie
from live_server import live_server

FPS, WIDTH, HEIGHT = 30.0, 640, 360
WARM_UP_SHARE = 0.2  # of the time, until kernels are compiled and buffers filled
MIN_DROPS = 10
MAX_GROWTH_MB, MAX_AGE_MS = 20.0, 500.0
SLOW_FPS = 5.0
MEDIANS = 10


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
    chosen = parser.parse_args()
    if chosen.drops and chosen.drops < MIN_DROPS:
        parser.error(f"--drops {chosen.drops}: memory is compared with that after the first ten; give 0 or at least 10")
    arguments = [
        "--part", SAMPLE / "part.toml", "--inspection", SAMPLE / "inspection.json", "--camera", SAMPLE / "camera.json",
        "--http", "--port", "0", "--size", f"{WIDTH}x{HEIGHT}",
    ]  # fmt: skip
    with live_server(arguments) as (pid, link):
        page = urlsplit(link)
        port, token = page.port or 80, parse_qs(page.query)["token"][0]
        samples = asyncio.run(_soak(pid, port, token, 60.0 * chosen.minutes))
        is_good = _evaluate(samples)
        if chosen.drops:
            is_good &= asyncio.run(_drop(pid, port, token, chosen.drops))
    sys.exit(0 if is_good else 1)


async def _soak(pid: int, port: int, token: str, seconds: float) -> list[Sample]:
    images = _images()
    samples: list[Sample] = []
    screen = Screen(port, token)
    print(f"{'s':>5} {'memory MB':>10} {'answers/s':>10} {'age p95 ms':>11} {'server p95 ms':>14} {'dropped':>8}")
    async with Phone(Http(port, token), Camera(images, FPS), mode="video") as phone:
        assert phone.camera is not None
        await phone.until(lambda: phone.answers, 180)
        screen.start()
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
            one = Sample(passed_s, _memory_mb(pid), len(answers), _p95(ages), _p95(server_ms), dropped, screen.is_slow)
            samples.append(one)
            if len(samples) % max(1, round(seconds / 20)) == 0:
                print(
                    f"{one.at_s:5.0f} {one.memory_mb:10.1f} {one.answers:10d} {one.age_p95_ms:11.0f} "
                    f"{one.server_p95_ms:14.0f} {one.dropped:8d} {'slow screen' if one.is_slow else ''}",
                    flush=True,
                )
    screen.is_on = False
    print(f"the screen took {screen.pictures} pictures")
    return samples


async def _drop(pid: int, port: int, token: str, count: int) -> bool:
    """Connect phones that vanish without closing; True when the server released all of them and their memory."""
    images = _images(30)
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
    ages = np.array([one.age_p95_ms for one in warm if one.answers])
    print(f"age of answers, p95 of each second: median {np.median(ages):.0f} ms, largest {ages.max():.0f} ms")
    is_flat = abs(growth_mb) <= MAX_GROWTH_MB and float(np.ptp(medians)) <= 2 * MAX_GROWTH_MB
    is_young = float(np.median(ages)) <= MAX_AGE_MS
    print("flat" if is_flat else f"NOT FLAT: more than ±{MAX_GROWTH_MB:.0f} MB", end=", ")
    print("young" if is_young else f"OLD: more than {MAX_AGE_MS:.0f} ms")
    return is_flat and is_young


def _images(count: int | None = None) -> list[Image]:
    """Frames of the sample clip."""
    frames = open_source(SAMPLE / "clip.mp4", end=count)
    return [cv2.resize(frame.image, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA) for frame in frames]


def _memory_mb(pid: int) -> float:
    """Resident memory of a process."""
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def _p95(values: list[float]) -> float:
    return float(np.percentile(values, 95)) if values else 0.0


if __name__ == "__main__":
    main()
