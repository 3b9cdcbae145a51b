"""Density of reference and measured points: bias and cost of a registration without noise."""

from __future__ import annotations

import time

import numpy as np

from arview.geometry import Array, apply
from arview.measurement.cloud.registration import register_to_surface
from arview_lab.chart import Chart
from arview_lab.cloud.icp import (
    IcpOptions,
    IcpTarget,
    Method,
    register_clouds,
)
from arview_lab.studies.common import EXACT, Study, over_cores, post, sideways

ROWS = (
    ("a", 240_965, 240_965),
    ("b", 24_099, 24_099),
    ("c", 240_965, 24_099),
    ("d", 240_965, 2_411),
)
"""Name, points of the reference, measured points."""
TRUE_MM = 1.0
_TIMED = 5
"""Runs whose CPU time is measured."""


def density_study(
    is_quick: bool = False, seed: int = 0, runs: int | None = None, cloud_runs: int | None = None, rows: str = "abcd"
) -> Study:
    """Register a post displaced by 1 mm to its exact surface, and by ICP to sampled references.

    The exact surface needs no reference points: its rows differ in the measured points only. Every run samples both
    clouds anew. CPU seconds are the mean of the first runs, including search tree and normals of the reference, but not
    sampling.

    Args:
        is_quick: few runs, with a tenth of the points.
        seed: of the samples.
        runs: with the exact surface, default 500.
        cloud_runs: with sampled references, default 500.
        rows: which rows.
    """
    runs, cloud_runs = (2, 2) if is_quick else (runs or 500, cloud_runs or 500)
    surface, center = post()
    table: list[tuple[object, ...]] = []
    chart = Chart("Mean error against measured points", "measured points", "mean error / um", True, True)
    summary = []
    methods: tuple[Method, ...] = ("plane", "point")
    for method in ("exact", *methods):
        xs, ys = [], []
        for name, reference, measured in (row for row in ROWS if row[0] in rows):
            if is_quick:
                reference, measured = reference // 10, measured // 10
            number = runs if method == "exact" else cloud_runs
            jobs = [[seed, k, reference, measured] for k in range(number)]

            def one(job: list[int], method: str = method) -> tuple[Array, float]:
                rng = np.random.default_rng(job)
                points, _ = surface.spread(job[3], int(rng.integers(1 << 31)))
                shift = sideways(rng.uniform(0.0, 2.0 * np.pi), TRUE_MM)
                points = points + shift
                turn = np.array([[shift[0], shift[1], 0.0], [-shift[1], shift[0], 0.0], [0.0, 0.0, 1.0]])
                if method == "exact":
                    start = time.process_time()
                    pose = register_to_surface(points, surface, center=center, options=EXACT).surface_from_points
                else:
                    target, faces = surface.spread(job[2], int(rng.integers(1 << 31)))
                    start = time.process_time()
                    options = IcpOptions(method="plane" if method == "plane" else "point")
                    cloud = IcpTarget(target, surface.face_normals[faces])
                    pose = register_clouds(points, cloud, options=options).target_from_source
                spent = time.process_time() - start
                return turn @ (center - apply(pose, center + shift)), spent

            # The first runs are made alone, because process time includes runs in other threads.
            alone = [one(job) for job in jobs[:_TIMED]]
            done = alone + over_cores(one, jobs[_TIMED:])
            errors = 1e3 * np.array([error for error, _ in done])
            length = np.linalg.norm(errors, axis=1)
            cpu = float(np.mean([seconds for _, seconds in alone]))
            table.append((
                name, reference if method != "exact" else 0, measured, method, float(errors[:, 0].mean()),
                float(errors[:, 2].mean()), float(length.mean()), float(length.max()), cpu, number,
            ))  # fmt: skip
            xs.append(measured)
            ys.append(float(length.mean()))
            summary.append(
                f"({name}) {method}: mean bias {errors[:, 0].mean():.4f} um along, {errors[:, 2].mean():.4f} um up, "
                f"mean error {length.mean():.4f} um, {number} runs"
            )
        order = np.argsort(xs)
        chart.add(np.array(xs)[order], np.array(ys)[order], {"plane": "point to plane", "point": "point to point"}.get(
            method, "exact surface"), "points")  # fmt: skip
    columns = (
        "row", "reference_points", "measured_points", "method", "bias_along_um", "bias_up_um", "mean_error_um",
        "largest_error_um", "cpu_s", "runs",
    )  # fmt: skip
    return Study("density", {"density": (columns, table)}, chart.draw(), tuple(summary))
