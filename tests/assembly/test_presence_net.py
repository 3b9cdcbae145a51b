"""The presence network: its inputs, and that it separates right components from missing and occluded ones."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from arview.assembly.presence_net import (
    GLOBALS,
    SIDE_PX,
    ComponentCrop,
    PartImage,
    PresenceNet,
    component_crops,
    network_input,
)
from arview.cad.model import Model
from arview.detection.features.edge_net import EdgeNet
from arview.detection.scoring.crops import BAND_PX, CROP_CHANNELS, RESPONSE_CHANNELS
from arview.geometry import Array, apply
from arview.refinement.projection import intrinsics_of
from arview.refinement.view_model import PartView
from helpers.synthetic import CAMERA, assembly, assembly_views, changed, picture, pose_from

PART = PartView(assembly_views())
NAMES = [component.name for component in assembly().components]
POSES = [pose_from(azimuth, 45.0, 480.0) for azimuth in (-60.0, -20.0, 30.0, 65.0)]


@cache
def network() -> PresenceNet:
    return PresenceNet()


@cache
def line_network() -> EdgeNet:
    return EdgeNet()


def without(name: str) -> Model:
    return changed(assembly(), **{name: None})


def crops(image: NDArray[np.uint8], pose: Array, *names: str) -> list[ComponentCrop]:
    only = [NAMES.index(name) for name in names] or None
    pose_of_body = pose @ PART.model_from_body
    picture_of_part = PartImage(image, line_network().predict(image), intrinsics_of(CAMERA), pose_of_body)
    return component_crops(picture_of_part, PART.surface, PART.views.diameter_mm, only)


@pytest.mark.slow
@pytest.mark.parametrize("noise", [2.0, 6.0])
def test_a_missing_component_scores_above_one_that_is_there(noise: float) -> None:
    there, gone = [], []
    for name in ("post_1", "post_2", "post_3", "block_1", "block_2"):
        for k, pose in enumerate(POSES):
            images = (picture(pose, model, seed=k, scene=k, noise=noise) for model in (None, without(name)))
            seen = [crops(image, pose, name) for image in images]
            if all(seen):
                for ratios, found in zip((there, gone), seen, strict=True):
                    ratios += network().log_odds(found).tolist()
    assert len(there) >= 12
    wins = np.mean(np.array(gone)[:, None] > np.array(there)[None])
    assert wins > 0.9
    assert np.median(gone) > 0.0 > np.median(there)


@pytest.mark.slow
def test_an_occluded_component_scores_below_a_missing_one() -> None:
    hidden, gone = [], []
    for name in ("post_1", "post_2", "post_3", "block_1", "block_2"):
        for k, pose in enumerate(POSES):
            at_px = CAMERA.project(apply(pose, assembly().components[NAMES.index(name)].vertices_in_model))
            low, high = at_px.min(axis=0), at_px.max(axis=0)
            margin = 0.15 * (k % 3) * (high - low)
            left, top, right, bottom = np.concatenate([low - margin, high + margin]).astype(int).tolist()
            before = crops(picture(pose, seed=k, scene=k, card=(left, top, right, bottom)), pose, name)
            without_it = crops(picture(pose, without(name), seed=k, scene=k), pose, name)
            if before and without_it:
                hidden += network().log_odds(before).tolist()
                gone += network().log_odds(without_it).tolist()
    assert len(hidden) >= 12
    assert np.median(hidden) < 0.5 * np.median(gone)
    assert np.mean(np.array(gone) > np.array(hidden)) > 0.72


def test_a_crop_shows_the_component_where_it_is() -> None:
    pose = POSES[2]
    (crop,) = crops(picture(pose, noise=2.0), pose, "block_1")
    part = assembly().components[NAMES.index("block_1")]
    pixels = CAMERA.project(apply(pose, part.vertices_in_model))
    assert crop.size_px == pytest.approx(float(np.ptp(pixels, axis=0).max()), abs=2.0)
    hull = cv2.convexHull(pixels.astype(np.float32))
    zoom = 2.0 * ComponentCropOptions().radius_px / crop.size_px
    middle = 0.5 * (pixels.min(axis=0) + pixels.max(axis=0))
    corners = ((hull[:, 0] - middle) * zoom + 0.5 * (SIDE_PX - 1)) * 16.0
    mask = np.zeros((SIDE_PX, SIDE_PX), np.uint8)
    cv2.fillConvexPoly(mask, np.round(corners).astype(np.int32), 1, shift=4)
    is_own = crop.drawn[0] < 0.0
    # The block is convex; others may stand before it.
    assert np.mean(mask[is_own]) > 0.95
    assert np.count_nonzero(is_own) > 0.7 * np.count_nonzero(mask)
    assert np.abs(crop.drawn[0]).max() <= 1.0 and np.count_nonzero(np.abs(crop.drawn[0]) < 1.0 / BAND_PX) > 20
    assert (crop.pixels[..., 3] == 255).all()


def test_network_inputs_have_their_shape() -> None:
    found = crops(picture(POSES[0], noise=2.0), POSES[0])
    assert len(found) >= 4
    for crop in found:
        seen, both = network_input(crop)
        assert seen.shape == (CROP_CHANNELS + RESPONSE_CHANNELS, SIDE_PX, SIDE_PX) and both.shape == (GLOBALS,)
        assert np.isfinite(seen).all() and np.isfinite(both).all()


def test_components_out_of_sight_have_no_crop() -> None:
    image = picture(POSES[0], noise=2.0)
    behind = POSES[0].copy()
    behind[2, 3] -= 2000.0
    assert crops(image, behind) == []
    far = pose_from(20.0, 45.0, 50_000.0)
    assert crops(image, far, "post_1") == []
    assert network().log_odds([]).shape == (0,)


def test_batched_crops_score_as_each_alone() -> None:
    found = crops(picture(POSES[1], noise=4.0), POSES[1])
    assert len(found) > 3
    alone = [network().log_odds([crop])[0] for crop in found]
    assert network().log_odds(found) == pytest.approx(np.array(alone), abs=1e-3)


@pytest.mark.parametrize(("across", "down"), [(True, False), (False, True), (True, True)])
def test_a_mirrored_crop_scores_as_the_crop_itself(across: bool, down: bool) -> None:
    found = crops(picture(POSES[2], noise=4.0), POSES[2])
    assert len(found) > 3
    turned_round = np.s_[..., :: -1 if down else 1, :: -1 if across else 1]
    in_mirror = []
    for crop in found:
        drawn = crop.drawn[turned_round].copy()
        drawn[2] *= -1.0 if across else 1.0
        drawn[3] *= -1.0 if down else 1.0
        pixels = np.ascontiguousarray(np.moveaxis(np.moveaxis(crop.pixels, 2, 0)[turned_round], 0, 2))
        lines = np.ascontiguousarray(crop.edge_responses[turned_round])
        in_mirror.append(replace(crop, pixels=pixels, drawn=drawn, edge_responses=lines))
    ratios, mirrored = network().log_odds(found), network().log_odds(in_mirror)
    assert mirrored == pytest.approx(ratios, abs=0.05)
    assert np.std(ratios) > 1.0
