"""The predicted U against triangulation of noisy bearings, and the choice of views against trying all of them."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest

from arview.capture.information import (
    InformationOptions,
    choose_views,
    expanded_uncertainty,
    expected_error,
    gains,
    prior_information,
    view_information,
)
from arview.geometry import Array

FOCAL_PX = 1500.0
EXACT = InformationOptions(common_mm=0.0, prior_mm=1e3)


def eyes_at(azimuths_deg: list[float], elevation_deg: float = 35.0, distance_mm: float = 600.0) -> Array:
    azimuth, elevation = np.radians(azimuths_deg), np.radians(elevation_deg)
    flat = np.cos(elevation)
    return distance_mm * np.stack(
        [flat * np.cos(azimuth), flat * np.sin(azimuth), np.full(len(azimuth), np.sin(elevation))], axis=1
    )


def triangulated(eyes: Array, rays: Array) -> Array:
    """The point (3,) nearest to rays (N,3) from some places (N,3), weighted as bearings of equal error."""
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    across /= np.sum(eyes**2, axis=1)[:, None, None]
    return np.linalg.solve(across.sum(axis=0), np.einsum("nij,nj->i", across, eyes))


@pytest.mark.parametrize("azimuths_deg", [[0, 20], [0, 40, 80], [0, 10, 20, 30, 40], list(range(0, 360, 30))])
def test_predicted_uncertainty_is_that_of_triangulated_bearings(azimuths_deg: list[float]) -> None:
    eyes = eyes_at(azimuths_deg)
    rng = np.random.default_rng(3)
    information = prior_information(1, EXACT)
    for eye in eyes:
        information = information + view_information(np.zeros((1, 3)), np.array([True]), eye, FOCAL_PX, EXACT)
    found = []
    for _ in range(4000):
        rays = -eyes / np.linalg.norm(eyes, axis=1, keepdims=True)
        rays = rays + EXACT.bearing_px / FOCAL_PX * rng.standard_normal(rays.shape)
        found.append(triangulated(eyes, rays / np.linalg.norm(rays, axis=1, keepdims=True)))
    covariance = np.cov(np.array(found).T)
    worst = 2.0 * np.sqrt(np.linalg.eigvalsh(covariance)[-1])
    assert expanded_uncertainty(information, EXACT)[0] == pytest.approx(worst, rel=0.05)
    assert expected_error(information, EXACT)[0] == pytest.approx(2.0 * np.sqrt(np.trace(covariance)), rel=0.05)


def test_a_component_that_is_not_seen_keeps_its_prior() -> None:
    seen = np.array([True, False])
    information = prior_information(2) + view_information(np.zeros((2, 3)), seen, np.array([0, 0, 500.0]), FOCAL_PX)
    options = InformationOptions()
    u_mm = expanded_uncertainty(information)
    # One photo does not tell the depth: along the ray, both keep the prior.
    assert u_mm == pytest.approx(2 * np.hypot(options.prior_mm, options.common_mm) * np.ones(2))
    assert expected_error(information)[0] < expected_error(information)[1]


def test_more_photos_do_not_lower_what_is_common_to_all() -> None:
    one = view_information(np.zeros((1, 3)), np.array([True]), np.array([0, 0, 500.0]), FOCAL_PX)
    other = view_information(np.zeros((1, 3)), np.array([True]), np.array([500.0, 0, 0]), FOCAL_PX)
    options = InformationOptions()
    assert expanded_uncertainty(1e8 * (one + other))[0] == pytest.approx(2 * options.common_mm, rel=1e-3)


def views_of_two_points(rng: np.random.Generator, count: int) -> tuple[Array, Array]:
    """(V,2,3,3) information of random views on two points, of which each view shows one or both; their directions."""
    eyes = rng.normal(size=(count, 3))
    eyes *= rng.uniform(400, 900, (count, 1)) / np.linalg.norm(eyes, axis=1, keepdims=True)
    points = np.array([[40.0, 0, 0], [-40.0, 10, 5]])
    seen = rng.random((count, 2)) < 0.7
    views = [view_information(points, row, eye, FOCAL_PX) for row, eye in zip(seen, eyes, strict=True)]
    return np.array(views), eyes / np.linalg.norm(eyes, axis=1, keepdims=True)


@pytest.mark.parametrize("seed", range(5))
def test_the_chosen_view_lowers_the_error_most_and_the_choice_is_near_the_best(seed: int) -> None:
    views, directions = views_of_two_points(np.random.default_rng(seed), 9)
    weights = np.array([1.0, 4.0])
    known = prior_information(2) + views[0] + views[1]
    order = choose_views(known, views, weights, directions, [directions[0]], 4, 180.0)
    assert len(set(order)) == 4

    def error(chosen: tuple[int, ...]) -> float:
        return float(expected_error(known + views[list(chosen)].sum(axis=0)) @ weights)

    assert error((order[0],)) == pytest.approx(min(error((index,)) for index in range(len(views))))
    assert gains(known, views, weights)[order[0]] == pytest.approx(
        float(expected_error(known) @ weights) - error((order[0],))
    )
    best = min(error(some) for some in permutations(range(len(views)), 3))
    assert error(tuple(order[:3])) <= 1.1 * best


def test_views_too_far_from_every_photo_wait() -> None:
    eyes = eyes_at([0, 30, 60, 90, 120, 150, 180])
    seen, points = np.array([True]), np.zeros((1, 3))
    views = np.array([view_information(points, seen, eye, FOCAL_PX) for eye in eyes])
    directions = eyes / np.linalg.norm(eyes, axis=1, keepdims=True)
    known = prior_information(1) + views[0]
    near = choose_views(known, views, np.ones(1), directions, [directions[0]], 4, 26.0)
    assert near[0] in (0, 1)
    far = choose_views(known, views, np.ones(1), directions, [directions[0]], 4, 180.0)
    assert far[0] in (3, 4, 5, 6)
