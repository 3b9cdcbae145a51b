"""Smallest tolerance zones against values worked out by hand, against brute force, and their U against draws."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize

from arview.geometry import Array
from arview.measurement.datums.equations import point_from_move
from arview.measurement.zones import Zone, with_uncertainty

FREE = np.zeros((6, 0))


def zone_of(points: Array, across: Array, motions: Array, reach_mm: Array | None = None) -> Zone:
    """A zone whose state is the displacement of each point (P,3), across some directions (D,3)."""
    count = len(points)
    displacements = np.zeros((count, len(across), 3 * count))
    for index in range(count):
        displacements[index, :, 3 * index : 3 * index + 3] = across
    reach = np.full(motions.shape[1], np.inf) if reach_mm is None else reach_mm
    return Zone(displacements, across @ point_from_move(points)[:, :, :6] @ motions, reach)


@pytest.mark.parametrize(
    ("across", "expected_mm"),
    [(np.eye(3), 2.6), (np.eye(3)[:2], 1.0), (np.eye(3)[:1], 0.6)],
    ids=["sphere", "cylinder", "width"],
)
def test_a_point_that_is_off_by_3_4_12(across: Array, expected_mm: float) -> None:
    """Twice the length of what counts: of (0.3, 0.4, 1.2) 1.3, 0.5 and 0.3 mm."""
    zone = zone_of(np.zeros((1, 3)), across, FREE)
    assert zone.size_mm(np.array([0.3, 0.4, 1.2])) == pytest.approx(expected_mm, abs=1e-12)


def test_perpendicularity_of_an_axis_is_what_its_ends_differ_by() -> None:
    """A cylinder that may shift but not tilt holds two ends that are 0.5 mm apart across it: its diameter is that."""
    ends = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 40.0]])
    zone = zone_of(ends, np.eye(3)[:2], np.eye(6)[:, 3:])
    assert zone.size_mm(np.array([7.0, -2.0, 9.0, 7.3, -1.6, 9.0])) == pytest.approx(0.5, abs=1e-5)


def test_parallelism_of_a_face_is_the_range_of_its_heights() -> None:
    corners = np.array([[0.0, 0, 0], [50.0, 0, 0], [50.0, 30.0, 0], [0, 30.0, 0]])
    zone = zone_of(corners, np.eye(3)[2:], np.eye(6)[:, 3:])
    heights = np.array([0.02, 0.05, -0.01, 0.0])
    assert zone.size_mm(np.outer(heights, [0, 0, 1]).ravel()) == pytest.approx(0.06, abs=1e-6)


def test_flatness_of_a_saddle() -> None:
    """Corners up and down in turn by 0.1 mm: no plane comes nearer, so the width is 0.2; a tilt alone has none."""
    corners = np.array([[0.0, 0, 0], [50.0, 0, 0], [50.0, 50.0, 0], [0, 50.0, 0]])
    zone = zone_of(corners, np.eye(3)[2:], np.eye(6))
    saddle = np.outer([0.1, -0.1, 0.1, -0.1], [0, 0, 1]).ravel()
    tilt = np.outer(corners[:, 0] * 0.004 + corners[:, 1] * 0.001, [0, 0, 1]).ravel()
    assert zone.size_mm(saddle) == pytest.approx(0.2, abs=1e-6)
    assert zone.size_mm(tilt) == pytest.approx(0.0, abs=1e-6)
    assert zone.size_mm(saddle + tilt) == pytest.approx(0.2, abs=1e-6)


def test_a_datum_at_maximum_material_lets_the_zone_shift_within_a_disc() -> None:
    """0.5 mm off in an oblique direction, with a clearance of 0.1 mm on the radius, are 0.4 mm: zone 0.8."""
    zone = zone_of(np.zeros((1, 3)), np.eye(3)[:2], np.eye(6)[:, 3:5], np.array([0.1, 0.1]))
    assert zone.size_mm(np.array([0.3, -0.4, 0.0])) == pytest.approx(0.8, abs=2e-3)
    assert zone.size_mm(np.array([0.06, 0.05, 0.0])) == pytest.approx(0.0, abs=1e-6)
    held = zone_of(np.zeros((1, 3)), np.eye(3)[:2], np.eye(6)[:, 3:5], np.zeros(2))
    assert held.size_mm(np.array([0.3, -0.4, 0.0])) == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize("seed", range(6))
def test_a_pattern_that_may_turn_and_shift_against_brute_force(seed: int) -> None:
    """Four holes at once, the zones held by a plane alone; Nelder and Mead's search from many starts."""
    rng = np.random.default_rng(seed)
    points = np.array([[40.0, 30, 0], [-40.0, 30, 0], [-40.0, -30, 0], [40.0, -30, 0]])
    motions = np.eye(6)[:, [2, 3, 4]]
    zone = zone_of(points, np.eye(3)[:2], motions)
    state = rng.normal(0.0, 0.2, 12)
    at = zone.displacements @ state

    def size(motion: Array) -> float:
        return 2.0 * float(np.linalg.norm(at - zone.motions @ (motion / [40.0, 1.0, 1.0]), axis=1).max())

    starts = [np.zeros(3), *rng.normal(0.0, 0.3, (8, 3))]
    options = {"xatol": 1e-9, "fatol": 1e-9, "maxiter": 5000}
    best = min(minimize(size, start, method="Nelder-Mead", options=options).fun for start in starts)
    assert best - 1e-6 <= zone.size_mm(state) <= 1.003 * best
    assert zone.size_mm(state) < size(np.zeros(3)) - 0.01


@pytest.mark.parametrize("offset_mm", [0.0, 0.05, 0.5])
def test_uncertainty_holds_what_it_says(offset_mm: float) -> None:
    """The true size lies within U of the measured one in about 95 % of draws, near zero in more."""
    zone = zone_of(np.zeros((1, 3)), np.eye(3)[:2], FREE)
    rng = np.random.default_rng(1)
    truth = np.array([offset_mm, 0.0, 0.0])
    covariance = np.diag([0.03, 0.02, 0.05]) ** 2
    hits = []
    for _ in range(400):
        value, uncertainty = with_uncertainty(zone, truth + rng.normal(0.0, np.sqrt(np.diag(covariance))), covariance)
        hits.append(abs(value - 2.0 * offset_mm) <= uncertainty)
    assert 0.92 <= np.mean(hits) <= (0.98 if offset_mm > 0.1 else 1.0)


def test_what_is_undetermined_is_noticed_only_where_it_counts() -> None:
    zone = zone_of(np.zeros((1, 3)), np.eye(3)[:2], FREE)
    assert not zone.depends_on(np.array([[0.0, 0.0, 1.0]]))
    assert zone.depends_on(np.array([[0.0, 0.0, 1.0], [0.7, 0.0, 0.7]]))
