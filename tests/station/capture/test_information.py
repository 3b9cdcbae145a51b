"""The predicted U against triangulation of noisy bearings, and the choice of views against trying all of them."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from arview.geometry import Array
from arview.station.capture.information import (
    KnownViews,
    Views,
    choose_views,
    expanded_uncertainty,
    expected_error,
    gains,
)

FOCAL_PX = 1500.0
BEARINGS = InformationOptions(common_mm=0.0, prior_mm=1e3, alone_weight=1.0)
"""Bearings alone: each photo counts in full."""


def eyes_at(azimuths_deg: list[float], elevation_deg: float = 35.0, distance_mm: float = 600.0) -> Array:
    azimuth, elevation = np.radians(azimuths_deg), np.radians(elevation_deg)
    flat = np.cos(elevation)
    return distance_mm * np.stack(
        [flat * np.cos(azimuth), flat * np.sin(azimuth), np.full(len(azimuth), np.sin(elevation))], axis=1
    )


def views_of(eyes: Array, points: Array | None = None) -> Views:
    points = np.zeros((1, 3)) if points is None else points
    return Views.of(points, np.ones((len(eyes), len(points)), dtype=bool), eyes, FOCAL_PX)


def information(views: Views) -> Array:
    return KnownViews(views).information()


def triangulated(eyes: Array, rays: Array) -> Array:
    """The point (3,) nearest to rays (N,3) from some places (N,3), weighted as bearings of equal error."""
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    across /= np.sum(eyes**2, axis=1)[:, None, None]
    return np.linalg.solve(across.sum(axis=0), np.einsum("nij,nj->i", across, eyes))


@pytest.mark.parametrize("azimuths_deg", [[0, 20], [0, 40, 80], [0, 10, 20, 30, 40], list(range(0, 360, 30))])
def test_predicted_uncertainty_is_that_of_triangulated_bearings(azimuths_deg: list[float]) -> None:
    eyes = eyes_at(azimuths_deg)
    rng = np.random.default_rng(3)
    predicted = information(views_of(eyes))
    found = []
    for _ in range(4000):
        rays = -eyes / np.linalg.norm(eyes, axis=1, keepdims=True)
        rays = rays + BEARINGS.bearing_px / FOCAL_PX * rng.standard_normal(rays.shape)
        found.append(triangulated(eyes, rays / np.linalg.norm(rays, axis=1, keepdims=True)))
    covariance = np.cov(np.array(found).T)
    worst = 2.0 * np.sqrt(np.linalg.eigvalsh(covariance)[-1])
    assert expanded_uncertainty(predicted)[0] == pytest.approx(worst, rel=0.05)
    assert expected_error(predicted)[0] == pytest.approx(2.0 * np.sqrt(np.trace(covariance)), rel=0.05)


def test_a_component_that_is_not_seen_keeps_its_prior() -> None:
    seen = np.array([[True, False]])
    views = Views.of(np.zeros((2, 3)), seen, np.array([[0, 0, 500.0]]), FOCAL_PX)
    known = information(views)
    # One photo does not tell the depth: along the ray, both keep the prior.
    assert expanded_uncertainty(known) == pytest.approx(2 * np.hypot(options.prior_mm, options.common_mm) * np.ones(2))
    assert expected_error(known)[0] < expected_error(known)[1]


def test_more_photos_do_not_lower_what_is_common_to_all() -> None:
    u_mm = expanded_uncertainty(information(views_of(eyes_at([0, 20, 40, 60, 80]))))
    assert u_mm[0] == pytest.approx(2 * options.common_mm, rel=1e-3)


def test_three_photos_that_can_be_matched_tell_more_than_three_far_apart() -> None:
    near, far = (information(views_of(eyes_at(angles))) for angles in ([0, 25, 50], [0, 120, 240]))
    bearings = [information(views_of(eyes_at(angles))) for angles in ([0, 25, 50], [0, 120, 240])]
    assert expected_error(near)[0] < expected_error(far)[0]
    # By bearings alone it would be the other way.
    assert expected_error(bearings[0])[0] > expected_error(bearings[1])[0]


def random_views(rng: np.random.Generator, count: int) -> tuple[Views, Array]:
    """Random views of two points, of which each shows one or both, and their directions."""
    eyes = rng.normal(size=(count, 3))
    eyes *= rng.uniform(400, 900, (count, 1)) / np.linalg.norm(eyes, axis=1, keepdims=True)
    points = np.array([[40.0, 0, 0], [-40.0, 10, 5]])
    views = Views.of(points, rng.random((count, 2)) < 0.7, eyes, FOCAL_PX)
    return views, eyes / np.linalg.norm(eyes, axis=1, keepdims=True)


@pytest.mark.parametrize("options", [InformationOptions(), BEARINGS])
@pytest.mark.parametrize("seed", range(5))
def test_the_chosen_view_lowers_the_error_most(seed: int) -> None:
    views, directions = random_views(np.random.default_rng(seed), 11)
    weights = np.array([1.0, 4.0])
    taken, rest = views[:2], views[2:]
    order = choose_views(taken, rest, weights, directions[2:], list(directions[:2]), 4, 180.0)
    assert len(set(order)) == 4

    def error(chosen: tuple[int, ...]) -> float:
        some = views[[0, 1, *(index + 2 for index in chosen)]]
        return float(expected_error(information(some)) @ weights)

    assert error((order[0],)) == pytest.approx(min(error((index,)) for index in range(len(rest))))
    gain = gains(KnownViews(taken), rest, weights)[order[0]]
    assert gain == pytest.approx(error(()) - error((order[0],)))
    if options is BEARINGS:  # the choice of three is near the best of all choices
        best = min(error(some) for some in combinations(range(len(rest)), 3))
        assert error(tuple(order[:3])) <= 1.25 * best


def test_views_too_far_from_every_photo_wait() -> None:
    eyes = eyes_at([0, 30, 60, 90, 120, 150, 180])
    directions = eyes / np.linalg.norm(eyes, axis=1, keepdims=True)
    views = views_of(eyes)
    near = choose_views(views[:1], views[1:], np.ones(1), directions[1:], [directions[0]], 4, 26.0)
    assert near == [0, 1, 2, 3]
    far = choose_views(views[:1], views[1:], np.ones(1), directions[1:], [directions[0]], 4, 180.0)
    assert far[0] >= 2
