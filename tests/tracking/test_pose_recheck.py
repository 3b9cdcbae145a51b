"""Pose recheck: poses far from the prediction are rechecked, wrong ones replaced, right ones kept."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from arview.detection.detector import local_search_for
from arview.detection.search.global_search import PoseCandidate
from arview.detection.search.local_search import LocalSearch
from arview.geometry import Array, exp_so3, rigid
from arview.refinement.schedules import LAST_STAGES
from arview.tracking import Tracker, TrackerOptions
from arview.tracking.motion import squared_motion_distance
from arview.tracking.pose_recheck import LocalSearchRecheck
from helpers.synthetic import CAMERA, assembly, assembly_views, error, half_hidden, path, picture, pose_from, wrong

SLOW = path(12)


@cache
def local() -> LocalSearch:
    return local_search_for(assembly_views(), CAMERA)


@cache
def recheck() -> LocalSearchRecheck:
    return LocalSearchRecheck(local())


def in_body(cam_from_model: Array) -> Array:
    return cam_from_model @ local().refiner.part.model_from_body


def in_model(cam_from_body: Array) -> Array:
    return cam_from_body @ local().refiner.part.body_from_model


def stuck(image: NDArray[np.uint8], cam_from_model: Array) -> Array:
    """Pose after the last stages of the tracker, which follow near edges."""
    gray = cv2.blur(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), (3, 3))
    return local().refiner.refine_fresh(image, gray, in_body(cam_from_model), LAST_STAGES)


@pytest.mark.slow
@pytest.mark.parametrize("noise", [3.0, 12.0])
def test_a_wrong_pose_is_replaced(noise: float) -> None:
    rng = np.random.default_rng(4)
    mended = tried = 0
    for k in range(12):
        truth = pose_from(rng.uniform(-60, 60), rng.uniform(25, 65), rng.uniform(440, 620))
        image = picture(truth, seed=k, scene=k, noise=noise)
        pose = stuck(image, wrong(truth, rng, 14.0, 10.0))
        if error(in_model(pose), truth)[2] < 6.0:
            continue
        tried += 1
        better = recheck().better(image, pose, [in_body(wrong(truth, rng, 5.0, 5.0))])
        if better is not None:
            mm, _, deg = error(in_model(better), truth)
            mended += mm < 3.0 and deg < 1.5
    assert tried >= 8
    assert mended >= 0.9 * tried


@pytest.mark.slow
def test_a_right_pose_is_kept() -> None:
    rng = np.random.default_rng(5)
    for k in range(10):
        truth = pose_from(rng.uniform(-60, 60), rng.uniform(25, 65), rng.uniform(440, 620))
        card = half_hidden(truth) if k % 3 == 0 else None
        image = picture(truth, seed=k, scene=k, noise=8.0, card=card)
        better = recheck().better(image, in_body(truth), [in_body(wrong(truth, rng, 10.0, 10.0))])
        if better is not None:
            mm, _, deg = error(in_model(better), truth)
            assert mm < 3.0 and deg < 1.5


def test_a_part_at_the_border_of_the_picture_is_rechecked_and_one_outside_is_not() -> None:
    truth = pose_from(30, 40, 520)
    truth[0, 3] += 190.0
    image = picture(truth, noise=6.0)
    better = recheck().better(image, stuck(image, wrong(truth, np.random.default_rng(1), 12.0, 8.0)), [in_body(truth)])
    assert better is not None
    mm, _, deg = error(in_model(better), truth)
    assert mm < 4.0 and deg < 2.0
    beside, behind = truth.copy(), truth.copy()
    beside[0, 3] += 600.0
    behind[2, 3] *= -1.0
    for pose in (beside, behind):
        assert recheck().better(image, in_body(pose), [in_body(pose)]) is None
        assert recheck().better(image, in_body(truth), [in_body(pose)]) is None


def test_a_window_gives_the_same_pose_as_the_whole_picture() -> None:
    """A pose refined in a window equals that refined in the whole picture."""
    truth = pose_from(-20, 45, 500)
    image = picture(truth, noise=6.0)
    start = PoseCandidate(1.0, in_body(wrong(truth, np.random.default_rng(2), 4.0, 4.0)))
    whole = local().refine_and_verify(local().pyramid(image), [start])[0]
    left, top, camera = 120, 60, CAMERA.cropped(120, 60, 416, 352)
    windowed = local().with_camera(camera)
    crop = np.ascontiguousarray(image[top : top + camera.height, left : left + camera.width])
    found = windowed.refine_and_verify(windowed.pyramid(crop), [start])[0]
    for one in (whole, found):
        mm, _, deg = error(in_model(one.cam_from_body), truth)
        assert mm < 2.0 and deg < 0.5
    assert found.evidence_logit == pytest.approx(whole.evidence_logit, abs=1.0)
    assert found.verifier_score == pytest.approx(whole.verifier_score, abs=3.0)


def test_a_verified_hypothesis_keeps_its_place_in_the_list() -> None:
    truth = pose_from(30, 40, 520)
    seen = local().pyramid(picture(truth, noise=6.0))
    far = rigid(exp_so3(np.array([0.0, 0.6, 0.0])) @ in_body(truth)[:3, :3], in_body(truth)[:3, 3])
    found = local().evaluate(seen, [far, in_body(truth)])
    verified = local().verify(seen, found)
    assert [np.allclose(a.cam_from_body, b.cam_from_body) for a, b in zip(found, verified, strict=True)] == [True] * 2
    assert verified[1].logit > verified[0].logit + 3.0


class Watched(LocalSearchRecheck):
    """Counts its calls."""

    asked = 0

    def better(self, *given: object) -> Array | None:
        self.asked += 1
        return super().better(*given)  # type: ignore[arg-type]


def follow(
    poses: list[Array], chosen: LocalSearchRecheck | None, noise: float, is_hidden: bool = False
) -> list[tuple[float, float, float]]:
    """Errors of each frame: mm, mm across, degrees; tracking restarts at the truth after each that is off by 5°."""
    tracker = Tracker(assembly_views(), CAMERA, assembly(), TrackerOptions(use_texture=False), recheck=chosen)
    tracker.start(picture(poses[0], noise=noise), poses[0])
    errors = []
    for k, truth in enumerate(poses[1:], 1):
        card = half_hidden(truth) if is_hidden else None
        image = picture(truth, seed=k, scene=k // 8, noise=noise, card=card)
        errors.append(error(tracker.track(image).cam_from_model, truth))
        if errors[-1][2] > 5.0:
            tracker.start(image, truth)
    return errors


@pytest.mark.slow
def test_it_is_run_only_for_poses_far_from_the_prediction() -> None:
    watched = Watched(local())
    errors = follow(SLOW, watched, 4.0)
    assert watched.asked == 0 and max(deg for _, _, deg in errors) < 0.5
    jumped = [SLOW[0], wrong(SLOW[0], np.random.default_rng(0), 10.0, 0.0)]
    errors = follow(jumped, watched, 4.0)
    assert watched.asked == 1 and errors[-1][2] < 1.0


@pytest.mark.slow
def test_a_part_half_hidden_that_turns_in_jerks_is_followed_better_with_it() -> None:
    """The part turns by 8° to 14° and moves by 20 mm per frame in random directions, which no prediction follows."""
    rng = np.random.default_rng(11)
    poses = [pose_from(rng.uniform(-20, 20), rng.uniform(40, 55), 600)]
    while len(poses) < 28:
        turned = wrong(poses[-1], rng, rng.uniform(8.0, 14.0), 20.0)
        eye = -turned[:3, :3].T @ turned[:3, 3]
        elevation_deg = np.rad2deg(np.arcsin(eye[2] / np.linalg.norm(eye)))
        if 20.0 < elevation_deg < 70.0 and abs(np.rad2deg(np.arctan2(eye[1], eye[0]))) < 75.0:
            poses.append(turned)
    right = {}
    for name, chosen in (("without", None), ("with", recheck())):
        right[name] = sum(deg < 5.0 and mm < 50.0 for mm, _, deg in follow(poses, chosen, 10.0, is_hidden=True))
    assert right["with"] >= 14
    assert right["with"] >= right["without"] + 6


def test_motion_distance_is_one_at_45_degrees_and_grows_with_the_square() -> None:
    pose = in_body(pose_from(30, 40, 520))
    diameter_mm = assembly_views().diameter_mm
    for turn_deg, expected in ((45.0, 1.0), (22.5, 0.25)):
        turned = rigid(exp_so3(np.deg2rad([0.0, turn_deg, 0.0])) @ pose[:3, :3], pose[:3, 3])
        assert squared_motion_distance(turned, pose, diameter_mm) == pytest.approx(expected, rel=0.01)
    assert squared_motion_distance(pose, pose, diameter_mm) == 0.0
