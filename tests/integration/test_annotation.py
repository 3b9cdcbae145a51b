"""annotate with scripted sources, sessions and overlays: order, files, Ctrl-C, errors, bounded memory."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from arview.annotation import QUEUED_FRAMES, annotate
from arview.core.messages import sentence
from arview.errors import InputError, OutputError
from arview.pose import Pose, StepReport, TrackingState
from arview.pose_file import PoseWriter, pose_line
from arview.video import Frame, FrameSource, Image, VideoSink, open_source
from helpers.video_files import number_of, numbered


class Pictures(FrameSource):
    """Frames of `numbered` at 10 per second."""

    def __init__(self, count: int, fail_at: int | None = None, error: BaseException | None = None) -> None:
        self.name, self.width, self.height, self.fps = "pictures", 160, 120, 10.0
        self.count, self.fail_at, self.error = count, fail_at, error
        self.given = 0

    def __iter__(self) -> Iterator[Frame]:
        for index in range(self.count):
            if index == self.fail_at and self.error is not None:
                raise self.error
            self.given += 1
            yield Frame(numbered(index % 25), index, index / 10)
        self.skipped, self.ended_reason = 2, "pictures: the file is cut short"


class Walk:
    """A session that tracks, moving by 1 mm a frame, loses every fourth frame, and sees the post in the sixth alone."""

    def process(self, image: Image, index: int, time_s: float) -> tuple[Pose, ...]:
        if index % 4 == 3:
            return (Pose(None, None, 0.1, TrackingState.LOST, time_s, index, 0.5),)
        place = np.eye(4)
        place[:3, 3] = [index, 0.0, 500.0]
        unverified = ("nut",) if index == 5 else ("post", "nut")
        return (Pose(place, np.eye(6), 0.9, TrackingState.TRACKED, time_s, index, 1.5, unverified=unverified),)


class Mark:
    """An overlay that blackens the top left corner where there is a pose."""

    def __init__(self, seconds: float = 0.0, fail_at: int | None = None) -> None:
        self.seconds, self.fail_at, self.drawn = seconds, fail_at, 0

    def draw(self, image: Image, poses: tuple[Pose, ...], /, fps: float | None = None) -> Image:
        (pose,) = poses
        time.sleep(self.seconds)
        if pose.index == self.fail_at:
            raise RuntimeError("drawing failed")
        assert fps is None or fps > 0
        self.drawn += 1
        image = image.copy()
        if pose.cam_from_model is not None:
            image[:16, :16] = 0
        return image


def left_over(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_video_and_poses_hold_every_frame_in_order(tmp_path: Path) -> None:
    source = Pictures(12)
    done: list[tuple[int, int]] = []
    sink = VideoSink(tmp_path / "out.mp4", 160, 120, 10.0)
    summary = annotate(
        source, Walk(), Mark(), sink, tmp_path / "poses.jsonl", progress=lambda n, pose: done.append((n, pose.index))
    )
    assert (summary.frames, summary.skipped, summary.is_interrupted) == (12, 2, False)
    assert summary.states == {"tracked": 9, "lost": 3}
    assert summary.ended_reason == "pictures: the file is cut short"
    assert summary.fps > 0 and summary.ms[:4] == (1.5, 1.5, 1.5, 0.5)
    assert done == [(k + 1, k) for k in range(12)]
    lines = [json.loads(line) for line in (tmp_path / "poses.jsonl").read_text().splitlines()]
    assert [line["index"] for line in lines] == list(range(12))
    pose = {"index", "time_s", "state", "quality", "cam_from_model", "covariance", "ms", "reason"}
    pose |= {"mismatches", "unverified", "alternatives"}
    found = {"completeness", "presence", "presence_details", "identity", "identity_reason", "serial", "instance"}
    assert set(lines[0]) == pose | found
    assert set(lines[3]) == pose
    assert (
        lines[4]["unverified"] == ["post", "nut"] and lines[5]["unverified"] == ["nut"] and lines[3]["unverified"] == []
    )
    assert summary.never_verified == ("nut",)
    assert lines[5]["cam_from_model"][0] == [1.0, 0.0, 0.0, 5.0] and lines[5]["time_s"] == 0.5
    assert lines[3]["cam_from_model"] is None and lines[3]["state"] == "lost"
    with open_source(tmp_path / "out.mp4") as video:
        images = [frame.image for frame in video]
    assert [number_of(image) for image in images] == list(range(12))
    assert [bool(image[:8, :8].mean() < 40) for image in images] == [k % 4 != 3 for k in range(12)]
    assert left_over(tmp_path) == ["out.mp4", "poses.jsonl"]


def test_poses_alone_need_neither_overlay_nor_sink(tmp_path: Path) -> None:
    annotate(Pictures(3), Walk(), poses_path=tmp_path / "poses.jsonl")
    assert len((tmp_path / "poses.jsonl").read_text().splitlines()) == 3


def test_seconds_choose_frames_by_their_time_stamps(tmp_path: Path) -> None:
    source = Pictures(100)
    annotate(source, Walk(), poses_path=tmp_path / "poses.jsonl", start_s=0.45, end_s=0.9)
    lines = (tmp_path / "poses.jsonl").read_text().splitlines()
    assert [json.loads(line)["index"] for line in lines] == [5, 6, 7, 8]
    assert source.given == 10  # not read to its end
    with pytest.raises(OutputError, match="no frame in the wanted range"):
        annotate(Pictures(5), Walk(), poses_path=tmp_path / "none.jsonl", start_s=9.0)
    assert left_over(tmp_path) == ["poses.jsonl"]


def test_ctrl_c_finishes_both_files(tmp_path: Path) -> None:
    sink = VideoSink(tmp_path / "out.mp4", 160, 120, 10.0)
    source = Pictures(50, 7, KeyboardInterrupt())
    summary = annotate(source, Walk(), Mark(0.01), sink, tmp_path / "poses.jsonl")
    assert summary.is_interrupted and summary.frames == 7
    with open_source(tmp_path / "out.mp4") as video:
        assert [number_of(frame.image) for frame in video] == list(range(7))
    assert len((tmp_path / "poses.jsonl").read_text().splitlines()) == 7
    assert left_over(tmp_path) == ["out.mp4", "poses.jsonl"]


def test_ctrl_c_before_the_first_frame_leaves_no_video(tmp_path: Path) -> None:
    sink = VideoSink(tmp_path / "out.mp4", 160, 120, 10.0)
    summary = annotate(Pictures(5, 0, KeyboardInterrupt()), Walk(), Mark(), sink)
    assert summary.is_interrupted and summary.frames == 0
    assert left_over(tmp_path) == []


@pytest.mark.parametrize("where", ["source", "overlay"])
def test_errors_go_to_the_caller_and_leave_nothing(tmp_path: Path, where: str) -> None:
    error = InputError("source: unplugged")
    source = Pictures(40, 20, error) if where == "source" else Pictures(40)
    overlay = Mark(fail_at=5 if where == "overlay" else None)
    sink = VideoSink(tmp_path / "out.mp4", 160, 120, 10.0)
    before = set(threading.enumerate())  # A server of another test may still be stopping.
    with pytest.raises((InputError, RuntimeError), match=r"unplugged|drawing failed"):
        annotate(source, Walk(), overlay, sink, tmp_path / "poses.jsonl")
    assert left_over(tmp_path) == []
    assert not [thread for thread in set(threading.enumerate()) - before if thread.name.startswith("arview")]


def test_older_files_survive_a_failed_run(tmp_path: Path) -> None:
    poses = tmp_path / "poses.jsonl"
    poses.write_text("old\n")
    with pytest.raises(InputError):
        annotate(Pictures(5, 3, InputError("dead")), Walk(), poses_path=poses)
    assert poses.read_text() == "old\n" and left_over(tmp_path) == ["poses.jsonl"]


class Hole:
    """A sink that only counts."""

    frames_written = 0
    closed = False

    def write(self, image: Image, time_s: float) -> None:
        self.frames_written += 1

    def close(self) -> None:
        self.closed = True

    def abort(self) -> None:
        raise AssertionError("nothing went wrong")


def test_slow_drawing_holds_the_source_back() -> None:
    source, overlay, sink = Pictures(40), Mark(0.005), Hole()
    ahead: list[int] = []
    annotate(source, Walk(), overlay, sink, progress=lambda done, _: ahead.append(done - overlay.drawn))
    assert max(ahead) <= QUEUED_FRAMES + 2  # the queue, one being drawn and one being put
    assert sink.frames_written == 40 and sink.closed


def test_poses_that_cannot_be_written(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_text("")
    for path in (file / "poses.jsonl", tmp_path / "none" / "poses.jsonl", tmp_path):
        with pytest.raises(OutputError):
            PoseWriter(path)


def test_covariance_that_is_not_finite_is_null() -> None:
    pose = Pose(np.eye(4), np.full((6, 6), np.inf), 0.5, TrackingState.CRITICAL, 0.0, 0)
    assert json.loads(pose_line(pose))["covariance"] is None


def test_sink_without_overlay_is_refused() -> None:
    with pytest.raises(ValueError, match="overlay"):
        annotate(Pictures(1), Walk(), sink=Hole())


class Worker:
    """A session of a part with two steps; the first is done in the sixth frame, after another part stood there."""

    def process(self, image: Image, index: int, time_s: float) -> tuple[Pose, ...]:
        fault = sentence("steps.wrong_part", name="post")
        steps = StepReport(
            names=("post", "both nuts"),
            components=(("post",), ("nut_1", "nut_2")),
            is_current=(index < 5, index >= 5),
            started_s=(0.0, 0.5 if index >= 5 else None),
            done_s=(0.5 if index >= 5 else None, None),
            faults=(fault,) if 2 <= index < 5 else (),
            history=((fault, 0.2, 0.5 if index >= 5 else None),) if index >= 2 else (),
        )
        return (Pose(np.eye(4), np.eye(6), 0.9, TrackingState.TRACKED, time_s, index, 1.5, steps=steps),)


def test_steps_are_written_with_a_photo_of_each(tmp_path: Path) -> None:
    path = tmp_path / "poses.jsonl"
    summary = annotate(Pictures(10), Worker(), poses_path=path)
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    assert lines[3]["steps"] == {"text": "1/2 mount post", "faults": ["wrong part in the place of post"]}
    assert lines[9]["steps"] == {"text": "2/2 both nuts: mount nut_1, nut_2", "faults": []}
    post, nuts, fault = (json.loads(line) for line in (tmp_path / "poses.steps.jsonl").read_text().splitlines())
    assert post == {
        "step": 1,
        "name": "post",
        "components": ["post"],
        "state": "done",
        "started_s": 0.0,
        "done_s": 0.5,
        "photo": "01.jpg",
    }
    assert nuts["state"] == "current" and nuts["done_s"] is None and nuts["photo"] == ""
    assert fault == {
        "fault": "wrong part in the place of post",
        "kind": "wrong_part",
        "began_s": 0.2,
        "ended_s": 0.5,
    }
    photo = cv2.imread(str(tmp_path / "poses.steps" / "01.jpg"))
    assert photo is not None and number_of(np.asarray(photo[..., ::-1], dtype=np.uint8)) == 5
    assert left_over(tmp_path) == ["poses.jsonl", "poses.steps", "poses.steps.jsonl"]
    assert summary.specimens[""].steps == ("2/2 both nuts: mount nut_1, nut_2", "wrong part in the place of post")


def test_a_failed_run_leaves_no_steps(tmp_path: Path) -> None:
    with pytest.raises(InputError):
        annotate(Pictures(10, 8, InputError("dead")), Worker(), poses_path=tmp_path / "poses.jsonl")
    assert not left_over(tmp_path)
