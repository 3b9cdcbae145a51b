"""Working pictures: scales by size and sharpness, and windows whose camera agrees with the frame's."""

from __future__ import annotations

from itertools import pairwise

import cv2
import numpy as np
import pytest

from arview.camera import Camera
from arview.geometry import Array, exp_so3, rigid
from arview.refinement.modalities.texture import TextureMatches
from arview.refinement.working_picture import (
    MAX_FINE_SPREAD_PX,
    SOFT_RADIUS_PX,
    WorkingScaleOptions,
    matches_in,
    window_around,
    working_picture,
)

CAMERA = Camera(640, 480, 600.0, 610.0, 322.0, 236.0, np.array([0.05, -0.02, 0.001, -0.0005, 0.0]))
OPTIONS = WorkingScaleOptions()


@pytest.mark.parametrize("factor", [0.9, 1.0, 2.0, 3.0, 6.0])
def test_the_part_has_the_same_sizes_whatever_the_size_of_the_picture(factor: float) -> None:
    scales = OPTIONS.scales(120.0 * factor, 0.5 * factor)
    assert scales[0] * 120.0 * factor == pytest.approx(100.0, rel=0.2)
    assert scales[-1] * 120.0 * factor == pytest.approx(400.0, rel=0.2)
    assert all(1.0 < b / a <= 2.1 for a, b in pairwise(scales))


def test_a_small_part_is_judged_as_it_is_and_enlarged_at_most_four_times() -> None:
    scales = OPTIONS.scales(30.0, 0.4)
    assert scales[0] == 1.0
    assert scales[-1] == 4.0


def test_a_soft_picture_has_no_pictures_finer_than_its_edges() -> None:
    sharp, soft, very_soft = (OPTIONS.scales(300.0, spread_px)[-1] for spread_px in (0.5, 4.0, 9.0))
    assert sharp > 1.0 > soft > very_soft
    assert 4.0 * soft <= 1.2 * MAX_FINE_SPREAD_PX
    scales = OPTIONS.scales(110.0, 8.0)
    assert len(scales) == 1
    assert scales[0] * 110.0 >= 0.8 * SOFT_RADIUS_PX


@pytest.mark.parametrize("scale", [2.0**-2.5, 0.25, 0.5, 2.0**-0.5, 1.0, 2.0**0.5, 2.0, 4.0])
def test_a_spot_lies_where_the_camera_of_the_window_projects_it(scale: float) -> None:
    points = np.array([[-30.0, 12.0, 400.0], [25.0, -8.0, 380.0], [2.0, 20.0, 420.0]])
    pixels = CAMERA.project(points)
    image = np.zeros((480, 640, 3), dtype=np.uint8)
    v, u = np.mgrid[:480, :640]
    for center in pixels:
        spot = 250.0 * np.exp(-0.5 * ((u - center[0]) ** 2 + (v - center[1]) ** 2) / 3.0**2)
        image = np.maximum(image, spot[..., None].astype(np.uint8))
    picture = working_picture(image, CAMERA, scale, (233.0, 171.0, 421.0, 303.0))
    assert picture.image.shape[:2] == picture.smooth.shape
    assert picture.smooth.shape[1] == pytest.approx(picture.pitch * picture.camera.width, abs=1.0)
    assert picture.camera.fx / CAMERA.fx == pytest.approx(scale, rel=1e-9)
    for point in points:
        x, y = (picture.camera.project(point) + 0.5) * picture.pitch - 0.5
        reach = max(3, round(7 * scale * picture.pitch))
        left, top = round(x) - reach, round(y) - reach
        crop = picture.smooth[top : top + 2 * reach + 1, left : left + 2 * reach + 1].astype(float)
        rows, columns = np.mgrid[: crop.shape[0], : crop.shape[1]]
        found = np.array([(crop * columns).sum(), (crop * rows).sum()]) / crop.sum() + (left, top)
        # A crop that is centred on whole pixels cuts the spot unevenly by up to a tenth of a pixel.
        assert np.abs(found - (x, y)).max() < 0.12


def test_a_picture_for_edges_has_the_same_grey_levels_and_no_colours() -> None:
    rng = np.random.default_rng(0)
    image = cv2.GaussianBlur(rng.integers(0, 256, (480, 640, 3), dtype=np.uint8), (0, 0), 2.0)
    both = [working_picture(np.asarray(image), CAMERA, 0.5, None, has_colors) for has_colors in (True, False)]
    assert both[0].has_colors and not both[1].has_colors
    assert np.abs(both[0].smooth.astype(int) - both[1].smooth).max() <= 2


def test_texture_matches_move_with_the_window_and_keep_their_precision() -> None:
    matches = TextureMatches(np.zeros((2, 3)), np.array([[300.0, 200.0], [340.0, 260.0]]), np.ones(2), 2)
    image = np.zeros((480, 640, 3), dtype=np.uint8)
    point = CAMERA.unproject(matches.pixels[0]) * 400.0
    small = working_picture(image, CAMERA, 0.25, (160.0, 80.0, 480.0, 400.0))
    moved = matches_in(small, matches)
    assert moved.pixels[0] == pytest.approx(small.camera.project(point), abs=1e-6)
    assert moved.weights == pytest.approx(16.0)
    large = working_picture(image, CAMERA, 2.0, (160.0, 80.0, 480.0, 400.0))
    assert matches_in(large, matches).weights == pytest.approx(1.0)
    assert matches_in(large, matches).pixels[0] == pytest.approx(large.camera.project(point), abs=1e-6)


def test_the_window_holds_the_part_at_all_poses() -> None:
    def pose(x: float, z: float) -> Array:
        return rigid(exp_so3([0.1, 0.2, 0.3]), np.array([x, 5.0, z]))

    window = window_around(CAMERA, [pose(-20.0, 500.0), pose(30.0, 450.0)], 100.0, 10.0)
    assert window is not None
    left, top, right, bottom = window
    for x, z in ((-20.0, 500.0), (30.0, 450.0)):
        u, v = CAMERA.project(np.array([x, 5.0, z]))
        radius_px = 50.0 * CAMERA.fx / z
        assert left < u - radius_px and u + radius_px < right and top < v - radius_px and v + radius_px < bottom
    assert window_around(CAMERA, [pose(0.0, -5.0)], 100.0, 10.0) is None


def test_a_window_outside_the_picture_gives_the_whole_picture() -> None:
    image = np.zeros((480, 640, 3), dtype=np.uint8)
    picture = working_picture(image, CAMERA, 0.5, (900.0, 100.0, 1200.0, 300.0))
    assert (picture.camera.width, picture.camera.height) == (320, 240)
