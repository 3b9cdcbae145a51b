"""Which pieces of the CAD's surface photos saw, against what is known of simple scenes."""

from __future__ import annotations

import numpy as np
import pytest

from arview.cad.model import Model, make_model
from arview.camera import Camera
from arview.errors import InputError
from arview.geometry import look_at
from arview.reconstruction.seen_surface import seen_surface
from helpers.cad_files import box
from helpers.synthetic import component

CAMERA = Camera(1600, 1200, 1900.0, 1900.0, 799.5, 599.5)


def part() -> Model:
    """A plate, and a wall on it whose foot hides a strip of the plate from one side."""
    return make_model(
        "part",
        (
            component("plate", box((-100, -100, -8), (100, 100, 0)), (0.5, 0.5, 0.5)),
            component("wall", box((-3, -100, 0), (3, 100, 60)), (0.5, 0.5, 0.5)),
        ),
    )


def from_side(azimuth_deg: float, elevation_deg: float = 45.0) -> np.ndarray:
    azimuth, elevation = np.radians([azimuth_deg, elevation_deg])
    eye = 500 * np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)])
    return look_at(eye, [0.0, 0.0, 0.0], [0.0, 0.0, 1.0])


def test_pieces_are_the_whole_surface() -> None:
    surface = seen_surface(part(), [(CAMERA, from_side(0.0))])
    assert surface.areas.sum() == pytest.approx(2 * 200 * 200 + 4 * 200 * 8 + 2 * (6 * 200 + 200 * 60 + 6 * 60))
    edges = np.linalg.norm(surface.corners - np.roll(surface.corners, -1, axis=1), axis=2)
    assert edges.max() <= part().diameter_mm / SeenOptions().pieces_across + 1e-9


def test_one_side_leaves_the_other_unseen() -> None:
    """Photos from +x at 45°: the wall of 60 mm hides the plate behind it; nothing shows the underside."""
    views = [(CAMERA, from_side(azimuth)) for azimuth in (-8.0, 0.0, 8.0)]
    surface = seen_surface(part(), views)
    middle = surface.corners.mean(axis=1)
    top = (surface.owner == 0) & (np.abs(surface.corners[..., 2]).max(axis=1) < 1e-9) & (np.abs(middle[:, 1]) < 70)
    assert surface.is_seen[top & (middle[:, 0] > 8)].mean() > 0.99
    hidden = top & (middle[:, 0] < -6) & (middle[:, 0] > -48)
    assert np.count_nonzero(hidden) > 50 and not surface.is_seen[hidden].any()
    assert surface.is_seen[top & (middle[:, 0] < -80)].mean() > 0.99
    assert not surface.is_seen[np.abs(surface.corners[..., 2] + 8).max(axis=1) < 1e-9].any()
    wall = surface.owner == 1
    assert surface.is_seen[wall & (np.abs(surface.corners[..., 0] - 3).max(axis=1) < 1e-9)].mean() > 0.95
    assert not surface.is_seen[wall & (np.abs(surface.corners[..., 0] + 3).max(axis=1) < 1e-9)].any()
    assert 0.4 < surface.share_of(1) < 0.65


def test_one_photo_is_not_enough() -> None:
    surface = seen_surface(part(), [(CAMERA, from_side(0.0))])
    assert surface.photos.max() == 1 and not surface.is_seen.any() and surface.share_of(0) == 0.0
    with pytest.raises(InputError, match="no camera poses"):
        seen_surface(part(), [])
