"""Rims whose edge rust and burrs move over an arc: the stated uncertainty of their position holds the truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from arview.geometry import Array
from arview.measurement.datums.alignment import align
from arview.measurement.datums.equations import DatumEquations, move_equations, surface_equations
from arview.measurement.datums.roundness import rim_shift_mm, waves
from arview.measurement.types import Move

EXPECTED_MM = 0.016
"""0.04 px at 0.4 mm per pixel."""


def rim(rng: np.random.Generator, sigma_mm: float, arc: float = 2 * np.pi, count: int = 400) -> DatumEquations:
    """Offsets of a rim at its nominal place whose edge deviates by smooth random errors of every harmonic."""
    angles = np.sort(rng.uniform(0, arc, count))
    radial = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(count)])
    orders = np.arange(1, 6)
    both = np.concatenate([np.cos(np.outer(angles, orders)), np.sin(np.outer(angles, orders))], axis=1)
    falling = np.tile(orders**-0.5, 2)
    offsets = both @ (falling * rng.normal(0, sigma_mm, both.shape[1])) - 0.05 + rng.normal(0, 0.07, count)
    variances = np.full(count, 0.07**2)
    one = surface_equations("B", "hole", 6.5 * radial, radial, offsets, variances, by_radius=np.ones(count))
    design = np.concatenate([radial, np.ones((count, 1))], axis=1)
    shift_mm = rim_shift_mm(design, offsets, variances, angles, EXPECTED_MM)
    return replace(one, form_mm=shift_mm, by_form=waves(np.ones(count), angles))


def normalised_errors(sigma_mm: float, runs: int, arc: float = 2 * np.pi) -> Array:
    """(2 runs,) errors of the position of a rim, each divided by its standard uncertainty."""
    rest = Move("base", "edges", np.zeros(3), np.zeros(6), 1e-12 * np.eye(6), np.zeros((0, 6)), 100.0, 0, 0.0, 1.0)
    found = []
    for seed in range(runs):
        frame = align(
            [rim(np.random.default_rng(seed), sigma_mm, arc)], np.zeros(3), 100.0, move_equations("x", rest)[0]
        )
        found.append(frame.move[3:5] / np.sqrt(np.diag(frame.covariance)[3:5]))
    return np.concatenate(found)


@pytest.mark.parametrize(("sigma_mm", "arc"), [(0.016, 2 * np.pi), (0.01, 2 * np.pi), (0.016, 1.3 * np.pi)])
@pytest.mark.slow
def test_intervals_hold_the_position_of_rusty_rims(sigma_mm: float, arc: float) -> None:
    z = normalised_errors(sigma_mm, 200, arc)
    held = np.mean(np.abs(z) < 1.96)
    # 400 values of which 95 % should hold: four standard deviations of a binomial distribution are 4.4 %.
    assert 0.906 < held < 0.994
    assert 0.7 < np.sqrt(np.mean(z**2)) < 1.2


def test_clean_rims_are_trusted_more_than_rusty_ones() -> None:
    clean, rusty = (rim(np.random.default_rng(3), sigma).form_mm for sigma in (0.0, 0.06))
    assert clean == pytest.approx(EXPECTED_MM / np.sqrt(2), rel=0.1)
    assert rusty > 2 * clean


def test_an_arc_shows_too_little_of_a_rim() -> None:
    assert rim(np.random.default_rng(3), 0.06, 1.3 * np.pi).form_mm == EXPECTED_MM
