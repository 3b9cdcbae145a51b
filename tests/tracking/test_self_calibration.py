"""An unknown focal length estimated from tracked frames: accuracy, coverage of the uncertainty, and refusal."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from arview.camera import Camera
from arview.camera.read import guess_camera
from arview.geometry import Array, apply, exp_so3, rigid
from arview.pose import Pose, TrackingState
from arview.refinement.view_model import PartView
from arview.tracking import TrackingSession
from arview.tracking.self_calibration.edge_lines import line_labels
from arview.tracking.self_calibration.estimator import FocalEstimate, FocalEstimator, pose_seen_by
from arview.tracking.self_calibration.frame_set import FrameSet, cropped_frame
from helpers.synthetic import assembly, assembly_views, error, path, picture, pose_from

GUESS = guess_camera(640, 480)
"""768 px."""


def true_camera(focal_px: float) -> Camera:
    return replace(GUESS, fx=focal_px, fy=focal_px)


def varied_poses(
    count: int, seed: int, nearest: float = 1.0, farthest: float = 1.25, focal_px: float = 720.0
) -> list[Array]:
    """Poses all over the range, at distances at which the part is as large as with 720 px at 440 mm, times a factor."""
    rng = np.random.default_rng(seed)
    poses = []
    for _ in range(count):
        distance_mm = 440.0 * focal_px / 720.0 * rng.uniform(nearest, farthest)
        pose = pose_from(rng.uniform(-70, 70), rng.uniform(20, 70), distance_mm, roll_deg=rng.uniform(-15, 15))
        pose[:2, 3] += distance_mm * rng.uniform([-0.1, -0.07], [0.1, 0.07])
        poses.append(pose)
    return poses


def tracked(pose: Array, index: int = 0) -> Pose:
    return Pose(pose, np.eye(6), 0.9, TrackingState.TRACKED, index / 30.0, index)


def estimate(focal_px: float, poses: list[Array], seed: int, noise: float = 3.0) -> FocalEstimate:
    """Estimate from pictures of a camera at true poses, which a tracker with the guessed camera sees at others."""
    part, camera = PartView(assembly_views()), true_camera(focal_px)
    estimator = FocalEstimator(part, GUESS)
    rng = np.random.default_rng(seed)
    for index, pose in enumerate(poses):
        image = picture(pose, camera=camera, seed=100 * seed + index, scene=index % 5, noise=noise)
        body = pose_seen_by(pose @ part.model_from_body, camera, GUESS)
        body[:3, :3] = body[:3, :3] @ exp_so3(rng.normal(0.0, 0.004, 3))
        estimator.add(image, tracked(body @ part.body_from_model, index), GUESS)
        if index == len(poses) - 4:
            estimator.estimate()
    return estimator.estimate()


def test_a_pose_is_carried_over_to_another_camera() -> None:
    before, after = GUESS, Camera(640, 480, 560.0, 560.0, 331.0, 236.0, np.array([-0.05, 0.0, 0.0, 0.0, 0.0]))
    pose = rigid(exp_so3([0.3, -0.5, 0.2]), [60.0, -40.0, 700.0])
    moved = pose_seen_by(pose, before, after)
    np.testing.assert_allclose(after.project(moved[:3, 3]), before.project(pose[:3, 3]), atol=1e-6)
    assert moved[2, 3] / after.fx == pytest.approx(pose[2, 3] / before.fx)
    np.testing.assert_allclose(moved[:3, :3] @ moved[:3, :3].T, np.eye(3), atol=1e-12)
    # What points towards the camera still does.
    sight, new_sight = pose[:3, :3].T @ pose[:3, 3], moved[:3, :3].T @ moved[:3, 3]
    np.testing.assert_allclose(sight / np.linalg.norm(sight), new_sight / np.linalg.norm(new_sight), atol=0.01)


def test_a_large_part_is_kept_small_and_in_its_place() -> None:
    camera = Camera(1920, 1080, 1700.0, 1700.0, 950.0, 545.0)
    rng = np.random.default_rng(0)
    image = rng.integers(0, 255, (1080, 1920, 3), dtype=np.uint8)
    image[:] = 40
    pose = rigid(np.eye(3), [30.0, 20.0, 500.0])
    u, v = np.round(camera.project(pose[:3, 3])).astype(int)
    image[v - 40 : v + 41, u - 40 : u + 41] = 220
    frame = cropped_frame(image, pose, camera, 220.0)
    assert frame is not None and frame.scale == pytest.approx(400.0 * 500.0 / (220.0 * 1700.0))
    assert frame.gray.size < 520 * 520
    rows, columns = np.nonzero(frame.gray > 130)
    intrinsics = frame.intrinsics(camera)
    center = intrinsics[:2] * pose[:2, 3] / pose[2, 3] + intrinsics[2:4]
    np.testing.assert_allclose([columns.mean(), rows.mean()], center, atol=0.4)


def test_frames_are_kept_when_the_view_is_new() -> None:
    frames = FrameSet(GUESS)
    pose = rigid(np.eye(3), [0.0, 0.0, 600.0])
    gray = np.zeros((200, 200), dtype=np.uint8)
    first = cropped_frame(np.zeros((480, 640, 3), dtype=np.uint8), pose, GUESS, 200.0)
    assert first is not None and first.gray.shape != gray.shape
    assert frames.is_new(pose, GUESS.fx) and frames.add(first)
    assert not frames.is_new(pose, GUESS.fx)
    # Another focal length at the same picture size is the same view.
    assert not frames.is_new(first.pose_at(600.0), 600.0)
    assert frames.is_new(rigid(exp_so3([0.0, 0.1, 0.0]), [0.0, 0.0, 600.0]), GUESS.fx)
    assert frames.is_new(rigid(np.eye(3), [0.0, 0.0, 640.0]), GUESS.fx)
    assert frames.is_new(rigid(np.eye(3), [60.0, 0.0, 600.0]), GUESS.fx)


def test_points_on_one_line_have_one_label() -> None:
    way = np.array([0.6, 0.0, 0.8])
    along = np.array([5.0, -1.0, 3.0]) + np.linspace(-40.0, 40.0, 9)[:, None] * way
    signs = np.where(np.arange(9) % 2, 1.0, -1.0)[:, None]
    points = np.concatenate([along, along + np.array([0.0, 25.0, 0.0])])
    labels = line_labels(points, np.concatenate([signs * way, signs * way]), 200.0, 0.05)
    assert len(set(labels[:9])) == 1 and len(set(labels[9:])) == 1 and labels[0] != labels[9]


@pytest.mark.slow
@pytest.mark.parametrize("focal_px", [560.0, 900.0])
def test_the_focal_length_is_found_from_a_guess_far_off(focal_px: float) -> None:
    found = estimate(focal_px, varied_poses(16, seed=3, focal_px=focal_px), seed=1)
    assert found.is_determined
    assert abs(found.focal_px - focal_px) <= 2.0 * found.std_px
    assert found.focal_px == pytest.approx(focal_px, rel=0.015)
    assert 0.002 * focal_px < found.std_px < 0.015 * focal_px
    assert (found.camera.cx, found.camera.cy) == (GUESS.cx, GUESS.cy)
    assert f"{found.focal_px:.0f} ± {2 * found.std_px:.0f} px (guessed 768)" in found.text


@pytest.mark.slow
def test_the_stated_uncertainty_covers_the_error() -> None:
    deviations = []
    for seed in range(12):
        focal_px = float(np.random.default_rng(seed).uniform(560.0, 950.0))
        found = estimate(focal_px, varied_poses(12, seed, focal_px=focal_px), seed, noise=6.0)
        deviations.append((found.focal_px - focal_px) / found.std_px)
    # Twice the standard uncertainty covers 95 %; of 12 at most one may be outside.
    assert np.count_nonzero(np.abs(deviations) > 2.0) <= 1
    assert 0.1 < np.sqrt(np.mean(np.square(deviations))) < 1.5


@pytest.mark.slow
def test_far_views_leave_the_guess_a_guess() -> None:
    found = estimate(620.0, varied_poses(14, seed=5, nearest=7.0, farthest=9.0, focal_px=620.0), seed=2)
    assert not found.is_determined
    assert "not determined" in found.text and "768 px is kept" in found.text


@pytest.mark.slow
def test_one_view_again_and_again_determines_nothing() -> None:
    pose = varied_poses(1, seed=4)[0]
    found = estimate(650.0, [pose] * 12, seed=3)
    assert not found.is_determined and found.frames <= 2


def clip(focal_px: float, count: int) -> tuple[list[NDArray[np.uint8]], list[Array]]:
    camera = true_camera(focal_px)
    poses = []
    for pose in path(count, seed=2):
        moved = pose.copy()
        center = apply(pose, assembly().center_in_model)
        moved[:3, 3] += center * (focal_px / 720.0 - 1.0)
        poses.append(moved)
    return [picture(pose, camera=camera, seed=k) for k, pose in enumerate(poses)], poses


@pytest.mark.slow
def test_a_session_replaces_its_guessed_camera_while_it_tracks() -> None:
    focal_px = 600.0
    images, poses = clip(focal_px, 90)
    part = PartView(assembly_views())
    start = pose_seen_by(poses[0] @ part.model_from_body, true_camera(focal_px), GUESS) @ part.body_from_model
    session = TrackingSession.of(assembly_views(), GUESS, assembly(), initial_cam_from_model=start, is_guessed=True)
    assert session.camera_estimate is not None
    found = []
    for k, image in enumerate(images):
        found += session.process(image, k, k / 30.0)
        session.camera_estimate.wait()
    last = session.finish()
    assert last is not None and last.is_determined and last.focal_px == pytest.approx(focal_px, rel=0.015)
    assert session.camera_of(0) is GUESS and session.camera.fx == pytest.approx(focal_px, rel=0.03)
    shifts_mm = [
        error(p.cam_from_model, truth)[0] for p, truth in zip(found, poses, strict=True) if p.cam_from_model is not None
    ]
    assert len(shifts_mm) == len(images)
    # The guess is 28 % too long, and so are the distances; in the end they are right.
    assert shifts_mm[0] > 80.0 and max(shifts_mm[-10:]) < 12.0
