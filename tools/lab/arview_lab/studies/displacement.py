"""Displaced posts: estimated against true displacement, and the cost around the minimum."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from arview.geometry import Array
from arview.measurement.cloud.mesh_surface import MeshSurface
from arview.measurement.cloud.registration import register_to_surface
from arview_lab.chart import Chart, stack
from arview_lab.studies.common import EXACT, POST_MM, SECOND_POST_MM, Study, over_cores, post, sideways

SIGMA_MM = 0.1
"""Noise of a point along each axis, as in a typical reconstruction."""


def displacement_study(is_quick: bool = False, seed: int = 0) -> Study:
    """Register two posts displaced by 1–9 mm in random directions, with 24,099 noisy points, without a start."""
    runs, count = (3, 3000) if is_quick else (25, 24_099)
    rows: list[tuple[object, ...]] = []
    truth = Chart("Estimated against true displacement", "true / mm", "estimated / mm")
    errors = Chart("Error of the estimate", "true / mm", "mean error / um")
    summary = []
    for name, size in (("post 16x40", POST_MM), ("post 20x25", SECOND_POST_MM)):
        lengths = np.arange(1.0, 10.0)
        surface, center = post(size)
        jobs = [(surface, center, count, float(d), [seed, k]) for d in lengths for k in range(runs)]
        found = np.asarray(over_cores(_run, jobs)).reshape(-1, runs)
        error_um = 1e3 * (found - lengths[:, None])
        for d, estimate, error in zip(lengths, found, error_um, strict=True):
            rows.append((name, float(d), float(estimate.mean()), float(error.mean()), float(error.std()), runs))
        truth.add(lengths, found.mean(axis=1), name)
        errors.add(lengths, error_um.mean(axis=1), name)
        summary.append(f"{name}: largest mean error {np.abs(error_um.mean(axis=1)).max():.2f} um over 1-9 mm")
    shifts, cost = cost_curve(count, seed)
    near = Chart("Cost around the minimum (post 16x40)", "displacement from the minimum / mm", "RMS distance / mm")
    near.add(shifts, cost)
    curve: list[tuple[object, ...]] = [(float(a), float(b)) for a, b in zip(shifts, cost, strict=True)]
    tables = {
        "displacement": (("post", "true_mm", "mean_estimate_mm", "mean_error_um", "std_um", "runs"), rows),
        "displacement_cost": (("shift_mm", "rms_mm"), curve),
    }
    return Study("displacement", tables, stack([truth.draw(), errors.draw(), near.draw()]), tuple(summary))


def cost_curve(count: int, seed: int) -> tuple[Array, Array]:
    """Displacements (M,) in mm of a noisy post along x, and the rms distance (M,) to the surface at each."""
    surface, _ = post()
    rng = np.random.default_rng(seed)
    points, _ = surface.spread(count, seed)
    points = points + rng.normal(0.0, SIGMA_MM, points.shape)
    shifts = np.linspace(-1.0, 1.0, 81)
    cost = [np.sqrt(np.mean(surface.closest(points + sideways(0.0, float(d))).distances ** 2)) for d in shifts]
    return shifts, np.array(cost)


def _run(job: tuple[MeshSurface, Array, int, float, list[int]]) -> float:
    """Estimated length of one displacement."""
    surface, center, count, true_mm, seeds = job
    rng = np.random.default_rng([*seeds, round(true_mm * 1000)])
    points, _ = surface.spread(count, int(rng.integers(1 << 31)))
    shift = sideways(rng.uniform(0.0, 2.0 * np.pi), true_mm)
    options = replace(EXACT, first_distance_mm=max(EXACT.first_distance_mm, true_mm + 2.0))
    noisy = points + shift + rng.normal(0.0, SIGMA_MM, points.shape)
    return float(np.linalg.norm(register_to_surface(noisy, surface, center=center, options=options).twist[3:5]))
