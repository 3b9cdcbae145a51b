"""A part of which only the base is there: found by it, and nothing is said of the others before they are seen."""

from __future__ import annotations

import numpy as np
import pytest

from arview.assembly.monitor import AssemblyMonitor
from arview.assembly.turned_poses import base_turns
from arview.detection.detector import Detector
from arview.geometry import Array, apply
from arview.pose import Presence
from arview.refinement.view_model import PartView
from arview.tracking import SpecimenTracking
from arview.tracking.base_detection import MIN_QUALITY, WHOLE_FRAMES, BaseDetection
from helpers.synthetic import CAMERA, assembly, assembly_views, block, changed, picture, pose_from

NAMES = tuple(one.name for one in assembly().components)
PLATE = assembly().components[0]
BARE = changed(assembly(), **dict.fromkeys(NAMES[1:]))


def is_right(found: Array, truth: Array) -> bool:
    """Whether a pose is the true one, or one in which the bare plate looks the same."""
    turns = [np.eye(4), *(turn.model_from_model for turn in base_turns(assembly().components, 0))]
    corners = PLATE.vertices_in_model
    return any(np.abs(apply(found, corners) - apply(truth @ turn, corners)).max() < 6.0 for turn in turns)


@pytest.mark.slow
def test_a_bare_base_is_found() -> None:
    detection = BaseDetection(assembly_views(), CAMERA, assembly())
    for k in range(3):
        pose = pose_from(-40 + 40 * k, 40, 520)
        (found,) = detection.detect(picture(pose, BARE, seed=k, scene=k, noise=3.0), [0])
        assert found.quality >= MIN_QUALITY
        assert is_right(found.cam_from_model, pose)


@pytest.mark.slow
def test_guide_views_of_the_base_are_in_the_frame_of_the_part() -> None:
    detection, whole = BaseDetection(assembly_views(), CAMERA, assembly()), PartView(assembly_views())
    assert detection.part is None
    assert detection.detector is not None
    part = detection.part
    assert part is not None and np.allclose(part.model_from_body, whole.model_from_body)
    assert np.allclose(part.body_from_model @ part.model_from_body, np.eye(4))
    low, high = PLATE.bounds_in_model
    for points in (part.arrays.edge_points, part.arrays.contour_points, part.surface.points):
        in_model = apply(part.model_from_body, points.astype(np.float64))
        assert len(in_model) > 100 or points is part.surface.points
        assert np.allclose(in_model.min(axis=0), low, atol=0.5) and np.allclose(in_model.max(axis=0), high, atol=0.5)


@pytest.mark.slow
def test_only_some_full_searches_are_followed_by_one_of_the_base() -> None:
    detection = BaseDetection(assembly_views(), CAMERA, assembly())
    image = picture(pose_from(0, 40, 520), BARE, seed=1, scene=1)
    assert [len(detection.detect(image, None)) for _ in range(3)] == [1, 0, 1]


def test_a_part_of_one_component_has_no_base_to_look_for() -> None:
    detection = BaseDetection(assembly_views(), CAMERA, block())
    assert not detection.is_possible
    assert detection.detect(np.zeros((CAMERA.height, CAMERA.width, 3), dtype=np.uint8), None) == []


@pytest.mark.slow
def test_a_session_finds_a_bare_base_and_says_of_nothing_that_it_is_present() -> None:
    session = SpecimenTracking(assembly_views(), CAMERA, assembly())
    followed = 0
    for k in range(10):
        pose = pose_from(-20 + 4 * k, 40, 520)
        result = session.process(picture(pose, BARE, seed=k, scene=2, noise=3.0), k, k / 30)
        if result.cam_from_model is not None:
            followed += 1
            assert is_right(result.cam_from_model, pose)
            assert not any(result.components[name].presence is Presence.PRESENT for name in NAMES[1:])
    assert followed >= 8


@pytest.mark.slow
def test_the_whole_part_is_found_where_another_thing_was_taken_for_its_base() -> None:
    monitor, detector = AssemblyMonitor(assembly_views(), CAMERA, assembly()), Detector(assembly_views(), CAMERA)
    truth = pose_from(20, 40, 520)
    elsewhere = truth.copy()
    elsewhere[:3, 3] += [90.0, -40.0, 60.0]
    image = picture(truth, assembly(), seed=3, scene=1, noise=3.0)
    for start, is_moved in ((elsewhere, True), (truth, False)):
        detection = BaseDetection(assembly_views(), CAMERA, assembly())
        monitor.is_placed = False
        assert monitor.rests_on_base
        found = [detection.find_whole(image, detector, monitor, start, 0.8) for _ in range(WHOLE_FRAMES)]
        assert found[:-1] == [None] * (WHOLE_FRAMES - 1), "a search in every frame would be too slow"
        if is_moved:
            assert found[-1] is not None and np.allclose(found[-1].cam_from_model, truth, atol=3.0)
            assert monitor.rests_on_base
        else:
            assert found[-1] is not None and np.allclose(found[-1].cam_from_model, start, atol=3.0)
            assert detection.is_same(monitor, found[-1].cam_from_model, start)


@pytest.mark.slow
def test_a_bare_base_is_not_left_for_the_whole_part() -> None:
    monitor, detector = AssemblyMonitor(assembly_views(), CAMERA, assembly()), Detector(assembly_views(), CAMERA)
    detection, truth = BaseDetection(assembly_views(), CAMERA, assembly()), pose_from(20, 40, 520)
    image = picture(truth, BARE, seed=3, scene=1, noise=3.0)
    found = [detection.find_whole(image, detector, monitor, truth, 0.8) for _ in range(6 * WHOLE_FRAMES)]
    assert all(one is None or detection.is_same(monitor, one.cam_from_model, truth) for one in found)
