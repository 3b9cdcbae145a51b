"""What a client that is bound to a job is shown: labels of that job, and none where a code names another specimen."""

from __future__ import annotations

import itertools
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from arview.cad import load_part
from arview.geometry import look_at
from arview.pose import Identity, Pose, TrackingState
from arview.station.live.jobs.desk import JobDesk, JobView
from arview.station.live.stream.annotator import FrameAnnotator
from arview.station.live.stream.documents import pose_document
from arview.station.live.stream.feed import TrackedFrame
from arview.station.live.stream.frames import DecodedFrame
from arview.station.live.stream.subject import OverlayStyle, Subject
from arview.station.live.stream.subjects import Subjects
from arview.station.walk.records import WalkState
from helpers.live_jobs import job_options, measured, quiet_worker, rough
from helpers.live_sample import PART, options


def view_of(folder: Path, is_measured: bool = True) -> tuple[JobView, Subjects]:
    part = load_part(str(PART), None)
    chosen = options(inspection=None, jobs=job_options(folder))
    views: Any = SimpleNamespace(view_range=part.effective_view_range)
    subjects = Subjects([Subject(part, views, chosen, path=str(PART))])
    desk = JobDesk(chosen.jobs, quiet_worker)
    desk.begin(subjects)
    job, _ = desk.start(0, "BP-0417", None)
    if is_measured:
        measured(job)
    return desk.view(job.id), subjects


def tracked(subjects: Subjects, serial: str = "") -> TrackedFrame:
    pose = Pose(
        look_at([320.0, 30.0, 250.0], [30.0, 30.0, 5.0], [0.0, 0.0, 1.0]), np.eye(6), 0.9, TrackingState.TRACKED,
        0.0, 0, serial=serial,
    )  # fmt: skip
    now_s = time.monotonic()
    frame = DecodedFrame(7, np.zeros((360, 640, 3), np.uint8))
    camera = subjects.camera(640, 360)
    return TrackedFrame(frame, (pose,), camera, now_s, now_s, now_s, 0, subjects.revision, 1, subjects)


def test_labels_are_withheld_from_another_specimen(tmp_path: Path) -> None:
    view, subjects = view_of(tmp_path)
    own = view.shown(tracked(subjects, "BP-0417"))
    assert own.pose.identity is Identity.FOLLOWED and own.revision == view.subjects.revision != subjects.revision
    other = view.shown(tracked(subjects, "BP-0418"))
    document = pose_document(other, time.monotonic())
    assert other.pose.identity is Identity.OTHER and document["withheld"] is not None and document["labels"] == []
    assert "BP-0418" in document["withheld"]["text"] and "BP-0417" in document["withheld"]["text"]


def test_a_frame_is_made_ready_once(tmp_path: Path) -> None:
    view, subjects = view_of(tmp_path)
    frame = tracked(subjects)
    assert view.shown(frame) is view.shown(frame) is not frame
    assert view.shown(tracked(subjects)) is not view.shown(frame)


def drawn_lines(view: JobView, style: OverlayStyle | None = None) -> dict[str, tuple[str, ...]]:
    """Texts of the labels that the server draws on a picture for a client of the job, by component."""
    frame = view.shown(tracked(view.subjects))
    drawing = view.subject.overlay(frame.camera, style or OverlayStyle(), view.number)
    drawing.draw(frame.frame.image, frame.poses[view.number])
    return {label.text.name: label.lines for label in drawing.laid_out.labels}


def test_drawn_labels_say_measuring_until_there_is_a_number(tmp_path: Path) -> None:
    view, _ = view_of(tmp_path, is_measured=False)
    before = drawn_lines(view)
    assert len(before) > 5 and all(lines[:2] == (name, "measuring") for name, lines in before.items())
    annotator = FrameAnnotator(view.subjects)
    pictures = [annotator.draw(view.shown(tracked(view.subjects))).image]
    # First numbers, of two components only.
    rough(view.job, ["post_1", "post_2"])
    assert view.subject.reload()
    first = drawn_lines(view)
    assert first["post_1"][1].endswith(" mm") and "measuring" not in first["post_1"]
    assert {"MEASURED"} == {first[name][2] for name in ("post_1", "post_2")}, "no verdict before the end"
    assert "measuring" in first["nut_1"] and first["nut_1"] == before["nut_1"]
    pictures.append(annotator.draw(view.shown(tracked(view.subjects))).image)
    # Of the only component that is drawn.
    assert set(drawn_lines(view, OverlayStyle(only="nut_1"))) == {"nut_1"}
    measured(view.job)
    assert view.subject.reload()
    after = drawn_lines(view)
    assert len(after) > 5 and not any("measuring" in lines for lines in after.values())
    pictures.append(annotator.draw(view.shown(tracked(view.subjects))).image)
    assert all(np.abs(a.astype(int) - b).max() > 50 for a, b in itertools.pairwise(pictures))


def test_only_what_a_recheck_measures_says_measuring(tmp_path: Path) -> None:
    view, subjects = view_of(tmp_path)
    desk = JobDesk(subjects.options.jobs, quiet_worker)
    desk.begin(subjects)
    again = desk.view(desk.board.recheck(view.job, ["post_1"]).id)
    lines = drawn_lines(again)
    assert [name for name, texts in lines.items() if "measuring" in texts] == ["post_1"]
    assert lines["post_2"] == drawn_lines(view)["post_2"]
    again.job.write_state(WalkState("failed", "no photo could be placed", 0, 0))
    assert again.subject.reload() and not any("measuring" in texts for texts in drawn_lines(again).values())
