"""How sure a displacement is: contributions as covariances, combined by their sum and by Monte Carlo.

After the GUM (JCGM 100:2008) and its supplement 1 (JCGM 101:2008). All contributions are (6,6) covariances of the
twist of a component about its centre, *relative to the datum frame*: what moves component and datums alike is nothing.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from arview.cad.model import Component, Model
from arview.core.parallel import pool
from arview.errors import InputError
from arview.geometry import Array, apply
from arview.measurement.datums.alignment import Alignment
from arview.measurement.datums.equations import point_from_move
from arview.measurement.uncertainty.combine import CombinedMove, quantile_of_length
from arview.measurement.uncertainty.rice import rice_estimate
from arview.reconstruction.types import PosedPhoto, SparseModel
from arview.rendering.renderers import ZBufferRenderer

_BOUND = float(np.sqrt(3.0))  # half the width of a rectangular distribution of unit variance
DRAWN_PX = 500
"""Longer side at which the model is drawn to see which photo sees what."""


@dataclass(frozen=True)
class UncertaintyOptions:
    """What is not in any covariance, and how the numbers are made."""

    form_mm: float = 0.005  # standard uncertainty of a component's place by its own form; as machined, not cast
    min_poses_mm: float = 0.004  # of what bundle adjustment does not know of itself: lens model, tracks
    k: float = 2.0  # coverage factor of a single direction; 2 is 95 % of a normal distribution
    probability: float = 0.95  # coverage of intervals
    draws: int = 20_000  # JCGM 101 asks for 1e4 / (1 - p) for two digits of the ends; U is stated with 0.7 % noise
    seed: int = 0
    monte_carlo: bool = True

    def __post_init__(self) -> None:
        if not 0.5 <= self.probability < 1 or self.draws < 100 or self.k <= 0:
            raise InputError("uncertainty: expected probability from 0.5 to 1, at least 100 draws, k above 0")


@dataclass(frozen=True)
class Contribution:
    """One line of the budget: (6,6) covariance; ``is_bounded`` when it is of type B, rectangular."""

    name: str
    covariance: Array
    is_bounded: bool = False


@dataclass(frozen=True)
class Length:
    """A length (mm or rad) with its uncertainty.

    Attributes:
        value: as measured.
        uncertainty: expanded U.
        k: U over the standard uncertainty along the measured direction.
        low, high: ends of the coverage interval.
        corrected: most likely true length, without Rice's bias.
    """

    value: float
    uncertainty: float
    k: float
    low: float
    high: float
    corrected: float

    @property
    def bias(self) -> float:
        """How much too large noise makes the measured length, most likely."""
        return self.value - self.corrected


@dataclass(frozen=True)
class Placement:
    """Where a component stands in the datum frame.

    Attributes:
        twist: (6,) about its centre, rad and mm; zero along undetermined directions.
        covariance: (6,6) of all contributions.
        contributions: the budget.
        undetermined: (K,6) scaled directions.
        observable: (6,) which of rx ry rz tx ty tz are determined.
        distance: of the centre from its nominal place, along determined axes; None when there are none.
        angle: of the determined rotation, rad; None when there is none.
    """

    twist: Array
    covariance: Array
    contributions: tuple[Contribution, ...]
    undetermined: Array
    observable: NDArray[np.bool_]
    distance: Length | None
    angle: Length | None

    def budget(self) -> tuple[tuple[str, float], ...]:
        """(name, standard uncertainty in mm of the distance), largest first; their squares sum to the total's."""
        direction = _direction(self.twist[3:], self.covariance[3:, 3:], self.observable[3:])
        parts = [(c.name, _along(c.covariance[3:, 3:], direction)) for c in self.contributions]
        return tuple(sorted(parts, key=lambda part: -part[1]))


# --- placing ---------------------------------------------------------------------------------------------


def place(
    combined: CombinedMove, alignment: Alignment, poses: Array | None = None, options: UncertaintyOptions | None = None
) -> Placement:
    """A component's move relative to the datum frame, with every contribution.

    Args:
        combined: its move in the rough frame.
        alignment: the datum frame's.
        poses: (6,6) covariance of the component's twist relative to the datums by the poses, see `PosePropagation`.
        options: type B contributions and the way of combining.
    """
    options = options or UncertaintyOptions()
    from_frame = alignment.twist_from_move(combined.center_in_model)
    unit = np.array([combined.radius_mm] * 3 + [1.0] * 3)
    project = np.eye(6) - combined.undetermined.T @ combined.undetermined
    project = project / unit[:, None] * unit
    own = [Contribution(f"noise of {method}", share) for method, share in combined.covariances.items()]
    own.append(Contribution("methods disagree", combined.disagreement))
    own.append(Contribution("form", np.diag((options.form_mm / unit) ** 2), is_bounded=True))
    least = np.diag((options.min_poses_mm / unit) ** 2)
    own.append(Contribution("camera poses", least if poses is None else poses + least))
    frame = [Contribution(f"datum {one.label}", one.covariance) for one in alignment.datums]
    frame.append(Contribution("scale", alignment.scale_covariance))
    twist = project @ relative_twists(combined.twist[None], alignment.move[None], combined, alignment)[0]
    contributions = tuple(
        Contribution(c.name, project @ c.covariance @ project.T, c.is_bounded)
        for c in [*own, *(Contribution(f.name, from_frame @ f.covariance @ from_frame.T) for f in frame)]
    )
    covariance = np.sum([c.covariance for c in contributions], axis=0)
    observable = np.count_nonzero(np.abs(combined.undetermined) > 0.05, axis=0) == 0
    deviations = None
    if options.monte_carlo:
        moves = combined.twist + _draw(own, options)
        frames = alignment.move + _draw(frame, options, salt=1)
        deviations = relative_twists(moves, frames, combined, alignment) @ project.T - twist
    lengths: list[Length | None] = []
    for part in (slice(3, 6), slice(0, 3)):
        seen = observable[part]
        if not seen.any():
            lengths.append(None)
            continue
        some = None if deviations is None else deviations[:, part] * seen
        block = covariance[part, part] * np.outer(seen, seen)
        lengths.append(length_of(twist[part] * seen, block, some, int(seen.sum()), options))
    return Placement(twist, covariance, contributions, combined.undetermined, observable, lengths[0], lengths[1])


def relative_twists(moves: Array, frames: Array, combined: CombinedMove, alignment: Alignment) -> Array:
    """(D,6) twists of a component in the datum frame, of its (D,6) and the frame's moves (D,7) in the rough frame."""
    center, origin = combined.center_in_model, alignment.origin_in_model
    arm = center - origin
    turned = rotate(-frames[:, :3], arm + moves[:, 3:] - frames[:, 3:6]) / (1.0 + frames[:, 6:])
    # The frame turns by arc minutes: to second order its rotation is taken off half before, half after.
    rotation = moves[:, :3] - frames[:, :3] + 0.5 * np.cross(moves[:, :3], frames[:, :3])
    return np.concatenate([rotation, turned - arm], axis=1)


def rotate(rotation_vectors: Array, vectors: Array) -> Array:
    """(D,3) vectors turned by rotation vectors (D,3) in rad (Rodrigues)."""
    angle = np.linalg.norm(rotation_vectors, axis=1, keepdims=True)
    axis = rotation_vectors / np.maximum(angle, 1e-12)
    along = axis * np.sum(axis * vectors, axis=1, keepdims=True)
    return along + np.cos(angle) * (vectors - along) + np.sin(angle) * np.cross(axis, vectors)


def length_of(
    vector: Array, covariance: Array, deviations: Array | None, axes: int, options: UncertaintyOptions
) -> Length:
    """Length of a measured vector (3,), whose error has a covariance or is drawn as (D,3).

    Away from zero U is k standard uncertainties along the vector. Near zero every error makes the length larger: there
    U is what 95 % of the lengths of pure noise stay below, so that the interval holds the true length as often as it
    says, whatever that is.
    """
    value = float(np.linalg.norm(vector))
    direction = _direction(vector, covariance, np.ones(3, dtype=bool))
    along = _along(covariance, direction)
    sigma = float(np.sqrt(max(0.0, np.trace(covariance)) / axes))
    corrected = rice_estimate(value, sigma, axes) if sigma > 0 else value
    if deviations is None:
        by_noise = quantile_of_length(covariance, options.probability)
    else:
        by_noise = float(np.quantile(np.linalg.norm(deviations, axis=1), options.probability))
    uncertainty = options.k * along
    if value <= by_noise:
        uncertainty = max(uncertainty, by_noise)
    elif deviations is None:
        uncertainty += value - corrected
    else:
        lengths = np.linalg.norm(corrected * direction + deviations, axis=1)
        uncertainty = max(uncertainty, float(np.quantile(np.abs(lengths - corrected), options.probability)))
    k = uncertainty / along if along > 0 else options.k
    return Length(value, uncertainty, k, max(0.0, value - uncertainty), value + uncertainty, corrected)


def _direction(vector: Array, covariance: Array, seen: NDArray[np.bool_]) -> Array:
    """Unit vector of a displacement; of one that noise explains, the direction of the largest uncertainty."""
    vector, covariance = vector * seen, covariance * np.outer(seen, seen)
    length = float(np.linalg.norm(vector))
    values, vectors = np.linalg.eigh(covariance)
    if length**2 > 4.0 * max(0.0, values[-1]) and length > 0:
        return vector / length
    return np.asarray(vectors[:, -1])


def _along(covariance: Array, direction: Array) -> float:
    """Standard deviation along a unit direction."""
    return float(np.sqrt(np.maximum(direction @ covariance @ direction, 0.0)))


def _draw(contributions: Sequence[Contribution], options: UncertaintyOptions, salt: int = 0) -> Array:
    """(D,K) sums of draws of all contributions: normal, or rectangular along their principal axes."""
    normal = np.sum([one.covariance for one in contributions if not one.is_bounded], axis=0)
    bounded = [one.covariance for one in contributions if one.is_bounded]
    rng = np.random.default_rng([options.seed, salt])
    total = np.zeros((options.draws, len(normal)))
    for index, covariance in enumerate([normal, *bounded]):
        values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
        noise = rng.standard_normal(total.shape) if index == 0 else rng.uniform(-_BOUND, _BOUND, total.shape)
        total += noise @ (np.sqrt(np.maximum(values, 0.0)) * vectors).T
    return total


# --- camera poses ----------------------------------------------------------------------------------------


def shifts_from_poses(points: Array, photos: Sequence[PosedPhoto], sees: NDArray[np.bool_]) -> Array:
    """(N,3,6M) derivative of triangulated points (N,3) by the left twists of the poses of the photos.

    A point keeps its pixels when poses err: with P_v the projector across its ray in view v, over its squared
    distance, δx = (Σ P_v)⁻¹ Σ P_v δx_v, and δx_v = −Rᵀ (ω × y + v) of y, the point in the camera.

    Args:
        points: scan frame, the poses' unit.
        photos: M placed photos.
        sees: (N,M) which photo sees which point; those seen by fewer than two do not move.
    """
    count = len(photos)
    total, parts = np.zeros((len(points), 3, 3)), np.zeros((len(points), 3, 6 * count))
    for view, photo in enumerate(photos):
        rotation = photo.cam_from_scan[:3, :3]
        in_cam = apply(photo.cam_from_scan, points)
        square = np.sum(in_cam**2, axis=1)
        ray = in_cam @ rotation / np.sqrt(square)[:, None]
        across = (np.eye(3) - ray[:, :, None] * ray[:, None, :]) * (sees[:, view] / square)[:, None, None]
        by_twist = point_from_move(in_cam)[:, :, :6]
        parts[:, :, 6 * view : 6 * view + 6] = -across @ rotation.T @ by_twist
        total += across
    good = sees.sum(axis=1) >= 2
    parts[good] = np.linalg.solve(total[good], parts[good])
    parts[~good] = 0.0
    return parts


def which_see(points: Array, normals: Array, sparse: SparseModel, model: Model) -> NDArray[np.bool_]:
    """(N,M) which photos of a reconstruction in the model's frame see surface points (N,3) with normals (N,3)."""

    def look(photo: PosedPhoto) -> NDArray[np.bool_]:
        shrink = min(1.0, DRAWN_PX / max(photo.camera.width, photo.camera.height))
        size = (round(photo.camera.width * shrink), round(photo.camera.height * shrink))
        camera = photo.camera.without_distortion().scaled(*size)
        depth = ZBufferRenderer(model, camera).render(photo.cam_from_scan).depth_mm
        in_cam = apply(photo.cam_from_scan, points)
        pixels = camera.project(in_cam)
        inside = np.all(np.isfinite(pixels) & (pixels >= 0) & (pixels <= np.array(size) - 1), axis=1)
        u, v = np.round(np.where(inside[:, None], pixels, 0.0)).astype(np.intp).T
        facing = np.sum(normals * (photo.centre_in_scan - points), axis=1) > 0.2 * np.linalg.norm(in_cam, axis=1)
        near = np.abs(depth[v, u] - in_cam[:, 2]) < 4.0 * in_cam[:, 2] / camera.fx
        return np.asarray(inside & facing & near)

    return np.stack(list(pool().map(look, sparse.photos)), axis=1)


def surface_points(component: Component, count: int, seed: int = 0) -> tuple[Array, Array]:
    """Random points (N,3), even by area, of a component's surface, with unit normals (N,3)."""
    rng = np.random.default_rng(seed)
    corners = component.vertices_in_model[component.faces]
    doubled = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.linalg.norm(doubled, axis=1)
    faces = rng.choice(len(areas), size=count, p=areas / areas.sum())
    u, v = np.sqrt(rng.random(count)), rng.random(count)
    points = np.einsum("nc,ncx->nx", np.stack([1 - u, u * (1 - v), u * v], axis=1), corners[faces])
    return points, doubled[faces] / areas[faces][:, None]


class PosePropagation:
    """What the joint covariance of the camera poses does to components, relative to the datums.

    What only makes all larger or smaller is left out: the scale is measured on the same photos and has its own
    contribution.
    """

    def __init__(
        self, sparse: SparseModel, model: Model, alignment: Alignment, base: Sequence[str], points: int = 60
    ) -> None:
        """``sparse``: in mm in the model's frame, with a ``pose_covariance``; ``base``: components of the scale."""
        if sparse.pose_covariance is None:
            raise InputError("uncertainty: the reconstruction has no covariance of its poses; reconstruct again")
        self.sparse, self.model, self.alignment, self.count = sparse, model, alignment, points
        names = base or [component.name for component in model.components]
        arms, shifts = [], []
        for name in names:
            places, moved = self._shifts(model.component(name))
            arms.append(point_from_move(places - alignment.origin_in_model))
            shifts.append(moved)
        rows, moved = np.concatenate(arms).reshape(-1, 7), np.concatenate(shifts)
        self.by_scale = np.linalg.lstsq(rows, moved.reshape(len(rows), -1), rcond=1e-10)[0][6]
        self.frame = np.zeros((7, moved.shape[2]))
        for one, gain in zip(alignment.equations, alignment.gains, strict=True):
            self.frame += gain @ self._offsets(one.rows, one.points, one.feature == "fit")

    def covariance_of(self, component: Component, center: Array) -> Array:
        """(6,6) of the component's twist about its centre, relative to the datum frame."""
        by_poses = self._twist(component, center) - self.alignment.twist_from_move(center) @ self.frame
        assert self.sparse.pose_covariance is not None
        return by_poses @ self.sparse.pose_covariance @ by_poses.T

    def _twist(self, component: Component, center: Array) -> Array:
        """(6,6M) derivative of a component's twist by the poses, without scale."""
        points, moved = self._shifts(component)
        moved = moved - (points - self.alignment.origin_in_model)[:, :, None] * self.by_scale
        rows = point_from_move(points - center)[:, :, :6].reshape(-1, 6)
        unit = np.array([float(np.ptp(points, axis=0).max()) or 1.0] * 3 + [1.0] * 3)
        return np.linalg.lstsq(rows / unit, moved.reshape(len(rows), -1), rcond=1e-3)[0] / unit[:, None]

    def _offsets(self, rows: Array, points: Array, is_fit: bool) -> Array:
        """(N,6M) derivative of a datum's offsets by the poses, without scale."""
        origin = self.alignment.origin_in_model
        if is_fit:
            center = points[0]
            arms = rows[:, :3] - np.cross(center, rows[:, 3:6])
            name = min(self.model.components, key=lambda c: float(np.linalg.norm(c.bounds_in_model.mean(0) - center)))
            return np.concatenate([arms, rows[:, 3:6]], axis=1) @ self._twist(name, center)
        normals = rows[:, 3:6]
        # All points of a datum are seen much alike: some of them stand for their neighbours.
        step = max(1, len(points) // 40)
        some = np.arange(0, len(points), step)
        toward = np.mean([p.centre_in_scan for p in self.sparse.photos], axis=0) - points[some].mean(axis=0)
        facing = np.tile(toward / np.linalg.norm(toward), (len(some), 1))
        sees = which_see(points[some], facing, self.sparse, self.model)
        moved = shifts_from_poses(points[some], self.sparse.photos, sees)
        apart = np.linalg.norm(points[:, None] - points[some][None], axis=2)
        apart[:, sees.sum(axis=1) < 2] = np.inf
        if not np.isfinite(apart).any():
            return np.zeros((len(points), moved.shape[2]))
        nearest = np.argmin(apart, axis=1)
        result = np.einsum("ni,nik->nk", normals, moved[nearest])
        stretch = np.einsum("ni,ni->n", normals, points - origin)
        return result - stretch[:, None] * self.by_scale

    def _shifts(self, component: Component) -> tuple[Array, Array]:
        """Points of a component that are seen, and how they move with the poses."""
        points, normals = surface_points(component, 3 * self.count)
        sees = which_see(points, normals, self.sparse, self.model)
        kept = np.flatnonzero(sees.sum(axis=1) >= 2)[: self.count]
        if len(kept) < 3:
            return points[:3], np.zeros((3, 3, 6 * len(self.sparse.photos)))
        return points[kept], shifts_from_poses(points[kept], self.sparse.photos, sees[kept])


def total_budget(placements: Mapping[str, Placement]) -> tuple[tuple[str, float], ...]:
    """Root mean square of each line of the budget over components, mm, largest first."""
    sums: dict[str, list[float]] = {}
    for placement in placements.values():
        for name, value in placement.budget():
            sums.setdefault(name, []).append(value**2)
    means = {name: float(np.sqrt(np.mean(values))) for name, values in sums.items()}
    return tuple(sorted(means.items(), key=lambda item: -item[1]))
