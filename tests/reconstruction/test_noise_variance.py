"""The noise of observations by their residuals: right for the covariance of a robust adjustment, with tails as well."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from arview.reconstruction.adjustment.covariance import LOSS_PX, noise_variance

Noise = Callable[[np.random.Generator, tuple[int, ...]], NDArray[np.float64]]


def means(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """(T,2) place of each of T sets of points (T,N,2) by Cauchy's loss, reweighted until it stands still."""
    found = np.median(points, axis=1)
    for _ in range(25):
        squares = np.sum((points - found[:, None]) ** 2, axis=2) / LOSS_PX**2
        weights = 1.0 / (1.0 + squares)
        found = np.sum(weights[..., None] * points, axis=1) / np.sum(weights, axis=1)[:, None]
    return found


@pytest.mark.parametrize(
    "noise",
    [
        lambda rng, shape: rng.normal(0.0, 0.1, shape),
        lambda rng, shape: rng.normal(0.0, 0.4, shape),
        lambda rng, shape: 0.2 * rng.standard_t(3, shape),
        lambda rng, shape: np.where(rng.random(shape) < 0.05, 4.0, 1.0) * rng.normal(0.0, 0.15, shape),
    ],
    ids=["normal, 0.1 px", "normal, 0.4 px", "t of 3 degrees of freedom", "one of 20 four times worse"],
)
def test_the_scatter_of_robust_means_is_predicted(noise: Noise) -> None:
    """40,000 sets of 60 points: the standard deviation of their means within 2 %."""
    rng = np.random.default_rng(1)
    points = noise(rng, (40_000, 60, 2))
    scatter = float(np.std(means(points)))
    residuals = points[:2000].reshape(-1, 2)
    information = 60 * float(np.mean(1.0 / (1.0 + np.sum(residuals**2, axis=1) / LOSS_PX**2)))
    assert np.sqrt(noise_variance(residuals) / information) == pytest.approx(scatter, rel=0.02)
