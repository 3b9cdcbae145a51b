"""What lies on both sides of an outline: colours that part there, and steps inside against those on it."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from arview.geometry import Array, apply
from arview.raster import rasterise
from arview.tracking.areas import UNKNOWN, look_at_areas
from arview.tracking.picture import Picture
from arview.tracking.tracker import PartView, Tracker
from synthetic import CAMERA, assembly, assembly_views, pose_from

PART = PartView(assembly_views())
POSE = pose_from(30.0, 45.0, 520.0)
DARK, BRIGHT = 48, 208


def silhouette() -> np.ndarray:
    """(H,W) bool, where the part is."""
    vertices, faces, _ = assembly().mesh
    _, ids = rasterise(
        apply(POSE, vertices), faces, CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy, CAMERA.width, CAMERA.height
    )
    return np.asarray(ids >= 0)


def areas(gray: np.ndarray, pose: Array = POSE, noise: float = 3.0) -> tuple[float, float]:
    """Parting and clutter of a pose in a picture that is made noisy."""
    noisy = gray[..., None] + np.random.default_rng(1).normal(0.0, noise, (*gray.shape, 3))
    image = np.clip(noisy, 0, 255).astype(np.uint8)
    parting, clutter = look_at_areas(Picture(image, CAMERA, 12), PART, (pose @ PART.model_from_body)[None])[0]
    return float(parting), float(clutter)


def test_a_plain_part_on_a_plain_ground_parts_wholly_and_has_no_clutter() -> None:
    parting, clutter = areas(np.where(silhouette(), DARK, BRIGHT))
    assert parting > 0.95
    # The step of 160 grey levels falls on about two pixels; noise leaves less than two inside.
    assert clutter < np.log(3.0 / 35.0)


def test_what_is_painted_half_in_the_colour_of_the_ground_parts_by_half_and_is_cluttered() -> None:
    rows, columns = np.indices((CAMERA.height, CAMERA.width))
    is_square = ((rows // 24 + columns // 24) % 2).astype(bool)
    parting, clutter = areas(np.where(silhouette() & is_square, DARK, BRIGHT))
    assert parting == pytest.approx(0.5, abs=0.12)
    assert clutter > -1.0


def test_where_there_is_nothing_little_parts_and_steps_are_alike() -> None:
    parting, clutter = areas(np.full((CAMERA.height, CAMERA.width), 100))
    assert parting < 0.3
    assert clutter == pytest.approx(0.0, abs=0.45)  # the strongest of five places on the outline, the mean inside


def test_design_edges_are_no_clutter_and_the_same_lines_elsewhere_are() -> None:
    ground = np.where(silhouette(), DARK, BRIGHT)
    seen = Tracker(assembly_views(), CAMERA).edge_steps(ground.astype(np.uint8), POSE @ PART.model_from_body)

    def with_lines(shift_px: int) -> np.ndarray:
        lines = np.zeros(ground.shape, dtype=np.uint8)
        for x, y in np.round(seen.pixels).astype(int) + shift_px:
            cv2.circle(lines, (int(x), int(y)), 2, 1, -1)
        return np.where(silhouette() & (lines > 0), BRIGHT, ground)

    on_edges, elsewhere = areas(with_lines(0))[1], areas(with_lines(9))[1]
    assert elsewhere > on_edges + 0.4


def test_of_a_pose_outside_the_picture_nothing_is_said() -> None:
    aside = POSE.copy()
    aside[0, 3] += 2000.0
    assert areas(np.full((CAMERA.height, CAMERA.width), 100), aside) == tuple(UNKNOWN)
