"""Large parts cut by the picture's border are scored by what the picture shows of them, and found."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from arview.cad.view_range import ViewRange
from arview.camera.read import guess_camera
from arview.detection import Detector
from arview.detection.features.response_maps import ORIENTATIONS
from arview.detection.search.pattern_search import outline_score
from arview.detection.search.template_bank import GROUPS, SECTORS, sector_order
from arview.detection.search.template_matching import (
    MIN_INSIDE,
    decimate,
    decimate_with_border,
    match_templates,
    visible_score,
)
from arview.geometry import Array, apply, exp_so3, rigid
from arview.guideviews import GuideViewOptions
from arview.guideviews.cache import cached_guide_views
from arview.video import Image
from arview_lab.semisynthetic import SequenceOptions, render_sequence, shape
from arview_lab.semisynthetic.real_sequence import share_in_view
from helpers.synthetic import background, error

PAD_PX, SIDE_PX, RADIUS_PX, STEP_PX = 12, 64, 20.0, 4
CAMERA = guess_camera(640, 480)
MODEL = shape("bracket")


def ring(points: int = 64) -> tuple[Array, NDArray[np.intp]]:
    """Points (N,2) of a circle in the order of `sector_order`, and the orientation bins of their normals."""
    turn = 2.0 * np.pi * (np.arange(points) + 0.5) / points
    order = sector_order(np.stack([np.cos(turn), np.sin(turn)], axis=1))
    shown = np.stack([np.cos(turn), np.sin(turn)], axis=1)[order]
    return shown, np.round(turn[order] / np.pi * ORIENTATIONS).astype(np.intp) % ORIENTATIONS


def ring_maps(center_x: float, seed: int, is_there: bool = True) -> NDArray[np.uint8]:
    """Padded response maps (8,H,W) of clutter with noise, and of a ring of which the part inside the picture shows."""
    rng = np.random.default_rng(seed)
    inside = (255 * rng.random((ORIENTATIONS, SIDE_PX, SIDE_PX)) ** 4).astype(np.uint8)
    for (x, y), plane in zip(*ring(1024), strict=True) if is_there else ():
        column, row = round(center_x + RADIUS_PX * x), round(0.5 * SIDE_PX + RADIUS_PX * y)
        if 0 <= column < SIDE_PX and 0 <= row < SIDE_PX:
            around = (slice(max(row - 1, 0), row + 2), slice(max(column - 1, 0), column + 2))
            inside[plane][around] = np.maximum(inside[plane][around], rng.integers(150, 256))
    return np.pad(inside, ((0, 0), (PAD_PX, PAD_PX), (PAD_PX, PAD_PX)))


def best_match(phases: NDArray[np.uint8], is_trimmed: bool) -> tuple[float, Array]:
    """Key of the best match of the ring, and the place (2,) of its centre in the maps."""
    points, bins = ring()
    px = RADIUS_PX * points
    low = np.floor(px.min(axis=0))
    keys, _, places = match_templates(
        phases, np.round(px - low).astype(np.int32)[None], bins.astype(np.uint8)[None], np.ones(1),
        np.zeros(1, np.int32), 0, 1, 50, 0.3, np.zeros((GROUPS, 1024), np.int64), is_trimmed,
    )  # fmt: skip
    best = int(np.argmax(keys)) if len(keys) else -1
    return (float(keys[best]), places[best] - low) if best >= 0 else (0.0, np.full(2, np.inf))


def test_a_score_of_fewer_points_keeps_less_of_what_exceeds_the_typical_response() -> None:
    assert visible_score(0.6, 1.0, 0.2) == 0.6
    assert visible_score(0.3, 0.5, 0.2) == pytest.approx(0.2 + (0.6 - 0.2) * np.sqrt(0.5))
    assert visible_score(0.2 * 0.7, 0.7, 0.2) == pytest.approx(0.2)
    assert visible_score(0.39, MIN_INSIDE - 0.01, 0.2) == 0.0
    by_share = [visible_score(share, share, 0.2) for share in (0.4, 0.6, 0.8, 1.0)]
    assert by_share == sorted(by_share) and by_share[0] > 0.6


@pytest.mark.parametrize("is_trimmed", [False, True])
@pytest.mark.parametrize("seed", range(3))
def test_a_template_cut_by_the_border_matches_at_its_place(is_trimmed: bool, seed: int) -> None:
    center = np.array([SIDE_PX - 4.0, 0.5 * SIDE_PX]) + PAD_PX
    maps, margin_px = ring_maps(SIDE_PX - 4.0, seed), 12
    key, place = best_match(decimate_with_border(maps, STEP_PX, PAD_PX, margin_px), is_trimmed)
    assert np.abs(place - margin_px - center).max() <= STEP_PX
    without, elsewhere = best_match(decimate(maps, STEP_PX), is_trimmed)
    assert key > without + 0.1 and np.abs(elsewhere - center).max() > STEP_PX
    empty = decimate_with_border(ring_maps(0.0, seed, is_there=False), STEP_PX, PAD_PX, margin_px)
    assert best_match(empty, is_trimmed)[0] < 0.5 * key


@pytest.mark.parametrize("is_trimmed", [False, True])
def test_a_whole_outline_matches_alike_with_and_without_the_wider_border(is_trimmed: bool) -> None:
    maps, margin_px = ring_maps(0.5 * SIDE_PX, 4), 8
    key, place = best_match(decimate(maps, STEP_PX), is_trimmed)
    wide_key, wide_place = best_match(decimate_with_border(maps, STEP_PX, PAD_PX, margin_px), is_trimmed)
    assert np.array_equal(wide_place - margin_px, place)
    assert key > 0.2 and wide_key == pytest.approx(key, abs=0.15)


@pytest.mark.parametrize("is_trimmed", [False, True])
def test_an_outline_cut_by_the_border_is_scored_by_its_points_inside(is_trimmed: bool) -> None:
    points, bins = ring()
    angles = (bins * 256 // ORIENTATIONS).astype(np.uint8)
    shown = np.column_stack([points, np.zeros(len(points))]).astype(np.float32)
    maps = np.pad(np.full((ORIENTATIONS, SIDE_PX, SIDE_PX), 255, np.uint8), ((0, 0), (PAD_PX,) * 2, (PAD_PX,) * 2))

    def at(x: float, floor: float, min_cut_px: float = 0.0) -> float:
        work = np.empty((3, len(points)), np.int64), np.empty((1, 1), np.int32), np.empty(SECTORS, np.int64)
        return float(outline_score(
            maps, shown, angles, 0.0, RADIUS_PX, 0.0, PAD_PX + x, PAD_PX + 0.5 * SIDE_PX, 0, 2, is_trimmed, PAD_PX,
            min_cut_px, floor, *work, 0.0,
        )[0])  # fmt: skip

    half = 2.0 / 3.0 if is_trimmed else 0.5  # the trimmed quarter is outside the picture
    assert at(0.5 * SIDE_PX, 0.2) == pytest.approx(1.0, abs=0.02)
    assert at(0.0, 0.2) == pytest.approx(visible_score(half, half, 0.2), abs=0.03)
    assert at(0.0, 0.2) > half + 0.1
    assert at(0.0, 0.2, min_cut_px=2.0 * RADIUS_PX) == pytest.approx(half, abs=0.03)
    assert at(-0.9 * RADIUS_PX, 0.2) == 0.0


@cache
def detector() -> Detector:
    diameter_mm = MODEL.diameter_mm
    near = ViewRange((0.6 * diameter_mm, 2.4 * diameter_mm))
    return Detector(cached_guide_views(MODEL, near, GuideViewOptions(renderer="zbuffer")), CAMERA)


def cut_pose(seed: int) -> Array:
    """The part seen from anywhere, about as large as the picture is wide, cut by the picture's left or right border."""
    rng = np.random.default_rng([seed, 11])
    axis = rng.normal(size=3)
    rotation = exp_so3(rng.uniform(0.0, np.pi) * axis / np.linalg.norm(axis))
    depth = CAMERA.fx * MODEL.diameter_mm / 600.0
    aside = rng.choice([-1.0, 1.0]) * 0.42 * CAMERA.width / CAMERA.fx
    place = depth * np.array([aside, rng.uniform(-0.1, 0.1), 1.0])
    return rigid(rotation, place - rotation @ MODEL.center_in_model)


def picture(pose: Array, seed: int) -> Image:
    """The part with noise in front of clutter."""
    return next(render_sequence(MODEL, pose[None], background(seed), SequenceOptions("noise", 1, seed), CAMERA)).image


@pytest.mark.slow
def test_large_parts_cut_by_the_border_are_found_at_their_poses() -> None:
    right = 0
    for seed in range(5):
        pose = cut_pose(seed)
        assert 0.4 < share_in_view(MODEL, CAMERA, pose) < 0.85
        found = detector().detect(picture(pose, seed), max_results=1)
        if found:
            shift_mm, across_mm, turn_deg = error(found[0].cam_from_model, pose, MODEL)
            depth_mm = float(apply(pose, MODEL.center_in_model)[2])
            right += turn_deg < 5.0 and across_mm < 0.04 * MODEL.diameter_mm and shift_mm < 0.05 * depth_mm
    assert right == 5


@pytest.mark.slow
def test_nothing_is_found_where_no_part_is_cut_by_the_border() -> None:
    assert not any(detector().detect(background(seed), max_results=1) for seed in range(20, 23))
