"""Trimmed scores leave out the quarter of an outline with the lowest responses."""

import numpy as np
import pytest

from arview.detection.search.pattern_search import outline_score
from arview.detection.search.template_bank import (
    SECTORS,
    min_adjacent_pair,
    sector_of,
    sector_order,
)

RADIUS_PX = 40.0


def ring(points: int = 64) -> tuple[np.ndarray, np.ndarray]:
    """Points of a circle in the order of `sector_order`, and their angles, 256 to the half turn."""
    turn = 2.0 * np.pi * (np.arange(points) + 0.5) / points
    shown = np.stack([np.cos(turn), np.sin(turn), 0.0 * turn], axis=1)
    order = sector_order(shown)
    return shown[order].astype(np.float32), (np.round(turn[order] / np.pi * 256.0).astype(int) % 256).astype(np.uint8)


def score(hidden_deg: tuple[float, float], is_trimmed: bool) -> float:
    """Score of a ring on maps with full responses except in one sector about its centre."""
    points, angles = ring()
    y, x = np.mgrid[:128, :128] - 63.5
    turn = np.rad2deg(np.arctan2(y, x)) % 360.0
    seen = ~((hidden_deg[0] <= turn) & (turn < hidden_deg[1]))
    maps = np.repeat((255 * seen).astype(np.uint8)[None], 8, axis=0)
    sums = np.empty((1, 1), dtype=np.int32)
    buffer = np.empty((3, len(points)), dtype=np.int64)
    sectors = np.empty(SECTORS, dtype=np.int64)
    found, dx, dy = outline_score(
        maps, points, angles, 0.0, RADIUS_PX, 0.0, 63.5, 63.5, 0, 2, is_trimmed, 0, 0.0, 0.0, buffer, sums, sectors, 0.0
    )
    assert (dx, dy) == (0, 0)
    return float(found)


def test_sectors_are_contiguous() -> None:
    points, _ = ring()
    turn = np.rad2deg(np.arctan2(points[:, 1], points[:, 0]))
    sectors = np.array([sector_of(place) for place in range(len(points))])
    for sector in range(SECTORS):
        assert np.count_nonzero(sectors == sector) == len(points) // SECTORS
        assert np.ptp(turn[sectors == sector]) < 360.0 / SECTORS


def test_the_smallest_pair_may_span_the_end() -> None:
    assert min_adjacent_pair(np.array([1, 9, 9, 9, 5, 5, 9, 2])) == 3
    assert min_adjacent_pair(np.array([9, 9, 1, 0, 9, 9, 9, 2])) == 1


@pytest.mark.parametrize("start_deg", [0.0, 45.0, 135.0, 270.0])
def test_a_hidden_quarter_is_trimmed(start_deg: float) -> None:
    hidden = (start_deg, start_deg + 90.0)
    assert score(hidden, True) == pytest.approx(1.0, abs=0.05)
    assert score(hidden, False) == pytest.approx(0.75, abs=0.05)


def test_a_hidden_half_is_not_trimmed() -> None:
    assert score((0.0, 180.0), True) == pytest.approx(2.0 / 3.0, abs=0.05)
