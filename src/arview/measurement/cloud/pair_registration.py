"""The CAD in a cloud that shows a part of it among much else: search by pairs of oriented points.

A pair of points with normals that are not parallel determines a pose once it is matched with a pair of the CAD that has
the same distance and angles (Drost et al., CVPR 2010). Instead of voting, every hypothesis is scored on the points
around its pair, in a distance field of the CAD. Points on large planes count little, both in the cloud and on the CAD:
a table fits a plate's face as well as its own points do. What lies beside the CAD costs nothing, what lies inside of it
speaks against a pose.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from arview.cad import Model
from arview.core.parallel import pool, thread_count
from arview.errors import InputError
from arview.geometry import Array, apply, invert, rigid
from arview.measurement.cloud.mesh_surface import MeshSurface
from arview.measurement.cloud.pair_kernels import hypotheses, refined, scores
from arview.measurement.cloud.registration import RegistrationOptions, register_to_surface
from arview.measurement.cloud.scene_points import ScenePoints, plane_weights, scene_points

MODEL_POINTS = 2400
"""Points of the CAD whose pairs are matched."""
FIRST_PAIRS = 7000
"""Pairs of the cloud that are matched in the first round, which finds what is the main thing in the cloud."""
PAIRS = 24_000
"""Pairs of the cloud that are matched in each later round."""
PROBES = 3
"""Cells of the table in which each pair is looked up, because noise moves it between them."""
MATCHES = 40
"""Pairs of the CAD that are tried for each pair of the cloud, at random if there are more."""
PAIR_RANGE = (0.06, 0.55)
"""Distance of the points of a pair."""
DISTANCE_STEP = 0.03
"""Step of the table of pairs for distances."""
ANGLE_STEP_DEG = 12.0
"""Step of the table of pairs for angles."""
PARALLEL_DEG = 25.0
"""Normals at a smaller angle do not determine a pose."""
FIELD_CELLS = 84
"""Cells of the distance field across the diameter."""
COARSE_REACH = 0.03
"""Distance within which points support a hypothesis."""
FINE_REACH = 0.008
"""Distance within which points support a hypothesis after refinement; components may be displaced by less."""
SCORED = 160
"""Points on which a hypothesis is scored."""
REFINED = 4
"""Hypotheses of each first point that are refined in the distance field."""
KEPT = 28
"""Poses that are refined on the exact surface and compared."""
MIN_SHARE = 0.15
"""Weighted share of the CAD that must be found in the cloud."""
SURE_SHARE = 0.35
"""With as much of the CAD found, normals are not tried the other way round."""
MAX_INSIDE = 0.25
"""Share of the points near the CAD that may lie inside of it."""
MIN_LEAD = 1.06
"""Score over that of the next best pose, below which the place is ambiguous."""
LIST_BLOCK = 2_000_000
"""Distances between points that are kept in memory at a time."""
ROUNDS = 4
"""Searches with other pairs, until the part is found."""
SEED = 0
"""Seed of the choice of pairs and points."""


@dataclass(frozen=True)
class PartPlacement:
    """A place of the CAD in a cloud.

    Attributes:
        model_from_scan: (4,4).
        share: 0 to 1, weighted share of the CAD's surface that the cloud shows there.
        inside: 0 to 1, share of the points near the CAD that lie inside of it.
        is_flipped: the normals of the cloud point inward.
    """

    model_from_scan: Array
    share: float
    inside: float
    is_flipped: bool = False

    @property
    def score(self) -> float:
        """Share that is found, less what contradicts."""
        return self.share * max(0.0, 1.0 - 2.0 * self.inside)


@dataclass(frozen=True)
class _Target:
    """The CAD, prepared for the search; lengths in mm."""

    surface: MeshSurface
    points: Array
    normals: Array
    weights: Array
    samples: Array
    sample_weights: Array
    diameter_mm: float
    nodes: NDArray[np.int32]
    field: NDArray[np.float32]
    low: Array
    cell: float


def find_by_pairs(points: Array, normals: Array | None, model: Model) -> PartPlacement:
    """Place of the model in points (N,3) in mm, all finite, with normals (N,3) or None.

    Raises:
        InputError: there are too few points, the part is not found, or two places fit alike that no symmetry relates.
    """
    target = _target(model)
    scene = scene_points(points, normals, target.diameter_mm)
    found = candidates(scene, target)
    if not found or found[0].score < MIN_SHARE or found[0].inside > MAX_INSIDE:
        raise InputError("cloud: the part was not found in it: another part, or too little of it")
    best, limit_mm = found[0], 0.015 * target.diameter_mm
    for rival in found[1:]:
        if rival.score * MIN_LEAD < best.score:
            break
        moved = apply(rival.model_from_scan @ invert(best.model_from_scan), target.samples)
        apart = np.linalg.norm(moved - target.samples, axis=1)
        if apart.mean() > limit_mm and np.abs(target.surface.closest(moved).distances).mean() > 0.1 * limit_mm:
            raise InputError(
                "cloud: the part fits in two ways equally: the cloud is mirrored, of another part, or shows too little"
                " of what distinguishes its sides"
            )
    return best


def candidates(scene: ScenePoints, target: _Target) -> list[PartPlacement]:
    """Different places of the CAD in the cloud, the best first."""
    rng, tables = np.random.default_rng(SEED), _PairTable(target)
    lists = _near_lists(scene, target.diameter_mm, rng)
    placements: list[PartPlacement] = []
    signs = (1.0, -1.0) if scene.is_oriented else (1.0,)
    for turn, sign in enumerate(signs * ROUNDS):
        pairs = _scene_pairs(scene, target, PAIRS if turn >= len(signs) else FIRST_PAIRS, rng)
        turned = sign * scene.normals
        chosen, matches = tables.lookup(scene.points, turned, pairs, rng, target.diameter_mm)
        poses = hypotheses(
            scene.points, turned, chosen, target.points, target.normals, matches, np.cos(np.deg2rad(20.0))
        )
        sound = np.isfinite(poses[:, 0])
        poses, start = poses[sound], chosen[sound, 0]
        values = _scored(poses, start, lists[:, :SCORED], scene, turned, target, COARSE_REACH)
        best = _best_of_each(values, start, REFINED)
        better = _refine(poses[best], start[best], lists, scene, turned, target)
        values = _scored(better, start[best], lists, scene, turned, target, FINE_REACH)
        order = np.argsort(-values)
        kept = _different([(better[i], sign) for i in order[: 20 * KEPT]], target)
        exact = pool().map(lambda one: _exact(one, scene, target), kept)
        placements += [one for one in exact if one is not None]
        best_score = max((one.score for one in placements), default=0.0)
        if best_score > (SURE_SHARE if sign > 0 and scene.is_oriented else MIN_SHARE):
            break
    return sorted(placements, key=lambda one: -one.score)


def _target(model: Model) -> _Target:
    """Points, weights and distance field of a model."""
    from scipy.ndimage import distance_transform_edt

    vertices, faces, groups = model.mesh
    surface, diameter = MeshSurface(vertices, faces, groups), model.diameter_mm
    samples, of_face = surface.spread(24_000, SEED)
    normals, cell = surface.face_normals[of_face], diameter / FIELD_CELLS
    margin = int(np.ceil(1.6 * COARSE_REACH * FIELD_CELLS)) + 1
    low = samples.min(axis=0) - margin * cell
    index = np.round((samples - low) / cell).astype(np.int64)
    occupied = np.ones(index.max(axis=0) + margin + 1, dtype=bool)
    occupied[tuple(index.T)] = False
    near = np.argwhere(distance_transform_edt(occupied) < margin)
    closest = surface.closest(near * cell + low)
    weights = plane_weights(samples, normals, 0.01 * diameter)
    weight_of_face = np.zeros(len(surface.faces))
    np.maximum.at(weight_of_face, of_face, weights)
    weight_of_face[weight_of_face == 0.0] = np.median(weights)
    nodes = np.full(occupied.shape, -1, dtype=np.int32)
    nodes[tuple(near.T)] = np.arange(len(near))
    field = np.column_stack([closest.distances, closest.normals, weight_of_face[closest.faces]]).astype(np.float32)
    # Components are small beside the base, but their pairs are those that tell where the part is.
    rng = np.random.default_rng(SEED)
    share = np.sqrt(weights) / np.sqrt(weights).sum()
    first = rng.choice(len(samples), size=min(MODEL_POINTS, len(samples) // 2), replace=False, p=share)
    return _Target(
        surface,
        np.ascontiguousarray(samples[first]),
        np.ascontiguousarray(normals[first]),
        weights=weights[first],
        samples=samples[::4],
        sample_weights=weights[::4] / weights[::4].sum(),
        diameter_mm=diameter,
        nodes=nodes,
        field=field,
        low=low,
        cell=cell,
    )


class _PairTable:
    """Pairs of model points by distance and angles."""

    def __init__(self, target: _Target) -> None:
        count = len(target.points)
        first, second = np.divmod(np.arange(count * count), count)
        distance = np.linalg.norm(target.points[second] - target.points[first], axis=1) / target.diameter_mm
        cosine = np.sum(target.normals[first] * target.normals[second], axis=1)
        used = (distance > PAIR_RANGE[0]) & (distance < PAIR_RANGE[1])
        used &= np.abs(cosine) < np.cos(np.deg2rad(PARALLEL_DEG))
        self._pairs = np.stack([first[used], second[used]], axis=1)
        keys = self._keys(target.points, target.normals, self._pairs, target.diameter_mm)
        order = np.argsort(keys, kind="stable")
        self._pairs, self._sorted = self._pairs[order], keys[order]

    def lookup(
        self, points: Array, normals: Array, pairs: NDArray[np.int64], rng: np.random.Generator, diameter_mm: float
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """(K,2) pairs of points, repeated for each of their matches, and the (K,2) matching model pairs."""
        pairs = np.repeat(pairs, PROBES, axis=0)
        keys = self._keys(points, normals, pairs, diameter_mm, rng)
        first = np.searchsorted(self._sorted, keys, "left")
        count = np.searchsorted(self._sorted, keys, "right") - first
        taken = np.minimum(count, MATCHES)
        of_pair = np.repeat(np.arange(len(pairs)), taken)
        at = np.floor(rng.random(len(of_pair)) * count[of_pair]).astype(np.int64)
        return pairs[of_pair], self._pairs[first[of_pair] + at]

    def _keys(
        self,
        points: Array,
        normals: Array,
        pairs: NDArray[np.int64],
        diameter_mm: float,
        rng: np.random.Generator | None = None,
    ) -> NDArray[np.int64]:
        """(K,) cell of each pair: distance, both angles with the connecting line, angle of the normals.

        With ``rng`` each value is moved at random by up to half a cell.
        """

        def cells(values: Array) -> NDArray[np.int64]:
            moved = values + 0.5 if rng is None else values + rng.random(len(values))
            return np.maximum(np.floor(moved), 0.0).astype(np.int64)

        along = points[pairs[:, 1]] - points[pairs[:, 0]]
        length = np.linalg.norm(along, axis=1)
        along = along / np.maximum(length, 1e-9)[:, None]
        a, b = normals[pairs[:, 0]], normals[pairs[:, 1]]
        key = cells(length / (diameter_mm * DISTANCE_STEP))
        for cosine in (np.sum(a * along, axis=1), np.sum(b * along, axis=1), np.sum(a * b, axis=1)):
            angle = np.rad2deg(np.arccos(np.clip(cosine, -1.0, 1.0)))
            key = key * 64 + cells(angle / ANGLE_STEP_DEG)
        return key


def _scene_pairs(scene: ScenePoints, target: _Target, count: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """(K,2) pairs of scene points within the range, with normals that are not parallel, rare ones preferred."""
    share, tree = scene.weights / scene.weights.sum(), cKDTree(scene.points)
    firsts = rng.choice(len(scene.points), size=min(count // 12 + 1, 3 * len(scene.points)), p=share)
    found = []
    for first in firsts:
        near = np.array(tree.query_ball_point(scene.points[first], PAIR_RANGE[1] * target.diameter_mm))
        cosine = scene.normals[near] @ scene.normals[first]
        far = np.linalg.norm(scene.points[near] - scene.points[first], axis=1) > PAIR_RANGE[0] * target.diameter_mm
        near = near[far & (np.abs(cosine) < np.cos(np.deg2rad(PARALLEL_DEG)))]
        if len(near) == 0:
            continue
        weights = scene.weights[near] / scene.weights[near].sum()
        second = rng.choice(near, size=min(12, len(near)), p=weights)
        found.append(np.stack([np.full(len(second), first), second], axis=1))
    if not found:
        raise InputError("cloud: the part was not found in it: the cloud is flat")
    return np.concatenate(found)


def _best_of_each(values: Array, start: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    """Indices of the hypotheses with the highest scores of each first point.

    The best of all would be many times the same pose, of an object that is not the part.
    """
    order = np.lexsort((-values, start))
    first = np.flatnonzero(np.concatenate([[True], start[order][1:] != start[order][:-1]]))
    rank = np.arange(len(order)) - np.repeat(first, np.diff(np.append(first, len(order))))
    return order[(rank < count) & (values[order] > 0.0)]


def _near_lists(scene: ScenePoints, diameter_mm: float, rng: np.random.Generator) -> NDArray[np.int64]:
    """(N,J) for each scene point, points within 0.6 diameters in random order, rare ones preferred; -1 at the end."""
    count = len(scene.points)
    lists = np.full((count, 4 * SCORED), -1, dtype=np.int64)
    width = min(count, lists.shape[1])
    points = (scene.points - scene.points.mean(axis=0)).astype(np.float32)
    squares = np.sum(points**2, axis=1)
    slowness = (1.0 / scene.weights).astype(np.float32)
    # In blocks, since the table of all together would fill a gigabyte.
    block = max(1, LIST_BLOCK // count)
    for first in range(0, count, block):
        part = slice(first, first + block)
        square = squares[part, None] + squares[None] - 2.0 * points[part] @ points.T
        # Weighted choice without repetition: the first arrivals (Efraimidis & Spirakis 2006).
        arrival = rng.standard_exponential(square.shape, dtype=np.float32)
        arrival *= slowness
        arrival[square > (0.6 * diameter_mm) ** 2] = np.inf
        chosen = np.argpartition(arrival, width - 1, axis=1)[:, :width]
        is_near = np.isfinite(np.take_along_axis(arrival, chosen, axis=1))
        order = np.argsort(np.where(is_near, rng.random(chosen.shape), 2.0), axis=1)
        lists[part, :width] = np.take_along_axis(np.where(is_near, chosen, -1), order, axis=1)
    return lists


def _scored(
    poses: Array,
    start: NDArray[np.int64],
    lists: NDArray[np.int64],
    scene: ScenePoints,
    normals: Array,
    target: _Target,
    reach: float,
) -> Array:
    """(K,) scores of poses, computed in all threads."""
    lists = np.ascontiguousarray(lists)

    def work(part: NDArray[np.int64]) -> Array:
        return scores(
            poses[part],
            start[part],
            lists,
            points=scene.points,
            normals=normals,
            point_weights=scene.weights,
            nodes=target.nodes,
            field=target.field,
            low=target.low,
            cell=target.cell,
            reach=reach * target.diameter_mm,
            is_oriented=scene.is_oriented,
        )

    parts = np.array_split(np.arange(len(poses)), 4 * thread_count())
    return np.concatenate(list(pool().map(work, parts)))


def _refine(
    poses: Array,
    start: NDArray[np.int64],
    lists: NDArray[np.int64],
    scene: ScenePoints,
    normals: Array,
    target: _Target,
) -> Array:
    """Poses refined in the distance field, in all threads."""
    reaches = target.diameter_mm * np.geomspace(1.5 * COARSE_REACH, FINE_REACH, 14)

    def work(part: NDArray[np.int64]) -> Array:
        return refined(
            poses[part],
            start[part],
            lists,
            points=scene.points,
            normals=normals,
            point_weights=scene.weights,
            nodes=target.nodes,
            field=target.field,
            low=target.low,
            cell=target.cell,
            reaches=reaches,
            size=0.3 * target.diameter_mm,
            is_oriented=scene.is_oriented,
        )

    parts = np.array_split(np.arange(len(poses)), 4 * thread_count())
    return np.concatenate(list(pool().map(work, parts)))


def _different(found: list[tuple[Array, float]], target: _Target) -> list[tuple[Array, float]]:
    """The best poses (4,4) with their signs, without those near a better one."""
    kept: list[tuple[Array, float, Array]] = []
    some = target.points[::15]
    for row, sign in found:
        pose = rigid(row[:9].reshape(3, 3), row[9:])
        back = apply(invert(pose), some)
        if all(np.linalg.norm(back - b, axis=1).mean() > 0.02 * target.diameter_mm for _, _, b in kept):
            kept.append((pose, sign, back))
        if len(kept) == KEPT:
            break
    return [(pose, sign) for pose, sign, _ in kept]


def _exact(start: tuple[Array, float], scene: ScenePoints, target: _Target) -> PartPlacement | None:
    """A pose refined on the exact surface, and judged there; None if it does not converge."""
    pose, sign = start
    reach_mm = FINE_REACH * target.diameter_mm
    low, high = target.samples.min(axis=0) - 3.0 * reach_mm, target.samples.max(axis=0) + 3.0 * reach_mm
    moved = apply(pose, scene.fine)
    near = np.all((moved > low) & (moved < high), axis=1)
    points, normals = scene.fine[near], sign * scene.fine_normals[near]
    options = RegistrationOptions(
        noise_points=0,
        first_distance_mm=2.0 * reach_mm,
        last_distance_mm=min(0.5, reach_mm),
        threshold_mm=1e-3,
        threshold_deg=1e-3,
        max_iterations=25,
        min_points=20,
    )
    for _ in range(2):  # unoriented normals follow the surface at the start
        if not scene.is_oriented and len(points):
            closest = target.surface.closest(apply(pose, points), 3.0 * reach_mm)
            cosine = np.sum(np.nan_to_num(closest.normals) * (normals @ pose[:3, :3].T), axis=1)
            normals = normals * np.where(cosine < 0.0, -1.0, 1.0)[:, None]
        try:
            fit = register_to_surface(points, target.surface, pose, normals=normals, options=options)
        except (InputError, np.linalg.LinAlgError):
            return None
        pose = fit.surface_from_points
    moved = apply(pose, points)
    closest = target.surface.closest(moved, 4.0 * reach_mm)
    cosine = np.sum(np.nan_to_num(closest.normals) * (normals @ pose[:3, :3].T), axis=1)
    is_on = (np.abs(np.nan_to_num(closest.distances, nan=np.inf)) < reach_mm) & (cosine > 0.6)
    is_inside = np.nan_to_num(closest.distances, nan=np.inf) < -reach_mm
    if not is_on.any():
        return None
    # A chance fit has points at any distance within reach, the part has most of them on the surface.
    support = 1.0 - np.abs(closest.distances[is_on]) / reach_mm
    distance, nearest = cKDTree(moved[is_on]).query(target.samples, distance_upper_bound=2.0 * scene.fine_mm)
    found = np.isfinite(distance)
    share = float(target.sample_weights[found] @ support[nearest[found]])
    inside = float(is_inside.sum() / max(1, is_on.sum() + is_inside.sum()))
    return PartPlacement(pose, share, inside, sign < 0)
