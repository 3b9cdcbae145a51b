"""Diagnosis: each reason is given for pictures that have it, and for no others."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from arview.annotation import reasons_text
from arview.detection.detector import RejectedHypothesis
from arview.geometry import Array
from arview.pose import TrackingState
from arview.refinement.evidence import PoseEvidence
from arview.tracking import Estimate, SpecimenTracking
from arview.tracking.diagnosis import (
    diagnose_loss,
    diagnose_picture,
    diagnose_search,
    edge_widths_px,
)
from helpers.synthetic import CAMERA, RANGE, assembly, assembly_views, background, picture, pose_from

TRUTH = pose_from(30, 40, 520)
GOOD = PoseEvidence(0.9, 0.8, 0.4, 0.9, 0.9, 0.2, 1.0)
WEAK = PoseEvidence(0.31, 0.2, 0.4, 0.4, 0.4, 0.1, 1.0)


def why(
    image: NDArray[np.uint8], pose: Array | None = None, evidence: PoseEvidence = WEAK, quality: float = 0.2
) -> str:
    rejected = None if pose is None else RejectedHypothesis(pose, evidence, quality)
    return diagnose_search(image, CAMERA, assembly_views(), rejected)


def on_plain(image: NDArray[np.uint8], level: float = 150.0) -> NDArray[np.uint8]:
    """The part of a picture at TRUTH in front of a plain wall with a soft gradient, with noise."""
    without = picture(None, scene=1, noise=0.0)
    mask = cv2.morphologyEx(
        np.any(image != without, axis=2).astype(np.uint8), cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8)
    )
    wall = level + np.linspace(-40, 40, 640)[None, :, None] + np.zeros((480, 640, 3))
    both = np.where(mask[..., None] > 0, image, wall) + np.random.default_rng(0).normal(0, 2, image.shape)
    return np.clip(both, 0, 255).astype(np.uint8)


# --- The picture by itself ------------------------------------------------------------------------------


@pytest.mark.parametrize("scene", range(6))
def test_an_ordinary_picture_has_nothing_wrong(scene: int) -> None:
    assert diagnose_picture(picture(TRUTH, scene=scene, noise=4.0)) == ""
    assert diagnose_picture(picture(None, scene=scene, noise=4.0)) == ""


def test_light() -> None:
    for gain in (0.02, 0.15):
        assert why(picture(TRUTH, gain=gain)) == "too dark"
    assert why(picture(TRUTH, gain=7.0)) == "overexposed"
    for gain in (0.35, 1.5):
        assert why(picture(TRUTH, gain=gain)).startswith("nothing like the part in view")
    # A white wall behind a well lit part is neither.
    assert diagnose_picture(on_plain(picture(TRUTH, scene=1, noise=0.0), 200.0)) == ""


@pytest.mark.parametrize("sigma_px", [4.0, 6.0, 9.0])
def test_a_picture_out_of_focus_is_blurred(sigma_px: float) -> None:
    for image in (picture(TRUTH, scene=2, noise=0.0), on_plain(picture(TRUTH, scene=1, noise=0.0))):
        assert diagnose_picture(cv2.GaussianBlur(image, (0, 0), sigma_px)) == "blurred"


@pytest.mark.parametrize("size", [(20, 1), (1, 20), (32, 1), (1, 32)])
def test_motion_blurs_the_edges_across_it(size: tuple[int, int]) -> None:
    for scene in (1, 3):
        assert diagnose_picture(cv2.blur(picture(TRUTH, scene=scene, noise=0.0), size)) == "blurred"


def test_a_plain_background_is_not_taken_for_blur() -> None:
    assert diagnose_picture(on_plain(picture(TRUTH, scene=1, noise=0.0))) == ""
    noise = np.random.default_rng(0).normal(0, 2, (480, 640, 3))
    assert (
        diagnose_picture(np.clip(150 + noise, 0, 255).astype(np.uint8)) == "low contrast: hardly an edge in the picture"
    )


@pytest.mark.parametrize("sigma_px", [1.5, 2.0, 3.0, 4.0])
def test_the_width_of_edges_is_that_of_the_blur(sigma_px: float) -> None:
    image = np.full((480, 640), 70, dtype=np.uint8)
    for k in range(6):
        cv2.rectangle(image, (30 + 100 * k, 40), (80 + 100 * k, 420), 180, -1)
        image[60 + 60 * k : 90 + 60 * k, :] = 120
    blurred = cv2.GaussianBlur(image.astype(np.float32), (0, 0), sigma_px)
    blurred += np.random.default_rng(1).normal(0, 1.5, image.shape)
    widths = edge_widths_px(np.clip(blurred, 0, 255).astype(np.uint8))
    assert widths == pytest.approx([sigma_px] * 2, rel=0.3, abs=0.3)
    assert np.all(np.isnan(edge_widths_px(np.full((480, 640), 128, dtype=np.uint8))))


def test_large_pictures_are_measured_like_small_ones() -> None:
    small = cv2.GaussianBlur(picture(TRUTH, scene=2, noise=0.0), (0, 0), 5.0)
    large = cv2.resize(small, (1920, 1440), interpolation=cv2.INTER_LINEAR)
    assert diagnose_picture(np.asarray(large)) == "blurred"
    sharp = cv2.resize(picture(TRUTH, scene=2, noise=0.0), (1920, 1440), interpolation=cv2.INTER_LINEAR)
    assert diagnose_picture(np.asarray(sharp)) == ""


# --- The best hypothesis --------------------------------------------------------------------------------


def test_nothing_like_the_part() -> None:
    assert why(background(3)) == "nothing like the part in view, 420 to 640 mm away"
    # Hypotheses as good as this are found in any clutter.
    assert why(background(3), TRUTH, quality=0.03) == "nothing like the part in view, 420 to 640 mm away"


def test_a_part_of_the_outline() -> None:
    assert why(picture(TRUTH), TRUTH) == "only 31 % of the outline found"


def test_distances() -> None:
    for distance_mm, words in ((800, "too far: about 800 mm, declared up to 640 mm"),
                               (330, "too near: about 330 mm, declared from 420 mm")):  # fmt: skip
        pose = pose_from(30, 40, distance_mm)
        assert why(picture(pose), pose, GOOD, 0.95) == words
    # A little outside is not the reason.
    pose = pose_from(30, 40, 670)
    assert why(picture(pose), pose) == "only 31 % of the outline found"
    tiny = pose_from(30, 40, 5200)
    assert why(picture(tiny), tiny) == "too far: the part spans only 29 px"


def test_directions_and_rolls_outside_the_declared_range() -> None:
    pose = pose_from(110, 40, 520)
    words = "seen from outside the declared range: azimuth 110°, elevation 40°"
    assert why(picture(pose), pose, GOOD, 0.9) == words
    pose = pose_from(30, 40, 520, roll_deg=90)
    words = "turned outside the declared range: roll 90°, declared -20 to 20°"
    assert why(picture(pose), pose, GOOD, 0.9) == words
    # Of a pose that does not fit the direction means nothing.
    assert why(picture(pose), pose) == "only 31 % of the outline found"
    pose = pose_from(83, 40, 520, roll_deg=-23)
    assert why(picture(pose), pose, GOOD, 0.9).startswith("only")
    assert RANGE.azimuth_deg == (-80.0, 80.0)


@pytest.mark.parametrize(
    "shift_mm,edge", [((-230, 0), "left"), ((230, 0), "right"), ((0, -170), "upper"), ((0, 170), "lower")]
)
def test_partly_outside_the_picture(shift_mm: tuple[float, float], edge: str) -> None:
    pose = TRUTH.copy()
    pose[:2, 3] += shift_mm
    evidence = PoseEvidence(0.5, 0.5, 0.4, 0.5, 0.5, 0.1, 0.5)
    assert why(picture(pose), pose, evidence) == f"partly outside the picture at the {edge} edge"


def test_low_contrast_of_the_part_against_its_background() -> None:
    part = picture(TRUTH, scene=1, noise=0.0, contrast=0.0).astype(np.float64)
    mask = np.any(part != picture(None, scene=1, noise=0.0), axis=2)
    faint = picture(None, scene=1, noise=3.0)
    # The part has the colours of the wall behind it; the rest of the picture has contrast.
    left, right, top, bottom = *np.flatnonzero(mask.any(axis=0))[[0, -1]], *np.flatnonzero(mask.any(axis=1))[[0, -1]]
    faint[top - 25 : bottom + 25, left - 25 : right + 25] = 120
    faint[mask] = np.clip(120 + 0.1 * (part[mask] - 120), 0, 255)
    assert why(faint, TRUTH) == "low contrast of the part against its background"
    assert why(picture(TRUTH, scene=1), TRUTH) == "only 31 % of the outline found"


# --- After a loss ---------------------------------------------------------------------------------------


def lost(pose: Array, step_mm: float, in_picture: float, image: NDArray[np.uint8], is_possible: bool = True) -> str:
    """Reason for the loss at a pose that the part reached in steps along the rows of the picture."""
    before = [pose.copy(), pose.copy()]
    before[0][0, 3] -= 2 * step_mm
    before[1][0, 3] -= step_mm
    evidence = PoseEvidence(0.1, 0.1, 0.4, 0.2, 0.1, 0.1, in_picture)
    estimate = Estimate(pose, np.eye(6), 0.02, evidence)
    return diagnose_loss(image, estimate, (before[0], before[1]), CAMERA, assembly_views(), is_possible)


def test_why_a_part_was_lost() -> None:
    image = picture(None, scene=2)
    aside = TRUTH.copy()
    aside[0, 3] -= 260.0
    assert lost(aside, -10.0, 0.4, image) == "the part left the picture at the left edge"
    leaving = TRUTH.copy()
    leaving[0, 3] += 170.0
    assert lost(leaving, 40.0, 0.9, image) == "the part left the picture at the right edge"
    assert lost(TRUTH, 0.5, 1.0, image) == "the part is hidden or moved too fast"
    assert lost(TRUTH, 10.0, 1.0, image) == "the part is hidden or moved too fast"
    assert lost(TRUTH, 25.0, 1.0, image) == "the part moved too fast"
    assert lost(TRUTH, 1.0, 1.0, cv2.GaussianBlur(image, (0, 0), 6.0)) == "the part moved too fast"
    assert lost(TRUTH, 0.5, 1.0, image // 8) == "too dark"
    far = pose_from(30, 40, 1400)
    assert lost(far, 0.0, 1.0, image, False) == "too far: about 1400 mm, declared up to 640 mm"


# --- In use ---------------------------------------------------------------------------------------------


def test_a_session_says_what_the_detector_rejected() -> None:
    session = SpecimenTracking(assembly_views(), CAMERA, assembly())
    far = pose_from(30, 40, 820)
    session.search.detector.detect = lambda *_, **__: []  # type: ignore[method-assign]
    session.search.detector.best_rejected = RejectedHypothesis(far, GOOD, 0.9)
    result = session.process(picture(far), 0, 0.0)
    assert result.state == TrackingState.SEARCHING
    assert result.reason == "too far: about 820 mm, declared up to 640 mm"


@pytest.mark.slow
def test_a_lost_part_keeps_the_reason_of_its_loss() -> None:
    session = SpecimenTracking(assembly_views(), CAMERA, assembly(), initial_cam_from_model=TRUTH)
    reasons: list[str] = []
    for k in range(40):
        pose = TRUTH.copy()
        pose[0, 3] += 12.0 * k
        result = session.process(picture(pose, seed=k), k, 0.0)
        if result.state == TrackingState.LOST:
            reasons.append(result.reason)
        if len(reasons) == 3:
            break
    assert reasons == ["the part left the picture at the right edge"] * 3


def test_reasons_are_summed_up() -> None:
    reasons = {"too dark": 80, "only 8 % of the outline found": 30, "only 12 % of the outline found": 10}
    assert reasons_text(reasons) == "too dark (80), only 8 to 12 % of the outline found (40)"
    rolls = {f"turned: roll {roll}°, declared -20 to 20°": 2 for roll in (-95, -9, 100)}
    assert reasons_text(rolls) == "turned: roll -95 to 100°, declared -20 to 20° (6)"
    many = {f"reason {letter}": 10 - k for k, letter in enumerate("abcdefg")}
    assert reasons_text(many) == "reason a (10), reason b (9), reason c (8), reason d (7), other (15)"
    assert reasons_text({"with {braces}": 1}) == "with {braces} (1)"
    assert reasons_text({}) == ""
