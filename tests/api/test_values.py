"""Values of the public interface can be copied, pickled and made from what other libraries give."""

from __future__ import annotations

import copy
import pickle
from dataclasses import FrozenInstanceError

import numpy as np
import pytest

from arview import Camera, Pose
from arview.errors import InputError
from arview.pose import ComponentPresence, Presence, TrackingState
from arview.tracking import TrackingSession
from helpers.synthetic import CAMERA, assembly, assembly_views, picture, pose_from


def test_poses_can_be_pickled_and_copied() -> None:
    pose = Pose(
        np.eye(4),
        np.eye(6),
        0.9,
        TrackingState.TRACKED,
        1.5,
        45,
        components={"nut": ComponentPresence(Presence.PRESENT)},
    )
    for same in (pickle.loads(pickle.dumps(pose)), copy.deepcopy(pose), copy.copy(pose)):
        assert same.index == 45 and same.state is TrackingState.TRACKED
        assert same.components["nut"].presence is Presence.PRESENT and np.array_equal(same.covariance, np.eye(6))
        with pytest.raises(TypeError):
            same.components["nut"] = ComponentPresence()
        with pytest.raises(FrozenInstanceError):
            same.index = 3


def test_a_camera_of_a_matrix() -> None:
    k = [[500.0, 0.0, 320.0], [0.0, 501.0, 240.0], [0.0, 0.0, 1.0]]
    camera = Camera.from_matrix(np.array(k), (640, 480), np.array([[0.1, -0.2, 1e-3, 2e-3, 0.01]]))
    np.testing.assert_allclose(camera.dist, [0.1, -0.2, 1e-3, 2e-3, 0.01])
    assert (camera.fx, camera.fy, camera.cx, camera.cy, camera.width) == (500.0, 501.0, 320.0, 240.0, 640)
    rational = Camera.from_matrix(k, (640, 480), [0.1, -0.2, 0.0, 0.0, 0.01, 0.3, 0.0, 0.0, *6 * [0.0]])
    assert rational.lens is not None and rational.lens.terms[5] == 0.3
    assert not Camera.from_matrix(k, (640, 480)).is_distorted
    for wrong, dist in ((np.eye(4), ()), ([[500, 3, 320], *k[1:]], ()), (k, [0.1, 0.2, 0.3]), (k, 13 * [0.0] + [0.1])):
        with pytest.raises(InputError):
            Camera.from_matrix(wrong, (640, 480), dist)


def test_a_session_takes_pictures_alone() -> None:
    session = TrackingSession.of(assembly_views(), CAMERA, assembly())
    image = picture(pose_from(20.0, 45.0, 440.0), seed=1)
    poses = [session.process(image)[0] for _ in range(3)]
    assert [pose.index for pose in poses] == [0, 1, 2]
    assert 0.0 <= poses[0].time_s <= poses[1].time_s <= poses[2].time_s and poses[2].cam_from_model is not None
    with pytest.raises(InputError, match="uint8"):
        session.process(image.astype(np.float32))
