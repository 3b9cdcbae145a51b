"""What a client that is bound to a job is shown of a frame in which a code names another specimen."""

from __future__ import annotations

import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from arview.cad import load_part
from arview.geometry import look_at
from arview.live.jobs.desk import JobDesk, JobView
from arview.live.stream.documents import pose_document
from arview.live.stream.feed import TrackedFrame
from arview.live.stream.frames import DecodedFrame
from arview.live.stream.subject import Subject
from arview.live.stream.subjects import Subjects
from arview.pose import Identity, Pose, TrackingState
from helpers.live_jobs import job_options, measured, quiet_worker
from helpers.live_sample import PART, options


def view_of(folder: Path) -> tuple[JobView, Subjects]:
    part = load_part(str(PART), None)
    chosen = options(inspection=None, jobs=job_options(folder))
    views: Any = SimpleNamespace(view_range=part.effective_view_range)
    subjects = Subjects([Subject(part, views, chosen, path=str(PART))])
    desk = JobDesk(chosen.jobs, quiet_worker)
    desk.begin(subjects)
    job, _ = desk.start(0, "BP-0417", None)
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
