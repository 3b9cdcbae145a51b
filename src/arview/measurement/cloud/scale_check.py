"""Scale of a cloud against the CAD: a similarity fitted to the base, whose size is known best.

A scanner that is not calibrated, or a wrong unit of its targets, makes a cloud some tenths of a percent too large. The
displacements of components then grow with their distance from the datums, and look like errors of the part.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from arview.cad import Model
from arview.core.fits import robust_sigma
from arview.errors import InputError
from arview.geometry import Array, exp_so3, rigid
from arview.measurement.cloud.mesh_surface import MeshSurface
from arview.measurement.cloud.points import prepare_cloud
from arview.reconstruction import DenseCloud

REACH_MM = 4.0
"""Points farther from the base are left out in the first step."""
NOISE_MM = 0.15
"""Width of the kernel in the last step, unless the noise is larger."""
GRID_MM = 1.0
"""The cloud is averaged on this grid."""
MAX_POINTS = 60_000
"""Points that are used."""
FORM_MM = 0.03
"""Standard uncertainty of the base's own length."""
SIGNIFICANT = 3.0
"""Standard deviations above which a scale contradicts the CAD."""
MIN_EXCESS = 3e-4
"""Smaller relative differences are not reported as contradictions."""
STEPS = 15
"""Largest number of steps of the fit of the scale."""


@dataclass(frozen=True)
class CloudScale:
    """Size of a cloud over that of the CAD.

    Attributes:
        factor: 1.003 if the cloud is 0.3 % too large.
        std: standard uncertainty of it.
        is_contradiction: it differs from 1 beyond chance.
    """

    factor: float
    std: float
    is_contradiction: bool


def cloud_scale(cloud: DenseCloud, model: Model, names: tuple[str, ...]) -> CloudScale | None:
    """Scale of a cloud, in mm and in the rough frame of the CAD, from its points on some components; None if unknown.

    Args:
        cloud: within some mm of the CAD.
        model: the nominal CAD.
        names: components of the base.
    """
    parts = [model.component(name) for name in names]
    offsets = np.cumsum([0, *(len(part.vertices_in_model) for part in parts)])
    vertices = np.concatenate([part.vertices_in_model for part in parts])
    surface = MeshSurface(
        vertices, np.concatenate([p.faces + start for p, start in zip(parts, offsets[:-1], strict=True)])
    )
    box = np.stack([vertices.min(axis=0) - REACH_MM, vertices.max(axis=0) + REACH_MM])
    try:
        points = prepare_cloud(cloud, box, GRID_MM, 500).points
    except InputError:
        return None
    if len(points) > MAX_POINTS:
        points = points[np.random.default_rng(0).permutation(len(points))[:MAX_POINTS]]
    size = 0.5 * float(np.linalg.norm(np.ptp(vertices, axis=0)))
    fit = _fit(points, surface, size)
    if fit is None:
        return None
    factor, std = fit
    std = float(np.hypot(std, FORM_MM / size))
    excess = abs(factor - 1.0)
    return CloudScale(factor, std, excess > max(SIGNIFICANT * std, MIN_EXCESS))


def _fit(points: Array, surface: MeshSurface, size: float) -> tuple[float, float] | None:
    """Factor and standard deviation by Gauss-Newton on seven parameters with Tukey's weights; None if undetermined."""
    center = points.mean(axis=0)
    pose, shrink = np.eye(4), 1.0
    width = REACH_MM
    for _ in range(STEPS):
        moved = shrink * (points @ pose[:3, :3].T + pose[:3, 3])
        closest = surface.closest(moved, width)
        near = (closest.faces >= 0) & ~closest.is_edge
        if np.count_nonzero(near) < 200:
            return None
        x, n, r = moved[near] - center, closest.normals[near], closest.distances[near]
        rows = np.hstack([np.cross(x, n) / size, n, np.sum(n * x, axis=1)[:, None] / size])
        weights = (1.0 - np.minimum(np.abs(r) / width, 1.0) ** 2) ** 2
        hessian = (rows * weights[:, None]).T @ rows
        values = np.linalg.eigvalsh(hessian)
        if values[0] < 1e-5 * weights.sum():
            return None
        inverse = np.linalg.inv(hessian)
        step = -inverse @ ((rows * weights[:, None]).T @ r)
        # About the centre: x → (1 + s) R x + t; kept as a rigid motion after a scaling about the origin.
        turn, grown = exp_so3(step[:3] / size), 1.0 + step[6] / size
        total = grown * shrink
        rotation = turn @ pose[:3, :3]
        shift = grown * turn @ (shrink * pose[:3, 3] - center) + center + step[3:6]
        pose, shrink = rigid(rotation, shift / total), total
        sigma = robust_sigma(r)
        width = max(0.5 * width, 4.7 * sigma, NOISE_MM)
    spread = float(np.sqrt(np.average(r**2, weights=weights)))
    return 1.0 / shrink, float(np.sqrt(inverse[6, 6])) * 10.0 * spread / size
