"""Weights of the modalities against synthetic truth: steps chosen by colour, lines without outline, scattered lines."""

from __future__ import annotations

import numpy as np
import pytest

from arview.refinement.gauss_newton import trust_in
from arview.refinement.modalities.edge import measure_edges, smoothed, weigh_by_color
from arview.refinement.modalities.region import BINS, EDGE_FUNCTION, ColorModel, log_odds, measure_region, value_bins
from arview.refinement.projection import ProjectedLines
from arview.rendering.mesh_edges import EDGE_CONTOUR, EDGE_SHARP

RED, GREEN = (170, 40, 30), (120, 190, 140)
OUTLINE, HIGHLIGHT = 100.0, 95.0
"""Columns of the outline and of the border of a highlight inside it."""
ROWS = np.arange(20.0, 80.0, 2.0)


def colors() -> ColorModel:
    """Colours of a red part on a green background."""
    bin_of = value_bins(1.0)
    odds = np.zeros(BINS**3)
    fore, back = np.zeros(BINS**3), np.zeros(BINS**3)
    for histogram, color in ((fore, RED), (back, GREEN)):
        for noise in np.random.default_rng(1).normal(0.0, 5.0, (500, 3)):
            r, g, b = bin_of[np.clip(color + noise, 0, 255).astype(int)]
            histogram[r * 256 + g * 16 + b] += 1.0
    log_odds(fore, back, odds)
    return ColorModel(bin_of, odds, EDGE_FUNCTION)


INTRINSICS = np.array([500.0, 500.0, *np.zeros(8), 1.0])
"""Of which only the focal length and the pitch are used."""


def picture(*, outline: float = OUTLINE, noise: float = 3.0) -> np.ndarray:
    """Picture (100,200,3) of a part to the left of a column, with a glaring stripe along its rim."""
    image = np.empty((100, 200, 3))
    columns = np.arange(200)
    image[:, columns <= outline] = RED
    image[:, columns > outline] = GREEN
    image[:, (columns > HIGHLIGHT - 4) & (columns <= HIGHLIGHT)] = (255, 250, 250)
    image += np.random.default_rng(2).normal(0.0, noise, image.shape)
    return np.clip(image, 0, 255).astype(np.uint8)


def lines(column: float) -> ProjectedLines:
    """Lines across an upright outline that is expected at a column, outwards to the right."""
    pixels = np.stack([np.full(len(ROWS), column), ROWS], axis=1)
    return ProjectedLines(pixels, np.tile([1.0, 0.0], (len(ROWS), 1)), np.full(len(ROWS), 500.0))


def strongest(profiles) -> np.ndarray:
    """Position (N,) of the strongest step of each point."""
    best = np.abs(profiles.strengths).argmax(axis=1)
    return profiles.positions[np.arange(len(best)), best]


@pytest.mark.parametrize("kind", [EDGE_CONTOUR, EDGE_CONTOUR | EDGE_SHARP])
def test_highlight_loses_against_round_outline(kind):
    image = picture()
    gray = smoothed(np.ascontiguousarray(image.mean(axis=2).astype(np.uint8)))
    expected = lines(OUTLINE - 1.0)
    profiles = measure_edges(gray, expected, 8, 1.0, 3.0, 1.0)
    assert profiles.visible.all()
    # The highlight is the stronger step by far, 5 px inside the outline.
    assert np.median(strongest(profiles)) < -2.0
    before = profiles.strengths.copy()
    weigh_by_color(image, colors(), expected, np.full(len(ROWS), kind, dtype=np.uint8), profiles, 1.0)
    if kind & EDGE_SHARP:
        assert np.array_equal(profiles.strengths, before)
    else:
        found = strongest(profiles)
        assert np.abs(found - 1.5).max() < 0.6
        kept = np.abs(profiles.positions - 1.5) < 0.6
        assert np.allclose(profiles.strengths[kept], before[kept], rtol=0.1)


def test_steps_keep_their_strength_where_colors_tell_nothing():
    image = picture()
    gray = smoothed(np.ascontiguousarray(image.mean(axis=2).astype(np.uint8)))
    profiles = measure_edges(gray, lines(OUTLINE), 8, 1.0, 3.0, 1.0)
    before = profiles.strengths.copy()
    unknown = colors()._replace(odds=np.zeros(BINS**3))
    weigh_by_color(image, unknown, lines(OUTLINE), np.full(len(ROWS), EDGE_CONTOUR, dtype=np.uint8), profiles, 1.0)
    assert np.count_nonzero(before) > len(ROWS) and np.allclose(profiles.strengths, before)


@pytest.mark.parametrize("scale", [1, 2])
def test_line_that_the_outline_does_not_cross_is_recognised(scale):
    runs = np.full((len(ROWS), 2), 1000.0, dtype=np.float32)
    image = picture(outline=150.0)
    image[:, 80:100] = RED
    crossed = measure_region(image, colors(), lines(151.0), runs, INTRINSICS, scale)
    assert crossed.crossing.min() > 0.99 and np.abs(crossed.mean).max() < 1.5 * scale
    inside = measure_region(image, colors(), lines(115.0), runs, INTRINSICS, scale)
    # The posterior of such a line is narrow as well, at its end; only the comparison with no outline reveals it.
    assert inside.information.min() > 0.1 / scale**2 and inside.mean.min() > 3.0 * scale
    assert inside.crossing.max() < 0.05


def test_trust_falls_with_the_scatter_about_the_own_optimum():
    rng = np.random.default_rng(3)
    rows = rng.normal(size=(200, 6))
    twist = rng.normal(size=6)
    for weight in (1.0, 3.0):
        for sigma, low, high in ((0.7, 1.0, 1.0), (2.0, 0.04, 0.1), (4.0, 0.002, 0.008)):
            residuals = rows @ twist + sigma * rng.normal(size=200)
            hessian, gradient = weight * rows.T @ rows, weight * rows.T @ residuals
            trust = trust_in(hessian, gradient, float(residuals @ residuals), 200.0, weight)
            assert low <= trust <= high
    assert trust_in(hessian, gradient, 1e9, 7.0, 1.0) == 1.0
