"""Nearly round parts and smooth parts: what is known of a turn, and which edges count."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from arview.cad import ViewRange, find_round_axis
from arview.geometry import Array, exp_so3, rigid
from arview.guideviews import GuideViewOptions, GuideViewSet, cached_guide_views
from arview.pose import Pose, TrackingState
from arview.refinement import PartView
from arview.tracking import TrackingSession
from arview_lab.evaluation import evaluate_scene, load_scene
from arview_lab.semisynthetic import curved_shape, shape
from helpers.paths import SHARED
from helpers.synthetic import CAMERA, assembly_views, block, error, picture, pose_from

MUG = curved_shape("mug")
HANDLE_AZIMUTH_DEG = 180.0
"""Direction of the handle, from the axis."""


@cache
def mug_views() -> GuideViewSet:
    return cached_guide_views(MUG, ViewRange((300.0, 900.0)), GuideViewOptions(subdivisions=3))


def turned(pose: Array, angle_deg: float) -> Array:
    """A pose of the mug with the mug turned about its axis, which is that of z."""
    return pose @ rigid(exp_so3([0.0, 0.0, np.deg2rad(angle_deg)]), [0.0, 0.0, 0.0])


def followed(azimuths_deg: list[float], start_deg: float) -> list[tuple[Pose, float]]:
    """Poses of a session that starts turned by an angle, each with the error of its rotation in degrees."""
    truths = [pose_from(azimuth_deg, 25.0, 480.0, MUG) for azimuth_deg in azimuths_deg]
    session = TrackingSession.of(mug_views(), CAMERA, MUG, initial_cam_from_model=turned(truths[0], start_deg))
    found = []
    for index, truth in enumerate(truths):
        image = picture(truth, MUG, seed=index, scene=3, contrast=0.0)
        (pose,) = session.process(image, index, index / 30.0)
        assert pose.cam_from_model is not None
        found.append((pose, error(pose.cam_from_model, truth, MUG)[2]))
    return found


def test_the_axis_of_a_nearly_round_part_is_found_and_other_parts_have_none() -> None:
    vertices, faces, _ = MUG.mesh
    axis = find_round_axis(vertices, faces)
    assert axis is not None
    assert abs(axis.direction[2]) > np.cos(np.deg2rad(1.0))
    assert np.linalg.norm(axis.point_in_model[:2]) < 0.01 * MUG.diameter_mm
    assert 0.7 < axis.share < 0.95 and len(axis.turns) == 23
    flange = shape("flange")
    vertices, faces, _ = flange.mesh
    axis = find_round_axis(vertices, faces)
    assert axis is not None and axis.share > 0.8
    for other in (block(), curved_shape("cat"), shape("bracket")):
        vertices, faces, _ = other.mesh
        assert find_round_axis(vertices, faces) is None, other.name


def test_a_turn_is_told_by_the_handle_that_stands_out() -> None:
    frames = followed([HANDLE_AZIMUTH_DEG + 90.0 + 0.5 * k for k in range(24)], 60.0)
    assert frames[0][1] > 30.0, "the start was not wrong"
    settled = frames[16:]
    assert max(degrees for _, degrees in settled) < 5.0
    assert {pose.state for pose, _ in settled} == {TrackingState.TRACKED}
    assert all(not pose.alternatives for pose, _ in settled)


def test_a_turn_is_ambiguous_while_the_handle_is_hidden() -> None:
    frames = followed([HANDLE_AZIMUTH_DEG + 180.0 + 0.2 * k for k in range(16)], 0.0)
    later = [pose for pose, _ in frames[8:]]
    assert max(degrees for _, degrees in frames) < 8.0, "the turn is held while nothing tells it"
    sigmas_deg = [np.rad2deg(np.sqrt(np.linalg.eigvalsh(pose.covariance[:3, :3])[-1])) for pose in later]
    assert min(sigmas_deg) > 20.0, "the covariance says that the turn is not known"
    assert {pose.state for pose in later} == {TrackingState.CRITICAL}
    assert all(pose.alternatives and pose.reason.startswith("ambiguous") for pose in later)


def test_only_parts_without_design_edges_are_smooth() -> None:
    assert PartView(mug_views()).is_smooth
    assert not PartView(assembly_views()).is_smooth


@pytest.mark.slow
@pytest.mark.shared
def test_a_smooth_figure_among_clutter_is_followed_by_its_colours() -> None:
    result = evaluate_scene(load_scene(SHARED / "sequences" / "desk_dragon" / "test" / "000001"), "truth")
    degrees = np.array([frame.error.rotation_deg for frame in result.frames if frame.error is not None])
    assert len(degrees) == 99
    assert np.mean(degrees <= 5.0) >= 0.9 and np.median(degrees) <= 2.5 and degrees.max() < 10.0
