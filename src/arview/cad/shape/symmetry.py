"""Rotational symmetries, exact and near ones: declared in part files, and found in the geometry."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from arview.cad.fitness import face_areas, surface_moments
from arview.errors import InputError
from arview.geometry import Array, exp_so3

ORDERS = (2, 3, 4, 5, 6, 8, 12)
# Angles outside the rotation groups of low order: a shape invariant under all of them is a body of revolution.
_FREE_TURNS_RAD = np.deg2rad([7.3, 23.1, 41.9, 77.7, 131.3])

_QUERY_COUNT = 600
_TARGET_COUNT = 30_000
_NEIGHBOURS = 8
_SEED = 20250


@dataclass(frozen=True)
class Symmetry:
    """A rotation about an axis that maps a shape onto itself.

    Attributes:
        axis_in_model: unit direction.
        through_in_model: a point of the axis, mm.
        order: n for turns of 360°/n; None for any angle (continuous).
    """

    axis_in_model: tuple[float, float, float]
    through_in_model: tuple[float, float, float]
    order: int | None

    def __post_init__(self) -> None:
        if abs(float(np.linalg.norm(self.axis_in_model)) - 1.0) > 1e-6:
            raise InputError(f"symmetry: the axis {self.axis_in_model} is not of unit length")
        if self.order is not None and self.order < 2:
            raise InputError(f"symmetry: order {self.order} must be at least 2")

    def enlarged(self, by: float) -> Symmetry:
        """The same symmetry of the shape enlarged by a factor."""
        x, y, z = self.through_in_model
        return Symmetry(self.axis_in_model, (by * x, by * y, by * z), self.order)

    def describe(self) -> str:
        """``any angle about +Z`` or ``120° about (0.00, 0.71, 0.71)``."""
        angle = "any angle" if self.order is None else f"{360.0 / self.order:g}°"
        axis = np.array(self.axis_in_model)
        for name, unit in zip("XYZ", np.eye(3), strict=True):
            if abs(float(axis @ unit)) > 0.9998:
                return f"{angle} about {name}"
        return f"{angle} about ({', '.join(f'{value:.2f}' for value in axis)})"

    def is_same_axis(self, other: Symmetry, angle_deg: float = 2.0, distance_mm: float = np.inf) -> bool:
        """True when two axes are parallel within an angle and pass each other within a distance."""
        axis = np.array(self.axis_in_model)
        if abs(float(axis @ np.array(other.axis_in_model))) < np.cos(np.deg2rad(angle_deg)):
            return False
        apart = np.array(other.through_in_model) - np.array(self.through_in_model)
        return float(np.linalg.norm(apart - axis * (axis @ apart))) <= distance_mm


@dataclass(frozen=True)
class FoundSymmetry:
    """A symmetry found in the geometry.

    Attributes:
        symmetry: the rotation.
        is_exact: the rotated surface lies within the tolerance of the surface.
        unmatched_share: share of the surface's area that the rotation moves off the surface.
        unmatched_of_group: (G,) the same for each group of faces alone.
    """

    symmetry: Symmetry
    is_exact: bool
    unmatched_share: float
    unmatched_of_group: Array


class SurfaceSamples:
    """Even samples of a surface, and distances from any points to it.

    Distances are computed to the triangles of the nearest samples. Each triangle has one sample at its centroid, and
    more by area, so that the result is the distance to the surface except in rare cases.
    """

    def __init__(self, vertices: Array, faces: NDArray[np.int64], groups: NDArray[np.int64]) -> None:
        from scipy.spatial import cKDTree

        rng, areas = np.random.default_rng(_SEED), face_areas(vertices, faces)
        self.vertices, self.faces = vertices, faces
        spread, self.owners = _sample(vertices, faces, areas, _TARGET_COUNT, rng)
        self.owners = np.concatenate([np.arange(len(faces)), self.owners])
        self.tree = cKDTree(np.concatenate([vertices[faces].mean(axis=1), spread]))
        self.queries, owners = _sample(vertices, faces, areas, _QUERY_COUNT, rng)
        self.query_groups = groups[owners]

    def distances(self, points: Array) -> Array:
        """(N,) distances of points (N,3) to the surface."""
        _, nearest = self.tree.query(points, k=min(_NEIGHBOURS, len(self.owners)))
        triangles = self.vertices[self.faces[self.owners[nearest.reshape(len(points), -1)]]]
        closest = _closest_on_triangles(points[:, None, :], triangles)
        return np.linalg.norm(closest - points[:, None, :], axis=2).min(axis=1)


@dataclass(frozen=True)
class _SymmetryTest:
    """Tests of candidate symmetries of one surface.

    Attributes:
        samples: of the surface.
        covariance: (3,3) of the surface.
        counts: (G,) sampled points of each group of faces.
        diameter: of the surface, mm.
        exact_fraction, near_fraction, near_share: see `find_symmetries`.
    """

    samples: SurfaceSamples
    covariance: Array
    counts: NDArray[np.int64]
    diameter: float
    exact_fraction: float
    near_fraction: float
    near_share: float

    def evaluate(
        self, axis: Array, center: Array, angles_rad: NDArray[np.float64], order: int | None
    ) -> FoundSymmetry | None:
        """The symmetry about an axis through a centre; None when the surface does not have it.

        Args:
            axis: (3,) unit vector.
            center: (3,) mm.
            angles_rad: rotations that are tried.
            order: of the symmetry; None for any angle.
        """
        samples, covariance, near_share = self.samples, self.covariance, self.near_share
        reach = self.near_fraction * self.diameter
        unmatched, is_exact = np.zeros(len(samples.queries), dtype=bool), True
        for angle in angles_rad:
            rotation = exp_so3(axis * angle)
            turned = rotation @ covariance @ rotation.T
            if np.linalg.norm(turned - covariance) > (0.02 + near_share) * np.linalg.norm(covariance):
                return None
            few = (samples.queries[::10] - center) @ rotation.T + center
            if np.mean(samples.distances(few) > reach) > 0.02 + 2.0 * near_share:
                return None
            distances = samples.distances((samples.queries - center) @ rotation.T + center)
            unmatched |= distances > reach
            is_exact &= bool(np.quantile(distances, 0.995) <= self.exact_fraction * self.diameter)
            if unmatched.mean() > near_share:
                return None
        of_group = np.bincount(samples.query_groups[unmatched], minlength=len(self.counts))
        x, y, z = axis.tolist()
        cx, cy, cz = center.tolist()
        symmetry = Symmetry((x, y, z), (cx, cy, cz), order)
        return FoundSymmetry(symmetry, is_exact, float(unmatched.mean()), of_group / np.maximum(self.counts, 1))


def find_symmetries(
    vertices: Array,
    faces: NDArray[np.int64],
    groups: NDArray[np.int64] | None = None,
    exact_fraction: float = 0.005,
    near_fraction: float = 0.01,
    near_share: float = 0.15,
) -> tuple[FoundSymmetry, ...]:
    """Proper rotations that map a surface onto itself, or all but a small part of it.

    Candidate axes (principal axes, axes of the model, normals of the largest flat areas, and bisectors of these) pass
    through the centroid of the surface or the centre of its box. Candidate angles are 360° over ORDERS, and some that
    only a body of revolution is invariant under. A candidate must preserve the covariance of the surface, a cheap
    necessary condition; then sampled points are rotated, and their distances to the surface are computed.

    Args:
        vertices: (V,3), mm.
        faces: (F,3).
        groups: (F,) group of each face, 0 to G-1, for ``unmatched_of_group``.
        exact_fraction: a symmetry is exact when 99.5 % of the rotated points lie within this share of the diameter from
            the surface (0.5 % covers the chords of tessellated cylinders).
        near_fraction: a point is unmatched beyond this share of the diameter (1 % are some pixels).
        near_share: largest unmatched share of a near-symmetry; 0 finds exact ones only, which is faster.

    Returns:
        the highest order for each axis, exact ones first, then by unmatched area.
    """
    groups = np.zeros(len(faces), dtype=np.int64) if groups is None else groups
    faces = faces.astype(np.int64)
    samples = SurfaceSamples(vertices, faces, groups)
    centroid, covariance = surface_moments(vertices, faces)
    used = vertices[np.unique(faces)]
    middle = 0.5 * (used.min(axis=0) + used.max(axis=0))
    diameter, centers = float(np.linalg.norm(np.ptp(used, axis=0))), [centroid]
    if np.linalg.norm(middle - centroid) > 0.25 * exact_fraction * diameter:
        centers.append(middle)
    counts = np.bincount(samples.query_groups, minlength=int(groups.max()) + 1)
    test = _SymmetryTest(samples, covariance, counts, diameter, exact_fraction, near_fraction, near_share)

    found: list[FoundSymmetry] = []
    for axis in _candidate_axes(vertices, faces, covariance):
        best: FoundSymmetry | None = None
        for center in centers:
            trials: list[tuple[int | None, NDArray[np.float64]]] = [(None, _FREE_TURNS_RAD)]
            trials += [(order, np.array([2.0 * np.pi / order])) for order in sorted(ORDERS, reverse=True)]
            for order, angles_rad in trials:
                candidate = test.evaluate(axis, center, angles_rad, order)
                if candidate is not None and (best is None or (candidate.is_exact and not best.is_exact)):
                    best = candidate
                if best is not None and best.is_exact:
                    break
            if best is not None and best.is_exact:
                break
        if best is not None:
            found.append(best)
    found.sort(key=lambda item: (not item.is_exact, item.symmetry.order is not None, item.unmatched_share))
    return _without_copies(found)


def _without_copies(found: list[FoundSymmetry]) -> tuple[FoundSymmetry, ...]:
    """One entry per axis; of the half turns across an axis of order 3 or more only the best one.

    The others follow from these two.
    """

    def is_across(flip: Symmetry, main: Symmetry) -> bool:
        cosine = float(np.dot(flip.axis_in_model, main.axis_in_model))
        return flip.order == 2 and main.order != 2 and abs(cosine) < 0.05

    kept: list[FoundSymmetry] = []
    for item in sorted(found, key=lambda item: item.symmetry.order == 2):
        mains = [other.symmetry for other in kept if is_across(item.symmetry, other.symmetry)]
        follows = any(is_across(other.symmetry, main) for main in mains for other in kept)
        if not follows and not any(item.symmetry.is_same_axis(other.symmetry) for other in kept):
            kept.append(item)
    return tuple(sorted(kept, key=lambda item: not item.is_exact))


def _candidate_axes(vertices: Array, faces: NDArray[np.int64], covariance: Array) -> list[Array]:
    """Unit directions of possible axes of symmetry, likely ones first."""
    _, principal = np.linalg.eigh(covariance)
    candidates = [*principal.T[::-1], *np.eye(3)]
    a, b, c = vertices[faces].transpose(1, 0, 2)
    doubled = np.cross(b - a, c - a)
    lengths = np.linalg.norm(doubled, axis=1)
    normals = doubled / np.maximum(lengths, 1e-300)[:, None]
    normals[normals[:, np.argmax(np.abs(normals).sum(axis=0))] < 0] *= -1.0
    _, group = np.unique(np.round(normals, 2), axis=0, return_inverse=True)
    weights = np.bincount(group.ravel(), weights=lengths)
    for largest in np.argsort(-weights)[:6]:
        mean = (normals * lengths[:, None])[group.ravel() == largest].sum(axis=0)
        candidates.append(mean / np.linalg.norm(mean))
    base, bisectors = _without_duplicates(candidates), []
    for i, one in enumerate(base):
        for other in base[:i]:
            if abs(float(one @ other)) < 0.9:
                bisectors += [
                    (one + other) / np.linalg.norm(one + other),
                    (one - other) / np.linalg.norm(one - other),
                ]
    diagonals = [np.array([1.0, y, z]) / np.sqrt(3.0) for y in (-1, 1) for z in (-1, 1)]
    # A rotation of order 3 or more requires two equal moments; bisectors are needed only then.
    moments = np.linalg.eigvalsh(covariance)
    is_round = np.min(np.diff(moments)) < 0.15 * moments[-1]
    return _without_duplicates([*base, *bisectors[:30], *diagonals]) if is_round else base


def _without_duplicates(axes: list[Array]) -> list[Array]:
    """The axes without those within 1° of an earlier one."""
    kept: list[Array] = []
    for axis in axes:
        if all(abs(float(axis @ other)) < np.cos(np.deg2rad(1.0)) for other in kept):
            kept.append(axis)
    return kept


def _sample(
    vertices: Array, faces: NDArray[np.int64], areas: Array, count: int, rng: np.random.Generator
) -> tuple[Array, NDArray[np.int64]]:
    """Points (N,3) spread evenly by area, stratified, and the face of each (N,)."""
    edges = np.cumsum(areas) / areas.sum()
    owners = np.searchsorted(edges, (np.arange(count) + rng.random(count)) / count)
    owners = np.minimum(owners, len(faces) - 1)
    u, v = np.sqrt(rng.random(count)), rng.random(count)
    weights = np.stack([1 - u, u * (1 - v), u * v], axis=1)
    return np.einsum("nc,ncx->nx", weights, vertices[faces[owners]]), owners.astype(np.int64)


def _closest_on_triangles(points: Array, triangles: Array) -> Array:
    """Closest points (...,3) of triangles (...,3,3) to points (...,3), by broadcasting.

    The foot of the perpendicular where it lies inside the triangle, else the closest point of the three edges.
    """
    a, b, c = triangles[..., 0, :], triangles[..., 1, :], triangles[..., 2, :]
    normal = np.cross(b - a, c - a)
    squared = np.maximum((normal * normal).sum(axis=-1, keepdims=True), 1e-300)
    foot = points - normal * (((points - a) * normal).sum(axis=-1, keepdims=True) / squared)
    inside = np.ones(foot.shape[:-1], dtype=bool)
    best, closest = np.full(foot.shape[:-1], np.inf), np.zeros_like(foot)
    for start, end in ((a, b), (b, c), (c, a)):
        edge = end - start
        inside &= (np.cross(edge, foot - start) * normal).sum(axis=-1) >= 0
        length = np.maximum((edge * edge).sum(axis=-1, keepdims=True), 1e-300)
        along = np.clip(((points - start) * edge).sum(axis=-1, keepdims=True) / length, 0.0, 1.0)
        on_edge = start + along * edge
        distance = ((points - on_edge) ** 2).sum(axis=-1)
        closest = np.where((distance < best)[..., None], on_edge, closest)
        best = np.minimum(best, distance)
    return np.where(inside[..., None], foot, closest)
