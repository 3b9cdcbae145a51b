"""Recordings that a crash has cut off are recovered and listed; notices before the disk is full; snapshots are kept."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from arview.cad import load_part
from arview.inspection import load_inspection
from arview.station.live.options import RecordingOptions
from arview.station.live.stream.inspection_file import InspectionFile
from arview.station.live.stream.recording import Recordings
from arview.station.live.stream.recovery import recover_recordings
from arview.video import VideoSink, open_source
from helpers.live_client import running, wait
from helpers.live_sample import INSPECTION, PART, loader, options

WRITER = """
import sys, time
import numpy as np
from pathlib import Path
from arview.pose import Pose, TrackingState
from arview.pose_file import PoseWriter
from arview.video import VideoSink
path = Path(sys.argv[1])
rng = np.random.default_rng(0)
sink, poses = VideoSink(path, 320, 240, is_recoverable=True), PoseWriter(path.with_suffix(".jsonl"))
for index in range(100000):
    image = np.full((240, 320, 3), index % 200, np.uint8)
    image[:, :100] = rng.integers(0, 255, (240, 100, 3))
    sink.write(image, index / 30)
    poses.write(Pose(np.eye(4), np.eye(6), 0.9, TrackingState.TRACKED, index / 30, index, 1.0))
    print(index, flush=True)
"""


def killed_recording(folder: Path, frames: int) -> int:
    """Kill a program in the middle of a recording; returns the frames that it had written by then."""
    process = subprocess.Popen(
        [sys.executable, "-c", WRITER, str(folder / "live_part_1.mp4")], stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    written = 0
    for line in process.stdout:
        written = int(line)
        if written >= frames:
            break
    process.send_signal(signal.SIGKILL)
    process.communicate()
    return written


@pytest.mark.slow
def test_a_recording_that_was_killed_is_recovered_up_to_its_last_second(tmp_path: Path) -> None:
    written = killed_recording(tmp_path, 200)
    assert not list(tmp_path.glob("*.mp4"))
    recordings = Recordings(tmp_path, "part")
    recordings.adopt()
    (found,) = recordings.listed()
    assert found.is_recovered and found.path.name == "live_part_1_recovered.mp4" and recordings.path(0) == found.path
    shown = [frame.image[120, 300] for frame in open_source(found.path)]
    assert written - 60 <= len(shown) <= written + 100  # the program went on between its last line and its end
    assert all(abs(int(color[0]) - index % 200) <= 4 for index, color in enumerate(shown))
    assert found.seconds == pytest.approx(len(shown) / 30, abs=0.1)
    poses = [json.loads(line) for line in found.path.with_suffix(".jsonl").read_text().splitlines()]
    assert [pose["index"] for pose in poses] == list(range(len(poses))) and len(shown) - 5 <= len(poses) <= len(shown)
    assert not list(tmp_path.glob(".*"))
    assert recordings.finished == []  # of this run
    again = Recordings(tmp_path, "part")
    again.adopt()
    assert [one.path for one in again.listed()] == [found.path]


def test_what_another_program_is_writing_is_left_alone(tmp_path: Path) -> None:
    other = tmp_path / f".live_part.mp4.{os.getppid()}.part"
    other.write_bytes(b"x" * 100)
    garbage = tmp_path / ".live_old.mp4.999999999.part"
    garbage.write_bytes(b"y" * 100)
    foreign = tmp_path / ".else.mp4.999999999.part"
    foreign.write_bytes(b"z" * 100)
    assert recover_recordings(tmp_path) == []
    assert sorted(tmp_path.iterdir()) == sorted([other, garbage, foreign])  # nothing is thrown away


def test_the_recording_of_this_process_is_left_alone_and_that_of_its_number_before_is_not(tmp_path: Path) -> None:
    sink = VideoSink(tmp_path / "live_a.mp4", 64, 64, is_recoverable=True)
    for index in range(90):
        sink.write(np.full((64, 64, 3), index, np.uint8), index / 30)
    time.sleep(0.3)
    assert recover_recordings(tmp_path, running=[tmp_path / "live_a.mp4"]) == []
    # In a container each run has the same process number.
    copied = (tmp_path / f".live_a.mp4.{os.getpid()}.part").read_bytes()
    sink.close()
    (tmp_path / f".live_b.mp4.{os.getpid()}.part").write_bytes(copied)
    recovered = recover_recordings(tmp_path)
    assert [path.name for path in recovered] == ["live_b_recovered.mp4"]
    assert len(list(open_source(recovered[0]))) >= 29


def test_a_finished_recording_is_an_ordinary_video(tmp_path: Path) -> None:
    with VideoSink(tmp_path / "a.mp4", 64, 64, is_recoverable=True) as sink:
        for index in range(75):
            sink.write(np.full((64, 64, 3), index, np.uint8), index / 30)
    assert len(list(open_source(tmp_path / "a.mp4"))) == 75
    assert (tmp_path / "a.mp4").read_bytes().count(b"moov") >= 1


def test_an_inspection_from_the_future_is_told(tmp_path: Path) -> None:
    part = load_part(str(PART), None)
    inspection = load_inspection(INSPECTION, part.model)
    file = InspectionFile(INSPECTION, part.model, None, 86400.0)
    at = inspection.created
    assert [one.code for one in file.notices(at - timedelta(hours=5))] == ["inspection_future"]
    assert "by 5 h" in file.notices(at - timedelta(hours=5))[0].text
    assert file.notices(at - timedelta(minutes=2)) == [] == file.notices(at + timedelta(hours=1))
    assert [one.code for one in file.notices(at + timedelta(days=2))] == ["inspection_old"]
    assert replace(inspection, created=datetime.now(UTC)).age_s() < 60


@pytest.mark.slow
def test_low_disk_is_told_before_a_recording_and_snapshots_are_kept(tmp_path: Path) -> None:
    (tmp_path / "live_old.mp4").write_bytes(b"x" * 1000)
    chosen = options(record_folder=tmp_path, max_age_s=None, recording=RecordingOptions(quota_bytes=10_000))
    with running(chosen, loader(chosen)) as server:
        page = server.session()
        name = page.join()
        codes = [one["code"] for one in page.json("GET", f"/api/clients/{name}/status")[1]["notices"]]
        assert "disk_low" in codes
        listed = wait(lambda: page.json("GET", "/api/recordings")[1]["recordings"], 20)
        assert [(one["number"], one["name"], one["seconds"], one["is_recovered"]) for one in listed] == [
            (0, "live_old.mp4", None, False)
        ]
        assert page.ask("GET", "/api/recordings/0")[2] == b"x" * 1000
        assert page.ask("GET", "/api/recordings/1")[0] == 404
        from arview.station.live.stream.frames import to_jpeg
        from helpers.live_sample import frames

        page.ask("POST", f"/api/clients/{name}/frame?id=5", to_jpeg(frames()[0], 92), Content_Type="image/jpeg")
        status, kept = page.json("POST", f"/api/clients/{name}/snapshots?id=5")
        assert status == 201
        assert [one["name"] for one in page.json("GET", "/api/snapshots")[1]["snapshots"]] == [kept["name"]]
        assert page.ask("GET", f"/api/snapshots/{kept['name']}")[2].startswith(b"\x89PNG")
        for wrong in ("..%2fdevices.json", "live_old.mp4", "snapshot_..png%00", "snapshot_x.png"):
            assert page.ask("GET", f"/api/snapshots/{wrong}")[0] == 404
