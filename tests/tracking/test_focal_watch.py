"""A camera whose focal length is not that of the pictures is named, a right one never."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from arview.camera import Camera
from arview.camera.read import guess_camera
from arview.geometry import Array
from arview.pose import Pose, TrackingState
from arview.refinement import PartView
from arview.tracking.self_calibration.estimator import pose_seen_by
from arview.tracking.self_calibration.focal_watch import FocalWatch, FrameFocal
from helpers.synthetic import assembly_views, picture, pose_from

GIVEN = guess_camera(640, 480)
"""768 px."""


def watched(watch: FocalWatch, true: Camera, poses: list[Array], first: int = 0) -> list[Pose]:
    """What a watch says of pictures that a camera takes, tracked with the given one."""
    part, found = PartView(assembly_views()), []
    for index, pose in enumerate(poses, first):
        image = picture(pose, camera=true, seed=index, scene=1, noise=3.0)
        body = pose_seen_by(pose @ part.model_from_body, true, GIVEN)
        seen = Pose(body @ part.body_from_model, np.eye(6), 0.95, TrackingState.TRACKED, index / 30.0, index)
        found.append(watch.checked(image, seen, index, has_jumped=index == first))
    return found


def circling(count: int, distance_mm: float) -> list[Array]:
    return [pose_from(-40.0 + 4.0 * index, 45.0, distance_mm) for index in range(count)]


@pytest.mark.parametrize("factor", [1.12, 0.85])
def test_a_crop_is_named_with_the_focal_length_that_fits(factor: float) -> None:
    watch = FocalWatch(assembly_views(), GIVEN)
    true = replace(GIVEN, fx=factor * GIVEN.fx, fy=factor * GIVEN.fy)
    poses = watched(watch, true, circling(16, 420.0 * factor))
    assert watch.contradiction is not None and not watch.has_changed
    assert np.exp(watch.contradiction.log_ratio) == pytest.approx(factor, rel=0.035)
    named = [pose for pose in poses if pose.state is TrackingState.CRITICAL]
    assert len(named) >= 8 and "contradicts the focal length" in named[-1].reason
    assert f"{GIVEN.fx:.0f} px were given" in named[-1].reason


def test_the_right_camera_is_not_doubted_and_a_zoom_later_is_a_change() -> None:
    watch = FocalWatch(assembly_views(), GIVEN)
    before = watched(watch, GIVEN, circling(20, 420.0))
    assert watch.contradiction is None and {pose.state for pose in before} == {TrackingState.TRACKED}
    zoomed = replace(GIVEN, fx=1.5 * GIVEN.fx, fy=1.5 * GIVEN.fy)
    after = watched(watch, zoomed, circling(8, 640.0), first=20)
    assert watch.has_changed and after[-1].state is TrackingState.CRITICAL
    assert "focal length has changed" in after[-1].reason


def test_few_lines_need_a_larger_difference() -> None:
    box, assembly = FrameFocal(0.06, 0.01, 9), FrameFocal(0.06, 0.01, 20)
    assert not box.contradicts(False) and assembly.contradicts(False) and not assembly.contradicts(True)
    assert FrameFocal(0.2, 0.01, 9).contradicts(True) and not FrameFocal(0.2, 0.08, 20).contradicts(False)
    assert not FrameFocal(0.2, 0.01, 9).agrees(FrameFocal(-0.2, 0.01, 9))
