"""The default range: from where the part fills the picture of a camera to where it spans 60 px."""

from __future__ import annotations

import pytest

from arview.cad.view_range import ViewRange
from arview.camera import Camera
from arview.camera.read import guess_camera

DIAMETER_MM = 200.0
DEFAULT = ViewRange((0.9 * DIAMETER_MM, 40.0 * DIAMETER_MM), min_span_px=60.0)


@pytest.mark.parametrize(("width", "height", "far_px"), [(640, 480, 60), (1280, 720, 60), (1920, 1080, 90)])
def test_the_default_range_is_told_by_the_picture(width: int, height: int, far_px: float) -> None:
    camera = guess_camera(width, height)
    near_mm, far_mm = DEFAULT.for_camera(camera, DIAMETER_MM).distance_mm
    assert camera.fx * DIAMETER_MM / far_mm == pytest.approx(far_px)
    assert camera.fx * DIAMETER_MM / near_mm == pytest.approx(1.3 * width)


def test_a_wide_lens_comes_no_nearer_than_the_part_allows() -> None:
    near_mm, _ = DEFAULT.for_camera(Camera(1280, 720, 900.0, 900.0, 639.5, 359.5), DIAMETER_MM).distance_mm
    assert near_mm == pytest.approx(0.9 * DIAMETER_MM)


def test_a_declared_range_holds_for_every_camera() -> None:
    declared = ViewRange((300.0, 9000.0), elevation_deg=(0.0, 90.0))
    assert declared.for_camera(guess_camera(640, 480), DIAMETER_MM) is declared


def test_a_range_is_never_empty() -> None:
    tele = Camera(640, 480, 90_000.0, 90_000.0, 319.5, 239.5)
    low, high = DEFAULT.for_camera(tele, DIAMETER_MM).distance_mm
    assert low == high == 40.0 * DIAMETER_MM
