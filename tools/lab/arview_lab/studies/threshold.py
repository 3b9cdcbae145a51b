"""Convergence threshold: error of the registration for different thresholds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from arview.geometry import Array, apply
from arview.measurement.cloud.registration import register_to_surface
from arview_lab.chart import Chart
from arview_lab.cloud.icp import (
    IcpOptions,
    IcpTarget,
    register_clouds,
)
from arview_lab.studies.common import EXACT, Study, over_cores, post, sideways

THRESHOLDS = (1e-1, 1e-2, 1e-3, 1e-4, 1e-5)
"""In mm and in degrees."""
METHODS = ("exact surface", "point to plane", "point to point", "point to point, same points")
TRUE_MM = 1.0


def threshold_study(is_quick: bool = False, seed: int = 0, runs: int = 20) -> Study:
    """Register a post displaced by 1 mm, with 24,099 points without noise, for several thresholds.

    The reference of the clouds is another sample of the surface, or the measured points themselves before they were
    moved:
    then the partners are exact, and only the threshold contributes an error.
    """
    runs, count = (2, 2000) if is_quick else (runs, 24_099)
    surface, center = post()

    def run(job: tuple[str, float, int]) -> tuple[Array, int]:
        method, threshold, k = job
        rng = np.random.default_rng([seed, k])
        points, faces = surface.spread(count, int(rng.integers(1 << 31)))
        shift = sideways(rng.uniform(0.0, 2.0 * np.pi), TRUE_MM)
        turn = np.array([[shift[0], shift[1], 0.0], [-shift[1], shift[0], 0.0], [0.0, 0.0, 1.0]])
        if method == METHODS[0]:
            options = replace(EXACT, threshold_mm=threshold, threshold_deg=threshold)
            fit = register_to_surface(points + shift, surface, center=center, options=options)
            pose, iterations = fit.surface_from_points, fit.iterations
        else:
            target, target_faces = points, faces
            if method != METHODS[3]:
                target, target_faces = surface.spread(count, int(rng.integers(1 << 31)))
            cloud = register_clouds(
                points + shift, IcpTarget(target, surface.face_normals[target_faces]),
                options=IcpOptions(
                    method="plane" if method == METHODS[1] else "point", threshold_mm=threshold,
                    threshold_deg=threshold, max_iterations=500,
                ),
            )  # fmt: skip
            pose, iterations = cloud.target_from_source, cloud.iterations
        return turn @ (center - apply(pose, center + shift)), iterations

    jobs = [(method, threshold, k) for method in METHODS for threshold in THRESHOLDS for k in range(runs)]
    done = over_cores(run, jobs)
    errors = 1e3 * np.array([error for error, _ in done]).reshape(len(METHODS), len(THRESHOLDS), runs, 3)
    steps = np.array([number for _, number in done]).reshape(len(METHODS), len(THRESHOLDS), runs)
    rows: list[tuple[object, ...]] = []
    chart = Chart("Error against threshold", "threshold / mm and deg", "mean error in the plane / um", True, True)
    summary = []
    for m, method in enumerate(METHODS):
        plane = np.linalg.norm(errors[m, :, :, :2], axis=-1)
        for t, threshold in enumerate(THRESHOLDS):
            e = errors[m, t]
            rows.append((
                method, threshold, float(e[:, 0].mean()), float(plane[t].mean()), float(e[:, 2].mean()),
                float(steps[m, t].mean()), runs,
            ))  # fmt: skip
        chart.add(THRESHOLDS, np.maximum(plane.mean(axis=1), 1e-9), method)
        at = THRESHOLDS.index(1e-4)
        summary.append(
            f"{method}: mean bias {errors[m, at, :, 0].mean():.4f} um at 1e-4, {steps[m, at].mean():.1f} iterations"
        )
    columns = ("method", "threshold", "bias_along_um", "mean_error_plane_um", "bias_up_um", "iterations", "runs")
    return Study("threshold", {"threshold": (columns, rows)}, chart.draw(), tuple(summary))
