"""The profile ranker: ranks right poses first, and its kernel computes what NumPy does."""

from __future__ import annotations

import numpy as np
import pytest

from arview.detection.features.edge_net import EdgeNet
from arview.detection.features.image_pyramid import ImagePyramid
from arview.detection.scoring.profile_ranker import (
    FINE,
    INNER_LINES,
    IS_SEEN,
    OUTLINE_LINES,
    PLACES,
    RADII_PX,
    REACH_PX,
    ROUGH,
    STRETCHES,
    ProfileRanker,
    describe_poses,
    ranker_layers,
)
from arview.geometry import Array, exp_so3, rigid
from arview.guideviews import GuideViewSet
from arview.refinement.view_model import PartView
from helpers.synthetic import CAMERA, assembly_views, pose_from, turned_about
from helpers.synthetic import picture as drawn

VIEWS: GuideViewSet = assembly_views()
PART = PartView(VIEWS)
TRUTH = pose_from(30.0, 45.0, 520.0) @ PART.model_from_body
NETWORKS = pytest.mark.parametrize("networks", [ROUGH, FINE], ids=["rough", "fine"])


def picture(noise: float = 6.0) -> ImagePyramid:
    """The assembly before clutter, with noise."""
    return ImagePyramid(drawn(TRUTH @ PART.body_from_model, noise=noise), CAMERA, 12, EdgeNet())


def turned(angle_deg: float, count: int) -> Array:
    return turned_about(TRUTH, angle_deg, count)


def random_poses(count: int) -> Array:
    """Random poses in the image."""
    rng = np.random.default_rng(3)
    poses = []
    for _ in range(count):
        axis = rng.normal(size=3)
        x, y, z = rng.uniform(-0.3, 0.3), rng.uniform(-0.2, 0.2), rng.uniform(400.0, 800.0)
        poses.append(rigid(exp_so3(axis / np.linalg.norm(axis) * rng.uniform(0.5, np.pi)), np.array([x * z, y * z, z])))
    return np.stack(poses)


def scores(seen: ImagePyramid, poses: Array, networks: tuple[str, ...]) -> Array:
    return ProfileRanker(PART, networks).scores(seen, poses, np.full(len(poses), 12.0))


@NETWORKS
def test_the_true_pose_ranks_first_in_noise_and_clutter(networks: tuple[str, ...]) -> None:
    seen = picture()
    true = scores(seen, TRUTH[None], networks)[0]
    others = scores(seen, np.concatenate([turned(25.0, 40), random_poses(160)]), networks)
    assert true > others.max() + 1.0


def test_scores_of_refined_poses_fall_within_a_few_degrees() -> None:
    seen = picture()
    by_angle = [float(np.mean(scores(seen, turned(angle, 60), FINE))) for angle in (0.0, 3.0, 6.0, 12.0)]
    assert by_angle == sorted(by_angle, reverse=True)
    assert by_angle[0] > by_angle[1] + 0.5


@NETWORKS
def test_the_kernel_scores_as_numpy_does(networks: tuple[str, ...]) -> None:
    seen, poses = picture(), np.concatenate([TRUTH[None], turned(8.0, 20), random_poses(40)])
    expected = np.zeros(len(poses))
    for name in networks:
        lines, both = describe_poses(seen, PART, poses, np.full(len(poses), 12.0), RADII_PX[name])
        net = ranker_layers(name)
        counts = lines[..., IS_SEEN : IS_SEEN + 1]
        hidden = np.maximum(lines @ net.first + net.first_bias, 0)
        hidden = np.maximum(hidden @ net.second + net.second_bias, 0) * counts
        outline, inner = np.split(hidden, [OUTLINE_LINES], axis=1)
        seen_outline, seen_inner = np.split(counts, [OUTLINE_LINES], axis=1)
        means = [outline.sum(1) / (seen_outline.sum(1) + 1), inner.sum(1) / (seen_inner.sum(1) + 1)]
        shape = (len(poses), STRETCHES, OUTLINE_LINES // STRETCHES, -1)
        stretches = outline.reshape(shape).sum(2) / (seen_outline.reshape(shape).sum(2) + 0.5)
        pooled = np.concatenate([*means, stretches.min(1), both], axis=1)
        expected += (np.maximum(pooled @ net.third + net.third_bias, 0) @ net.last + net.last_bias)[:, 0]
    assert scores(seen, poses, networks) == pytest.approx(expected, abs=1e-4)


def test_profiles_outside_the_image_are_empty_and_scored() -> None:
    aside = TRUTH.copy()
    aside[0, 3] += 2000.0
    lines, both = describe_poses(picture(), PART, aside[None], np.array([12.0]), 48.0)
    assert lines.shape[1] == OUTLINE_LINES + INNER_LINES
    assert not lines.any()
    assert both[0, 2] == 0.0
    assert np.isfinite(scores(picture(), aside[None], FINE)).all()
    assert scores(picture(), aside[None], FINE)[0] < scores(picture(), TRUTH[None], FINE)[0]


def test_profiles_hold_the_responses_to_edges_and_solids() -> None:
    seen = picture()
    lines, _ = describe_poses(seen, PART, TRUTH[None], np.full(1, 12.0), RADII_PX["rough"])
    outline = lines[0, :OUTLINE_LINES]
    assert (outline[:, IS_SEEN] == 1.0).all()
    alike, inside = np.split(outline[:, IS_SEEN + 2 :].mean(axis=0), 2)
    assert len(alike) == len(inside) == PLACES
    # One edge, none beside it; solid on the inner side only.
    assert alike[REACH_PX - 1 : REACH_PX + 2].max() > 0.6 > 4.0 * alike[-3:].mean()
    assert inside[:3].mean() > 0.6 and inside[-3:].mean() < 0.3
    without = ImagePyramid(seen.image, CAMERA, 12)
    lines, _ = describe_poses(without, PART, TRUTH[None], np.full(1, 12.0), RADII_PX["rough"])
    assert not lines[0, :, IS_SEEN + 2 :].any()
