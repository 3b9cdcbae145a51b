"""Pixels in which twins differ: they speak for the right one, and say nothing where they cannot know."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from arview.cad import Model, make_model
from arview.cad.view_range import ViewRange
from arview.geometry import Array, rigid
from arview.guideviews import GuideViewOptions, make_guide_views
from arview.tracking.ambiguity import TELLING
from arview.tracking.detector import MOST_PIXELS_TELL, PIXELS_TELL
from arview.tracking.picture import Picture
from arview.tracking.tracker import PartView, Tracker, TrackerOptions
from arview.tracking.twin_pixels import TwinPixels
from synthetic import CAMERA, box, component, picture, pose_from, post

GREY = (0.55, 0.55, 0.6)
SIXTHS = [Rotation.from_euler("z", angle, degrees=True).as_matrix() for angle in range(60, 360, 60)]


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
    return Tracker(views, CAMERA, TrackerOptions(use_feature=False)).part


def leads(key_mm: float, pose: Array, base: Array, **drawn: object) -> Array:
    """Leads of a pose of the centre over its sixths, in a picture of the part at a pose."""
    part = part_of(key_mm)
    seen = Picture(picture(pose, plate(key_mm), **drawn), CAMERA, 12)  # type: ignore[arg-type]
    pixels = TwinPixels(seen, part, base @ part.model_from_body)
    return np.array([pixels.lead(turn) for turn in SIXTHS])


@pytest.mark.parametrize("noise", [2.0, 10.0])
def test_the_right_twin_explains_the_pixels_better(noise: float) -> None:
    part = part_of(10.0)
    right, turned = [], []
    for k in range(12):
        truth = pose_from(30.0 * k, 35.0 + 4.0 * k, 400.0, plate(10.0), 20.0 * k)
        right += leads(10.0, truth, truth, seed=k, scene=k, noise=noise).tolist()
        body = truth @ part.model_from_body
        twin = rigid(body[:3, :3] @ SIXTHS[k % 5], body[:3, 3]) @ part.body_from_model
        # The turn that leads back.
        turned.append(leads(10.0, truth, twin, seed=k, scene=k, noise=noise)[4 - k % 5])
    assert np.mean(np.array(right) > 1.0) > 0.9 and min(right) > -6.0, np.round(right, 1)
    assert np.mean(np.array(turned) < -1.0) > 0.8 and max(turned) < 6.0, np.round(turned, 1)


def test_what_hides_the_difference_decides_nothing() -> None:
    truth = pose_from(40.0, 80.0, 400.0, plate(10.0))
    part = part_of(10.0)
    flat = np.clip(np.random.default_rng(0).normal(120.0, 4.0, (CAMERA.height, CAMERA.width, 3)), 0, 255)
    pixels = TwinPixels(Picture(flat.astype(np.uint8), CAMERA, 12), part, truth @ part.model_from_body)
    assert max(abs(pixels.lead(turn)) for turn in SIXTHS) < MOST_PIXELS_TELL
    # Whatever they say, pixels alone do not decide.
    assert PIXELS_TELL * MOST_PIXELS_TELL < TELLING


def test_twins_that_differ_nowhere_are_equal() -> None:
    truth = pose_from(40.0, 50.0, 400.0, plate(0.0))
    np.testing.assert_array_equal(leads(0.0, truth, truth), 0.0)


def test_a_part_that_is_mostly_outside_the_picture_is_looked_at_as_far_as_it_is_seen() -> None:
    truth = pose_from(40.0, 50.0, 400.0, plate(10.0))
    for aside_mm in (150.0, 250.0, 2000.0):
        moved = truth.copy()
        moved[0, 3] += aside_mm
        assert np.all(np.isfinite(leads(10.0, moved, moved)))
