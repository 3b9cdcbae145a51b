"""The pose verifier: scores right poses above wrong ones and images without the part; its crops match the CAD."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from arview.detection.features.edge_net import EdgeNet
from arview.detection.features.image_pyramid import ImagePyramid
from arview.detection.scoring.crops import (
    BAND_PX,
    CROP_CHANNELS,
    CROP_RADIUS_PX,
    CROP_SIDE_PX,
    PLAIN_CHANNELS,
    SHADING,
    PoseCrop,
    append_gradients,
    normalise_colours,
    pose_crop,
    without_outside,
)
from arview.detection.scoring.pose_verifier import PoseVerifier
from arview.geometry import Array, apply
from arview.refinement.view_model import PartView
from arview.rendering.rasterizer import rasterise
from helpers.synthetic import CAMERA, assembly, assembly_views, background, half_hidden, pose_from, turned_about
from helpers.synthetic import picture as drawn

PART = PartView(assembly_views())
TRUTH = pose_from(30.0, 45.0, 520.0) @ PART.model_from_body
KNOWN = np.array([3.0, 1.0, 0.5])
"""Evidence logit, profile score and scatter: equal for all poses, so that the image alone decides."""


@cache
def verifier() -> PoseVerifier:
    return PoseVerifier(PART)


def picture(noise: float = 6.0, is_hidden: bool = False) -> ImagePyramid:
    pose = TRUTH @ PART.body_from_model
    card = half_hidden(pose) if is_hidden else None
    return ImagePyramid(drawn(pose, noise=noise, card=card), CAMERA, 12, edge_net())


@cache
def edge_net() -> EdgeNet:
    return EdgeNet()


def scores(seen: ImagePyramid, poses: Array) -> Array:
    return verifier().scores(seen, poses, np.tile(KNOWN, (len(poses), 1)))


def raw_crop(pose: Array) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Pixels and drawn channels of the crop around a pose."""
    return crop_at(picture(), pose)[:2]


def crop_at(seen: ImagePyramid, pose: Array) -> PoseCrop:
    return pose_crop(seen, PART, pose, float(seen.radii_px(PART.views.diameter_mm, pose[None])[0]))


def turned(angle_deg: float, count: int) -> Array:
    return turned_about(TRUTH, angle_deg, count)


@pytest.mark.parametrize("noise", [3.0, 12.0])
def test_the_true_pose_scores_above_poses_far_off(noise: float) -> None:
    seen = picture(noise)
    true, others = scores(seen, TRUTH[None])[0], scores(seen, turned(30.0, 60))
    assert true > others.max() + 1.0
    assert true > 0.0 > np.median(others)


def test_scores_fall_with_the_rotation_error() -> None:
    seen = picture()
    by_angle = [float(np.mean(scores(seen, turned(angle, 40)))) for angle in (1.0, 6.0, 12.0, 25.0)]
    assert by_angle == sorted(by_angle, reverse=True)


def test_an_image_without_the_part_scores_low() -> None:
    clutter = [ImagePyramid(background(seed), CAMERA, 12, edge_net()) for seed in range(6)]
    true = scores(picture(), TRUTH[None])[0]
    assert max(scores(seen, turned(20.0, 20)).max() for seen in clutter) < true - 2.0


def test_the_drawn_outline_is_that_of_the_mesh() -> None:
    pixels, drawn_part = raw_crop(TRUTH)
    is_inside = around_truth(rendered()[1] >= 0) > 0.5
    outside_px = cv2.distanceTransform((~is_inside).astype(np.uint8), cv2.DIST_L2, 5)
    inside_px = cv2.distanceTransform(is_inside.astype(np.uint8), cv2.DIST_L2, 5)
    expected = np.clip(np.where(is_inside, 0.5 - inside_px, outside_px - 0.5) / BAND_PX, -1.0, 1.0)
    assert np.mean((drawn_part[0] < 0) == is_inside) > 0.98
    assert np.mean(np.abs(drawn_part[0] - expected) * BAND_PX) < 0.5
    assert 0.02 < np.mean(drawn_part[1] > 0.5) < 0.3
    assert np.mean(drawn_part[0][drawn_part[1] > 0.5] < 1.0 / BAND_PX) > 0.95
    assert (pixels[..., 3] == 255).all()


def test_the_drawn_surface_is_that_of_the_mesh() -> None:
    _, drawn_part = raw_crop(TRUTH)
    normals, depth = drawn_part[2:5], drawn_part[5]
    inverse_depth, face_ids = rendered()
    is_inside = cv2.erode(around_truth(face_ids >= 0), np.ones((3, 3))) > 0.99
    assert np.mean((drawn_part[4] != 0.0) == (around_truth(face_ids >= 0) > 0.5)) > 0.98
    assert np.linalg.norm(normals, axis=0)[is_inside] == pytest.approx(1.0, abs=0.02)
    assert (normals[2] > 0.0)[is_inside].mean() > 0.98
    depth_mm = around_truth(np.where(face_ids >= 0, 1.0 / np.maximum(inverse_depth, 1e-9), 0.0))
    expected = (depth_mm - TRUTH[2, 3]) / (0.5 * PART.views.diameter_mm)
    assert np.median(np.abs(depth - expected)[is_inside]) < 0.02
    vertices, faces, _ = assembly().mesh
    a, b, c = apply(TRUTH @ PART.body_from_model, vertices)[faces].transpose(1, 0, 2)
    flat = np.cross(b - a, c - a)
    flat /= np.linalg.norm(flat, axis=1, keepdims=True)
    flat[np.sum(flat * a, axis=1) > 0.0] *= -1.0
    for axis, sign in ((0, 1.0), (1, 1.0), (2, -1.0)):
        true = around_truth(np.where(face_ids >= 0, sign * flat[face_ids, axis], 0.0))
        assert np.median(np.abs(normals[axis] - true)[is_inside]) < 0.05


def test_cropped_edge_responses_match_outline_and_solid() -> None:
    _, drawn_part, seen = crop_at(picture(), TRUTH)
    strongest, along, solids = seen.astype(float) / 255.0
    is_inside = around_truth(rendered()[1] >= 0) > 0.5
    at_outline = np.abs(drawn_part[0]) < 1.0 / BAND_PX
    far_off = drawn_part[0] == 1.0
    assert np.median(strongest[at_outline]) > 0.6 > 0.2 > np.median(strongest[far_off])
    assert np.median(along[at_outline]) > 0.5
    assert not along[np.abs(drawn_part[0]) == 1.0].any()
    assert (along <= strongest).all()
    assert np.median(solids[is_inside & ~at_outline]) > 0.6 > 0.3 > np.median(solids[far_off])


def test_without_an_edge_network_responses_are_zero() -> None:
    assert not crop_at(ImagePyramid(picture().image, CAMERA, 12), TRUTH).responses.any()


def rendered() -> tuple[Array, NDArray[np.int32]]:
    """Inverse depth and face ids (H,W) of the assembly at the true pose, by the rasteriser."""
    vertices, faces, _ = assembly().mesh
    seen_from = apply(TRUTH @ PART.body_from_model, vertices)
    c = CAMERA
    return rasterise(seen_from, faces, c.fx, c.fy, c.cx, c.cy, c.width, c.height)


def around_truth(values: Array) -> Array:
    """Values (H,W) of the image resampled to the crop (S,S) around the true pose."""
    zoom = CROP_RADIUS_PX / (
        0.5 * (CAMERA.fx + CAMERA.fy) * 0.5 * PART.views.diameter_mm / np.linalg.norm(TRUTH[:3, 3])
    )
    center = CAMERA.project(TRUTH[None, :3, 3])[0]
    columns, rows = np.meshgrid(*[(np.arange(CROP_SIDE_PX) - 0.5 * (CROP_SIDE_PX - 1)) / zoom + c for c in center])
    maps = columns.astype(np.float32), rows.astype(np.float32)
    return np.asarray(cv2.remap(values.astype(np.float32), *maps, cv2.INTER_LINEAR))


def shaded(strength: float, noise: float) -> tuple[Array, float]:
    """Shading and residual (S,S) for a surface shaded with some strength, and the share explained."""
    pixels, drawn_part = raw_crop(TRUTH)
    light = 0.3 + np.maximum(np.tensordot([0.4, -0.5, 0.77], drawn_part[2:5], axes=1), 0.0)
    rng = np.random.default_rng(4)
    grays = 60.0 + strength * light + rng.normal(0.0, noise, light.shape)
    pixels[..., :3] = np.clip(grays, 0, 255)[..., None]
    seen, explained = append_gradients(normalise_colours(pixels, drawn_part)[0])
    return seen[SHADING:], float(explained)


def test_shading_is_explained_and_noise_is_not() -> None:
    _, drawn_part = raw_crop(TRUTH)
    is_surface = drawn_part[4] != 0.0
    (shading, rest), explained = shaded(100.0, 2.0)
    assert explained > 0.9
    assert not shading[~is_surface].any() and not rest[~is_surface].any()
    assert np.std(rest[is_surface]) < 0.3 * np.std(shading[is_surface])
    assert abs(shaded(0.0, 20.0)[1]) < 0.1


def test_an_occluded_true_pose_scores_above_wrong_ones() -> None:
    seen = picture(is_hidden=True)
    assert scores(seen, TRUTH[None])[0] > scores(seen, turned(30.0, 60)).max()


def test_a_pose_outside_the_image_is_scored() -> None:
    aside = TRUTH.copy()
    aside[0, 3] += 2000.0
    plain, contrast = normalise_colours(*raw_crop(aside))
    seen, explained = append_gradients(plain)
    assert seen.shape == (CROP_CHANNELS, CROP_SIDE_PX, CROP_SIDE_PX)
    assert not seen[:4].any() and not seen[PLAIN_CHANNELS:].any()
    assert explained == 0.0
    assert contrast < 0.01
    assert scores(picture(), aside[None])[0] < scores(picture(), TRUTH[None])[0]


@pytest.mark.parametrize(("aside_mm", "seed"), [(-205.0, 1), (205.0, 2)])
def test_a_pose_cut_by_the_border_scores_above_wrong_ones(aside_mm: float, seed: int) -> None:
    cut = TRUTH.copy()
    cut[0, 3] += aside_mm
    seen = ImagePyramid(drawn(cut @ PART.body_from_model, noise=6.0, seed=seed), CAMERA, 12, edge_net())
    crop = crop_at(seen, cut)
    is_beyond = crop.pixels[..., 3] == 0
    assert 0.2 < np.mean(is_beyond[crop.drawn[0] < 0.0]) < 0.6
    empty = ImagePyramid(background(seed), CAMERA, 12, edge_net())
    poses = np.concatenate([cut[None], turned_about(cut, 30.0, 60)])
    known = np.tile(KNOWN, (len(poses), 1))
    of_large = PoseVerifier(PART, cut_fill=0.0)
    true, *others = of_large.scores(seen, poses, known)
    assert true > max(others) + 1.0
    assert of_large.scores(empty, poses[:1], known[:1])[0] < -3.0 < 0.0 < true
    of_none = PoseVerifier(PART, cut_fill=10.0)
    assert of_none.scores(seen, poses[:1], known[:1])[0] < 0.0


def test_nothing_is_expected_beyond_the_border() -> None:
    cut = TRUTH.copy()
    cut[0, 3] += 205.0
    crop = crop_at(picture(), cut)
    is_beyond = crop.pixels[..., 3] == 0
    assert is_beyond.any() and not is_beyond.all()
    shown = without_outside(crop)
    assert (shown.drawn[0][is_beyond] == 1.0).all() and not shown.drawn[1:, is_beyond].any()
    assert np.array_equal(shown.drawn[:, ~is_beyond], crop.drawn[:, ~is_beyond])
    assert (shown.pixels[..., 3] == 255).all()
    assert np.array_equal(shown.pixels[~is_beyond], crop.pixels[~is_beyond])
    inside = crop_at(picture(), TRUTH)
    assert without_outside(inside) is inside


def test_batched_scores_equal_single_scores() -> None:
    seen, poses = picture(), np.concatenate([TRUTH[None], turned(10.0, 20)])
    together = scores(seen, poses)
    alone = [scores(seen, pose[None])[0] for pose in poses]
    assert together == pytest.approx(np.array(alone), abs=1e-3)
