"""Rigid transforms and the camera against figures worked out by hand and against OpenCV."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from arview.camera import Camera
from arview.detection.search.template_bank import rolls_between
from arview.errors import InputError
from arview.geometry import (
    apply,
    are_near,
    check_rigid,
    exp_se3,
    exp_so3,
    invert,
    log_se3,
    log_so3,
    look_at,
    orthonormalise,
    rigid,
    rotation_angle_rad,
    turn_ball,
    turns_to_rays,
)

LENS = np.array([-0.21, 0.08, 0.0012, -0.0017, -0.015])
CAMERA = Camera(640, 480, 610.0, 605.0, 322.5, 231.25, LENS)


# --- Rigid transforms -----------------------------------------------------------------------------------


def test_a_quarter_turn_about_z() -> None:
    b_from_a = exp_se3([0, 0, np.pi / 2, 0, 0, 0])
    b_from_a[:3, 3] = [10, 20, 30]
    assert apply(b_from_a, [1.0, 2.0, 3.0]) == pytest.approx([8.0, 21.0, 33.0])
    assert apply(invert(b_from_a), [8.0, 21.0, 33.0]) == pytest.approx([1.0, 2.0, 3.0])


def test_the_turn_to_a_ray_is_the_smallest_and_the_roll_between_two_views_is_the_nearest() -> None:
    rng = np.random.default_rng(0)
    rays = rng.normal(size=(20, 3)) * 0.5 + [0, 0, 1.5]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    turns = turns_to_rays(rays)
    assert turns[..., 2] == pytest.approx(rays)
    angles = [rotation_angle_rad(np.eye(3), turn) for turn in turns]
    assert angles == pytest.approx(np.arccos(rays[:, 2]))
    views = np.stack([exp_so3(v) for v in rng.normal(size=(20, 3))])
    rolls = rng.uniform(-3.0, 3.0, 20)
    rolled = np.stack([exp_so3([0, 0, roll]) for roll in rolls]) @ views
    assert rolls_between(views, rolled) == pytest.approx(rolls)


def test_a_ball_of_turns_leaves_no_gap_and_ends_at_its_reach() -> None:
    ball = turn_ball(20.0, 8.0)
    angles = np.rad2deg([rotation_angle_rad(np.eye(3), turn) for turn in ball])
    assert angles.min() < 1e-6 and angles.max() <= 20.0
    rng = np.random.default_rng(1)
    for _ in range(50):
        wanted = exp_so3(np.deg2rad(rng.uniform(-8.0, 8.0, 3)))
        # Half the longest edge of a cell of the body-centred grid is √5/4 of its step.
        assert min(rotation_angle_rad(wanted, turn) for turn in ball) < np.deg2rad(0.6 * 8.0)


def test_near_means_near_in_place_and_in_angle() -> None:
    pose = rigid(exp_so3([0.3, 0.1, -0.5]), [10, 20, 500])
    for turn_deg, way, expected in ((4.9, 0.9, True), (5.1, 0.9, False), (4.9, 1.1, False)):
        other = pose @ rigid(exp_so3(np.deg2rad([0, turn_deg, 0])), [way, 0, 0])
        assert are_near(pose, other, 1.0, 5.0) == expected


def test_a_screw_moves_along_an_arc() -> None:
    # Half a turn about Z while moving at (1, 0, 0) in the body: the chord of a half circle, 2 / pi long, towards +Y.
    assert exp_se3([0, 0, np.pi, 1, 0, 0])[:3, 3] == pytest.approx([0.0, 2 / np.pi, 0.0], abs=1e-12)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-7, 1e-5, 1e-3, 0.5, 2.0, np.pi - 1e-3, np.pi - 1e-5])
def test_exp_and_log_are_inverse(angle: float) -> None:
    rng = np.random.default_rng(4)
    for _ in range(50):
        axis = rng.normal(size=3)
        twist = np.concatenate([angle * axis / np.linalg.norm(axis), rng.normal(0, 200, 3)])
        b_from_a = exp_se3(twist)
        assert log_se3(b_from_a) == pytest.approx(twist, abs=1e-5 if angle > 3 else 1e-7)
        assert np.linalg.det(b_from_a[:3, :3]) == pytest.approx(1.0)
        assert invert(b_from_a) @ b_from_a == pytest.approx(np.eye(4), abs=1e-10)
        assert exp_se3(-twist) == pytest.approx(invert(b_from_a), abs=1e-9)


@pytest.mark.parametrize("axis", [[1, 0, 0], [0, 1, 0], [0, 0, 1], [0.6, 0, -0.8]])
def test_log_of_half_a_turn(axis: list[float]) -> None:
    rotation = 2.0 * np.outer(axis, axis) - np.eye(3)
    vector = log_so3(rotation)
    assert np.linalg.norm(vector) == pytest.approx(np.pi)
    assert abs(vector @ axis) == pytest.approx(np.pi)
    assert exp_so3(vector) == pytest.approx(rotation, abs=1e-9)


def test_angle_between_rotations() -> None:
    a = exp_so3([0.3, -0.2, 0.9])
    assert rotation_angle_rad(a, a @ exp_so3([0.0, 0.25, 0.0])) == pytest.approx(0.25)
    assert rotation_angle_rad(a, a) == pytest.approx(0.0, abs=1e-9)


def test_orthonormalise_returns_the_nearest_rotation() -> None:
    rotation = exp_so3([0.4, 1.1, -0.3])
    noisy = rigid(rotation + np.random.default_rng(0).normal(0, 1e-3, (3, 3)), [1, 2, 3])
    cleaned = orthonormalise(noisy)
    assert cleaned[:3, :3] @ cleaned[:3, :3].T == pytest.approx(np.eye(3), abs=1e-12)
    assert rotation_angle_rad(cleaned, rotation) < 3e-3


def test_look_at_puts_the_target_ahead_and_up_upwards() -> None:
    pose = look_at([300.0, -200.0, 150.0], [10.0, 20.0, 5.0], [0, 0, 1])
    target = apply(pose, [10.0, 20.0, 5.0])
    assert target == pytest.approx([0, 0, np.linalg.norm([290, -220, 145])])
    above = apply(pose, [10.0, 20.0, 6.0])
    assert above[0] == pytest.approx(0.0, abs=1e-9)
    assert above[1] < 0  # +Y is down
    from_above = look_at([0.0, 0.0, 500.0], [0.0, 0.0, 0.0], [0, 0, 1])
    assert check_rigid(from_above, "pose") == pytest.approx(from_above)


@pytest.mark.parametrize(
    "matrix,words",
    [
        (np.eye(3), "shape (3, 3)"),
        ([["a"] * 4] * 4, "numbers"),
        (np.full((4, 4), np.nan), "NaN"),
        (rigid(np.eye(3), [0, 0, np.inf]), "infinity"),
        (rigid(2.0 * np.eye(3), [0, 0, 0]), "not a rotation"),
        (np.diag([1.0, 1.0, -1.0, 1.0]), "mirrored"),
        (rigid(np.eye(3), [1, 2, 3]).T, "last row"),
        (rigid(np.eye(3) + np.diag([0.01, 0], 1).T + np.diag([0.01, 0], 1), [0, 0, 0]), "sheared"),
    ],
    ids=["shape", "text", "nan", "infinite", "scaled", "mirrored", "column-major", "sheared"],
)
def test_what_is_no_rigid_transform_is_refused(matrix: object, words: str) -> None:
    with pytest.raises(InputError, match="given") as caught:
        check_rigid(matrix, "given")  # type: ignore[arg-type]
    assert words in str(caught.value)


def test_a_rounded_rotation_is_accepted_and_cleaned() -> None:
    pose = rigid(exp_so3([0.4, 1.1, -0.3]), [1, 2, 3])
    cleaned = check_rigid(np.round(pose, 4).tolist(), "pose")
    assert cleaned[:3, :3] @ cleaned[:3, :3].T == pytest.approx(np.eye(3), abs=1e-12)
    assert cleaned == pytest.approx(pose, abs=2e-4)


# --- Camera ---------------------------------------------------------------------------------------------


def test_projection_is_opencv_s() -> None:
    points = np.random.default_rng(1).uniform([-150, -110, 400], [150, 110, 700], (200, 3))
    theirs, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), CAMERA.matrix, LENS)
    assert CAMERA.project(points) == pytest.approx(theirs[:, 0], abs=1e-8)
    ideal = CAMERA.without_distortion()
    assert ideal.project([[61.0, -12.2, 610.0]]) == pytest.approx(np.array([[383.5, 219.15]]))
    assert np.isnan(CAMERA.project([[1.0, 2.0, 0.0], [1.0, 2.0, -5.0]])).all()


def test_unprojection_undoes_projection() -> None:
    pixels = np.random.default_rng(2).uniform([0, 0], [639, 479], (500, 2))
    rays = CAMERA.unproject(pixels)
    assert rays[:, 2] == pytest.approx(np.ones(500))
    assert CAMERA.project(123.0 * rays) == pytest.approx(pixels, abs=1e-3)


def test_a_scaled_camera_sees_the_same_field() -> None:
    half = CAMERA.scaled(320, 240)
    points = np.random.default_rng(3).uniform([-150, -110, 400], [150, 110, 700], (50, 3))
    # Pixel edges, not centres, are what scales: (u + 1/2) halves.
    assert half.project(points) + 0.5 == pytest.approx((CAMERA.project(points) + 0.5) / 2)


@pytest.mark.parametrize("turns", [-1, 0, 1, 2, 3, 4])
def test_a_turned_camera_sees_the_turned_picture(turns: int) -> None:
    points = np.random.default_rng(3).uniform([-150, -110, 400], [150, 110, 700], (50, 3))
    turned = CAMERA.rotated(turns)
    angle = np.pi / 2 * turns
    pixels = turned.project(points @ exp_so3([0, 0, angle]).T)
    checked = 0
    # A dot drawn into the picture and turned by numpy lies where the turned camera sees the point.
    for (u, v), (tu, tv) in zip(np.round(CAMERA.project(points)).astype(int), pixels, strict=True):
        if 0 <= u < 640 and 0 <= v < 480:
            image = np.zeros((480, 640), dtype=np.uint8)
            image[v, u] = 1
            row, column = np.argwhere(np.rot90(image, -turns))[0]
            checked += 1
            assert abs(column - tu) <= 0.51
            assert abs(row - tv) <= 0.51
    assert checked > 25
    assert (turned.width, turned.height) == ((640, 480) if turns % 2 == 0 else (480, 640))


@pytest.mark.parametrize(
    "change",
    [{"fx": np.nan}, {"cy": np.inf}, {"fx": 0.0}, {"fy": -600.0}, {"width": 0}, {"dist": np.array([0.1, np.nan])}],
)
def test_what_is_no_camera_is_refused(change: dict[str, float]) -> None:
    values: dict[str, float] = {"width": 640, "height": 480, "fx": 600.0, "fy": 600.0, "cx": 320.0, "cy": 240.0}
    with pytest.raises(InputError, match="camera"):
        Camera(**{**values, **change})  # type: ignore[arg-type]


def test_a_lens_model_with_more_terms_is_refused() -> None:
    with pytest.raises(InputError, match="8 distortion terms"):
        Camera(640, 480, 600.0, 600.0, 320.0, 240.0, np.array([0.1, 0, 0, 0, 0, 0.2, 0, 0]))
    assert Camera(640, 480, 600.0, 600.0, 320.0, 240.0, np.zeros(8)).dist.shape == (5,)
