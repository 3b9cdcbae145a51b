"""Registration of points to points (ICP), for references that are scans and for the studies.

Point to point (Besl & McKay 1992), point to plane (Chen & Medioni 1992) and generalized ICP, plane to plane (Segal,
Haehnel & Thrun 2009). arview itself registers to the exact surface of the CAD: `arview.measurement.cloud.registration`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from arview.core.fits import fit_similarity
from arview.errors import InputError
from arview.geometry import Array, apply
from arview.measurement.cloud.registration import move_about

Method = Literal["point", "plane", "generalized"]
"""Distance that is minimised."""


@dataclass(frozen=True)
class IcpOptions:
    """Options of ICP between clouds.

    Attributes:
        method: distance that is minimised: to the point, to the plane at the point, or between planes at both points.
        threshold_mm, threshold_deg: converged when a step moves the centre and rotates the points by less than this.
        max_iterations: point to point needs tens where surfaces slide.
        first_distance_mm: largest distance of a pair in the first iteration; it halves in every iteration.
        last_distance_mm: lower bound of that distance.
        trim: share of the pairs, those farthest apart, that is left out.
        neighbours: points from which a normal is estimated.
        flatness: for generalized ICP, variance along the normal divided by that across it (Segal's epsilon).
    """

    method: Method = "plane"
    threshold_mm: float = 1e-4
    threshold_deg: float = 1e-4
    max_iterations: int = 200
    first_distance_mm: float = 10.0
    last_distance_mm: float = 5.0
    trim: float = 0.0
    neighbours: int = 12
    flatness: float = 1e-3


@dataclass(frozen=True)
class IcpResult:
    """Result of ICP.

    Attributes:
        target_from_source: (4,4) mm.
        rms_mm: root mean square distance of the pairs.
        overlap: share of the source points that have a partner.
        iterations, converged: of the iteration.
    """

    target_from_source: Array
    rms_mm: float
    overlap: float
    iterations: int
    converged: bool


class IcpTarget:
    """A cloud to which others are registered, with its search tree and normals.

    Args:
        points: (N,3) mm.
        normals: (N,3) unit; estimated when not given.
        neighbours: points from which a normal is estimated.

    Raises:
        InputError: there are too few points, or one is not finite.
    """

    def __init__(self, points: Array, normals: Array | None = None, neighbours: int = 12) -> None:
        from scipy.spatial import cKDTree

        self.points = np.ascontiguousarray(points, dtype=np.float64)
        if len(self.points) < neighbours or not np.isfinite(self.points).all():
            raise InputError(f"reference cloud: expected at least {neighbours} points, all finite")
        self.tree = cKDTree(self.points)
        self.normals = estimate_normals(self.points, self.tree, neighbours) if normals is None else normals


def estimate_normals(points: Array, tree: Any = None, neighbours: int = 12) -> Array:
    """(N,3) unit normals of planes through the nearest points of each; their sign is arbitrary."""
    from scipy.spatial import cKDTree

    search = cKDTree(points) if tree is None else tree
    _, near = search.query(points, k=min(neighbours, len(points)))
    around = points[near] - points[near].mean(axis=1, keepdims=True)
    _, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", around, around))
    return np.asarray(vectors[:, :, 0])


def register_clouds(
    source: Array, target: IcpTarget, start: Array | None = None, options: IcpOptions | None = None
) -> IcpResult:
    """Register points (N,3) to a cloud.

    Raises:
        InputError: there are fewer than 6 pairs within the distance.
    """
    o = options or IcpOptions()
    source = np.asarray(source, dtype=np.float64)
    pose = np.eye(4) if start is None else start
    center = apply(pose, source).mean(axis=0)
    own_normals = estimate_normals(source, None, o.neighbours) if o.method == "generalized" else source
    limit, converged = o.first_distance_mm, False
    iterations = 0
    while iterations < o.max_iterations:
        iterations += 1
        moved = apply(pose, source)
        distance, index = target.tree.query(moved, distance_upper_bound=limit)
        pairs = np.flatnonzero(np.isfinite(distance))
        if o.trim > 0.0 and len(pairs):
            pairs = pairs[distance[pairs] <= np.quantile(distance[pairs], 1.0 - o.trim)]
        if len(pairs) < 6:
            raise InputError(f"registration: {len(pairs)} of {len(source)} points have a partner within {limit:g} mm")
        x, y, n = moved[pairs], target.points[index[pairs]], target.normals[index[pairs]]
        if o.method == "point":
            step = fit_similarity(x, y, 1.0)[1]
        elif o.method == "plane":
            rows = np.hstack([np.cross(x - center, n), n])
            step = _step(rows.T @ rows, rows.T @ np.sum(n * (x - y), axis=1), center)
        else:
            step = _plane_to_plane(x, y, n, own_normals[pairs] @ pose[:3, :3].T, center, o.flatness)
        pose = step @ pose
        shift = float(np.linalg.norm(apply(step, center) - center))
        turn = float(np.rad2deg(np.linalg.norm(step[:3, :3] - np.eye(3)) / np.sqrt(2.0)))
        if shift < o.threshold_mm and turn < o.threshold_deg:
            converged = True
            break
        limit = max(o.last_distance_mm, 0.5 * limit)
    rms = float(np.sqrt(np.mean(distance[pairs] ** 2)))
    return IcpResult(pose, rms, len(pairs) / len(source), iterations, converged)


def _step(hessian: Array, gradient: Array, center: Array) -> Array:
    """Gauss–Newton step about a centre; directions without information are left at zero."""
    scales = 1.0 / np.sqrt(np.maximum(np.diag(hessian), 1e-12))
    values, vectors = np.linalg.eigh(hessian * np.outer(scales, scales))
    kept = values > 1e-6
    inverse = (vectors[:, kept] / values[kept]) @ vectors[:, kept].T
    return move_about(center, -scales * (inverse @ (scales * gradient)))


def _plane_to_plane(x: Array, y: Array, n: Array, m: Array, center: Array, flatness: float) -> Array:
    """A step of generalized ICP: pairs weighted by the planes at both points, with normals n at y and m at x."""
    # Each point has covariance I − (1 − ε) n nᵀ; a pair is weighted by the inverse of their sum.
    loss = 1.0 - flatness
    covariance = 2.0 * np.eye(3) - loss * (n[:, :, None] * n[:, None] + m[:, :, None] * m[:, None])
    weight = np.linalg.inv(covariance)
    jacobian = np.zeros((len(x), 3, 6))
    arm = x - center
    jacobian[:, 0, 1], jacobian[:, 1, 2], jacobian[:, 2, 0] = arm[:, 2], arm[:, 0], arm[:, 1]
    jacobian[:, 1, 0], jacobian[:, 2, 1], jacobian[:, 0, 2] = -arm[:, 2], -arm[:, 0], -arm[:, 1]
    jacobian[:, :, 3:] = np.eye(3)
    weighted = weight @ jacobian
    hessian = np.einsum("nij,nik->jk", jacobian, weighted)
    gradient = np.einsum("nij,ni->j", weighted, x - y)
    return _step(hessian, gradient, center)
