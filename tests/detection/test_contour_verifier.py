"""Contour profiles: a right pose has the edge in the middle column, and the network scores deviations from it."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from arview.detection.features.edge_net import EdgeNet
from arview.detection.features.image_pyramid import ImagePyramid
from arview.detection.scoring.contour_verifier import (
    CHANNELS,
    COLUMNS,
    OUTLINE_ROWS,
    RAW_CHANNELS,
    ROWS,
    STEP_PX,
    ContourVerifier,
    contour_profiles,
    network_input,
    profile_step,
)
from arview.geometry import Array, rigid
from arview.refinement.view_model import PartView
from helpers.synthetic import CAMERA, assembly_views, background, half_hidden, pose_from, turned_about
from helpers.synthetic import picture as drawn

PART = PartView(assembly_views())
TRUTH = pose_from(30.0, 45.0, 520.0) @ PART.model_from_body
MIDDLE = COLUMNS // 2


@cache
def verifier() -> ContourVerifier:
    return ContourVerifier(PART)


@cache
def picture(noise: float = 4.0, is_hidden: bool = False) -> ImagePyramid:
    pose = TRUTH @ PART.body_from_model
    return ImagePyramid(drawn(pose, noise=noise, card=half_hidden(pose) if is_hidden else None), CAMERA, 12, EdgeNet())


def scores(seen: ImagePyramid, poses: list[Array]) -> Array:
    return verifier().scores(seen, np.stack(poses))


def aside(right_px: float) -> Array:
    """The true pose moved to the right in the image."""
    return rigid(TRUTH[:3, :3], TRUTH[:3, 3] + [right_px * TRUTH[2, 3] / CAMERA.fx, 0.0, 0.0])


def nearer(share: float) -> Array:
    """The true pose at a fraction of its distance."""
    return rigid(TRUTH[:3, :3], share * TRUTH[:3, 3])


def edge_offsets_px(cut: NDArray[np.uint8]) -> Array:
    """Offset of the strongest colour step in each outline row that is fully inside the image."""
    steps = network_input(cut, 80.0)[0][RAW_CHANNELS, :OUTLINE_ROWS]
    return STEP_PX * (steps[(cut[3, :OUTLINE_ROWS] > 0).all(axis=1)].argmax(axis=1) - MIDDLE)


def test_a_right_pose_has_the_edge_in_the_middle() -> None:
    offsets = edge_offsets_px(contour_profiles(picture(), PART, TRUTH))
    assert len(offsets) > 0.7 * OUTLINE_ROWS
    assert abs(np.median(offsets)) < 0.6
    assert np.percentile(np.abs(offsets), 70) < 1.2


def test_a_near_pose_has_the_edge_inside_and_a_far_one_outside() -> None:
    near, far = (edge_offsets_px(contour_profiles(picture(), PART, nearer(share))) for share in (0.97, 1.03))
    # The outline is 60 to 110 px from the centre of the part: 3 % of that.
    assert np.median(near) == pytest.approx(-2.7, abs=1.0)
    assert np.median(far) == pytest.approx(2.7, abs=1.0)


def test_the_expected_part_is_on_the_inner_side() -> None:
    cut = contour_profiles(picture(), PART, TRUTH)
    seen = cut[3, :OUTLINE_ROWS] > 0
    inside, outside = cut[7, :OUTLINE_ROWS, : MIDDLE + 1], cut[7, :OUTLINE_ROWS, MIDDLE + 1 :]
    assert set(np.unique(inside[seen[:, : MIDDLE + 1]])) <= {128, 255}
    assert set(np.unique(outside[seen[:, MIDDLE + 1 :]])) <= {0, 128}
    # The edge network predicts a solid on one side and none on the other.
    assert cut[6, :OUTLINE_ROWS, :4][inside[:, :4] == 255].mean() > 150.0
    assert cut[6, :OUTLINE_ROWS, -4:][outside[:, -4:] == 0].mean() < 100.0


def test_profiles_outside_the_image_are_zero() -> None:
    half_out = contour_profiles(picture(), PART, aside(-310.0))
    seen = half_out[3] > 0
    assert 0.1 < seen[:OUTLINE_ROWS].mean() < 0.9
    assert not half_out[:, ~seen].any()
    behind = rigid(TRUTH[:3, :3], -TRUTH[:3, 3])
    assert not contour_profiles(picture(), PART, behind).any()
    seen_behind, scalars = network_input(contour_profiles(picture(), PART, behind), 80.0)
    assert np.isfinite(seen_behind).all() and np.isfinite(scalars).all()


def test_large_images_are_sampled_at_the_scale_of_the_edge_network() -> None:
    large = cv2.resize(picture().image, None, fx=2.0, fy=2.0, interpolation=cv2.INTER_CUBIC)
    twice = ImagePyramid(large, CAMERA.scaled(1280, 960), 12, EdgeNet())
    assert (profile_step(picture(), 60.0), profile_step(twice, 60.0)) == (0, -4)
    # A part larger than the network knows is sampled in a smaller image, too.
    assert (profile_step(picture(), 240.0), profile_step(picture(), 130.0)) == (-4, 0)
    one, other = (contour_profiles(seen, PART, TRUTH)[:3].astype(int) for seen in (picture(), twice))
    assert np.abs(one - other).mean() < 4.0


def test_the_network_input_is_invariant_to_brightness() -> None:
    cut = contour_profiles(picture(), PART, TRUTH)
    dark = cut.copy()
    dark[:3] = cut[:3] // 2
    (seen, scalars), (seen_dark, scalars_dark) = network_input(cut, 80.0), network_input(dark, 80.0)
    assert seen.shape == (CHANNELS, ROWS, COLUMNS)
    assert np.abs(seen - seen_dark)[:3].mean() < 0.15
    assert np.abs(seen - seen_dark)[RAW_CHANNELS].mean() < 0.05
    assert scalars_dark[1] < scalars[1] - 0.2


@pytest.mark.parametrize("noise", [2.0, 8.0])
def test_poses_off_by_a_few_pixels_score_less(noise: float) -> None:
    seen = picture(noise)
    near = scores(seen, [TRUTH, *turned_about(TRUTH, 0.7, 6)])
    off = scores(seen, [aside(4.0), aside(-4.0), nearer(0.95), nearer(1.05)])
    turned = scores(seen, [*turned_about(TRUTH, 8.0, 20)])
    assert near.min() > max(off.max(), turned.max())
    assert near.mean() > off.mean() + 3.0
    assert near.mean() > turned.mean() + 6.0


def test_the_true_pose_scores_more_than_any_on_clutter() -> None:
    clutter = [ImagePyramid(background(seed), CAMERA, 12, EdgeNet()) for seed in range(4)]
    highest = max(scores(seen, [*turned_about(TRUTH, 20.0, 20)]).max() for seen in clutter)
    assert scores(picture(), [TRUTH])[0] > highest + 5.0
    # A card over half of the outline lowers the score, but not to that of clutter.
    assert scores(picture(is_hidden=True), [TRUTH])[0] > highest + 3.0


def test_scores_are_the_same_alone_and_together() -> None:
    poses = [TRUTH, *turned_about(TRUTH, 5.0, 10)]
    alone = [scores(picture(), [pose])[0] for pose in poses]
    np.testing.assert_allclose(scores(picture(), poses), alone, atol=1e-4)
