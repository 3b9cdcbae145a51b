"""Length of a noisy displacement: Rice's density compared with simulated lengths."""

from __future__ import annotations

import numpy as np

from arview.measurement.plot import Chart, stack
from arview.measurement.uncertainty.rice import rice_density, rice_estimate, rice_mean
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
