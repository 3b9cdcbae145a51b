"""Two fixed, synchronous cameras that track one part: one pose, against exact truth."""

from __future__ import annotations

import numpy as np
import pytest

from arview.cad import ViewRange
from arview.camera import Camera
from arview.errors import InputError
from arview.geometry import Array, apply, exp_so3, invert, look_at, rigid
from arview.guideviews import cached_guide_views
from arview.tracking import RigSession, TrackingSession
from helpers.photo_scene import Picture, photograph
from helpers.synthetic import bracket

pytestmark = pytest.mark.slow  # a film of two cameras is rendered and tracked three times

CAMERA = Camera(640, 480, 720.0, 720.0, 319.5, 239.5, np.zeros(5))
MODEL = bracket()
CENTER = MODEL.center_in_model
CAMS = [
    look_at(np.array(place) + CENTER, CENTER, [0.0, 0.0, 1.0])
    for place in ([300.0, -250.0, 330.0], [-280.0, -300.0, 330.0])
]
FRAMES, SETTLED = 36, 6


def moved(frame: int) -> Array:
    """(4,4) where the part has gone: turned by up to 14° and 18 mm aside, as in two hands."""
    t = frame / 25.0
    turn = np.deg2rad([8.0 * np.sin(1.3 * t + 1.0), 8.0 * np.sin(1.1 * t), 14.0 * np.sin(0.9 * t + 2.0)])
    shift = [18.0 * np.sin(1.5 * t), 18.0 * np.sin(1.2 * t + 4.0), 10.0 * np.sin(1.7 * t)]
    about = rigid(np.eye(3), CENTER)
    return about @ rigid(exp_so3(turn), shift) @ invert(about)


@pytest.fixture(scope="module")
def film() -> list[list[Picture]]:
    return [
        [photograph(MODEL, cam @ moved(k), CAMERA, seed=k, noise=3.0, is_linear=True) for cam in CAMS]
        for k in range(FRAMES)
    ]


def session() -> TrackingSession:
    return TrackingSession.of(cached_guide_views(MODEL, ViewRange((350.0, 800.0), (5.0, 90.0))), CAMERA, MODEL)


def error_mm(cam_from_model: Array | None, camera: int, frame: int) -> float:
    """Root mean square distance of the part's corners from where they are."""
    assert cam_from_model is not None, "the part was lost"
    corners = MODEL.mesh[0]
    apart = apply(cam_from_model, corners) - apply(CAMS[camera] @ moved(frame), corners)
    return float(np.sqrt(np.mean(np.sum(apart**2, axis=1))))


def test_two_cameras_halve_the_error_of_the_better_one(film: list[list[Picture]]) -> None:
    alone = []
    for camera in (0, 1):
        one = session()
        poses = [one.process(film[k][camera], k, k / 25.0)[0] for k in range(FRAMES)]
        alone.append(np.mean([error_mm(poses[k].cam_from_model, camera, k) for k in range(SETTLED, FRAMES)]))
    both = RigSession(session(), [(CAMERA, CAMS[1] @ invert(CAMS[0]))])
    poses = [both.process(film[k], k, k / 25.0) for k in range(FRAMES)]
    errors = [error_mm(poses[k].cam_from_model, 0, k) for k in range(SETTLED, FRAMES)]
    assert np.mean(errors) <= 0.5 * min(alone), (np.mean(errors), alone)
    covariance = poses[-1].covariance
    assert covariance is not None and (np.linalg.eigvalsh(covariance) > 0.0).all()


def test_a_covered_camera_changes_nothing(film: list[list[Picture]]) -> None:
    """The second camera shows a wall: its pose does not count, and the first goes on alone."""
    wall = np.full_like(film[0][1], 90)
    one, both = session(), RigSession(session(), [(CAMERA, CAMS[1] @ invert(CAMS[0]))])
    for k in range(12):
        alone, pose = one.process(film[k][0], k, k / 25.0)[0], both.process([film[k][0], wall], k, k / 25.0)
        assert np.allclose(pose.cam_from_model, alone.cam_from_model)


def test_a_pose_between_cameras_must_be_rigid() -> None:
    with pytest.raises(InputError, match="cam_from_first"):
        RigSession(session(), [(CAMERA, np.diag([2.0, 1.0, 1.0, 1.0]))])
