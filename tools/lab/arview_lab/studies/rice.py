"""Length of a noisy displacement: Rice's density compared with simulated lengths."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import gamma, hyp1f1, ive

from arview.geometry import Array
from arview.measurement.uncertainty.rice import rice_estimate
from arview_lab.chart import Chart, stack
from arview_lab.studies.common import Study

SIGMA_MM = 0.3
OFFSETS_MM = (0.0, 1.0)
BIN_MM = 0.05


def rice_study(is_quick: bool = False, seed: int = 0) -> Study:
    """Lengths of 10,000 displacements in a plane, of 0 and 1 mm, with 0.3 mm of noise along each axis."""
    count = 2000 if is_quick else 10_000
    rng = np.random.default_rng(seed)
    rows: list[tuple[object, ...]] = []
    bins: list[tuple[object, ...]] = []
    charts, summary = [], []
    for offset in OFFSETS_MM:
        lengths = np.linalg.norm(rng.normal(0.0, SIGMA_MM, (count, 2)) + np.array([offset, 0.0]), axis=1)
        edges = np.arange(0.0, lengths.max() + BIN_MM, BIN_MM)
        share, _ = np.histogram(lengths, edges, density=True)
        middles = 0.5 * (edges[1:] + edges[:-1])
        density = rice_density(middles, offset, SIGMA_MM)
        chart = Chart(f"Measured length of a displacement of {offset:g} mm", "length / mm", "density / (1/mm)")
        chart.add(middles, share, "simulated", "bars")
        chart.add(middles, density, "Rice")
        charts.append(chart.draw())
        bins += [(offset, float(r), float(s), float(d)) for r, s, d in zip(middles, share, density, strict=True)]
        expected, estimate = rice_mean(offset, SIGMA_MM), rice_estimate(lengths, SIGMA_MM)
        rows.append((offset, SIGMA_MM, count, float(lengths.mean()), expected, float(lengths.std()), estimate))
        summary.append(
            f"offset {offset:g} mm: mean length {lengths.mean():.4f} mm, by Rice {expected:.4f} mm; most likely true "
            f"length {estimate:.4f} mm"
        )
    columns = ("offset_mm", "sigma_mm", "count", "mean_mm", "rice_mean_mm", "std_mm", "estimated_offset_mm")
    tables = {"rice": (columns, rows), "rice_histogram": (("offset_mm", "length_mm", "density", "rice"), bins)}
    return Study("rice", tables, stack(charts), tuple(summary))


def rice_density(lengths: ArrayLike, true_length: float, sigma: float, axes: int = 2) -> Array:
    """Density of measured lengths (...,) for a true length and the noise of each axis."""
    r = np.asarray(lengths, dtype=np.float64) / sigma
    a, order = true_length / sigma, 0.5 * axes - 1.0
    if a < 1e-6:
        density = 2.0 ** (-order) / gamma(0.5 * axes) * r ** (axes - 1) * np.exp(-0.5 * r**2)
    else:
        inside = np.where(r > 0, r, 1.0)
        density = inside * (inside / a) ** order * np.exp(-0.5 * (inside - a) ** 2) * ive(order, inside * a)
        at_zero = np.sqrt(2.0 / np.pi) * np.exp(-0.5 * a**2) if axes == 1 else 0.0
        density = np.where(r > 0, density, at_zero)
    return np.asarray(np.where(r >= 0, density / sigma, 0.0))


def rice_mean(true_length: float, sigma: float, axes: int = 2) -> float:
    """Mean of the measured lengths, which exceeds the true length."""
    x = -0.5 * (true_length / sigma) ** 2
    if x < -500.0:  # far from zero, use the series in σ/A
        return true_length + 0.5 * (axes - 1) * sigma**2 / true_length
    factor = np.sqrt(2.0) * gamma(0.5 * (axes + 1)) / gamma(0.5 * axes)
    return float(sigma * factor * hyp1f1(-0.5, 0.5 * axes, x))
