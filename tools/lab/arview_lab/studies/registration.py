"""The classical ICP beside the registration to the exact surface, on the same clouds."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from arview.errors import InputError
from arview.geometry import Array, apply
from arview.measurement.cloud.mesh_surface import MeshSurface
from arview.measurement.cloud.points import CloudPoints, grid_average
from arview.measurement.cloud.registration import register_to_surface
from arview_lab.chart import Chart
from arview_lab.cloud.classical_icp import ClassicalIcpOptions, classical_icp
from arview_lab.studies.common import EXACT, Study, post, sideways

NOISE_MM = (0.0, 0.1, 0.2, 0.4)
"""Standard deviation of a point along each axis."""
COUNT = 24_099
"""Measured points; the reference has ten times as many."""
TRUE_MM = 1.0


@dataclass(frozen=True)
class Way:
    """One way to register.

    Attributes:
        name: in the table.
        icp: options of the classical way, None for the exact surface.
        grid_mm: grid on which the measured points are averaged before the exact surface.
    """

    name: str
    icp: ClassicalIcpOptions | None = None
    grid_mm: float = 0.0


WAYS = (
    Way("exact surface"),
    Way("exact surface, grid 0.5 mm", None, 0.5),
    Way("point to point, grid 0.5 mm", ClassicalIcpOptions(steps=("point",))),
    Way("point to plane, grid 0.5 mm", ClassicalIcpOptions()),
    Way("point to point, every point", ClassicalIcpOptions(steps=("point",), grid_mm=0.0)),
    Way("point to plane, every point", ClassicalIcpOptions(grid_mm=0.0)),
)
"""The ways that are compared."""


def registration_study(is_quick: bool = False, seed: int = 0, runs: int | None = None) -> Study:
    """Register a post displaced by 1 mm in a random direction, without and with noise, in every way.

    A row also says how the same points fare as both clouds (``same points``): then the partners are exact, and only the
    iteration contributes an error.

    Args:
        is_quick: few runs with few points.
        seed: of the samples.
        runs: default 50.
    """
    runs, count = (2, 2000) if is_quick else (runs or 50, COUNT)
    surface, center = post()
    rows: list[tuple[object, ...]] = []
    summary = []
    chart = Chart("Error of registration ways", "noise of a point / mm", "mean error / um", False, True)
    for way in (*WAYS, Way("point to plane, same points", ClassicalIcpOptions(grid_mm=0.0))):
        is_same = way.name.endswith("same points")
        levels = (0.0,) if is_same else NOISE_MM
        means = []
        for sigma in levels:
            done = [_run(way, surface, center, sigma, count, [seed, k], is_same) for k in range(runs)]
            errors = 1e3 * np.array([error for error, _, _ in done])
            length = np.linalg.norm(errors, axis=1)
            cpu, points = (float(np.mean([one[i] for one in done])) for i in (1, 2))
            rows.append((
                way.name, sigma, round(points), float(errors[:, 0].mean()), float(errors[:, 0].std()),
                float(errors[:, 2].mean()), float(length.mean()), float(length.max()), cpu, runs,
            ))  # fmt: skip
            means.append(float(length.mean()))
            if sigma in (0.0, NOISE_MM[-1]):
                summary.append(
                    f"{way.name}, noise {sigma:g} mm: bias along {errors[:, 0].mean():+.3f} um, mean error "
                    f"{length.mean():.3f} um, largest {length.max():.3f} um, {cpu:.2f} s"
                )
        if not is_same:
            chart.add(levels, np.maximum(means, 1e-6), way.name)
    columns = (
        "way", "noise_mm", "points", "bias_along_um", "std_along_um", "bias_up_um", "mean_error_um",
        "largest_error_um", "cpu_s", "runs",
    )  # fmt: skip
    return Study("registration", {"registration": (columns, rows)}, chart.draw(), tuple(summary))


def _run(
    way: Way, surface: MeshSurface, center: Array, sigma: float, count: int, seeds: list[int], is_same: bool
) -> tuple[Array, float, int]:
    """(3,) error along the displacement, across and up, mm; CPU seconds; measured points."""
    rng = np.random.default_rng([*seeds, round(1000 * sigma)])
    points, faces = surface.spread(count, int(rng.integers(1 << 31)))
    shift = sideways(rng.uniform(0.0, 2.0 * np.pi), TRUE_MM)
    measured = points + shift + rng.normal(0.0, 1.0, points.shape) * sigma
    bounds = np.stack([surface.triangles.min(axis=(0, 1)), surface.triangles.max(axis=(0, 1))])
    used = len(measured)
    if way.icp is None:
        start = time.process_time()
        if way.grid_mm > 0.0:
            none = CloudPoints(measured, np.zeros_like(measured), np.ones(len(measured)))
            measured = grid_average(none, way.grid_mm).points
            used = len(measured)
        pose = register_to_surface(measured, surface, center=center, options=EXACT).surface_from_points
    else:
        reference, of_face = (points, faces) if is_same else surface.spread(10 * count, int(rng.integers(1 << 31)))
        start = time.process_time()
        try:
            found = classical_icp(measured, reference, surface.face_normals[of_face], bounds, way.icp)
        except InputError as error:
            raise InputError(f"{way.name}, noise {sigma:g} mm: {error}") from error
        pose, used = found.reference_from_measured, found.points[0]
    spent = time.process_time() - start
    turn = np.array([[shift[0], shift[1], 0.0], [-shift[1], shift[0], 0.0], [0.0, 0.0, TRUE_MM]]) / TRUE_MM
    return turn @ (center - apply(pose, center + shift)), spent, used
