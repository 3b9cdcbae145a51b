"""Noise of the points: bias and spread of the registration to the exact surface compared with a cylinder fit."""

from __future__ import annotations

import numpy as np

from arview.geometry import Array
from arview.measurement.cloud.registration import register_to_surface
from arview_lab.chart import Chart, stack
from arview_lab.cloud.shape_fits import fit_cylinder
from arview_lab.studies.common import EXACT, Study, over_cores, post, sideways

COUNT = 10_000
LEVELS_MM = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5)
TRUE_MM = 1.0
METHODS = ("registration", "cylinder fit")


def noise_study(is_quick: bool = False, seed: int = 0) -> Study:
    """Register a post displaced by 1 mm, with 10,000 points of its wall and top and Gaussian noise along each axis.

    The bias is that of the length of the displacement in the plane; the cylinder is fitted to the points of the wall.
    """
    runs, count = (6, 2000) if is_quick else (100, COUNT)
    surface, center = post()
    up = np.array([0.0, 0.0, 1.0])

    def run(job: tuple[float, int]) -> Array:
        """(2,3) displacement by both methods; the cylinder does not determine the height."""
        sigma, k = job
        rng = np.random.default_rng([seed, k, round(sigma * 1000)])
        points, faces = surface.spread(round(count / 0.9167), int(rng.integers(1 << 31)))
        seen = surface.face_normals[faces][:, 2] > -0.5
        shift = sideways(rng.uniform(0.0, 2.0 * np.pi), TRUE_MM)
        points, is_wall = points[seen] + shift, surface.face_normals[faces[seen]][:, 2] < 0.5
        points = points + rng.normal(0.0, sigma, points.shape)
        fit = register_to_surface(points, surface, center=center, options=EXACT)
        cylinder = fit_cylinder(points[is_wall], up)
        turn = np.array([[shift[0], shift[1], 0.0], [-shift[1], shift[0], 0.0], [0.0, 0.0, TRUE_MM]]) / TRUE_MM
        return np.stack([turn @ -fit.twist[3:], turn @ (cylinder.axis_at(center, up) - center)])

    jobs = [(sigma, k) for sigma in LEVELS_MM for k in range(runs)]
    found = np.asarray(over_cores(run, jobs)).reshape(len(LEVELS_MM), runs, 2, 3)
    length = np.linalg.norm(found[..., :2], axis=-1)
    rows: list[tuple[object, ...]] = []
    bias = Chart("Bias of the displacement in the plane", "noise of a point / mm", "bias / um")
    spread = Chart("Spread of the displacement in the plane", "noise of a point / mm", "standard deviation / um")
    for m, method in enumerate(METHODS):
        error_um = 1e3 * (length[:, :, m] - TRUE_MM)
        height_um = 1e3 * found[:, :, m, 2]
        for s, sigma in enumerate(LEVELS_MM):
            rows.append((
                method, sigma, float(error_um[s].mean()), float(error_um[s].std()),
                float(error_um[s].std() / np.sqrt(runs)), float(height_um[s].mean()), float(height_um[s].std()), runs,
            ))  # fmt: skip
        bias.add(LEVELS_MM, error_um.mean(axis=1), method)
        spread.add(LEVELS_MM, error_um.std(axis=1), method)
    columns = (
        "method",
        "sigma_mm",
        "bias_um",
        "std_um",
        "standard_error_um",
        "height_bias_um",
        "height_std_um",
        "runs",
    )
    at_04 = [row for row in rows if row[1] == 0.4]
    summary = tuple(f"{row[0]}: bias {row[2]:.2f} um, spread {row[3]:.2f} um at 0.4 mm" for row in at_04)
    return Study("noise", {"noise": (columns, rows)}, stack([bias.draw(), spread.draw()]), summary)
