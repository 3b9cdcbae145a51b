"""Global registration: the CAD in a cloud of unknown frame and, if need be, unknown scale.

Rotations that turn a principal direction of the cloud's normals onto one of the CAD's are tried all around it; for each
the translation follows from a correlation of both as voxels (by FFT, as in Padfield, CVPR 2010). The best poses are
refined on the exact surface, and the fit of the whole part decides: wrong poses of symmetric parts fit the base, but
not the components.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from arview.cad import Model
from arview.core.parallel import pool
from arview.errors import InputError
from arview.geometry import Array, apply, exp_so3, invert, rigid
from arview.measurement.cloud.mesh_surface import MeshSurface
from arview.measurement.cloud.pair_registration import find_by_pairs
from arview.measurement.cloud.scale_check import fit_similarity_to_surface
from arview.reconstruction import DenseCloud, Similarity

POINTS = 4000
"""Points of cloud and CAD each; a few for each voxel."""
VOXELS = 40
"""Voxels across the diameter: components are some voxels wide."""
STEP_DEG = 6.0
"""Step of the rotations about a principal direction; refinement converges from half of it."""
REACH, NOISE = 9.0, 0.25
"""Largest distance of points from the surface in the first and in the last step of the refinement, over the limit."""
KEPT = 12
"""Poses that are refined and compared."""
SCALE_STEP = 1.08
"""Ratio of scales that are tried when the scale is unknown."""
SCALE_RANGE = (0.7, 2.5)
"""Size of the part over the cloud's; above 1, part of it is unseen."""
LIMIT_SHARE = 0.015
"""Distances are limited to this share of the diameter."""
MIN_LEAD = 1.08
"""Cost of the next best pose over the best one's, below which it is ambiguous."""
SEED = 0
"""Seed of the choice of points."""


def find_model_in_cloud(cloud: DenseCloud, model: Model, scale: float | None = 1.0) -> Similarity:
    """Scale and rigid pose ``model_from_scan`` of the model in a cloud.

    With a known scale the search goes by pairs of points (`pair_registration`), which finds a quarter of the part among
    much else; with an unknown one by correlation, which needs a cloud of the part and little else.

    Args:
        cloud: of the part.
        model: the nominal CAD.
        scale: mm per unit of the cloud, None when unknown.

    Raises:
        InputError: there are too few points, none fits, or two poses fit alike that are not related by a symmetry.
    """
    if scale:
        own = np.asarray(cloud.points, dtype=np.float64) * scale
        sound = np.isfinite(own).all(axis=1)
        sides = np.nan_to_num(np.asarray(cloud.normals[sound], dtype=np.float64)) if cloud.normals.any() else None
        return Similarity(scale, find_by_pairs(own[sound], sides, model).model_from_scan)
    points, normals, is_oriented = _some_points(cloud)
    vertices, faces, groups = model.mesh
    surface = MeshSurface(vertices, faces, groups)
    samples, of_face = surface.spread(POINTS, SEED)
    extent = float(np.linalg.norm(np.diff(np.quantile(points, [0.01, 0.99], axis=0), axis=0)))
    scales = list(_ladder(model.diameter_mm / extent))
    turns = _turns(normals, surface.face_normals[of_face])
    places = [
        job for one in scales for job in pool().map(lambda r, s=one: _shifted(points * s, samples, r, model, s), turns)
    ]
    places.sort(key=lambda place: -place[0])
    limit_mm = LIMIT_SHARE * model.diameter_mm
    # A thin plate also fits with its top on its bottom, so there are starts displaced to both sides.
    step = 0.8 * model.diameter_mm / VOXELS * _main_axes(surface.face_normals[of_face], 1)[0]
    tried = [
        Similarity(s, rigid(np.eye(3), k * step) @ pose) for _, s, pose in _separated(places) for k in (-1.0, 0.0, 1.0)
    ]
    sides = normals if is_oriented else None
    fits = list(pool().map(lambda start: _refined(points, sides, surface, samples, start, limit_mm), tried))
    fits.sort(key=lambda fit: fit[0])
    cost, found = fits[0]
    around = _around(found.points_in_model(points), samples, limit_mm)
    cost -= around * limit_mm
    if around > 0.7 or cost > 0.6 * limit_mm * (1.0 - around):
        raise InputError("cloud: the part was not found in it: another part, or too little of it")
    for rival_cost, rival in fits[1:]:
        if rival_cost - around * limit_mm > MIN_LEAD * cost + 1e-3 * limit_mm:
            break
        moved = apply(rival.model_from_scan @ invert(found.model_from_scan), samples)
        other_mm = np.abs(surface.closest(moved).distances)
        if np.mean(np.linalg.norm(moved - samples, axis=1)) > limit_mm and np.mean(other_mm) > 0.1 * limit_mm:
            raise InputError(
                "cloud: the part fits in two ways equally, and in neither of them well: the cloud is mirrored, of "
                "another part, or shows too little of what distinguishes its sides"
            )
    return found


def _some_points(cloud: DenseCloud) -> tuple[Array, Array, bool]:
    """Points (N,3) spread evenly over a cloud, their normals, and whether these are oriented (else estimated)."""
    points, own = np.asarray(cloud.points, dtype=np.float64), np.asarray(cloud.normals, dtype=np.float64)
    sound = np.isfinite(points).all(axis=1)
    points, own = points[sound], np.nan_to_num(own[sound])
    if len(points) < 200:
        raise InputError(f"cloud: {len(points)} points are too few to find the part in it; at least 200 are needed")
    rng = np.random.default_rng(SEED)
    if len(points) > 40 * POINTS:
        few = rng.permutation(len(points))[: 40 * POINTS]
        points, own = points[few], own[few]
    low, high = np.quantile(points, [0.002, 0.998], axis=0)
    core = np.all((points >= low - 0.05 * (high - low)) & (points <= high + 0.05 * (high - low)), axis=1)
    points, own = points[core], own[core]
    # Shrink the cells until there are as many as points are wanted.
    cell = float(np.linalg.norm(high - low)) / 20.0
    for _ in range(12):
        _, first = np.unique(np.floor(points / cell).astype(np.int64), axis=0, return_index=True)
        if len(first) >= 0.7 * POINTS or len(first) > 0.5 * len(points):
            break
        cell *= 0.8
    chosen = points[first]
    if np.mean(np.linalg.norm(own, axis=1) > 0.5) > 0.9:
        return chosen, own[first], True
    _, near = cKDTree(points).query(chosen, k=min(16, len(points)))
    around = points[near] - points[near].mean(axis=1, keepdims=True)
    _, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", around, around))
    return chosen, vectors[:, :, 0], False


def _ladder(middle: float) -> Array:
    """Scales to try around a middle one, in geometric steps."""
    low, high = SCALE_RANGE
    return np.asarray(middle * np.geomspace(low, high, int(np.log(high / low) / np.log(SCALE_STEP)) + 2))


def _main_axes(normals: Array, max_count: int) -> list[Array]:
    """Principal directions of normals (N,3), at most ``max_count``, with the sign that most normals have."""
    left, found = normals[np.linalg.norm(normals, axis=1) > 0.5], []
    for _ in range(max_count):
        if len(left) < 0.03 * len(normals):
            break
        tried = left[:: max(1, len(left) // 400)]
        close = np.abs(tried @ left.T) > np.cos(np.deg2rad(5.0))
        best = close[np.argmax(close.sum(axis=1))]
        if best.sum() < 0.04 * len(normals):
            break
        _, _, axes = np.linalg.svd(left[best], full_matrices=False)
        found.append(axes[0] * (1.0 if np.mean(left[best] @ axes[0] > 0) >= 0.5 else -1.0))
        left = left[np.abs(left @ axes[0]) < np.cos(np.deg2rad(15.0))]
    return found or [np.array([0.0, 0.0, 1.0])]


def _turns(of_cloud: Array, of_model: Array) -> list[Array]:
    """Rotations (3,3) that turn the cloud's main direction onto one of the model's, either side up, all around it."""
    turns, angles = [], np.arange(0.0, 360.0, STEP_DEG)
    for target in _main_axes(of_model, 2):
        for sign in (1.0, -1.0):
            first = _between(sign * _main_axes(of_cloud, 1)[0], target)
            turns += [exp_so3(np.deg2rad(angle) * target) @ first for angle in angles]
    return turns


def _between(a: Array, b: Array) -> Array:
    """(3,3) smallest rotation of one unit vector onto another."""
    axis, cosine = np.cross(a, b), float(a @ b)
    if np.linalg.norm(axis) < 1e-9:
        across = np.cross(a, np.eye(3)[np.argmin(np.abs(a))])
        return np.eye(3) if cosine > 0 else exp_so3(np.pi * across / np.linalg.norm(across))
    return exp_so3(axis / np.linalg.norm(axis) * np.arctan2(np.linalg.norm(axis), cosine))


def _shifted(points: Array, samples: Array, turn: Array, model: Model, scale: float) -> tuple[float, float, Array]:
    """Best translation of rotated points: normalised score, scale, and pose (4,4) of the scaled points."""
    from scipy import fft

    turned = points @ turn.T
    cell = max(model.diameter_mm / VOXELS, float(np.ptp(turned, axis=0).max()) / 90.0)
    of_points, low = _voxels(turned, cell)
    of_model, low_model = _voxels(samples, cell)
    shape = [fft.next_fast_len(a + b, real=True) for a, b in zip(of_points.shape, of_model.shape, strict=True)]
    spectrum = fft.rfftn(of_model, shape) * np.conj(fft.rfftn(of_points, shape))
    score = fft.irfftn(spectrum, shape)
    best = np.array(np.unravel_index(int(np.argmax(score)), score.shape))
    best = np.where(best > np.array(of_model.shape), best - np.array(shape), best)
    shift = low_model - low + best * cell
    size = np.sqrt(float((of_points**2).sum()) * float((of_model**2).sum()))
    return float(score.max()) / size, scale, rigid(turn, shift)


def _voxels(points: Array, cell: float) -> tuple[Array, Array]:
    """Occupied cells, blurred, and the corner of the first cell."""
    from scipy.ndimage import gaussian_filter

    low = points.min(axis=0) - 2.0 * cell
    index = np.floor((points - low) / cell).astype(np.int64)
    grid = np.zeros(index.max(axis=0) + 3)
    grid[tuple(index.T)] = 1.0
    return gaussian_filter(grid, 0.8), low


def _separated(places: list[tuple[float, float, Array]]) -> list[tuple[float, float, Array]]:
    """The best poses, without those close to a better one."""
    kept: list[tuple[float, float, Array]] = []
    for score, scale, pose in places:
        turns = [np.trace(other[:3, :3].T @ pose[:3, :3]) for _, s, other in kept if abs(s / scale - 1.0) < 0.04]
        if all(turn < 1.0 + 2.0 * np.cos(np.deg2rad(2.5 * STEP_DEG)) for turn in turns):
            kept.append((score, scale, pose))
        if len(kept) == KEPT:
            break
    return kept


def _refined(
    points: Array, normals: Array | None, surface: MeshSurface, samples: Array, start: Similarity, limit_mm: float
) -> tuple[float, Similarity]:
    """Cost and place on the exact surface of points, refined as a similarity."""
    size = 0.25 * float(np.linalg.norm(np.ptp(samples, axis=0)))
    fit = fit_similarity_to_surface(points, surface, size, REACH * limit_mm, NOISE * limit_mm, start, normals)
    if fit is None:
        return np.inf, start
    found = fit.similarity
    # Distances both ways: from points to the surface and from the surface to points. What lies around the part costs
    # the same for every pose.
    moved = found.points_in_model(points)
    closest = surface.closest(moved)
    of_points = np.minimum(np.abs(closest.distances), limit_mm)
    if normals is not None:
        of_points[np.sum(closest.normals * (normals @ found.model_from_scan[:3, :3].T), axis=1) < 0.0] = limit_mm
    apart = cKDTree(moved).query(samples)[0]
    to_points = np.clip(apart - 2.0 * np.median(apart), 0.0, limit_mm)  # less the spacing of the points
    return float(of_points.mean() + 0.3 * to_points.mean()), found


def _around(points: Array, samples: Array, limit_mm: float) -> float:
    """Share of points (N,3) outside the model's bounding box, which are not part of it."""
    low, high = samples.min(axis=0) - limit_mm, samples.max(axis=0) + limit_mm
    return 1.0 - float(np.mean(np.all((points > low) & (points < high), axis=1)))
