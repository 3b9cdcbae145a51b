"""Down-sampling of a one-sided scan: grid average, random choice, and choice by information."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from arview.geometry import Array, apply
from arview.measurement.cloud.mesh_surface import MeshSurface
from arview.measurement.cloud.points import CloudPoints, grid_average
from arview.measurement.cloud.registration import register_to_surface
from arview_lab.chart import Chart
from arview_lab.studies.common import EXACT, Study, over_cores, post, sideways

SIGMA_MM = 0.1
"""Noise of a point along each axis."""
COUNT = 24_099
"""Points of the scan."""
KEPT = (100, 300, 1000, 3000)
"""Points that are kept."""
METHODS = ("every point", "grid average", "random", "by information")
TRUE_MM = 1.0
SCANNER = np.array([0.94, 0.0, 0.34])
"""Direction of the scanner: from the side, 20° above the plate, so that the top is seen at a flat angle."""


def sampling_study(is_quick: bool = False, seed: int = 0) -> Study:
    """Register a displaced post from fewer and fewer points of a scan from one side.

    The density of the scan falls with the angle at which a surface is seen, so that a random choice keeps hardly a
    point of the top, which alone determines the height.
    """
    runs, count = (6, 4000) if is_quick else (60, COUNT)
    levels = KEPT[:3] if is_quick else KEPT
    surface, center = post()
    jobs = [
        (method, kept, k)
        for method in METHODS
        for kept in (levels if method != METHODS[0] else (count,))
        for k in range(runs)
    ]

    def run(job: tuple[str, int, int]) -> tuple[Array, int]:
        method, kept, k = job
        rng = np.random.default_rng([seed, k])
        points, normals = scan(surface, count, rng)
        shift = sideways(rng.uniform(0.0, 2.0 * np.pi), TRUE_MM)
        noisy = points + rng.normal(0.0, SIGMA_MM, points.shape)
        chosen = _thinned(method, noisy, normals, kept, rng) + shift
        options = replace(EXACT, min_points=20)
        pose = register_to_surface(chosen, surface, center=center, options=options).surface_from_points
        return center - apply(pose, center + shift), len(chosen)

    found = over_cores(run, jobs)
    rows: list[tuple[object, ...]] = []
    chart = Chart("Error against points kept", "points kept", "rms error of the centre / um", True, True)
    summary = []
    for method in METHODS:
        xs, ys = [], []
        for kept in levels if method != METHODS[0] else (count,):
            mine = [found[i] for i, job in enumerate(jobs) if job[0] == method and job[1] == kept]
            errors = 1e3 * np.array([error for error, _ in mine])
            rms = np.sqrt(np.mean(errors**2, axis=0))
            total, points = float(np.sqrt((rms**2).sum())), float(np.mean([number for _, number in mine]))
            rows.append((method, kept, round(points), *(float(v) for v in rms), total, runs))
            xs.append(points)
            ys.append(total)
            summary.append(f"{method}, {points:.0f} points: rms error {total:.1f} um, of which up {rms[2]:.1f} um")
        chart.add(xs, ys, method, "points" if len(xs) == 1 else "line")
    columns = ("method", "kept", "points", "rms_x_um", "rms_y_um", "rms_up_um", "rms_um", "runs")
    return Study("sampling", {"sampling": (columns, rows)}, chart.draw(), tuple(summary))


def scan(surface: MeshSurface, count: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """About ``count`` points (N,3) as the scanner sees them, and their normals; the density falls with the angle."""
    points, faces = surface.spread(6 * count, int(rng.integers(1 << 31)))
    normals = surface.face_normals[faces]
    facing = np.maximum(normals @ SCANNER, 0.0) ** 2
    chosen = np.flatnonzero(rng.random(len(points)) < count * facing / facing.sum())
    return points[chosen], normals[chosen]


def by_information(points: Array, normals: Array, count: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Indices (count,) of points, chosen at random by their leverage (Ma, Mahoney & Yu, JMLR 2015).

    The leverage is a point's share of what is known about the six motions; a few points that alone determine one of
    them have as much together as the many for another. Choosing the best points for each motion in turn (Gelfand et
    al., 3DIM 2003) takes those at the rims, where noise makes it uncertain which face they belong to.
    """
    center = points.mean(axis=0)
    radius = float(np.sqrt(np.mean(np.sum((points - center) ** 2, axis=1))))
    rows = np.hstack([np.cross(points - center, normals) / radius, normals])
    values, vectors = np.linalg.eigh(rows.T @ rows / len(rows))
    kept = values > 1e-4
    leverage = np.sum((rows @ vectors[:, kept]) ** 2 / values[kept], axis=1)
    return rng.choice(len(points), min(count, len(points)), replace=False, p=leverage / leverage.sum())


def _thinned(method: str, points: Array, normals: Array, kept: int, rng: np.random.Generator) -> Array:
    """(M,3) about ``kept`` points."""
    if method == METHODS[0] or kept >= len(points):
        return points
    if method == "random":
        return points[rng.permutation(len(points))[:kept]]
    if method == "by information":
        return points[by_information(points, normals, kept, rng)]
    whole = CloudPoints(points, normals, np.ones(len(points)))
    low, high = 0.05, 40.0
    for _ in range(18):  # the cell that leaves as many points as are wanted
        cell = float(np.sqrt(low * high))
        low, high = (cell, high) if len(grid_average(whole, cell)) > kept else (low, cell)
    return grid_average(whole, high).points
