"""The learned motion: what a hand does is learned from the stream, and a jump out of it is unusual."""

from __future__ import annotations

import numpy as np
import pytest

from arview.geometry import Array, exp_so3, rigid
from arview.tracking.motion import MotionModel, innovation, normalised_covariance, squared_motion_distance

DIAMETER_MM = 150.0
POSE = rigid(exp_so3([0.3, -0.5, 0.2]), [20.0, -30.0, 600.0])


def certain() -> Array:
    return np.zeros((6, 6))


def moved(turn_deg: Array, shift_mm: Array) -> Array:
    return rigid(exp_so3(np.deg2rad(turn_deg)) @ POSE[:3, :3], POSE[:3, 3] + shift_mm)


def stream(sigma_deg: float, sigma_mm: float, count: int, seed: int) -> list[Array]:
    """Innovations of a hand that trembles by some degrees and mm from frame to frame, with heavy tails."""
    rng = np.random.default_rng(seed)
    return [
        innovation(moved(sigma_deg * rng.standard_t(5, 3), sigma_mm * rng.standard_t(5, 3)), POSE, DIAMETER_MM)
        for _ in range(count)
    ]


def test_the_square_of_an_innovation_is_the_motion_distance() -> None:
    pose = moved(np.array([3.0, -2.0, 4.0]), np.array([5.0, -8.0, 20.0]))
    difference = innovation(pose, POSE, DIAMETER_MM)
    assert difference @ difference == pytest.approx(squared_motion_distance(pose, POSE, DIAMETER_MM), rel=1e-6)
    assert difference @ difference > 0.02


@pytest.mark.parametrize(("sigma_deg", "sigma_mm"), [(0.3, 0.5), (0.6, 1.0), (1.0, 2.0)])
def test_what_a_hand_does_is_seldom_unusual_and_a_jump_always_is(sigma_deg: float, sigma_mm: float) -> None:
    jump = innovation(moved(np.array([0.0, 15.0, 0.0]), np.zeros(3)), POSE, DIAMETER_MM)
    for seed in range(3):
        model = MotionModel()
        unusual = 0
        for number, difference in enumerate(stream(sigma_deg, sigma_mm, 400, seed)):
            is_unusual = model.is_unusual(difference, certain)
            unusual += number >= 40 and is_unusual
            model.learn(difference, is_unusual, is_confirmed=is_unusual)
        assert unusual <= 0.08 * 360
        assert model.is_unusual(jump, certain)


def test_the_same_motion_is_unusual_for_a_steady_hand_and_usual_for_a_restless_one() -> None:
    start = innovation(moved(np.array([0.0, 0.0, 6.0]), np.zeros(3)), POSE, DIAMETER_MM)
    steady, restless = MotionModel(), MotionModel()
    for calm, wild in zip(stream(0.3, 0.5, 60, 1), stream(2.5, 4.0, 60, 1), strict=True):
        steady.learn(calm, False)
        restless.learn(wild, False)
    assert steady.is_unusual(start, certain)
    assert not restless.is_unusual(start, certain)


def test_a_jump_that_is_not_confirmed_hardly_counts_and_a_confirmed_one_does() -> None:
    jump = innovation(moved(np.array([0.0, 15.0, 0.0]), np.zeros(3)), POSE, DIAMETER_MM)
    doubted, confirmed = MotionModel(), MotionModel()
    before = doubted.covariance
    doubted.learn(jump, True)
    confirmed.learn(jump, True, is_confirmed=True)
    assert np.trace(doubted.covariance) < 1.4 * np.trace(before)
    assert np.trace(confirmed.covariance) > 1.5 * np.trace(before)


def test_a_motion_that_the_covariance_of_the_pose_explains_is_not_unusual() -> None:
    """A shift along the line of sight is usual for a pose whose depth is hardly determined."""
    difference = innovation(moved(np.zeros(3), np.array([0.0, 0.0, 15.0])), POSE, DIAMETER_MM)
    along = POSE[:3, :3].T @ [0.0, 0.0, 1.0]
    twist_covariance = np.zeros((6, 6))
    twist_covariance[3:, 3:] = 15.0**2 * np.outer(along, along)
    covariance = normalised_covariance(twist_covariance, POSE, DIAMETER_MM)
    assert covariance[5, 5] == pytest.approx((15.0 / (0.7 * DIAMETER_MM)) ** 2, rel=1e-6)
    model = MotionModel()
    assert model.is_unusual(difference, certain)
    assert not model.is_unusual(difference, lambda: covariance)


def test_one_jump_is_borne_and_several_make_the_motion_restless() -> None:
    jump = innovation(moved(np.array([0.0, 20.0, 0.0]), np.zeros(3)), POSE, DIAMETER_MM)
    still = np.zeros(6)
    model = MotionModel()
    assert model.is_calm and not model.is_restless
    model.learn(jump, model.is_unusual(jump, certain))
    assert not model.is_calm and not model.is_restless
    model.learn(still, model.is_unusual(still, certain))
    model.learn(jump, model.is_unusual(jump, certain))
    assert model.is_restless
    for _ in range(5):
        model.learn(still, model.is_unusual(still, certain))
    assert model.is_calm and not model.is_restless
