"""Registration of points to the exact surface of a mesh, for any set of free degrees of freedom.

Gauss–Newton on the signed distances of the points to the surface, reweighted for robustness (Holland & Welsch 1977;
Huber 1981). The free motions are a subspace of the six; those that the points do not determine are found in the
information matrix and excluded. The covariance of the result includes the correlation of neighbouring errors
(`measurement.cloud.noise`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from arview.core.fits import orthogonal_complement, robust_sigma, row_space, tukey_weights
from arview.errors import InputError
from arview.geometry import Array, apply, exp_so3, log_so3, rigid
from arview.measurement.cloud.mesh_surface import MeshSurface
from arview.measurement.cloud.noise import NoiseModel, estimate_noise, spread_of_sum

NAMES = ("rx", "ry", "rz", "tx", "ty", "tz")
"""Degrees of freedom, in the order of a twist."""
DISTANCE_SIGMAS = 6.0
"""Maximum distance in widths of the kernel."""
SHRINK = 1.0 / 3.0
"""Factor by which the kernel's width, at first that of the largest distance, decreases in each iteration until it
reaches the noise; narrow from the start, it would take a face displaced by more than the noise for an outlier."""
MIN_NORMAL_COSINE = 0.5
"""Points whose normal makes a larger angle with the surface's belong to another face."""
MIN_INFORMATION = 1e-4
"""Motions with less information per point, as a share of the largest possible, are undetermined; rotations are
converted by the size of the cloud."""
SEED = 0
"""Seed of the choice of points."""


@dataclass(frozen=True)
class RegistrationOptions:
    """Options of the registration.

    Attributes:
        first_distance_mm: maximum distance of points from the surface in the first iteration.
        last_distance_mm: maximum distance in the last iteration, unless the noise is larger.
        threshold_mm, threshold_deg: converged when a step moves the centre and rotates the points by less than this.
        max_iterations: of the solver, which needs 4 to 15.
        min_points: fewer points cannot be registered.
        min_width_mm: lower bound of the kernel's width: surfaces displaced by less are never treated as outliers.
        noise_points: points from which the noise is estimated; 0 assumes independent errors, which makes the covariance
            far too small for real clouds.
    """

    first_distance_mm: float = 5.0
    last_distance_mm: float = 0.2
    threshold_mm: float = 1e-4
    threshold_deg: float = 1e-4
    max_iterations: int = 60
    min_points: int = 50
    min_width_mm: float = 0.0
    noise_points: int = 240

    def __post_init__(self) -> None:
        if not 0.0 < self.last_distance_mm <= self.first_distance_mm:
            raise InputError(
                f"registration: distances {self.first_distance_mm} … {self.last_distance_mm} mm must be positive and "
                "shrink"
            )


@dataclass(frozen=True)
class Registration:
    """Position of points relative to a surface.

    Attributes:
        surface_from_points: (4,4), mm.
        twist: (6,) the same as rotation vector (rad) and translation (mm) of the centre: x → R (x − c) + c + t.
        center: (3,) c, mm.
        radius_mm: length that converts rotations to mm.
        free: (K,6) orthonormal directions, rotations scaled by ``radius_mm``, that were solved for.
        undetermined: (M,6) those of the free directions that the points do not determine; nothing moved along them.
        information: (6,6) of ``twist``: JᵀWJ in points per rad² and mm². Divided by ``sigma_mm``² it is the inverse of
            the covariance for independent errors.
        covariance: (6,6) of ``twist`` with correlated errors; zero along directions that were not solved for.
        noise: of the residuals.
        residuals: (N,) signed, mm; NaN for points without a surface in reach.
        weights: (N,) 0–1, of the last iteration.
        rms_mm: weighted root mean square of the residuals.
        sigma_mm: robust standard deviation of the residuals within reach.
        overlap: share of the points with a weight above one half.
        iterations, converged: of the solver.
        runner_up: (4,4) next best minimum found from other starts, or None.
        runner_up_cost: its cost divided by the best one's; a value near 1 makes the result ambiguous.
    """

    surface_from_points: Array
    twist: Array
    center: Array
    radius_mm: float
    free: Array
    undetermined: Array
    information: Array
    covariance: Array
    noise: NoiseModel
    residuals: Array
    weights: Array
    rms_mm: float
    sigma_mm: float
    overlap: float
    iterations: int
    converged: bool
    runner_up: Array | None = None
    runner_up_cost: float | None = None


def degrees_of_freedom(names: str, axes: Array | None = None) -> Array:
    """Directions (K,6) of names like ``"rz tx ty"``, about and along ``axes`` (3,3) given as rows; default XYZ.

    Raises:
        InputError: a name is unknown, or there is none.
    """
    axes = np.eye(3) if axes is None else axes
    rows = []
    for name in names.split():
        if name not in NAMES:
            raise InputError(f"degrees of freedom: {name!r} is none of {' '.join(NAMES)}")
        row = np.zeros((2, 3))
        row[NAMES.index(name) // 3] = axes[NAMES.index(name) % 3]
        rows.append(row.ravel())
    if not rows:
        raise InputError("degrees of freedom: none is free, so there is nothing to register")
    return np.array(rows)


def move_about(center: Array, twist: Array) -> Array:
    """(4,4) matrix of a twist (rotation vector in rad, translation in mm) about a centre: x → R (x − c) + c + t."""
    rotation = exp_so3(twist[:3])
    return rigid(rotation, center - rotation @ center + twist[3:])


def twist_about(center: Array, b_from_a: Array) -> Array:
    """(6,) twist about a centre of a rigid motion (4,4); the inverse of `move_about`."""
    return np.concatenate([log_so3(b_from_a[:3, :3]), apply(b_from_a, center) - center])


def register_to_surface(
    points: Array,
    surface: MeshSurface,
    start: Array | None = None,
    center: Array | None = None,
    free: Array | None = None,
    radius_mm: float | None = None,
    point_weights: Array | None = None,
    normals: Array | None = None,
    usable_faces: NDArray[np.bool_] | None = None,
    options: RegistrationOptions | None = None,
) -> Registration:
    """Register points to a surface.

    Args:
        points: (N,3), mm.
        surface: the reference.
        start: (4,4) initial ``surface_from_points``; default: identity.
        center: (3,) in the frame of the surface, about which the free motions rotate; default: mean of the points.
        free: (K,6) allowed motions (rotation vector, translation), see `degrees_of_freedom`; default: all. Finite
            rotations about two axes leave their subspace in second order.
        radius_mm: length that converts rotations to mm; default: rms distance of the points from the centre.
        point_weights: (N,) inverse variances, of which only the ratios count. Residuals are compared in these units.
        normals: (N,3) of the points, to match faces with the same orientation; zero where unknown.
        usable_faces: (F,) False for faces that cannot have been seen; points nearest to these are ignored.
        options: see `RegistrationOptions`.

    Raises:
        InputError: there are too few points, a coordinate is not finite, or no point is within reach of the surface.
    """
    o = options or RegistrationOptions()
    points = np.ascontiguousarray(points, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or len(points) < o.min_points:
        raise InputError(f"registration: {len(points)} points are too few; at least {o.min_points} are needed")
    if not np.isfinite(points).all():
        bad = int(np.count_nonzero(~np.isfinite(points).all(axis=1)))
        raise InputError(f"registration: {bad} of {len(points)} points are NaN or infinite; remove them first")
    pose = np.eye(4) if start is None else np.asarray(start, dtype=np.float64)
    base = (
        np.ones(len(points)) if point_weights is None else np.clip(point_weights / np.median(point_weights), 0.04, 25.0)
    )
    center = apply(pose, points).mean(axis=0) if center is None else np.asarray(center, dtype=np.float64)
    radius = radius_mm or float(np.sqrt(np.mean(np.sum((apply(pose, points) - center) ** 2, axis=1)))) or 1.0
    basis = np.eye(6) if free is None else row_space(free / _scales(radius))
    problem = _Problem(points, normals, base, surface, usable_faces, center, radius, basis=basis, options=o)
    width, hint, converged, iterations = o.first_distance_mm / DISTANCE_SIGMAS, None, False, 0
    while iterations < o.max_iterations:
        iterations += 1
        system = problem.linearised(pose, width, hint)
        step = -(system.vectors / system.values) @ (system.vectors.T @ (basis @ system.gradient))
        twist = (basis.T @ step) * _scales(radius)
        pose, hint = move_about(center, twist) @ pose, system.faces
        turned_deg = float(np.rad2deg(np.linalg.norm(twist[:3])))
        is_narrow = width <= max(system.sigma, o.min_width_mm, o.last_distance_mm / DISTANCE_SIGMAS)
        if is_narrow and np.linalg.norm(twist[3:]) < o.threshold_mm and turned_deg < o.threshold_deg:
            converged = True
            break
        width = max(system.sigma, o.min_width_mm, SHRINK * width)
    return problem.result(problem.linearised(pose, width, hint), pose, iterations, converged)


def register_from_starts(
    points: Array,
    surface: MeshSurface,
    starts: Sequence[Array],
    coarse_points: int = 800,
    apart_mm: float = 0.2,
    normals: Array | None = None,
    point_weights: Array | None = None,
    options: RegistrationOptions | None = None,
    **given: object,
) -> Registration:
    """Best of the minima found from several starts, with the next best one as ``runner_up``.

    All starts are tried on few points; the best minimum is refined on all points. The cost of a minimum is the mean of
    its squared residuals, each limited to three times the best minimum's noise.

    Args:
        points, surface, normals, point_weights, options, given: see `register_to_surface`.
        starts: (4,4) each.
        coarse_points: number of points on which starts are tried.
        apart_mm: minima whose points differ by less on average count as one.

    Raises:
        InputError: no start leads to a registration.
    """
    o = options or RegistrationOptions()
    few = slice(None, None, -(-len(points) // coarse_points))
    some = {
        "normals": normals[few] if normals is not None else None,
        "point_weights": point_weights[few] if point_weights is not None else None,
    }
    quick = replace(o, noise_points=0, threshold_mm=0.01, threshold_deg=0.01, max_iterations=15)
    found: list[Registration] = []
    failure: InputError | None = None
    for start in starts:
        try:
            found.append(register_to_surface(points[few], surface, start, options=quick, **some, **given))  # type: ignore[arg-type]
        except InputError as error:
            failure = error
    if not found:
        raise failure or InputError("registration: no start was given")
    limit = 3.0 * max(min(item.sigma_mm for item in found), 0.02)
    costs = np.array([_cost(item, limit) for item in found])
    best = found[int(np.argmin(costs))]
    placed = apply(best.surface_from_points, points[few])
    rivals = [
        (cost, item.surface_from_points)
        for cost, item in zip(costs, found, strict=True)
        if np.sqrt(np.mean(np.sum((apply(item.surface_from_points, points[few]) - placed) ** 2, axis=1))) > apart_mm
    ]
    result = register_to_surface(
        points,
        surface,
        best.surface_from_points,
        normals=normals,
        point_weights=point_weights,
        options=replace(o, first_distance_mm=max(o.last_distance_mm, min(o.first_distance_mm, limit))),
        **given,  # type: ignore[arg-type]
    )
    if not rivals:
        return result
    cost, rival = min(rivals, key=lambda item: item[0])
    return replace(result, runner_up=rival, runner_up_cost=float(cost / max(costs.min(), 1e-12)))


@dataclass(frozen=True)
class _LinearSystem:
    """The linear system of one iteration; ``values`` and ``vectors`` belong to the determined part of ``basis``."""

    residuals: Array
    weights: Array
    rows: Array
    normals: Array
    moved: Array
    hessian: Array
    gradient: Array
    values: Array
    vectors: Array
    sigma: float
    faces: NDArray[np.int64]


@dataclass(frozen=True)
class _Problem:
    """Points to be registered to a surface, see `register_to_surface`; rotations are in mm at ``radius``."""

    points: Array
    point_normals: Array | None
    base: Array
    surface: MeshSurface
    usable_faces: NDArray[np.bool_] | None
    center: Array
    radius: float
    basis: Array
    options: RegistrationOptions

    def linearised(self, pose: Array, width: float, hint: NDArray[np.int64] | None) -> _LinearSystem:
        """Residuals, weights and normal equations at a pose (4,4) for a kernel of some width in mm."""
        o, moved = self.options, apply(pose, self.points)
        reach = min(max(DISTANCE_SIGMAS * width, o.last_distance_mm), o.first_distance_mm)
        closest = self.surface.closest(moved, reach, hint)
        residuals = closest.distances
        # Points whose closest point lies on an edge are left out: with noise they pull to its outside.
        counts = (closest.faces >= 0) & ~closest.is_edge
        if self.usable_faces is not None:
            counts &= self.usable_faces[closest.faces]
        if self.point_normals is not None:
            cosine = np.sum((self.point_normals @ pose[:3, :3].T) * np.nan_to_num(closest.normals), axis=1)
            counts &= (cosine >= MIN_NORMAL_COSINE) | ~self.point_normals.any(axis=1)
        found = np.count_nonzero(counts)
        if found < max(6, o.min_points // 4):
            raise InputError(f"registration: {found} of {len(moved)} points are within {reach:.2f} mm of the surface")
        size = np.abs(np.where(counts, residuals, 0.0)) * np.sqrt(self.base)
        sigma = max(robust_sigma(size[counts]), 1e-9)
        weights = np.where(counts, tukey_weights(size / max(sigma, width, o.min_width_mm)), 0.0) * self.base
        normals = np.where(counts[:, None], closest.normals, 0.0)
        rows = np.hstack([np.cross(moved - self.center, normals) / self.radius, normals])
        weighted = rows * weights[:, None]
        hessian = weighted.T @ rows
        values, vectors = np.linalg.eigh(self.basis @ hessian @ self.basis.T)
        kept = values > MIN_INFORMATION * weights.sum()
        return _LinearSystem(
            residuals,
            weights,
            rows,
            normals,
            moved,
            hessian,
            gradient=weighted.T @ np.where(counts, residuals, 0.0),
            values=values[kept],
            vectors=vectors[:, kept],
            sigma=sigma,
            faces=closest.faces,
        )

    def result(self, system: _LinearSystem, pose: Array, iterations: int, converged: bool) -> Registration:
        """The registration with its covariance."""
        determined, scales = system.vectors.T @ self.basis, _scales(self.radius)
        used = np.flatnonzero(system.weights > 0.1 * self.base)
        residuals, weights = system.residuals[used], system.weights[used]
        own = np.sqrt(self.base[used])  # residuals × own have equal variance
        noise = estimate_noise(
            system.moved[used],
            system.normals[used],
            residuals * own,
            (system.rows[used] * own[:, None]) @ determined.T,
            self.options.noise_points,
            SEED,
        )
        # A residual moves the result by H⁻¹ Jᵀ w; the covariance is that of the sum of correlated residuals.
        pull = (determined.T / system.values) @ (determined @ (system.rows[used] * (weights / own)[:, None]).T)
        scatter = spread_of_sum(system.moved[used], system.normals[used], pull, noise, SEED)
        return Registration(
            surface_from_points=pose,
            twist=twist_about(self.center, pose),
            center=self.center,
            radius_mm=self.radius,
            free=self.basis,
            undetermined=orthogonal_complement(determined, self.basis),
            information=system.hessian / np.outer(scales, scales),
            covariance=scatter * np.outer(scales, scales),
            noise=noise,
            residuals=system.residuals,
            weights=system.weights / np.maximum(self.base, 1e-300),
            rms_mm=float(np.sqrt(np.average(residuals**2, weights=weights))),
            sigma_mm=system.sigma,
            overlap=float(np.mean(system.weights > 0.5 * self.base)),
            iterations=iterations,
            converged=converged,
        )


def _cost(found: Registration, limit: float) -> float:
    """Mean squared residual, each limited to ``limit`` mm; points without a surface in reach count as the limit."""
    size = np.abs(np.nan_to_num(found.residuals, nan=np.inf))
    return float(np.mean(np.minimum(size, limit) ** 2))


def _scales(radius: float) -> Array:
    """(6,) factors that convert scaled twists, mm at the radius, to rad and mm."""
    return np.array([1.0 / radius] * 3 + [1.0] * 3)
