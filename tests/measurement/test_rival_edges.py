"""Edges with another one beside them: where it is, and by how much its blurred step shifts theirs."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from arview.camera import Camera
from arview.core.subpixel_edges import find_steps
from arview.geometry import Array, rigid
from arview.measurement.photo.rival_edges import EdgePoints, merged_shift_px, rival_offsets_px
from arview.measurement.photo.views import PhotoViews, views_of
from helpers.plate_scene import nominal

CAMERA = Camera(400, 300, 500.0, 500.0, 200.0, 150.0)
DISTANCE_MM = 500.0


def seen_shift_px(gap_px: float, heights: tuple[float, float], blur_px: float = 1.0) -> float:
    """Mean place of the first of two steps as it is found, off its true one, over places between the pixels."""
    fine, angle = 4, 0.3
    v, u = (np.mgrid[0 : 48 * fine, 0 : 48 * fine] + 0.5) / fine - 0.5
    found = []
    for phase in np.arange(0.0, 1.0, 0.1):
        along = (u - 24.0) * np.cos(angle) + (v - 24.0) * np.sin(angle) - phase
        levels = (100.0 + heights[0] * (along >= 0.0) + heights[1] * (along >= gap_px)).astype(np.float32)
        blurred = cv2.GaussianBlur(levels, (0, 0), blur_px * fine)
        gray = cv2.resize(blurred, (48, 48), interpolation=cv2.INTER_AREA).astype(np.float32)
        normal = np.array([[np.cos(angle), np.sin(angle)]])
        offsets, slopes, seen = find_steps(gray, np.array([[24.0, 24.0]]) + phase * normal, normal, 4.0, 2.0, 1.0)
        assert seen[0] and slopes[0].any()
        steps = offsets[0][slopes[0] != 0.0]
        found.append(float(steps[np.argmin(np.abs(steps))]))
    return float(np.mean(found))


@pytest.mark.parametrize("gap_px", [2.0, 2.2, 2.4, -2.2])
def test_a_step_beside_a_step_shifts_it(gap_px: float) -> None:
    expected = float(merged_shift_px(np.array([gap_px]), 1.0)[0])
    towards, away = (seen_shift_px(gap_px, (60.0, other), 0.85) for other in (60.0, -60.0))
    assert np.sign(towards) == np.sign(gap_px) == -np.sign(away) == np.sign(expected)
    assert 0.7 * abs(expected) < abs(away) < 1.4 * abs(expected)
    assert abs(towards) > abs(away)  # nearer than twice the blur the two become one


def test_a_step_alone_is_where_it_is() -> None:
    assert abs(seen_shift_px(6.0, (60.0, -60.0), 0.85)) < 0.01


def test_steps_without_another_one_are_not_shifted() -> None:
    assert merged_shift_px(np.array([np.inf, -np.inf]), 1.0).tolist() == [0.0, 0.0]
    assert abs(float(merged_shift_px(np.array([6.0]), 1.0)[0])) < 1e-6


def two_edges(apart_px: float) -> tuple[EdgePoints, PhotoViews]:
    """Points on two vertical lines in one photo, the second one to the right, and a third line far away."""
    apart_mm = apart_px * DISTANCE_MM / CAMERA.fx
    y = np.arange(-20.0, 20.0, 1.0)
    lines: list[Array] = [np.stack([np.full(len(y), x), y, np.zeros(len(y))], axis=1) for x in (0.0, apart_mm, 40.0)]
    points = np.concatenate(lines)
    tangents = np.tile([0.0, 1.0, 0.0], (len(points), 1))
    gray = np.zeros((CAMERA.height, CAMERA.width), np.uint8)
    pose = rigid(np.eye(3), np.array([0.0, 0.0, DISTANCE_MM]))
    views = views_of([gray], (CAMERA,), pose[None], nominal(), ("a.jpg",))
    return EdgePoints(points, tangents, np.zeros(len(points), dtype=np.int64)), views


def test_offsets_lead_to_the_nearest_edge_beside() -> None:
    edges, views = two_edges(2.5)
    offsets = rival_offsets_px(edges, views, 6.0).reshape(3, -1, 2)
    assert offsets[0] == pytest.approx(np.tile([2.5, 0.0], (offsets.shape[1], 1)), abs=1e-3)
    assert offsets[1] == pytest.approx(np.tile([-2.5, 0.0], (offsets.shape[1], 1)), abs=1e-3)
    assert np.isinf(offsets[2]).all()
    assert np.isinf(rival_offsets_px(edges, views, 2.0)).all()
    assert np.isinf(rival_offsets_px(*two_edges(0.1), 6.0)).all()  # one line in the photo
