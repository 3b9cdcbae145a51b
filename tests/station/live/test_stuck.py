"""Workers that never come back: they are replaced, and the server ends at the first signal all the same."""

from __future__ import annotations

import asyncio
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from arview.camera.read import guess_camera
from arview.pose import Pose, TrackingState
from arview.station.live.options import RecordingOptions
from arview.station.live.server.workers import StuckError, WorkerPool
from arview.station.live.stream import annotator as annotator_module
from arview.station.live.stream import feed as feed_module
from arview.station.live.stream import recording as recording_module
from arview.station.live.stream import station as station_module
from arview.station.live.stream.annotator import FrameAnnotator
from arview.station.live.stream.feed import Feed
from arview.station.live.stream.frames import DecodedFrame, IncomingFrame
from arview.station.live.stream.recording import Recordings, free_space
from helpers.live_client import wait
from helpers.live_sample import CLIP, PART, options


@pytest.fixture(autouse=True)
def soon_stuck(monkeypatch: pytest.MonkeyPatch) -> None:
    """What does not come back is given up soon."""
    monkeypatch.setattr(feed_module, "STUCK_S", 0.3)
    monkeypatch.setattr(annotator_module, "DRAW_TIMEOUT_S", 0.3)


class Subject(list[Any]):
    """A subject whose session never comes back from frame 1, and whose overlay never from serial 3."""

    def __init__(self, **changes: Any) -> None:
        super().__init__([SimpleNamespace(name="")])
        self.serial_numbers = [None]
        self.options = options()
        self.revision, self.sessions, self.stuck, self.drawing = 1, 0, threading.Event(), threading.Event()
        self.never = threading.Event()

    def camera(self, width: int, height: int, turns: int, unsquared_size: tuple[int, int] | None) -> Any:
        return guess_camera(width, height)

    def session(self, camera: Any) -> Session:
        self.sessions += 1
        return Session(self, camera)

    def overlay(self, camera: Any, style: Any) -> Any:
        return self

    def draw(self, image: Any, poses: tuple[Pose, ...]) -> Any:
        if poses[0].index == 3 and not self.drawing.is_set():
            self.drawing.set()
            self.never.wait()
        return image.copy()


class Session:
    """A session that never comes back from frame 1."""

    estimate = None

    def __init__(self, subject: Subject, camera: Any) -> None:
        self.subject, self.camera = subject, camera

    def expect(self, serials: Any) -> None:
        pass

    def finish(self) -> None:
        pass

    def process(self, image: Any, index: int, time_s: float) -> tuple[Pose, ...]:
        if index == 1:
            self.subject.stuck.set()
            self.subject.never.wait()
        return (Pose(np.eye(4), np.eye(6), 0.9, TrackingState.TRACKED, time_s, index, 1.0),)


def frame(number: int) -> IncomingFrame:
    picture = DecodedFrame(number, np.full((120, 160, 3), number, dtype=np.uint8))
    return IncomingFrame(lambda: picture, time.monotonic())


def test_a_stuck_worker_is_replaced_and_its_task_fails() -> None:
    async def run() -> None:
        pool = WorkerPool(2, timeout_s=0.3, max_lost=3)
        asyncio.get_running_loop().set_default_executor(pool)
        never = threading.Event()
        stuck = [asyncio.ensure_future(asyncio.to_thread(never.wait)) for _ in range(2)]
        assert await asyncio.wait_for(asyncio.to_thread(lambda: 7), 10) == 7  # after both threads were replaced
        for one in await asyncio.gather(*stuck, return_exceptions=True):
            assert isinstance(one, StuckError)
        assert pool.replaced == 2
        with pytest.raises(ZeroDivisionError):
            await asyncio.to_thread(lambda: 1 / 0)
        with pytest.raises(StuckError):
            await asyncio.to_thread(never.wait)
        with pytest.raises(StuckError, match="start the server again"):
            await asyncio.to_thread(lambda: 7)
        never.set()  # they come back: there is room again
        while True:
            try:
                assert await asyncio.to_thread(lambda: 8) == 8
                break
            except StuckError:
                await asyncio.sleep(0.05)
        stuck_at_end = asyncio.ensure_future(asyncio.to_thread(threading.Event().wait))
        await asyncio.sleep(0.05)
        stuck_at_end.cancel()

    began_s = time.monotonic()
    asyncio.run(run())
    assert time.monotonic() - began_s < 30


def test_a_tracking_that_never_comes_back_is_replaced() -> None:
    subject: Any = Subject()
    feed = Feed(subject, "phone")
    feed.put(frame(0))
    wait(lambda: feed.newest is not None and feed.newest.frame.frame_id == 0)
    feed.put(frame(1))
    assert subject.stuck.wait(10)
    wait(lambda: feed.replace_if_stuck() or feed.failures == 1)
    feed.put(frame(2))
    wait(lambda: feed.newest is not None and feed.newest.frame.frame_id == 2)
    assert [notice.code for notice in feed.notices()] == ["tracking_failed"] and subject.sessions == 2
    subject.never.set()  # what the stuck thread answers now is nobody's
    time.sleep(0.2)
    assert feed.newest is not None and feed.newest.frame.frame_id == 2
    assert feed.find(1) is None and feed.find(2) is not None
    feed.close()


def test_pictures_are_drawn_though_one_never_gets_ready() -> None:
    subject: Any = Subject()
    feed, annotator = Feed(subject, "phone"), FrameAnnotator(subject)
    feed.put(frame(3))
    wait(lambda: feed.newest is not None)
    tracked: Any = feed.newest
    threading.Thread(target=annotator.draw, args=(tracked,), daemon=True).start()
    assert subject.drawing.wait(10)
    assert annotator.draw(tracked).image.shape == (120, 160, 3)
    subject.never.set()
    feed.close()


def test_a_camera_that_never_answers_is_opened_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    subject: Any = Subject()
    opened: list[str] = []
    never = threading.Event()

    def open_source(spec: str, **timeouts: float) -> Any:
        opened.append(spec)
        never.wait()
        raise RuntimeError

    monkeypatch.setattr(station_module, "open_source", open_source)
    monkeypatch.setattr(station_module, "STUCK_S", 0.2)
    feed = Feed(subject, "station")
    camera = station_module.StationCamera("rtsp://user:secret@host/1", feed)
    wait(lambda: camera.replace_if_stuck() or len(opened) == 2)
    assert camera.state[0] == "reconnecting" and "secret" not in camera.state[1]
    camera._ended.set()
    never.set()
    feed.close()


def test_recordings_end_at_their_quota_and_say_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recording_module, "LOW_BYTES", 10_000_000)
    monkeypatch.setattr(recording_module, "CHECK_INTERVAL_S", 0.0)
    subject: Any = Subject()
    feed = Feed(subject, "phone")
    (tmp_path / "live_old_1.mp4").write_bytes(bytes(5000))
    limits = RecordingOptions(quota_bytes=1_000_000)
    assert free_space(tmp_path, limits).free_bytes == 995_000
    recordings = Recordings(tmp_path, "part", limits)
    recordings.start(feed, FrameAnnotator(subject))
    feed.put(frame(4))
    wait(lambda: feed.newest is not None and feed.newest.frame.frame_id == 4)
    wait(lambda: [notice.code for notice in recordings.notices(feed)] == ["disk_low"])
    time.sleep(0.3)
    (tmp_path / "live_old_2.mp4").write_bytes(bytes(1_000_000))
    feed.put(frame(5))
    wait(lambda: recordings.of(feed) is None)
    (notice,) = recordings.notices(feed)
    assert notice.code == "recording_ended" and "quota of 0.001 GB" in notice.text
    recordings.stop(feed)
    assert recordings.finished == [0] and recordings.path(0).stat().st_size > 500  # type: ignore[union-attr]
    recordings.start(feed, FrameAnnotator(subject))  # it is refused, and said
    assert recordings.of(feed) is None and [one.code for one in recordings.notices(feed)] == ["recording_ended"]
    monkeypatch.setattr(recording_module, "MIN_FREE_BYTES", 1 << 62)
    full = free_space(tmp_path, RecordingOptions())
    assert "disk is almost full" in full.exhausted
    feed.close()


CODE = """
import threading
from arview.station.live.stream import feed, recording
from arview.station.live.server import hub

def stay():
    print("stuck", flush=True)
    threading.Event().wait()

{patch}
from arview.cli import main
main()
"""
PATCHES = {
    "tracking": "feed.Feed._step = lambda self, incoming: stay()",
    "drawing": "recording.Recorder._write = lambda self, tracked: stay()",
    "event loop": "hub.Hub._replace_stuck = lambda self: stay()",
    "closing": "hub.Hub.close = lambda self: __import__('asyncio').sleep(1000)",
}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("stuck", "number"), [*((name, signal.SIGTERM) for name in PATCHES), ("event loop", signal.SIGINT)]
)
def test_the_first_signal_ends_the_program_within_five_seconds(
    tmp_path: Path, stuck: str, number: signal.Signals
) -> None:
    command = [sys.executable, "-c", CODE.format(patch=PATCHES[stuck]), "live", "--part", str(PART), "--http"]
    command += ["--source", str(CLIP), "--record", str(tmp_path / "out.mp4"), "--port", "0"]
    process = subprocess.Popen(
        command, cwd=tmp_path, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        env={**os.environ, "ARVIEW_DATA": str(tmp_path / "data")},
    )  # fmt: skip
    try:
        assert process.stdout is not None
        seen: set[str] = set()
        wanted = {"Ctrl-C"} if stuck == "closing" else {"Ctrl-C", "stuck"}
        assert any(wanted <= (seen := seen | {line.split()[0]}) for line in process.stdout if line.strip())
        asked_s = time.monotonic()
        process.send_signal(number)
        _, err = process.communicate(timeout=60)
        took_s = time.monotonic() - asked_s
    finally:
        process.kill()
    assert process.returncode == 130 and "Traceback" not in err, err
    assert took_s < 5.0 + 1.0, took_s  # a second for a machine that does other work
    assert "arview: ended" in err
