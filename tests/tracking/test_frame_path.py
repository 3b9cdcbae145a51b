"""The way of one tracked frame: few calls down to the inner kernel, few folders."""

from __future__ import annotations

import importlib

import pytest

from arview.errors import ArviewError
from arview.tracking import TrackingSession
from helpers.paths import TOOLS
from helpers.synthetic import CAMERA, assembly, assembly_views, path, picture


def test_a_tracked_frame_takes_few_calls_and_enters_few_folders(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(TOOLS / "benchmarks"))
    frame_path = importlib.import_module("frame_path").frame_path
    poses = path(4)
    session = TrackingSession.of(assembly_views(), CAMERA, assembly(), initial_cam_from_model=poses[0])
    with pytest.raises(ArviewError, match="searching, not tracked"):
        frame_path(session, picture(poses[0]), 0)
    for index, pose in enumerate(poses[:-1]):
        session.process(picture(pose, seed=index), index, index / 30.0)
    followed = frame_path(session, picture(poses[-1], seed=3), 3)
    assert followed.chain == (
        "TrackingSession.process",
        "SpecimenTracking.process",
        "SpecimenTracking._follow",
        "Tracker.track",
        "Tracker._refine",
        "RefinementPyramid.refine",
        "PoseRefiner.refine",
        "run_stages",
    )
    assert followed.calls <= 7
    assert {".", "tracking", "refinement", "camera"} <= set(followed.folders)
    assert len(followed.folders) <= 8
