"""Feeds, annotators, recordings and the inspection file, with scripted trackers."""

from __future__ import annotations

import asyncio
import json
import shutil
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from arview.cad import load_part
from arview.cad.model import Model
from arview.camera import Camera
from arview.camera.lens import LensDistortion, LensModel
from arview.camera.read import guess_camera
from arview.errors import InputError, MismatchError
from arview.fiducials.serial_code import SerialNumbers
from arview.inspection import load_inspection, save_inspection
from arview.pose import Pose, TrackingState
from arview.station.live.options import RecordingOptions
from arview.station.live.protocol import NOTICE_CODES
from arview.station.live.stream import recording
from arview.station.live.stream.annotator import KEPT_STYLES, FrameAnnotator
from arview.station.live.stream.documents import _source_name, pose_document
from arview.station.live.stream.feed import KEPT_FRAMES, Feed, TrackedFrame
from arview.station.live.stream.frames import DecodedFrame, IncomingFrame
from arview.station.live.stream.inspection_file import InspectionFile
from arview.station.live.stream.newest import AsyncNewestSlot, NewestSlot
from arview.station.live.stream.notices import Notice
from arview.station.live.stream.recording import Recorder, Recordings, _fitted
from arview.station.live.stream.subject import OverlayStyle
from arview.video import Image, open_source
from helpers.live_client import wait
from helpers.live_sample import INSPECTION, PART, options


class Session:
    """A session with a given duration per frame, a constant pose and a failure on demand."""

    estimate = None

    def __init__(self, subject: Scripted, camera: Camera) -> None:
        self.subject, self.camera = subject, camera

    def expect(self, serials: list[SerialNumbers | None]) -> None:
        self.subject.expected += serials

    def confirm(self, part: int | None) -> None:
        self.subject.confirmed += 1

    def reset(self, part: int | None) -> None:
        self.subject.resets += 1

    def finish(self) -> None:
        pass

    def process(self, image: Image, index: int, time_s: float) -> tuple[Pose, ...]:
        time.sleep(self.subject.pause_s)
        if self.subject.fail_at == index:
            raise RuntimeError("a bug")
        place = np.eye(4)
        place[2, 3] = 500.0
        return (Pose(place, np.eye(6), 0.9, TrackingState.TRACKED, time_s, index, 1.0),)


class Overlay:
    """Draws the index of the frame into the picture."""

    def draw(self, image: Image, poses: tuple[Pose, ...]) -> Image:
        drawn = image.copy()
        drawn[:8, :8] = poses[0].index % 250
        return drawn


class Scripted(list[Any]):
    """One subject without a part."""

    def __init__(self, pause_s: float = 0.0, fail_at: int | None = None) -> None:
        super().__init__([SimpleNamespace(name="")])
        self.pause_s, self.fail_at = pause_s, fail_at
        self.revision = 1
        self.resets = self.sessions = self.overlays = self.confirmed = 0
        self.serial_numbers: list[SerialNumbers | None] = [None]
        self.expected: list[SerialNumbers | None] = []
        self.options = options()

    def camera(self, width: int, height: int, turns: int, unsquared_size: tuple[int, int] | None) -> Camera:
        if width == height:
            raise MismatchError("/secret/place/camera.json: for frames of another shape")
        return guess_camera(width, height)

    def session(self, camera: Camera) -> Session:
        self.sessions += 1
        return Session(self, camera)

    def overlay(self, camera: Camera, style: OverlayStyle) -> Overlay:
        self.overlays += 1
        return Overlay()


def feed_of(subject: Any, kind: str = "phone") -> Feed:
    return Feed(subject, kind)


def frame(number: int, shape: tuple[int, int] = (120, 160)) -> IncomingFrame:
    picture = DecodedFrame(number, np.full((*shape, 3), number % 256, dtype=np.uint8))
    return IncomingFrame(lambda: picture, time.monotonic())


@pytest.fixture
def closing() -> Iterator[Callable[[Feed], Feed]]:
    feeds: list[Feed] = []
    yield lambda feed: feeds.append(feed) or feed  # type: ignore[func-returns-value]
    for feed in feeds:
        feed.close()


def test_a_confirmation_and_another_serial_number_reach_the_session(closing: Callable[[Feed], Feed]) -> None:
    subject = Scripted()
    feed = closing(feed_of(subject))
    feed.put(frame(0))
    assert wait(lambda: feed.newest is not None and feed.newest.frame.frame_id == 0)
    assert (subject.confirmed, subject.expected) == (0, [None])
    subject.serial_numbers = [SerialNumbers("BP-0042")]
    feed.confirm()
    for number in (1, 2):
        feed.put(frame(number))
        assert wait(lambda number=number: feed.newest.frame.frame_id == number)
    assert subject.confirmed == 1
    assert subject.expected == [None, SerialNumbers("BP-0042"), SerialNumbers("BP-0042")]


class WideLens(Scripted):
    """A subject whose camera file has a fisheye lens."""

    def camera(self, width: int, height: int, turns: int, unsquared_size: tuple[int, int] | None) -> Camera:
        lens = LensDistortion(LensModel.FISHEYE, (0.05, 0.01))
        return Camera(width, height, 0.5 * width, 0.5 * width, 0.5 * width - 0.5, 0.5 * height - 0.5, lens=lens)


def test_pages_get_pictures_of_a_wide_station_camera_undistorted(closing: Callable[[Feed], Feed]) -> None:
    feed = closing(feed_of(WideLens(), "station"))
    feed.put(frame(1))
    assert wait(lambda: feed.newest is not None)
    assert feed.newest is not None
    camera, picture = feed.newest.camera, feed.newest.frame.image
    assert camera.lens is None and not camera.is_distorted
    assert picture.shape == (camera.height, camera.width, 3)
    assert camera.width <= 1.25 * 160 + 1
    # A phone shows its own pictures, which must not be drawn on as if they were undistorted.
    phone = closing(feed_of(WideLens(), "phone"))
    phone.put(frame(1))
    assert wait(lambda: phone.newest is not None)
    assert [notice.level for notice in phone.notices()] == ["error"]
    assert "lens model fisheye" in phone.notices()[0].text


@pytest.mark.slow
def test_a_slow_tracker_takes_the_newest_frame_and_counts_the_others(closing: Callable[[Feed], Feed]) -> None:
    """30 frames per second into a tracker that manages 5: no pose is older than one waiting and one tracking."""
    feed = closing(feed_of(Scripted(pause_s=0.2)))
    tracked: list[TrackedFrame] = []
    feed.listen(tracked.append)
    late_s = 0.0  # by which this machine, busy with other tests, wakes a thread that slept
    for number in range(60):
        feed.put(frame(number))
        began_s = time.monotonic()
        time.sleep(1 / 30)
        late_s = max(late_s, time.monotonic() - began_s - 1 / 30)
    wait(lambda: tracked and tracked[-1].frame.frame_id == 59)
    ages_s = [one.done_s - one.arrived_s for one in tracked]
    assert max(ages_s) < 0.2 + 0.2 + 0.1 + 4.0 * late_s
    assert 7 <= len(tracked) <= 14
    assert feed.received == 60 and feed.dropped == 60 - len(tracked) == tracked[-1].dropped
    ids = [one.frame.frame_id for one in tracked]
    assert ids == sorted(set(ids))


@pytest.mark.slow
def test_memory_of_a_feed_is_bounded(closing: Callable[[Feed], Feed]) -> None:
    feed = closing(feed_of(Scripted()))
    for number in range(200):
        feed.put(frame(number))
        wait(lambda number=number: feed.newest is not None and feed.newest.frame.frame_id == number)
    assert sum(feed.find(number) is not None for number in range(200)) == KEPT_FRAMES
    assert feed.find(199 - KEPT_FRAMES) is None and feed.find(199 - KEPT_FRAMES + 1) is not None


def test_an_error_of_the_tracker_is_reported_and_tracking_restarts(closing: Callable[[Feed], Feed]) -> None:
    subject = Scripted(fail_at=2)
    feed = closing(feed_of(subject))
    for number in range(5):
        feed.put(frame(number))
        wait(lambda number=number: feed.failures or (feed.newest is not None and feed.newest.frame.frame_id == number))
        time.sleep(0.05)
    wait(lambda: feed.newest is not None and feed.newest.frame.frame_id == 4)
    assert subject.sessions == 2 and feed.failures == 1
    assert [notice.code for notice in feed.notices()] == ["tracking_failed"]


def test_a_phone_that_is_turned_gets_another_session_and_a_misfit_none(closing: Callable[[Feed], Feed]) -> None:
    subject = Scripted()
    feed = closing(feed_of(subject))
    for number, shape in enumerate([(120, 160), (120, 160), (160, 120), (160, 160), (120, 160)]):
        feed.put(frame(number, shape))
        wait(lambda number=number: feed.newest is not None and feed.newest.frame.frame_id == number)
        assert feed.newest is not None
        is_misfit = shape == (160, 160)
        assert (feed.newest.pose.cam_from_model is None) == is_misfit
        assert [notice.code for notice in feed.notices()] == (["size_refused"] if is_misfit else [])
    assert subject.sessions == 3


def test_frames_that_cannot_be_read_are_counted_and_told(closing: Callable[[Feed], Feed]) -> None:
    feed = closing(feed_of(Scripted()))
    for number in range(15):
        feed.put(IncomingFrame(lambda: None, time.monotonic()))
        wait(lambda number=number: feed.unreadable == number + 1)
    assert [notice.code for notice in feed.notices()] == ["stamp_unreadable"]
    feed.put(frame(1))
    wait(lambda: feed.notices() == [])


def test_slots_hold_one_value() -> None:
    slot: NewestSlot[int] = NewestSlot()
    for value in range(5):
        slot.put(value)
    assert (slot.take(), slot.dropped) == (4, 4)
    assert slot.take(timeout_s=0.01) is None
    taken: list[int | None] = []
    waiting = threading.Thread(target=lambda: taken.append(slot.take()))
    waiting.start()
    slot.close()
    waiting.join(5)
    slot.put(1)
    assert taken == [None] and slot.is_closed


def test_inbox_brings_the_newest_from_threads_to_a_task() -> None:
    async def go() -> list[int]:
        inbox: AsyncNewestSlot[int] = AsyncNewestSlot(asyncio.get_running_loop())

        def write() -> None:
            for value in range(2000):
                inbox.put(value)

        writer = threading.Thread(target=write)
        writer.start()
        got = [await asyncio.wait_for(inbox.take(), 5)]
        while got[-1] != 1999:
            got.append(await asyncio.wait_for(inbox.take(), 5))
        writer.join()
        with pytest.raises(TimeoutError):
            await asyncio.wait_for(inbox.take(), 0.05)
        return got

    got = asyncio.run(go())
    assert got == sorted(set(got)) and got[-1] == 1999


def tracked_frame(number: int = 0, shape: tuple[int, int] = (120, 160)) -> TrackedFrame:
    picture = DecodedFrame(number, np.full((*shape, 3), 50, dtype=np.uint8))
    pose = Pose(None, None, 0.0, TrackingState.SEARCHING, 0.0, number, 0.0, "too dark")
    return TrackedFrame(picture, (pose,), guess_camera(shape[1], shape[0]), 1.0, 1.01, 1.03, 3, 1, number)


def test_a_frame_is_drawn_once_for_each_style() -> None:
    subject: Any = Scripted()
    annotator = FrameAnnotator(subject)
    one = tracked_frame()
    assert annotator.draw(one) is annotator.draw(one)
    assert annotator.draw(one, OverlayStyle(status=False)) is not annotator.draw(one)
    assert subject.overlays == 2
    for opacity in (0.1, 0.2, 0.3, 0.4, 0.5, 0.6):
        annotator.style = replace(annotator.style, opacity=opacity)
        annotator.draw(one)
    assert len(annotator._renderers) == KEPT_STYLES
    overlays = subject.overlays
    subject.revision += 1  # another inspection
    annotator.draw(tracked_frame(1))
    assert subject.overlays == overlays + 1


def test_pose_document_measures_its_times() -> None:
    document = pose_document(tracked_frame(7), 1.05)
    assert (document["wait_ms"], document["track_ms"], document["server_ms"]) == (10.0, 20.0, 50.0)
    assert (document["id"], document["dropped"], document["reason"]) == (7, 3, "too dark")
    json.dumps(document, allow_nan=False)


@pytest.mark.parametrize(
    ("source", "shown"),
    [
        ("rtsp://user:pass@10.0.0.3:554/live?key=1", "rtsp://10.0.0.3:554"),
        ("0", "camera 0"),
        ("/home/someone/clip.mp4", "clip.mp4"),
        ("C:\\clips\\clip.mp4", "clip.mp4"),
    ],
)
def test_names_of_sources_hide_passwords_and_folders(source: str, shown: str) -> None:
    assert _source_name(source) == shown


def test_notices_are_of_the_protocol() -> None:
    with pytest.raises(ValueError, match="not in the protocol"):
        Notice("made_up", "info", "x")
    assert all(text for text in NOTICE_CODES.values())


# --- recordings -----------------------------------------------------------------------------------------


def test_recording_fits_in_pictures_of_another_shape(tmp_path: Path, closing: Callable[[Feed], Feed]) -> None:
    subject: Any = Scripted()
    feed = closing(feed_of(subject))
    recorder = Recorder(feed, FrameAnnotator(subject), tmp_path / "out.mp4")
    for number in range(8):
        feed.put(frame(200, (120, 160) if number < 4 else (160, 120)))
        wait(lambda number=number: feed.newest is not None and feed.newest.serial >= number)
        time.sleep(0.1)
    assert recorder.stop()
    shown = [one.image for one in open_source(tmp_path / "out.mp4")]
    poses = [json.loads(line) for line in (tmp_path / "out.jsonl").read_text().splitlines()]
    assert [one["index"] for one in poses] == list(range(len(shown)))
    assert poses[0]["time_s"] == 0.0 and 0.3 < poses[-1]["time_s"] < 60.0
    assert (poses[0]["state"], poses[0]["cam_from_model"][2][3]) == ("tracked", 500.0)
    assert 4 <= len(shown) <= 8 and all(image.shape == (120, 160, 3) for image in shown)
    assert shown[0][60, 5].min() > 150 and shown[-1][60, 5].max() < 60  # bars beside the upright picture
    upright = _fitted(np.full((160, 120, 3), 200, dtype=np.uint8), 160, 120)
    assert upright[:, 35:125].min() == 200 and upright[:, :34].max() == 0 and upright[:, 126:].max() == 0


def test_a_recording_that_cannot_be_written_is_told_and_harms_nobody(
    tmp_path: Path, closing: Callable[[Feed], Feed]
) -> None:
    subject: Any = Scripted()
    feed = closing(feed_of(subject))
    recordings = Recordings(tmp_path, "a part/../x")
    recordings.start(feed, FrameAnnotator(subject), tmp_path / "gone" / "out.mp4")
    feed.put(frame(1))
    wait(lambda: recordings.notices(feed))
    (notice,) = recordings.notices(feed)
    assert notice.code == "recording_failed" and str(tmp_path) not in notice.text
    feed.put(frame(2))
    wait(lambda: feed.newest is not None and feed.newest.frame.frame_id == 2)
    recordings.start(feed, FrameAnnotator(subject))
    feed.put(frame(3))
    wait(lambda: feed.newest is not None and feed.newest.frame.frame_id == 3)
    time.sleep(0.2)
    recordings.stop_all()
    (path,) = [recordings.path(number) for number in recordings.finished]
    assert path is not None and path.parent == tmp_path and path.name.startswith("live_a_part_.._x_")
    assert recordings.notices(feed) == [] and recordings.path(5) is None


def test_a_recording_ends_before_the_disk_is_full(
    tmp_path: Path, closing: Callable[[Feed], Feed], monkeypatch: pytest.MonkeyPatch
) -> None:
    subject: Any = Scripted()
    feed = closing(feed_of(subject))
    monkeypatch.setattr(recording, "CHECK_INTERVAL_S", 0.0)
    recorder = Recorder(feed, FrameAnnotator(subject), tmp_path / "out.mp4", RecordingOptions())
    feed.put(frame(1))
    wait(lambda: feed.newest is not None and feed.newest.frame.frame_id == 1)
    time.sleep(0.2)
    monkeypatch.setattr(recording, "MIN_FREE_BYTES", 1 << 60)
    feed.put(frame(2))
    wait(lambda: not recorder.is_running)
    assert recorder.stop() and len(list(open_source(tmp_path / "out.mp4"))) == 1
    assert len((tmp_path / "out.jsonl").read_text().splitlines()) == 1


# --- the inspection file --------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def model() -> Model:
    return load_part(PART).model


@pytest.mark.slow
def test_inspection_file_keeps_the_last_good_one(tmp_path: Path, model: Model) -> None:
    path = tmp_path / "inspection.json"
    shutil.copy(INSPECTION, path)
    file = InspectionFile(path, model, None, None)
    good = file.inspection
    assert not file.reload() and file.notices() == []
    path.write_text("{")
    assert not file.reload() and file.notices() == []  # the file may be in the middle of a write
    assert not file.reload()
    (notice,) = file.notices()
    assert notice.code == "inspection_unreadable" and str(tmp_path) not in notice.text and file.inspection is good
    save_inspection(replace(good, serial="BP-2"), path)
    assert file.reload() and file.inspection.serial == "BP-2" and file.notices() == []
    path.unlink()
    file.reload()
    file.reload()
    assert [notice.code for notice in file.notices()] == ["inspection_unreadable"]
    save_inspection(replace(good, serial="BP-2"), path)
    assert not file.reload() and file.notices() == []  # the same content: nothing new to show


@pytest.mark.slow
def test_inspection_that_is_old_or_of_another_part_is_told(tmp_path: Path, model: Model) -> None:
    path = tmp_path / "inspection.json"
    good = load_inspection(INSPECTION)
    now = datetime(2026, 11, 22, 12, 0, tzinfo=UTC)
    save_inspection(replace(good, created=now - timedelta(hours=5), serial="BP-1"), path)
    for serial, max_age_s, expected in (
        ("BP-1", 6 * 3600.0, []),
        ("BP-1", 4 * 3600.0, ["inspection_old"]),
        ("BP-2", None, ["inspection_serial"]),
        ("BP-2", 60.0, ["inspection_old", "inspection_serial"]),
        (None, None, []),
    ):
        said = InspectionFile(path, model, serial, max_age_s).notices(now)
        assert [notice.code for notice in said] == expected
    with pytest.raises(MismatchError):
        save_inspection(replace(good, model_hash="0" * 64), path)
        InspectionFile(path, model, None, None)
    with pytest.raises(InputError):
        InspectionFile(tmp_path / "none.json", model, None, None)
