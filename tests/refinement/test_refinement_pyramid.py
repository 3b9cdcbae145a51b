"""Refinement pyramid: blur as measured on the part's edges, and poses that do not depend on the picture's size."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from arview.camera import Camera
from arview.geometry import Array
from arview.refinement.refinement_pyramid import RefinementPyramid
from arview.refinement.refiner import Appearance, PoseRefiner
from arview.refinement.schedules import LAST_STAGES, TRACK_STAGES
from arview.refinement.view_model import PartView
from helpers.synthetic import CAMERA, assembly_views, error, path, picture, wrong

POSES = path(3)


def resized(image: NDArray[np.uint8], factor: float) -> tuple[NDArray[np.uint8], Camera]:
    """A picture at another size, and its camera."""
    size = round(factor * CAMERA.width), round(factor * CAMERA.height)
    how = cv2.INTER_AREA if factor < 1 else cv2.INTER_CUBIC
    return np.asarray(cv2.resize(image, size, interpolation=how)), CAMERA.scaled(*size)


def pyramid(image: NDArray[np.uint8], camera: Camera, cam_from_model: Array) -> tuple[RefinementPyramid, Array, Array]:
    """Pyramid of a picture at a pose (4,4), the pose about the part's centre, and ``body_from_model`` (4,4)."""
    part = PartView(assembly_views())
    refiner = PoseRefiner(part, camera)
    start = cam_from_model @ part.model_from_body
    first = RefinementPyramid(refiner, image, [start])
    spread_px = first.finest.edge_spread_px(start)
    return RefinementPyramid(refiner, image, [start], spread_px or 0.0), start, part.body_from_model


@pytest.mark.slow
@pytest.mark.parametrize("blur_px", [0.0, 1.0, 2.0, 3.5])
def test_blur_is_measured_on_the_edges_of_the_part(blur_px: float) -> None:
    image = picture(POSES[0], seed=1)
    sharp, start, _ = pyramid(image, CAMERA, POSES[0])
    own_px = sharp.finest.edge_spread_px(start)
    assert own_px is not None and own_px < 1.0
    if blur_px:
        image = np.asarray(cv2.GaussianBlur(image, (0, 0), blur_px))
        soft, start, _ = pyramid(image, CAMERA, POSES[0])
        spread_px = soft.level(0).edge_spread_px(start)
        assert spread_px == pytest.approx(np.hypot(own_px, blur_px), rel=0.2)


def test_blur_is_unknown_where_there_are_no_edges() -> None:
    grey = np.full((CAMERA.height, CAMERA.width, 3), 128, dtype=np.uint8)
    levels, start, _ = pyramid(grey, CAMERA, POSES[0])
    assert levels.finest.edge_spread_px(start) is None


@pytest.mark.slow
def test_scores_and_poses_are_the_same_in_pictures_of_all_sizes() -> None:
    rng = np.random.default_rng(4)
    begin = wrong(POSES[1], rng, 1.0, 2.0)
    found = []
    for factor in (0.75, 1.0, 2.0, 3.0):
        image, camera = resized(picture(POSES[1], seed=2, noise=4.0), factor)
        levels, start, body_from_model = pyramid(image, camera, begin)
        appearance = Appearance()
        levels.working.learn_colors(start, appearance, 1.0)
        pose, information = levels.refine(start, TRACK_STAGES, appearance)
        mm, _, deg = error(pose @ body_from_model, POSES[1])
        assert np.linalg.eigvalsh(information)[0] > 0
        found.append((mm, deg, levels.working.evidence(pose, appearance).score))
    shifts_mm, turns_deg, scores = np.array(found).T
    assert shifts_mm.max() < 0.5 and turns_deg.max() < 0.15
    assert np.ptp(scores) < 0.1
    assert scores.min() > 0.8


@pytest.mark.slow
def test_the_finest_picture_tells_near_poses_apart() -> None:
    image = picture(POSES[2], seed=3)
    levels, start, _ = pyramid(image, CAMERA, POSES[2])
    appearance = Appearance()
    levels.working.learn_colors(start, appearance, 1.0)
    right, _ = levels.refine(start, LAST_STAGES, appearance, first=-1)
    farther = right.copy()
    farther[:3, 3] *= 1.01
    drops = [
        level.evidence(right, appearance).score - level.evidence(farther, appearance).score
        for level in (levels.finest, levels.working)
    ]
    assert drops[0] > 0.2
    assert drops[0] > 2 * drops[1]


def test_other_poses_are_covered_by_new_pictures() -> None:
    image = picture(POSES[0], seed=1)
    levels, start, _ = pyramid(image, CAMERA, POSES[0])
    before = levels.working.picture
    levels.cover([start])
    assert levels.working.picture is before
    aside = start.copy()
    aside[0, 3] += 0.4 * assembly_views().diameter_mm
    levels.cover([aside])
    after = levels.working.picture
    assert after is not before
    assert after.right - after.left > before.right - before.left
