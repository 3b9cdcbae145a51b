"""The pair comparator: prefers the right pose, and gives small log odds where the difference cannot be seen."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from arview.cad import Model, make_model
from arview.cad.view_range import ViewRange
from arview.detection.features.edge_net import EdgeNet
from arview.detection.features.image_pyramid import ImagePyramid
from arview.detection.scoring.pair_comparator import PairComparator
from arview.geometry import Array, rigid
from arview.guideviews import GuideViewOptions, make_guide_views
from arview.refinement.view_model import PartView
from helpers.synthetic import CAMERA, box, component, picture, pose_from, post

GREY = (0.55, 0.55, 0.6)
TURNS = [Rotation.from_euler("z", angle, degrees=True).as_matrix() for angle in range(0, 360, 60)]


@cache
def plate(key_mm: float) -> Model:
    """A six-sided plate of 120 mm with a block at one of its sides; none of 0 mm."""
    parts = [component("plate", post((0, 0), 60, 0, 12, 6), GREY), component("hub", post((0, 0), 24, 12, 40, 6), GREY)]
    if key_mm:
        parts.append(component("key", box((36, -0.5 * key_mm, 12), (36 + key_mm, 0.5 * key_mm, 12 + key_mm)), GREY))
    return make_model("plate", tuple(parts))


@cache
def part_of(key_mm: float) -> PartView:
    views = make_guide_views(plate(key_mm), ViewRange((250.0, 700.0), (20.0, 90.0)), GuideViewOptions(subdivisions=2))
    return PartView(views)


def symmetric_poses(truth: Array, key_mm: float) -> list[Array]:
    """``cam_from_body`` of a true ``cam_from_model``, and its rotations by sixths."""
    body = truth @ part_of(key_mm).model_from_body
    return [rigid(body[:3, :3] @ turn, body[:3, 3]) for turn in TURNS]


def log_odds(key_mm: float, truth: Array, poses: list[Array], **drawn: object) -> Array:
    seen = picture(truth, plate(key_mm), **drawn)  # type: ignore[arg-type]
    return PairComparator(part_of(key_mm)).log_odds(ImagePyramid(seen, CAMERA, 12, EdgeNet()), poses)


@pytest.mark.slow
@pytest.mark.parametrize("noise", [2.0, 10.0])
def test_the_right_pose_leads(noise: float) -> None:
    right, steep = [], []
    for k in range(12):
        truth = pose_from(30.0 * k, 35.0 + 4.0 * k, 400.0, plate(10.0), 20.0 * k)
        odds = log_odds(10.0, truth, symmetric_poses(truth, 10.0), seed=k, scene=k, noise=noise)
        np.testing.assert_array_equal(odds, -odds.T)
        # From straight above a block of the plate's colour is hardly to be seen.
        (right if k < 10 else steep).extend(odds[0, 1:].tolist())
    assert np.mean(np.array(right) > 1.0) > 0.9 and min(right) > -6.0, np.round(right, 1)
    assert min(steep) > -4.0, np.round(steep, 1)


def test_the_order_of_the_poses_does_not_matter() -> None:
    truth = pose_from(40.0, 50.0, 400.0, plate(10.0))
    poses = symmetric_poses(truth, 10.0)
    forth, back = (log_odds(10.0, truth, some) for some in (poses, poses[::-1]))
    # The window is centred on the first pose.
    np.testing.assert_allclose(forth, back[::-1, ::-1], atol=0.5)


def test_an_image_without_the_part_gives_no_decision() -> None:
    truth = pose_from(40.0, 80.0, 400.0, plate(10.0))
    flat = np.clip(np.random.default_rng(0).normal(120.0, 4.0, (CAMERA.height, CAMERA.width, 3)), 0, 255)
    seen = ImagePyramid(flat.astype(np.uint8), CAMERA, 12, EdgeNet())
    odds = PairComparator(part_of(10.0)).log_odds(seen, symmetric_poses(truth, 10.0))
    assert np.abs(odds).max() < DisambiguationOptions().min_margin, np.round(odds, 1)


def test_exactly_symmetric_poses_have_equal_odds() -> None:
    truth = pose_from(40.0, 50.0, 400.0, plate(0.0))
    np.testing.assert_array_equal(log_odds(0.0, truth, symmetric_poses(truth, 0.0)), 0.0)


def test_a_part_mostly_outside_the_image_is_compared() -> None:
    truth = pose_from(40.0, 50.0, 400.0, plate(10.0))
    for aside_mm in (150.0, 250.0, 2000.0):
        moved = truth.copy()
        moved[0, 3] += aside_mm
        assert np.all(np.isfinite(log_odds(10.0, moved, symmetric_poses(moved, 10.0))))
