"""The detector on rendered frames: finds the part anywhere in the range, and never a wrong or ambiguous pose alone."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import permutations, product

import numpy as np
import pytest

from arview.cad.model import Model, make_model
from arview.cad.view_range import ViewRange
from arview.detection import Detector, DetectorOptions
from arview.detection.disambiguation import turned
from arview.detection.features.image_pyramid import ImagePyramid
from arview.detection.search.global_search import (
    GRADIENTS_ONLY,
    QUICK,
    RESPONSE_WEIGHT,
    UNTRIMMED,
    WIDE,
    CandidatePoses,
    PoseCandidate,
    SearchBudget,
    search_distances_mm,
)
from arview.detection.search.hypothesis import Hypothesis
from arview.detection.search.local_search import PREVIOUS_WEIGHT
from arview.detection.search.template_bank import DOMAIN_DIRECTION, in_fundamental_domain
from arview.detection.symmetry import edge_margin, find_rotational_symmetries
from arview.errors import InputError
from arview.geometry import apply, are_near, exp_so3, rigid
from arview.guideviews import GuideViewOptions, make_guide_views
from arview.guideviews.sphere import icosphere_directions
from arview.pose import TrackingState
from arview.refinement.evidence import EdgeSteps, PoseEvidence
from arview.tracking import SpecimenTracking
from helpers.cad_files import box
from helpers.synthetic import (
    CAMERA,
    RANGE,
    assembly,
    assembly_views,
    block,
    component,
    error,
    half_hidden,
    path,
    picture,
    pose_from,
    post,
    wrong,
)

SIGNS = tuple(product((-1.0, 1.0), repeat=3))
CLEAR = 1.25
"""Standard deviations, see `edge_margin`."""


@cache
def detector() -> Detector:
    return Detector(assembly_views(), CAMERA)


def anywhere(rng: np.random.Generator) -> np.ndarray:
    """A pose of the declared range with the part fully in the image."""
    pose = pose_from(
        rng.uniform(*RANGE.azimuth_deg), rng.uniform(*RANGE.elevation_deg), rng.uniform(440, 620),
        roll_deg=rng.uniform(*RANGE.roll_deg),
    )  # fmt: skip
    pose[:2, 3] += rng.uniform([-90, -50], [90, 50])
    return pose


@pytest.mark.slow
def test_the_part_is_found_without_a_hint() -> None:
    rng = np.random.default_rng(11)
    found, exact = 0, 0
    for k in range(6):
        truth = anywhere(rng)
        detections = detector().detect(picture(truth, seed=k, scene=k % 9, noise=3.0))
        qualities = [d.quality for d in detections]
        assert qualities == sorted(qualities, reverse=True)
        assert all(quality >= detector().options.min_quality for quality in qualities)
        if not detections:
            continue
        depth = apply(detections[0].cam_from_model, assembly().center_in_model)[2]
        depth_truth = apply(truth, assembly().center_in_model)[2]
        mm, _, deg = error(detections[0].cam_from_model, truth)
        found += deg < 10.0 and abs(depth / depth_truth - 1.0) < 0.05
        exact += mm < 5.0 and deg < 1.0
    assert found >= 6
    assert exact >= 5


@pytest.mark.slow
def test_nothing_is_found_where_there_is_no_part() -> None:
    for k in range(5):
        assert detector().detect(picture(None, seed=k, scene=20 + k)) == []


@pytest.mark.slow
def test_the_part_is_found_over_the_full_sphere_and_all_rolls() -> None:
    views = make_guide_views(assembly(), ViewRange((300.0, 1200.0)), GuideViewOptions(subdivisions=3))
    everywhere = Detector(views, CAMERA)
    rng = np.random.default_rng(3)
    found, wrong_ones = 0, 0
    for k in range(5):
        truth = pose_from(
            rng.uniform(-180, 180), rng.uniform(0, 80), rng.uniform(400, 650), None, rng.uniform(-180, 180)
        )
        detections = everywhere.detect(picture(truth, seed=k, scene=k % 9, noise=3.0), max_results=1)
        if detections:
            mm, _, deg = error(detections[0].cam_from_model, truth)
            found += mm < 8.0 and deg < 2.0
            wrong_ones += mm > 50.0 or deg > 5.0
    assert found >= 5
    assert wrong_ones == 0


@pytest.mark.slow
def test_the_best_rejected_hypothesis_is_kept() -> None:
    seen = detector()
    assert seen.detect(picture(None, seed=1, scene=21)) == []
    rejected = seen.best_rejected
    assert rejected is None or rejected.quality < seen.options.min_quality
    assert seen.detect(picture(pose_from(30, 40, 520), seed=1))
    assert seen.best_rejected is None


@pytest.mark.slow
def test_symmetries_are_discovered() -> None:
    block_views = make_guide_views(block(), ViewRange((200.0, 500.0)), GuideViewOptions(subdivisions=2))
    half_turns = find_rotational_symmetries(block_views).exact
    assert len(half_turns) == 3
    assert np.allclose(np.trace(half_turns, axis1=1, axis2=2), -1.0, atol=1e-9)
    assert len(find_rotational_symmetries(assembly_views()).exact) == 0
    assert len(find_rotational_symmetries(assembly_views()).near) == 0


@pytest.mark.slow
def test_symmetries_are_tested_where_the_declared_range_shows_both_poses() -> None:
    """From one side the hidden edges of a cube are never seen; a mark on one face tells its quarter turns."""
    half_round = ViewRange((300.0, 600.0), elevation_deg=(15.0, 70.0), azimuth_deg=(-150.0, 30.0))
    grey = (0.5, 0.5, 0.5)
    cube = component("cube", box((0, 0, 0), (60, 60, 60)), grey)
    mark = component("mark", box((20, 20, 60), (50, 26, 62)), grey)
    found = find_rotational_symmetries(
        make_guide_views(make_model("cube", (cube,)), half_round, GuideViewOptions(subdivisions=3))
    )
    upright = [turn for turn in found.exact if turn[2, 2] > 0.9]
    assert len(found.near) == 0 and len(upright) >= 2
    marked = make_guide_views(make_model("marked", (cube, mark)), half_round, GuideViewOptions(subdivisions=3))
    assert len(find_rotational_symmetries(marked).exact) == 0


@pytest.mark.slow
def test_symmetries_by_fifths_are_discovered() -> None:
    angles = np.deg2rad(72.0 * np.arange(5) + 10.0)
    grey = (0.5, 0.5, 0.5)
    places = [(38 * np.cos(a), 38 * np.sin(a)) for a in angles]
    wheel = [component(f"stud_{k}", post(place, 8, 12, 30), grey) for k, place in enumerate(places)]
    wheel += [component("disc", post((0, 0), 60, 0, 12, 60), grey), component("hub", post((0, 0), 14, 12, 40), grey)]
    key = component("key", box((48, -4, 12), (56, 4, 18)), grey)
    for parts, kind in ((wheel, "exact"), ([*wheel, key], "near")):
        views = make_guide_views(make_model("wheel", tuple(parts)), ViewRange((200.0, 500.0)), GuideViewOptions(2))
        found = find_rotational_symmetries(views)
        turns = getattr(found, kind)
        assert len(found.exact) + len(found.near) == len(turns) == 4
        angles_deg = np.rad2deg(np.arctan2(turns[:, 1, 0], turns[:, 0, 0])) % 360.0
        np.testing.assert_allclose(np.sort(angles_deg), [72.0, 144.0, 216.0, 288.0])


def cube_rotations() -> np.ndarray:
    """The 24 rotations of a cube onto itself."""
    signed = [np.diag(signs) @ np.eye(3)[list(order)] for order in permutations(range(3)) for signs in SIGNS]
    return np.array([turn for turn in signed if np.linalg.det(turn) > 0.0])


def max_angle_to_images_deg(directions: np.ndarray, wanted: np.ndarray, turns: np.ndarray) -> float:
    """Largest angle from one of some directions (N,3) to the nearest image of the wanted ones."""
    images = np.concatenate([wanted @ turn for turn in turns])
    return float(np.rad2deg(np.arccos(np.clip((directions @ images.T).max(axis=1), -1.0, 1.0)).max()))


def test_one_of_several_symmetric_views_and_a_margin_are_searched() -> None:
    turns, directions = cube_rotations(), icosphere_directions(2)
    assert len(turns) == 24
    rng = np.random.default_rng(2)
    anywhere = rng.normal(size=(2000, 3))
    anywhere /= np.linalg.norm(anywhere, axis=1, keepdims=True)
    full = ViewRange((200.0, 500.0))
    wanted = directions[in_fundamental_domain(directions, turns, full)]
    assert 162 / 24 < len(wanted) < 162 / 6
    assert max_angle_to_images_deg(anywhere, wanted, turns) < 11.0
    # A margin: by every direction there are templates on all sides that need no turn.
    inside = anywhere[np.all((turns @ DOMAIN_DIRECTION - DOMAIN_DIRECTION) @ anywhere.T <= 0.0, axis=0)]
    assert len(inside) > 40
    assert max_angle_to_images_deg(inside, wanted, np.eye(3)[None]) < 11.0

    above = ViewRange((200.0, 500.0), elevation_deg=(20.0, 90.0), azimuth_deg=(-100.0, 40.0))
    sought = directions[above.contains_direction(directions, 3.0)]
    wanted = sought[in_fundamental_domain(sought, turns, above)]
    assert len(wanted) < len(sought)
    declared = anywhere[above.contains_direction(anywhere)]
    assert max_angle_to_images_deg(declared, wanted, turns) < 13.0

    upright = ViewRange((200.0, 500.0), roll_deg=(-20.0, 20.0))
    assert in_fundamental_domain(directions, turns, upright).all()
    assert in_fundamental_domain(directions, turns[:0], full).all()


@pytest.mark.slow
def test_a_box_is_found_from_all_directions_up_to_its_symmetries() -> None:
    sought = Detector(make_guide_views(block(), ViewRange((250.0, 500.0)), GuideViewOptions(subdivisions=3)), CAMERA)
    assert len(sought.disambiguator.exact_rotations) == 4
    rng = np.random.default_rng(5)
    found, wrong_ones = 0, 0
    for k in range(7):
        place = rng.uniform(-180, 180), rng.uniform(-80, 80), rng.uniform(280, 450)
        truth = pose_from(*place, block(), rng.uniform(-180, 180))
        detections = sought.detect(picture(truth, block(), seed=k, scene=k % 9, noise=3.0), max_results=1)
        if detections:
            body = detections[0].cam_from_model @ sought.local.refiner.part.model_from_body
            alike = [
                body @ rigid(t, np.zeros(3)) @ sought.local.refiner.part.body_from_model
                for t in sought.disambiguator.exact_rotations
            ]
            mm, _, deg = min((error(one, truth, block()) for one in alike), key=lambda of: of[2])
            found += mm < 8.0 and deg < 2.0
            wrong_ones += mm > 50.0 or deg > 5.0
    assert found >= 6
    # From some directions a plain box is similar to a box seen from another one.
    assert wrong_ones <= 1


@cache
def knob(key_mm: float) -> Model:
    """A six-sided knob with a small block on one of its corners, which alone breaks the symmetry."""
    parts = (
        component("head", post((0, 0), 50, 0, 30, 6), (0.6, 0.6, 0.65)),
        component("neck", post((0, 0), 26, 30, 55, 6), (0.5, 0.5, 0.55)),
        component("key", box((31, -0.5 * key_mm, 30), (31 + key_mm, 0.5 * key_mm, 30 + 0.6 * key_mm)), (0.3, 0.3, 0.3)),
    )
    return make_model("knob", parts)


@pytest.mark.slow
@pytest.mark.parametrize(("key_mm", "is_visible"), [(14.0, True), (1.8, False)])
def test_a_visible_key_disambiguates_and_an_invisible_one_leaves_alternatives(key_mm: float, is_visible: bool) -> None:
    model = knob(key_mm)
    views = make_guide_views(model, ViewRange((250.0, 700.0), (20.0, 90.0)), GuideViewOptions(subdivisions=3))
    sought = Detector(views, CAMERA)
    assert len(sought.symmetries.near) == 5
    right = 0
    for k in range(3):
        truth = pose_from(15.0 + 30 * k, 50.0, 380.0, model, 10.0 * k)
        for found in sought.detect(picture(truth, model, seed=k, scene=k), max_results=1):
            poses = [found.cam_from_model, *found.alternatives]
            wrong_by = [error(pose, truth, model)[2] for pose in poses]
            right += wrong_by[0] < 3.0 and len(poses) == 1 if is_visible else len(poses) > 1 and min(wrong_by) < 3.0
    assert right == 3


@pytest.mark.slow
def test_a_badly_refined_copy_is_no_alternative(monkeypatch: pytest.MonkeyPatch) -> None:
    truth = pose_from(30, 40, 500.0)
    seen = detector().local.pyramid(picture(truth))
    right = detector().hypotheses(seen)[0]
    (pose,) = turned(right.cam_from_body, [exp_so3(np.deg2rad([0.0, 10.0, 0.0]))])
    aside = replace(right, cam_from_body=pose, contour_score=right.contour_score - 2.0)
    against = np.array([[0.0, -9.0], [9.0, 0.0]])
    monkeypatch.setattr(
        detector().disambiguator, "evidence_margins", lambda of, rivals: against[: len(rivals), : len(rivals)]
    )
    monkeypatch.setattr(detector().local, "refine_fine", lambda of, starts: [])
    best, alternatives = detector().disambiguator.choose(seen, right, [aside])
    assert best is right and not alternatives


def test_a_search_by_gradients_ignores_the_edge_network() -> None:
    seen = detector().local.pyramid(picture(pose_from(30, 40, 500.0)))
    without = ImagePyramid(seen.image, CAMERA, seen.pad_px)
    for one, other in zip(
        detector().global_search.candidates(seen, GRADIENTS_ONLY),
        detector().global_search.candidates(without, UNTRIMMED),
        strict=True,
    ):
        np.testing.assert_array_equal(one, other)
    assert not np.array_equal(detector().global_search.candidates(seen, UNTRIMMED).responses, one)


def lid() -> Model:
    """A round lid with six pins and a small block beside one: its outline is nearly the same at any angle."""
    parts = [component("disc", post((0, 0), 60, 0, 14, 60), (0.55, 0.55, 0.6))]
    for k in range(6):
        place = 42.0 * np.array([np.cos(np.pi * k / 3), np.sin(np.pi * k / 3)])
        parts.append(component(f"pin_{k}", post(tuple(place), 8.0, 14, 26, 24), (0.3, 0.3, 0.32)))
    parts.append(component("key", box((18, -6, 14), (30, 6, 22)), (0.25, 0.25, 0.27)))
    return make_model("lid", tuple(parts))


@pytest.mark.slow
def test_a_rotation_sweep_finds_the_angle_of_a_nearly_round_part() -> None:
    model = lid()
    views = make_guide_views(model, ViewRange((250.0, 700.0), (20.0, 90.0)), GuideViewOptions(subdivisions=3))
    sought = Detector(views, CAMERA)
    np.testing.assert_allclose(np.abs(sought.symmetries.axes), [[0.0, 0.0, 1.0]])
    part = sought.local.refiner.part
    for k in range(3):
        truth = pose_from(20.0 + 80.0 * k, 45.0, 380.0, model)
        seen = sought.local.pyramid(picture(truth, model, seed=k, scene=k))
        (rotated,) = turned(truth @ part.model_from_body, [exp_so3(np.deg2rad([0.0, 0.0, 23.0]))])
        starts = sought.disambiguator.rotation_sweep(seen, rotated)
        assert min(error(start @ part.body_from_model, truth, model)[2] for start in starts[:3]) < 6.0
        best = sought.local.verify(seen, sought.local.refine_fine(seen, [rotated]))[0]
        found, _ = sought.disambiguator.choose(seen, best, [])
        assert error(found.cam_from_body @ part.body_from_model, truth, model)[2] < 2.0


def test_a_part_with_few_near_symmetries_is_not_swept() -> None:
    assert not len(detector().symmetries.axes)
    assert (
        detector().disambiguator.rotation_sweep(detector().local.pyramid(picture(pose_from(30, 40, 500.0))), np.eye(4))
        == []
    )


def test_edges_of_only_one_pose_give_the_margin() -> None:
    rng = np.random.default_rng(4)
    shared, only_a, only_b = (
        np.array([x, 0.0]) + rng.uniform(0, 90, (n, 2)) for x, n in ((0, 200), (200, 30), (400, 30))
    )
    normals = np.tile([1.0, 0.0], (230, 1))
    noise = rng.normal(0.0, 0.3, 230)

    def steps(own: np.ndarray, support: float) -> EdgeSteps:
        jitter = rng.normal(0.0, 0.5, (230, 2))
        return EdgeSteps(
            np.concatenate([shared, own]) + jitter, normals, np.r_[np.full(200, 0.6), np.full(30, support)] + noise
        )

    assert edge_margin(steps(only_a, 0.6), steps(only_b, 0.0)) > CLEAR
    assert edge_margin(steps(only_b, 0.0), steps(only_a, 0.6)) < -CLEAR
    assert abs(edge_margin(steps(only_a, 0.6), steps(only_b, 0.55))) < CLEAR
    # Edges that exist where the other pose has none count, too.
    assert edge_margin(steps(only_a, 0.6), steps(shared[:30], 0.6)) > CLEAR
    assert edge_margin(steps(only_a, 0.0), steps(shared[:30], 0.6)) < -CLEAR
    # Shared edges alone give no margin.
    assert edge_margin(steps(shared[:30], 0.6), steps(shared[:30], 0.0)) == 0.0


def test_small_parts_plain_views_and_competitors_lower_the_quality() -> None:
    evidence = PoseEvidence(0.6, 0.6, 0.35, 0.6, 0.5, 0.15, 1.0, 0.4)
    weaker = PoseEvidence(0.58, 0.58, 0.35, 0.6, 0.5, 0.15, 1.0, 0.4)

    def quality(distance_mm: float, competitor_offset_mm: float | None, turn_deg: float, share: float = 1.0) -> float:
        pose, lines = pose_from(30, 40, distance_mm), share * detector().local.mean_view_lines
        radius_px = detector().local.refiner.radius_px(pose)
        hypotheses = [Hypothesis(pose, evidence, 4.0, lines, radius_px, verifier_score=1.0, contour_score=1.0)]
        if competitor_offset_mm is not None:
            other = pose_from(30 + turn_deg, 40, distance_mm)
            other[0, 3] += competitor_offset_mm
            hypotheses.append(Hypothesis(other, weaker, 4.0, lines, radius_px, verifier_score=1.0, contour_score=1.0))
        return detector().qualities(hypotheses)[0]

    alone = quality(500.0, None, 0.0)
    assert alone > 0.5
    assert quality(500.0, 5.0, 8.0) == alone
    assert quality(500.0, 5.0, 60.0) < 0.5 * alone and quality(500.0, 300.0, 8.0) < 0.5 * alone
    assert quality(2000.0, None, 0.0) < 0.5
    # A view with fewer lines than usual fits by chance.
    assert quality(500.0, None, 0.0, 0.3) < 0.5 < alone < quality(500.0, None, 0.0, 2.0)


@pytest.mark.slow
def test_an_ambiguous_view_has_alternatives() -> None:
    model = knob(1.8)
    views = make_guide_views(model, ViewRange((250.0, 700.0), (20.0, 90.0)), GuideViewOptions(subdivisions=3))
    session = SpecimenTracking(views, CAMERA, model)
    truth = pose_from(15.0, 50.0, 380.0, model)
    pose = session.process(picture(truth, model, seed=1, scene=1), 0, 0.0)
    assert pose.state == TrackingState.CRITICAL and pose.reason.startswith("ambiguous")
    assert pose.cam_from_model is not None and pose.alternatives
    assert min(error(p, truth, model)[2] for p in (pose.cam_from_model, *pose.alternatives)) < 3.0


def test_rough_poses_are_tried_alone() -> None:
    truth = pose_from(30, 40, 520)
    image = picture(truth, seed=1)
    near = wrong(truth, np.random.default_rng(1), 8.0, 12.0)
    found = detector().detect_near(image, [near])
    assert len(found) == 1 and error(found[0].cam_from_model, truth)[2] < 1.5
    away = pose_from(30, 40, 520, roll_deg=180.0)
    assert detector().detect_near(image, [away]) == []
    tried_first = detector().detect(image, guesses=[near])
    assert len(tried_first) == 1 and np.array_equal(tried_first[0].cam_from_model, found[0].cam_from_model)
    searched = detector().detect(image, guesses=[away])
    assert searched and error(searched[0].cam_from_model, truth)[2] < 1.5


@pytest.mark.slow
def test_an_occluder_over_half_of_the_part_does_not_shift_the_pose() -> None:
    errors = []
    for k, truth in enumerate(path(40)[::8]):
        found = detector().detect_near(picture(truth, seed=8 * k, card=half_hidden(truth)), [truth])
        errors += [error(detection.cam_from_model, truth) for detection in found]
    assert len(errors) == 5
    worst = np.max(errors, axis=0)  # with colours in every stage 22 mm, 3.3°
    assert worst[0] < 5.0 and worst[2] < 1.0, worst
    assert np.median(errors, axis=0)[0] < 1.5


def test_no_more_results_than_requested() -> None:
    image = picture(pose_from(30, 40, 520), seed=1)
    assert len(detector().detect(image, max_results=1)) == 1
    assert detector().detect(image, max_results=0) == []


def test_options_out_of_range_are_refused() -> None:
    with pytest.raises(InputError, match="radius_px"):
        DetectorOptions(radius_px=2.0)


@pytest.mark.slow
def test_no_search_leaves_the_declared_distances() -> None:
    seen = detector().local.pyramid(picture(pose_from(30, 40, 500.0), noise=12.0))
    nearest_mm, farthest_mm = search_distances_mm(detector().views, CAMERA)
    candidates = detector().global_search.candidates(seen, WIDE).poses
    improved = detector().local.pattern_search(seen, detector().global_search.starts(seen, WIDE), WIDE.kept)
    poses = np.concatenate([candidates, [candidate.cam_from_body for candidate in improved]])
    distances_mm = np.linalg.norm(poses[:, :3, 3], axis=1)
    assert len(candidates) > 100 and improved
    assert distances_mm.min() >= nearest_mm and distances_mm.max() <= farthest_mm


def test_responses_rank_poses_of_equal_profile_score() -> None:
    seen = detector().local.pyramid(picture(pose_from(30, 40, 500.0)))
    pose = pose_from(10, 20, 480.0) @ detector().local.refiner.part.model_from_body
    responses = np.array([0.2, 0.7, 0.4])
    alike = CandidatePoses(np.stack([pose] * 3), np.full(3, 12.0), responses)
    found = detector().global_search.rank(seen, alike)
    scores = [candidate.score for candidate in found]
    assert scores[0] - scores[1] == pytest.approx(0.3 * RESPONSE_WEIGHT) and scores[1] > scores[2]


def test_matches_outside_the_distances_give_no_detection(monkeypatch: pytest.MonkeyPatch) -> None:
    search = detector().global_search
    monkeypatch.setattr(search, "_distances_mm", (1.0, 2.0))
    seen = detector().local.pyramid(picture(pose_from(30, 40, 500.0)))
    candidates, lines, _ = search.candidates(seen, WIDE)
    assert candidates.shape == (0, 4, 4) and lines.shape == (0,)
    assert detector().detect(seen.image) == []


@pytest.mark.slow
def test_hypotheses_are_sorted_and_apart() -> None:
    rng, counts = np.random.default_rng(5), []
    for k in range(4):
        found = detector().hypotheses(detector().local.pyramid(picture(anywhere(rng), seed=k, scene=k, noise=12.0)))
        counts.append(len(found))
        logits = [hypothesis.logit for hypothesis in found]
        assert logits == sorted(logits, reverse=True)
        for i, a in enumerate(found):
            assert a.verifier_score is not None
            for b in found[i + 1 :]:
                assert not are_near(a.cam_from_body, b.cam_from_body, 0.04 * detector().views.diameter_mm, 4.0)
    assert min(counts) >= 1 and max(counts) >= 2


@pytest.mark.slow
def test_only_a_sure_quick_search_ends_the_search(monkeypatch: pytest.MonkeyPatch) -> None:
    seen = detector().local.pyramid(picture(pose_from(30, 40, 500.0)))
    candidates, budgets = detector().global_search.candidates, []

    def watched(of: ImagePyramid, budget: SearchBudget = QUICK) -> CandidatePoses:
        budgets.append(budget)
        return candidates(of, budget)

    monkeypatch.setattr(detector().global_search, "candidates", watched)
    sure = detector().options.min_quick_quality
    for quality, expected in (
        (sure, [QUICK]),
        (sure - 0.01, [QUICK, WIDE]),  # good enough, and the wide search found nothing better
        (0.3, [QUICK, WIDE, GRADIENTS_ONLY, UNTRIMMED]),
        (0.05, [QUICK, WIDE]),  # hopeless
    ):
        monkeypatch.setattr(detector(), "qualities", lambda found, quality=quality: [quality] * len(found))
        budgets.clear()
        assert detector().hypotheses(seen)
        assert budgets == expected


def test_the_score_of_one_level_counts_at_the_next() -> None:
    seen = detector().local.pyramid(picture(pose_from(30, 40, 500.0)))
    poses = [candidate.cam_from_body for candidate in detector().global_search.starts(seen, QUICK)]
    plain = detector().local.pattern_search(seen, [PoseCandidate(0.0, pose) for pose in poses])
    # The last of them, and it alone, was far ahead before.
    found = detector().local.pattern_search(
        seen, [PoseCandidate(1000.0 * (k == len(poses) - 1), p) for k, p in enumerate(poses)]
    )
    alone = detector().local.pattern_search(seen, [PoseCandidate(0.0, poses[-1])])
    np.testing.assert_allclose(found[0].cam_from_body, alone[0].cam_from_body, atol=1e-9)
    assert found[0].score == pytest.approx(alone[0].score + 1000.0 * PREVIOUS_WEIGHT**2)
    assert not np.allclose(plain[0].cam_from_body, alone[0].cam_from_body, atol=1e-3)
