"""How certain tracked poses are: probability by the evidence, and what all points of a frame share."""

from __future__ import annotations

import numpy as np
import pytest

from arview.geometry import Array
from arview.pose import TrackingState
from arview.tracking import TrackingSession
from arview.tracking.covariance import common_covariance
from arview.tracking.probability import PoseFeatures, pose_probability
from arview.tracking.specimen import LITTLE_SEEN
from helpers.synthetic import CAMERA, assembly, assembly_views, error, part_box, path, picture, pose_from

SURE = PoseFeatures(0.85, 0.05, 0.5, 0.7, 0.0, 0.0, 0.0, 0.0, 1.0, -0.3)
"""Features of a pose that nothing speaks against."""


def qualities(truths: list[Array]) -> list[float]:
    """Qualities of poses tracked from the truth, all of them right."""
    session = TrackingSession.of(assembly_views(), CAMERA, assembly(), initial_cam_from_model=truths[0])
    found = []
    for index, truth in enumerate(truths):
        (pose,) = session.process(picture(truth, seed=index), index, index / 30.0)
        assert pose.cam_from_model is not None and error(pose.cam_from_model, truth)[2] < 3.0
        found.append(pose.quality)
    return found


def test_a_part_in_full_view_is_surer_than_one_that_is_mostly_outside_the_picture() -> None:
    whole = qualities(path(6))
    cut = pose_from(40.0, 45.0, 520.0)
    cut[0, 3] += 280.0  # a quarter of its outline is left in the picture
    assert min(whole) > 0.97
    assert max(qualities([cut] * 4)) < 0.9


@pytest.mark.parametrize(
    "worse",
    [
        {"outline": 0.4},
        {"inner": -0.2},
        {"colours": 0.1},
        {"log_in_picture": float(np.log(0.4))},
        {"log_sigma_mm": 1.5},
        {"restless": 1.0},
    ],
    ids=lambda worse: next(iter(worse)),
)
def test_what_speaks_against_a_pose_lowers_its_quality(worse: dict[str, float]) -> None:
    assert pose_probability(SURE) > 0.97
    assert 0.0 < pose_probability(SURE._replace(**worse)) < pose_probability(SURE) - 0.005


def test_errors_that_all_points_share_are_a_shift_across_and_a_change_of_size_along() -> None:
    pose = pose_from(30.0, 40.0, 600.0)
    covariance = common_covariance(pose, 100.0, 200.0, np.zeros(6))
    in_camera = pose[:3, :3] @ covariance[3:, 3:] @ pose[:3, :3].T
    assert np.sqrt(np.diag(in_camera)) == pytest.approx([0.6, 0.6, 0.003 * pose[2, 3]], rel=1e-6)
    assert np.sqrt(np.diag(covariance)[:3]) == pytest.approx([0.003] * 3)
    moved = common_covariance(pose, 100.0, 200.0, np.array([0.0, 0.0, 0.0, 20.0, 0.0, 0.0]))
    assert np.all(np.linalg.eigvalsh(moved - covariance) > -1e-12)
    assert 1.0 < np.sqrt(np.trace(moved[3:, 3:]) / np.trace(covariance[3:, 3:])) < 3.0


def test_a_given_pose_that_is_little_seen_is_followed_in_doubt() -> None:
    """A card goes with the part and hides more than half of it: too little for `tracked`, enough to follow."""
    truths = path(50)
    reasons = []
    session = TrackingSession.of(assembly_views(), CAMERA, assembly(), initial_cam_from_model=truths[0])
    for index, truth in enumerate(truths):
        left, top, right, bottom = part_box(truth)
        card = left, top, int(left + 0.55 * (right - left)), bottom
        (pose,) = session.process(picture(truth, seed=index, card=card), index, index / 30.0)
        assert pose.state is TrackingState.CRITICAL
        reasons.append(pose.reason)
        assert pose.cam_from_model is not None and error(pose.cam_from_model, truth)[2] < 1.0
    assert reasons[:10] == [LITTLE_SEEN] * 10


def test_a_given_pose_at_which_nothing_is_seen_is_refused() -> None:
    session = TrackingSession.of(assembly_views(), CAMERA, assembly(), initial_cam_from_model=path(1)[0])
    (pose,) = session.process(picture(None), 0, 0.0)
    assert pose.state is TrackingState.SEARCHING and pose.cam_from_model is None
