"""Scene change: noise, light and tremor are no change, the part that comes into view is one."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from arview.cad.view_range import ViewRange
from arview.detection.scene_change import SceneChange
from arview.guideviews import GuideViewOptions, make_guide_views
from helpers.synthetic import CAMERA, RANGE, assembly, assembly_views, picture, pose_from

FARTHEST_MM = RANGE.distance_mm[1]


def scene_change() -> SceneChange:
    return SceneChange(assembly_views(), CAMERA)


def has_changed(before: NDArray[np.uint8], after: NDArray[np.uint8]) -> bool:
    compared = scene_change()
    return compared.has_changed(compared.reduced(before), compared.reduced(after))


def shaken(image: NDArray[np.uint8], shift_px: tuple[float, float], roll_deg: float) -> NDArray[np.uint8]:
    warp = cv2.getRotationMatrix2D((320, 240), roll_deg, 1.0)
    warp[:, 2] += shift_px
    return np.asarray(cv2.warpAffine(image, warp, (640, 480), borderMode=cv2.BORDER_REPLICATE), dtype=np.uint8)


@pytest.mark.parametrize("scene", range(6))
def test_noise_light_and_tremor_are_no_change(scene: int) -> None:
    before = picture(None, seed=1, scene=scene, noise=6.0)
    assert not has_changed(before, picture(None, seed=2, scene=scene, noise=6.0))
    assert not has_changed(before, picture(None, seed=2, scene=scene, noise=6.0, gain=0.75))
    assert not has_changed(before, shaken(picture(None, seed=2, scene=scene, noise=6.0), (5.0, -4.0), 0.4))


@pytest.mark.parametrize("scene", range(6))
def test_the_part_at_its_farthest_and_a_turn_of_the_camera_are_changes(scene: int) -> None:
    before = picture(None, seed=1, scene=scene, noise=6.0)
    shown = [pose_from(azimuth, 40, FARTHEST_MM) for azimuth in (-60, 0, 60)]
    assert all(has_changed(before, picture(pose, seed=2, scene=scene, noise=6.0)) for pose in shown)
    assert has_changed(before, shaken(before, (90.0, 20.0), 3.0))
    assert has_changed(before, picture(None, seed=1, scene=scene + 1, noise=6.0))


def test_the_changed_share_is_that_of_the_area() -> None:
    before = np.full((480, 640, 3), 90, dtype=np.uint8)
    after = before.copy()
    after[120:360, 160:320] = (90, 140, 90)
    compared = scene_change()
    small = [compared.reduced(image) for image in (before, after)]
    assert compared.changed_share(small[0], small[1]) == pytest.approx(240 * 160 / (480 * 640), rel=0.02)
    assert compared.changed_share(small[0], small[0]) == 0.0
    # Lighter by less than the threshold is none.
    after[120:360, 160:320] = 90 + SceneChangeOptions().min_difference - 1
    assert compared.changed_share(small[0], compared.reduced(after)) == 0.0


def test_of_a_part_that_may_be_tiny_any_pixel_counts() -> None:
    far = ViewRange((400.0, 12_000.0), elevation_deg=(40.0, 50.0), azimuth_deg=(0.0, 10.0), roll_deg=(0.0, 0.0))
    views = make_guide_views(assembly(), far, GuideViewOptions(renderer="zbuffer", subdivisions=1))
    compared = SceneChange(views, CAMERA)
    before = np.full((480, 640, 3), 90, dtype=np.uint8)
    after = before.copy()
    after[200:215, 300:315] = 160
    assert compared.has_changed(compared.reduced(before), compared.reduced(after))
    assert not has_changed(before, after)
