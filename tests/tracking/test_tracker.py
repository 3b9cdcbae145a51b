"""Tracker and session on synthetic sequences with known poses: accuracy, covariance, quality, states."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from arview.cad.view_range import ViewRange
from arview.camera import Camera
from arview.errors import InputError, MismatchError
from arview.geometry import Array, invert, log_se3, rigid
from arview.guideviews import GuideViewOptions, make_guide_views
from arview.pose import Pose, TrackingState
from arview.refinement.modalities.edge import smoothed
from arview.refinement.schedules import TRACK_STAGES
from arview.tracking import Estimate, SpecimenTracking, Tracker, TrackerOptions
from arview.tracking.search.wide_search import WideSearch
from helpers.synthetic import (
    CAMERA,
    assembly,
    assembly_views,
    bracket,
    error,
    half_hidden,
    part_box,
    path,
    picture,
    pose_from,
    wrong,
)

MODALITIES = {
    "all": TrackerOptions(),
    "region": TrackerOptions(use_edge=False, use_texture=False),
    "edge": TrackerOptions(use_region=False, use_texture=False),
    "texture": TrackerOptions(use_region=False, use_edge=False),
}
PATH = path(40)
REAL_CAMERA = Camera(640, 480, 720.6, 722.6, 318.35, 242.25)
"""Camera with errors that a careful calibration may leave: 0.1 % in focal length, 0.4 px in the principal point."""


@cache
def clip() -> list[NDArray[np.uint8]]:
    return [picture(pose, seed=i) for i, pose in enumerate(PATH)]


def follow(
    images: list[NDArray[np.uint8]], poses: list[Array], options: TrackerOptions | None = None
) -> tuple[Tracker, list[Estimate], Array]:
    """Tracker after all frames, its estimates, and their errors (N,3): mm, mm across, deg."""
    tracker = Tracker(assembly_views(), CAMERA, assembly(), options)
    tracker.start(images[0], poses[0])
    estimates = [tracker.track(image) for image in images[1:]]
    errors = [error(e.cam_from_model, truth) for e, truth in zip(estimates, poses[1:], strict=True)]
    return tracker, estimates, np.array(errors)


# --- Accuracy -------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    "name,median,worst",
    [
        ("all", (0.35, 0.08), (0.8, 0.2)),
        ("edge", (0.35, 0.10), (0.9, 0.3)),
        ("region", (0.60, 0.25), (2.0, 0.8)),
        ("texture", (0.25, 0.10), (0.6, 0.2)),
    ],
)
def test_accuracy_of_each_modality(name: str, median: tuple[float, float], worst: tuple[float, float]) -> None:
    _, estimates, errors = follow(clip(), PATH, MODALITIES[name])
    assert np.median(errors[:, 0]) < median[0]
    assert np.median(errors[:, 2]) < median[1]
    assert errors[:, 0].max() < worst[0]
    assert errors[:, 2].max() < worst[1]
    assert min(e.quality for e in estimates) > 0.9


@pytest.mark.slow
def test_a_jump_of_the_exposure_is_followed() -> None:
    images = [picture(pose, seed=i, gain=0.6 if 15 <= i < 30 else 1.0) for i, pose in enumerate(PATH)]
    for name, worst_mm, worst_deg in (("all", 0.8, 0.2), ("edge", 0.9, 0.3), ("region", 10.0, 2.0)):
        _, estimates, errors = follow(images, PATH, MODALITIES[name])
        assert np.median(errors[:, 0]) < 0.7
        assert errors[:, 0].max() < worst_mm
        assert errors[:, 1].max() < 1.5
        assert errors[:, 2].max() < worst_deg
        assert errors[-5:, 0].max() < 0.8
        assert min(e.quality for e in estimates) > 0.8


@pytest.mark.slow
def test_half_of_the_part_may_be_hidden() -> None:
    images = [picture(p, seed=i, card=half_hidden(p) if i >= 10 else None) for i, p in enumerate(PATH)]
    _, _, errors = follow(images, PATH)
    assert np.median(errors[10:, 0]) < 1.0
    assert np.median(errors[10:, 2]) < 0.3
    assert errors[:, 1].max() < 2.0
    assert errors[:, 2].max() < 1.5


@pytest.mark.slow
def test_another_background_and_strong_noise() -> None:
    images = [picture(p, seed=i, scene=4, noise=12.0) for i, p in enumerate(PATH)]
    _, _, errors = follow(images, PATH)
    assert np.median(errors[:, 0]) < 0.6
    assert errors[:, 2].max() < 0.5


@pytest.mark.slow
def test_a_start_that_is_off_is_pulled_in() -> None:
    rng = np.random.default_rng(8)
    ends = []
    for k in range(12):
        tracker = Tracker(assembly_views(), CAMERA, assembly())
        image = picture(PATH[3 * k], seed=k, scene=k)
        tracker.start(image, wrong(PATH[3 * k], rng, 3.0, 6.0))
        for _ in range(3):
            estimate = tracker.track(image)
        ends.append(error(estimate.cam_from_model, PATH[3 * k]))
    assert np.mean([mm < 2.0 and deg < 0.5 for mm, _, deg in ends]) >= 0.9


@pytest.mark.slow
def test_a_part_that_moved_far_between_frames_is_found() -> None:
    """20° to 35° and up to a quarter of the diameter sideways in one frame; the next frames need no search."""
    rng = np.random.default_rng(3)
    tracker = Tracker(assembly_views(), CAMERA, options=TrackerOptions(use_texture=False))
    right = 0
    for k in range(12):
        first = pose_from(rng.uniform(-60, 60), rng.uniform(25, 60), 520)
        then = wrong(first, rng, rng.uniform(20, 35), rng.uniform(0.0, 0.25) * tracker.diameter_mm)
        tracker.start(picture(first, seed=k), first)
        tracker.track(picture(then, seed=k + 50))
        estimate = tracker.track(picture(then, seed=k + 50))
        mm, _, deg = error(estimate.cam_from_model, then)
        right += mm < 3.0 and deg < 1.0
        assert estimate.quality < 0.5 or (mm < 10.0 and deg < 5.0)
    assert right >= 11


@pytest.mark.slow
def test_a_part_that_moved_a_tenth_of_its_size_needs_no_search(monkeypatch: pytest.MonkeyPatch) -> None:
    """6° to 10° and 16 to 30 mm in one frame, with noise: stages in which colours lead reach it (27 of 30, without
    them 1)."""
    monkeypatch.setattr(WideSearch, "find", lambda *_: [])
    rng = np.random.default_rng(5)
    tracker = Tracker(assembly_views(), CAMERA, options=TrackerOptions(use_texture=False))
    right = 0
    for k in range(12):
        first = pose_from(rng.uniform(-60, 60), rng.uniform(25, 60), 520)
        then = wrong(first, rng, rng.uniform(6, 10), rng.uniform(16, 30))
        tracker.start(picture(first, seed=k, scene=k, noise=8.0), first)
        mm, _, deg = error(tracker.track(picture(then, seed=k + 50, scene=k, noise=8.0)).cam_from_model, then)
        right += mm < 3.0 and deg < 1.0
    assert right >= 10


@pytest.mark.slow
def test_tracking_before_a_start_is_an_error() -> None:
    with pytest.raises(RuntimeError, match=r"before Tracker\.start"):
        Tracker(assembly_views(), CAMERA).track(clip()[0])
    with pytest.raises(InputError, match="at least one modality"):
        TrackerOptions(use_region=False, use_edge=False, use_texture=False)


# --- Covariance and quality -----------------------------------------------------------------------------


def squared_distances(tracker: Tracker, estimates: list[Estimate], truths: list[Array]) -> Array:
    """Squared Mahalanobis distance of the error twist about the centre, over its six dimensions."""
    model_from_body = rigid(np.eye(3), assembly().center_in_model)
    values = []
    for estimate, truth in zip(estimates, truths, strict=True):
        twist = log_se3(invert(estimate.cam_from_model @ model_from_body) @ truth @ model_from_body)
        values.append(twist @ np.linalg.solve(tracker.covariance(estimate), twist) / 6.0)
    return np.array(values)


@pytest.mark.slow
def test_covariance_covers_the_errors_of_a_real_camera() -> None:
    images = [picture(p, camera=REAL_CAMERA, seed=i, noise=4.0, scene=2) for i, p in enumerate(PATH)]
    tracker, estimates, _ = follow(images, PATH)
    distances = squared_distances(tracker, estimates, PATH[1:])
    # Cautious: blur and rolling shutter, for which the motion counts, are not in these pictures.
    assert 0.03 < np.median(distances) < 2.0
    assert np.mean(distances < 12.6 / 6.0) >= 0.95


@pytest.mark.slow
def test_covariance_is_never_too_small_on_ideal_pictures_and_grows_with_hiding() -> None:
    tracker, estimates, _ = follow(clip(), PATH)
    distances = squared_distances(tracker, estimates, PATH[1:])
    assert np.median(distances) > 0.002
    # Too cautious on purpose: what a real camera and part add is not in these pictures.
    assert distances.max() < 1.0
    for estimate in estimates:
        covariance = tracker.covariance(estimate)
        assert covariance == pytest.approx(covariance.T, rel=1e-6)
        assert np.linalg.eigvalsh(covariance).min() > 0
    hidden = [picture(p, seed=i, card=half_hidden(p) if i >= 10 else None) for i, p in enumerate(PATH)]
    other, poorer, _ = follow(hidden, PATH)
    sure, unsure = tracker.covariance(estimates[20]), other.covariance(poorer[20])
    # What all points of a frame share is the same; what each measures for itself is less.
    assert np.linalg.det(unsure[3:, 3:]) > 1.5 * np.linalg.det(sure[3:, 3:])


@pytest.mark.slow
def test_quality_separates_right_from_wrong_poses() -> None:
    """Poses refined from wrong starts have a low quality, and the wide search finds the part from there."""
    rng = np.random.default_rng(5)
    tracker = Tracker(assembly_views(), CAMERA, options=TrackerOptions(use_texture=False))
    right, mistaken, found = [], [], 0
    for k in range(24):
        truth = pose_from(
            rng.uniform(-75, 75), rng.uniform(20, 70), rng.uniform(440, 620), roll_deg=rng.uniform(-18, 18)
        )
        truth[:2, 3] += rng.uniform(-40, 40, 2)
        image = picture(truth, seed=k, scene=k % 8, noise=4.0)
        tracker.start(image, wrong(truth, rng, 1.0, 2.0))
        estimate = tracker.track(image)
        mm, _, deg = error(estimate.cam_from_model, truth)
        if mm < 5.0 and deg < 1.0:
            right.append(estimate.quality)
        gray = smoothed(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
        for angle_deg, shift_mm in ((rng.uniform(15, 40), 0.0), (0.0, 0.3 * tracker.diameter_mm)):
            start = wrong(truth, rng, angle_deg, shift_mm)
            tracker.start(image, start)
            refiner, appearance = tracker.refiner, tracker.state.appearance
            start = start @ refiner.part.model_from_body
            pose, _ = refiner.refine(image, gray, start, TRACK_STAGES, appearance)
            mm, _, deg = error(pose @ refiner.part.body_from_model, truth)
            if mm > 10.0 or deg > 5.0:
                mistaken.append(refiner.evidence(image, gray, pose, appearance).quality)
                mm, _, deg = error(tracker.track(image).cam_from_model, truth)
                found += mm < 5.0 and deg < 1.0
    assert len(right) >= 23
    assert found >= 0.9 * len(mistaken)
    assert len(mistaken) >= 30
    assert np.mean(np.array(right) > 0.5) >= 0.97
    assert np.mean(np.array(mistaken) < 0.5) >= 0.95


# --- Session --------------------------------------------------------------------------------------------


@cache
def hidden_run() -> tuple[list[Pose], list[Array]]:
    """70 frames: found and tracked for 20, hidden by a card for 30, in view again for 20."""
    poses = path(70, seed=3)
    session = SpecimenTracking(assembly_views(), CAMERA, assembly())
    results = []
    for i, pose in enumerate(poses):
        card = part_box(pose, margin_px=25) if 20 <= i < 50 else None
        results.append(session.process(picture(pose, seed=i, scene=1, card=card), i, i / 30.0))
    return results, poses


@pytest.mark.slow
def test_a_hidden_part_is_lost_and_found_again() -> None:
    results, poses = hidden_run()
    states = [result.state for result in results]
    assert states[5:20] == [TrackingState.TRACKED] * 15
    assert TrackingState.LOST in states[20:25]
    assert TrackingState.TRACKED not in states[24:50]
    back = [i for i in range(50, 70) if states[i] == TrackingState.TRACKED]
    assert back
    assert back[0] < 60
    assert states[back[0] :] == [TrackingState.TRACKED] * (70 - back[0])
    mm, _, deg = np.transpose([error(results[i].cam_from_model, poses[i]) for i in back])  # type: ignore[arg-type]
    assert mm.max() < 5.0
    assert deg.max() < 1.0


@pytest.mark.slow
def test_no_wrong_pose_is_ever_called_tracked() -> None:
    results, poses = hidden_run()
    assert sum(result.state == TrackingState.TRACKED for result in results) > 25
    for result, truth in zip(results, poses, strict=True):
        if result.state == TrackingState.TRACKED:
            assert result.cam_from_model is not None
            mm, _, deg = error(result.cam_from_model, truth)
            assert mm < 50.0
            assert deg < 5.0


@pytest.mark.slow
def test_there_is_no_pose_without_the_part() -> None:
    results, _ = hidden_run()
    assert sum(result.state == TrackingState.LOST for result in results) > 20
    for i, result in enumerate(results):
        assert (result.index, result.time_s) == (i, i / 30.0)
        is_seen = result.state in (TrackingState.TRACKED, TrackingState.CRITICAL)
        assert (result.cam_from_model is not None) == is_seen
        assert (result.covariance is not None) == is_seen
        if not is_seen:
            assert result.quality == 0.0
            assert result.reason
    session = SpecimenTracking(assembly_views(), CAMERA, assembly())
    for i in range(4):
        result = session.process(picture(None, seed=i, scene=6), i, 0.0)
        assert (result.state, result.cam_from_model) == (TrackingState.SEARCHING, None)
    black = session.process(np.zeros((480, 640, 3), dtype=np.uint8), 4, 0.0)
    assert (black.state, black.cam_from_model, black.reason) == (TrackingState.SEARCHING, None, "too dark")
    white = session.process(np.full((480, 640, 3), 255, dtype=np.uint8), 5, 0.0)
    assert (white.cam_from_model, white.reason) == (None, "overexposed")


@pytest.mark.slow
def test_a_part_that_leaves_the_picture_is_lost() -> None:
    session = SpecimenTracking(assembly_views(), CAMERA, assembly(), initial_cam_from_model=PATH[0])
    states = []
    for i in range(20):
        pose = PATH[0].copy()
        pose[0, 3] += max(0, i - 4) * 45.0
        result = session.process(picture(pose, seed=i), i, 0.0)
        states.append(result.state)
    assert states[4] == TrackingState.TRACKED
    # The part is out of the picture from the tenth step on, 450 mm to the side.
    assert TrackingState.TRACKED not in states[15:]
    assert TrackingState.LOST in states[:19]


@pytest.mark.slow
def test_an_initial_pose_is_refined() -> None:
    start = wrong(PATH[0], np.random.default_rng(1), 4.0, 8.0)
    session = SpecimenTracking(assembly_views(), CAMERA, assembly(), initial_cam_from_model=start)
    result = session.process(clip()[0], 0, 0.0)
    assert result.state == TrackingState.TRACKED
    assert result.cam_from_model is not None
    mm, _, deg = error(result.cam_from_model, PATH[0])
    assert mm < 2.0
    assert deg < 0.5


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((480, 641, 3), dtype=np.uint8),
        np.zeros((640, 480, 3), dtype=np.uint8),
        np.zeros((480, 640), dtype=np.uint8),
        np.zeros((480, 640, 4), dtype=np.uint8),
        np.zeros((480, 640, 3), dtype=np.float32),
    ],
    ids=["width", "turned", "gray", "alpha", "float"],
)
def test_a_wrong_image_is_refused(image: NDArray[np.uint8]) -> None:
    session = SpecimenTracking(assembly_views(), CAMERA, assembly())
    with pytest.raises(InputError, match=r"frame 7: .*expected \(480, 640, 3\) uint8"):
        session.process(image, 7, 0.0)


def test_guide_views_of_another_model_are_refused() -> None:
    coarse = GuideViewOptions(subdivisions=0, renderer="zbuffer")
    with pytest.raises(MismatchError, match=r"'bracket'.*'assembly'"):
        SpecimenTracking(make_guide_views(bracket(), ViewRange((400.0, 700.0)), coarse), CAMERA, assembly())


def test_invalid_poses_are_refused() -> None:
    with pytest.raises(InputError, match="initial pose"):
        SpecimenTracking(assembly_views(), CAMERA, assembly(), initial_cam_from_model=2.0 * np.eye(4))
