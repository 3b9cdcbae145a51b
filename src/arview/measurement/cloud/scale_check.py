"""Scale of a cloud against the CAD: a similarity fitted to the base, whose size is known best.

A scanner that is not calibrated, or a wrong unit of its targets, makes a cloud some tenths of a percent too large. The
displacements of components then grow with their distance from the datums, and look like errors of the part.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from arview.cad import Model
from arview.core.fits import TUKEY_SIGMAS, robust_sigma, tukey_weights
from arview.errors import InputError
from arview.geometry import Array, exp_so3, rigid
from arview.measurement.cloud.enlarged import enlargement
from arview.measurement.cloud.mesh_surface import MeshSurface
from arview.measurement.cloud.points import prepare_cloud
from arview.reconstruction import DenseCloud, Similarity

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
MIN_NORMAL_COSINE = 0.3
"""Points whose normal makes a larger angle with the surface's belong to another face."""
DAMPING = 1e-6
"""Addition to the normal matrix, over its trace."""
MIN_INFORMATION = 1e-5
"""Motions with less information per point are open."""
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
    by = enlargement(model)
    vertices = by * np.concatenate([part.vertices_in_model for part in parts])
    surface = MeshSurface(
        vertices, np.concatenate([p.faces + start for p, start in zip(parts, offsets[:-1], strict=True)])
    )
    box = np.stack([vertices.min(axis=0) - REACH_MM, vertices.max(axis=0) + REACH_MM])
    try:
        points = prepare_cloud(replace(cloud, points=cloud.points * by), box, GRID_MM, 500).points
    except InputError:
        return None
    if len(points) > MAX_POINTS:
        points = points[np.random.default_rng(0).permutation(len(points))[:MAX_POINTS]]
    size = 0.5 * float(np.linalg.norm(np.ptp(vertices, axis=0)))
    fit = fit_similarity_to_surface(points, surface, size, REACH_MM, NOISE_MM, min_points=200)
    if fit is None or fit.scale_std is None:
        return None
    factor, std = 1.0 / fit.similarity.scale, float(np.hypot(fit.scale_std, by * FORM_MM / size))
    excess = abs(factor - 1.0)
    return CloudScale(factor, std, excess > max(SIGNIFICANT * std, MIN_EXCESS))


@dataclass(frozen=True)
class SurfaceSimilarity:
    """A similarity of points to a surface, and the relative standard deviation of its scale.

    ``scale_std`` is None where the points leave a motion open.
    """

    similarity: Similarity
    scale_std: float | None


def fit_similarity_to_surface(
    points: Array,
    surface: MeshSurface,
    size: float,
    reach_mm: float,
    noise_mm: float,
    start: Similarity | None = None,
    normals: Array | None = None,
    min_points: int = 50,
) -> SurfaceSimilarity | None:
    """Scale and motion of points onto a surface; None if too few points are near it.

    Gauss-Newton on seven parameters with Tukey's weights.

    Args:
        points: (N,3).
        surface: the reference.
        size: length in mm that converts rotations and scale to mm.
        reach_mm: points farther from the surface are left out in the first step.
        noise_mm: the same in the last step, unless the noise is larger.
        start: first similarity; default: the points are where they are.
        normals: (N,3) of the points; those that face away from the surface's are left out.
        min_points: points near the surface that are needed.
    """
    found, width = start or Similarity(1.0, np.eye(4)), reach_mm
    center = found.points_in_model(points).mean(axis=0)
    for _ in range(STEPS):
        moved = found.points_in_model(points)
        closest = surface.closest(moved, width)
        near = (closest.faces >= 0) & ~closest.is_edge
        if normals is not None:
            towards = normals @ found.model_from_scan[:3, :3].T
            near &= np.sum(np.nan_to_num(closest.normals) * towards, axis=1) > MIN_NORMAL_COSINE
        if np.count_nonzero(near) < min_points:
            return None
        x, n, r = moved[near] - center, closest.normals[near], closest.distances[near]
        rows = np.hstack([np.cross(x, n) / size, n, np.sum(n * x, axis=1)[:, None] / size])
        weights = tukey_weights(TUKEY_SIGMAS * r / width)
        hessian = (rows * weights[:, None]).T @ rows
        # Damping keeps motions that a symmetric part leaves open where they are.
        damped = hessian + DAMPING * np.trace(hessian) * np.eye(7)
        step = -np.linalg.solve(damped, (rows * weights[:, None]).T @ r)
        # About the centre: x → (1 + s) R x + t.
        turn, grown = exp_so3(step[:3] / size), 1.0 + step[6] / size
        pose = found.model_from_scan
        shift = grown * turn @ (pose[:3, 3] - center) + center + step[3:6]
        found = Similarity(grown * found.scale, rigid(turn @ pose[:3, :3], shift))
        width = max(0.5 * width, TUKEY_SIGMAS * robust_sigma(r), noise_mm)
    if np.linalg.eigvalsh(hessian)[0] < MIN_INFORMATION * weights.sum():
        return SurfaceSimilarity(found, None)
    spread = float(np.sqrt(np.average(r**2, weights=weights)))
    return SurfaceSimilarity(found, float(np.sqrt(np.linalg.inv(hessian)[6, 6])) * 10.0 * spread / size)
