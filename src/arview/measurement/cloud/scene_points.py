"""A cloud prepared for the search of a part in it: thinned, without strays and the plane it stands on, with normals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from arview.errors import InputError
from arview.geometry import Array
from arview.measurement.cloud.open3d_library import load_open3d

Flags = NDArray[np.bool_]


MAX_POINTS = 400_000
"""Points that are looked at, at random if there are more."""
COARSE = 0.014
"""Cell of the grid for pairs, in diameters of the part."""
FINE = 0.006
"""Cell of the grid for judging places, in diameters of the part."""
MAX_COARSE = 9000
"""Points for pairs; with more the cells grow."""
NORMAL_NEIGHBOURS = 24
"""Points from which a normal is estimated."""
STRAY_NEIGHBOURS = 12
"""Points whose mean distance tells strays."""
STRAY_SIGMAS = 3.0
"""Standard deviations above the mean distance."""
PLANE_TOLERANCE = 0.004
"""Distance within which points are on a plane."""
PLANE_EXCESS = 1.25
"""A plane wider than the part by this factor is what it stands on."""
MAX_PLANES = 3
"""Planes that are removed."""
MIN_POINTS = 200
"""Points that a cloud needs."""
FLAT_VARIATION = 0.05
"""Least eigenvalue, as a share of all, below which neighbours lie on a surface."""
MIN_FLAT = 0.005
"""Share of such neighbourhoods below which the points lie on no surface."""
MIN_FLAT_POINTS = 1000
"""Points of a cloud from which ``MIN_FLAT`` is asked for."""
SEED = 0
"""Seed of the choice of points."""


@dataclass(frozen=True)
class ScenePoints:
    """A prepared cloud.

    Attributes:
        points, normals, weights: (N,3), (N,3), (N,) evenly spread; points of large planes have small weights.
        fine, fine_normals: (M,3) denser ones.
        fine_mm: their spacing.
        is_oriented: neighbouring normals agree in sign.
        removed: points of planes wider than the part.
    """

    points: Array
    normals: Array
    weights: Array
    fine: Array
    fine_normals: Array
    fine_mm: float
    is_oriented: bool
    removed: int


def scene_points(points: Array, normals: Array | None, diameter_mm: float) -> ScenePoints:
    """Prepare points (N,3) in mm, all finite, for the search of a part of a given diameter.

    Raises:
        InputError: too few points are left.
    """
    if len(points) < MIN_POINTS:
        raise InputError(
            f"cloud: {len(points)} points are too few to find the part in it; at least {MIN_POINTS} are needed"
        )
    if len(points) > MAX_POINTS:
        few = np.random.default_rng(SEED).permutation(len(points))[:MAX_POINTS]
        points, normals = points[few], None if normals is None else normals[few]
    has_normals = normals is not None and float(np.mean(np.linalg.norm(normals, axis=1) > 0.5)) > 0.9
    kept = ~_strays(points)
    points = points[kept]
    own = normals[kept] if has_normals and normals is not None else None
    if len(points) >= MIN_FLAT_POINTS and _flat_share(points) < MIN_FLAT:
        raise InputError(
            "cloud: its points lie on no surface, so the part is not in it; is it the right file, and are its columns "
            "x, y, z?"
        )
    estimated, is_oriented = _normals(points), False
    if own is not None:
        sign = np.sign(np.sum(estimated * own, axis=1))
        is_oriented = _is_consistent(points, own)
        estimated = estimated * np.where(sign == 0.0, 1.0, sign)[:, None] if is_oriented else estimated
    before, on_table = len(points), wide_planes(points, estimated, diameter_mm)
    points, estimated = points[~on_table], estimated[~on_table]
    if len(points) < MIN_POINTS:
        raise InputError("cloud: the part was not found in it: the cloud is flat")
    fine, cell = _thin(points, FINE * diameter_mm), COARSE * diameter_mm
    coarse = _thin(points, cell)
    while len(coarse) > MAX_COARSE:
        cell *= 1.15
        coarse = _thin(points, cell)
    weights = plane_weights(points[coarse], estimated[coarse], 0.01 * diameter_mm)
    return ScenePoints(
        np.ascontiguousarray(points[coarse]),
        np.ascontiguousarray(estimated[coarse]),
        weights,
        fine=points[fine],
        fine_normals=estimated[fine],
        fine_mm=FINE * diameter_mm,
        is_oriented=is_oriented,
        removed=before - len(points),
    )


def wide_planes(points: Array, normals: Array, diameter_mm: float) -> Flags:
    """(N,) bool, whether points are on a plane that is wider than the part, such as a table or a wall.

    Planes are found by Open3D's RANSAC, on few points.
    """
    o3d, out = load_open3d(), np.zeros(len(points), dtype=bool)
    few = _thin(points, 2.0 * COARSE * diameter_mm)
    tolerance = max(PLANE_TOLERANCE * diameter_mm, 1e-6)
    o3d.utility.random.seed(SEED)
    for _ in range(MAX_PLANES):
        rest = few[~out[few]]
        if len(rest) < 100:
            break
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points[rest]))
        plane, inliers = cloud.segment_plane(tolerance, 3, 600)
        normal, flat = np.asarray(plane[:3]), points[rest[inliers]]
        if len(flat) < 0.08 * len(rest):
            break
        axes = np.linalg.svd(flat - flat.mean(axis=0), full_matrices=False)[2]
        size = np.ptp(np.quantile((flat - flat.mean(axis=0)) @ axes[:2].T, [0.03, 0.97], axis=0), axis=0)
        is_wide = bool(np.linalg.norm(size) > PLANE_EXCESS * diameter_mm)
        near = np.abs(points @ normal + plane[3]) < tolerance
        if not is_wide:
            break
        out |= near & (np.abs(normals @ normal) > 0.8)
    return out


def plane_weights(points: Array, normals: Array, tolerance: float, share: float = 0.02) -> Array:
    """(N,) weights, small for points on large planes: a plane counts as much as a share of all points at most.

    Points are on one plane if their normals agree within 8° and they are within ``tolerance`` of it.
    """
    weights, left = np.ones(len(points)), np.arange(len(points))
    rng, limit = np.random.default_rng(0), share * len(points)
    for _ in range(60):
        if len(left) < limit:
            break
        best = np.zeros(0, dtype=np.int64)
        for index in rng.choice(left, size=min(24, len(left)), replace=False):
            normal = normals[index]
            away = np.abs((points[left] - points[index]) @ normal)
            on = left[(away < tolerance) & (np.abs(normals[left] @ normal) > 0.99)]
            best = on if len(on) > len(best) else best
        if len(best) < limit:
            break
        weights[best] = limit / len(best)
        left = np.setdiff1d(left, best, assume_unique=True)
    return weights


def _strays(points: Array) -> Flags:
    """(N,) bool, points far from their neighbours, by Open3D's statistical outlier removal."""
    o3d = load_open3d()
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    _, kept = cloud.remove_statistical_outlier(STRAY_NEIGHBOURS, STRAY_SIGMAS)
    out = np.ones(len(points), dtype=bool)
    out[np.asarray(kept)] = False
    return out


def _flat_share(points: Array) -> float:
    """Share of some points whose neighbours lie on a surface, by the surface variation of Pauly et al. (2002)."""
    few = np.random.default_rng(SEED).permutation(len(points))[:1000]
    _, near = cKDTree(points).query(points[few], k=NORMAL_NEIGHBOURS)
    around = points[near] - points[near].mean(axis=1, keepdims=True)
    sizes = np.linalg.eigvalsh(np.einsum("nki,nkj->nij", around, around))
    return float(np.mean(sizes[:, 0] <= FLAT_VARIATION * sizes.sum(axis=1)))


def _normals(points: Array) -> Array:
    """(N,3) normals of planes through neighbours, by Open3D; their sign is arbitrary."""
    o3d = load_open3d()
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(NORMAL_NEIGHBOURS))
    return np.array(cloud.normals)


def _is_consistent(points: Array, normals: Array) -> bool:
    """Whether the normals of neighbours have the same sign."""
    few = np.random.default_rng(0).permutation(len(points))[:2000]
    _, near = cKDTree(points).query(points[few], k=2)
    cosine = np.sum(normals[few] * normals[near[:, 1]], axis=1)
    cosine = cosine[np.abs(cosine) > 0.8]
    return len(cosine) > 0 and float(np.mean(cosine > 0)) > 0.95


def _thin(points: Array, cell: float) -> NDArray[np.int64]:
    """Indices of one point for each cell of a grid."""
    index = np.floor((points - points.min(axis=0)) / cell).astype(np.int64)
    size = index.max(axis=0) + 1
    _, first = np.unique((index[:, 0] * size[1] + index[:, 1]) * size[2] + index[:, 2], return_index=True)
    return np.asarray(first, dtype=np.int64)
