"""Least-squares planes, cylinders and circles through points, as feature-based metrology fits them; for comparison.

Gauss–Newton on orthogonal distances (Forbes, NPL DITC 140/89), with Tukey's weights against outliers.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from arview.core import fits as core_fits
from arview.core.fits import robust_sigma, tukey_weights
from arview.errors import InputError
from arview.geometry import Array

_ITERATIONS = 60


@dataclass(frozen=True)
class Plane:
    """A plane.

    Attributes:
        point: (3,) on it, nearest to the mean of the points, mm.
        normal: (3,) unit.
        rms_mm: rms residual of the points used.
        used: number of points used.
    """

    point: Array
    normal: Array
    rms_mm: float
    used: int


@dataclass(frozen=True)
class Cylinder:
    """A cylinder.

    Attributes:
        point: (3,) on the axis, nearest to the mean of the points, mm.
        direction: (3,) unit, of the axis.
        radius_mm: its radius.
        rms_mm: rms residual of the points used.
        used: number of points used.
    """

    point: Array
    direction: Array
    radius_mm: float
    rms_mm: float
    used: int

    def axis_at(self, plane_point: Array, plane_normal: Array) -> Array:
        """(3,) intersection of the axis with a plane."""
        return self.point + self.direction * (
            float((plane_point - self.point) @ plane_normal) / float(self.direction @ plane_normal)
        )


@dataclass(frozen=True)
class Circle:
    """A circle in space.

    Attributes:
        center: (3,) mm.
        normal: (3,) unit normal of its plane.
        radius_mm: its radius.
        rms_mm: rms residual of the points used.
        used: number of points used.
    """

    center: Array
    normal: Array
    radius_mm: float
    rms_mm: float
    used: int


def fit_plane(points: Array, is_robust: bool = True) -> Plane:
    """Plane through points (N,3) in mm. Raises InputError for fewer than 3 points or one that is not finite."""
    points = _checked(points, 3, "plane")
    weights = np.ones(len(points))
    for _ in range(_ITERATIONS if is_robust else 1):
        middle = np.average(points, axis=0, weights=weights)
        centred = points - middle
        normal = np.linalg.eigh((centred * weights[:, None]).T @ centred)[1][:, 0]
        residuals = centred @ normal
        before, weights = weights, _weights(residuals) if is_robust else weights
        if np.abs(weights - before).max() < 1e-6:
            break
    return Plane(middle, normal, *_quality(residuals, weights))


def fit_cylinder(
    points: Array, direction: Array | None = None, radius_mm: float | None = None, is_robust: bool = True
) -> Cylinder:
    """Cylinder through points (N,3) in mm.

    Args:
        points: on its wall.
        direction: (3,) approximate axis; None tries the three principal directions of the points.
        radius_mm: known radius; None fits it.
        is_robust: False is plain least squares.

    Raises:
        InputError: fewer than 5 points, one that is not finite, or the points do not lie on a cylinder.
    """
    points = _checked(points, 5, "cylinder")
    if direction is None:
        main = np.linalg.eigh(np.cov(points.T))[1].T
        fits = []
        for axis in main:
            try:
                fits.append(fit_cylinder(points, axis, radius_mm, is_robust))
            except InputError:
                continue
        if not fits:
            raise InputError("cylinder: the points do not lie on one")
        return min(fits, key=lambda fit: fit.rms_mm / fit.used)
    middle = points.mean(axis=0)
    frame = _frame(np.asarray(direction, dtype=np.float64))
    local = (points - middle) @ frame.T

    def residuals(x: Array) -> tuple[Array, Array]:
        """Distances to the wall, and their derivatives by the centre (2), the slopes of the axis (2) and the radius."""
        axis = np.array([x[2], x[3], 1.0])
        scale = np.linalg.norm(axis)
        axis = axis / scale
        away = local - np.array([x[0], x[1], 0.0])
        along = away @ axis
        across = away - along[:, None] * axis
        distance = np.maximum(np.linalg.norm(across, axis=1), 1e-9)
        out = across / distance[:, None]
        rows = np.column_stack([-out[:, :2], -out[:, :2] * (along / scale)[:, None], -np.ones(len(local))])
        return distance - x[4], rows

    known = radius_mm if radius_mm is not None else np.nan
    center, radius = core_fits.fit_circle(local[:, :2])
    start = np.array([*center, 0.0, 0.0, radius if radius_mm is None else known])
    x, weights, rest = _solve(residuals, start, 5 if radius_mm is None else 4, is_robust)
    axis = np.array([x[2], x[3], 1.0]) @ frame
    axis = axis / np.linalg.norm(axis)
    point = middle + np.array([x[0], x[1], 0.0]) @ frame
    return Cylinder(point + axis * ((middle - point) @ axis), axis, float(x[4]), *_quality(rest, weights))


def fit_circle(points: Array, normal: Array | None = None, is_robust: bool = True) -> Circle:
    """Circle through points (N,3) in mm, in the plane through their mean with ``normal``; None fits the plane.

    Raises:
        InputError: fewer than 3 points, or one that is not finite.
    """
    points = _checked(points, 3, "circle")
    plane = fit_plane(points, is_robust) if normal is None else Plane(points.mean(axis=0), normal, 0.0, 0)
    frame = _frame(plane.normal)
    local = ((points - plane.point) @ frame.T)[:, :2]

    def residuals(x: Array) -> tuple[Array, Array]:
        away = local - x[:2]
        distance = np.maximum(np.linalg.norm(away, axis=1), 1e-9)
        return distance - x[2], np.column_stack([-away / distance[:, None], -np.ones(len(local))])

    center, radius = core_fits.fit_circle(local)
    x, weights, rest = _solve(residuals, np.array([*center, radius]), 3, is_robust)
    return Circle(plane.point + np.array([x[0], x[1], 0.0]) @ frame, frame[2], float(x[2]), *_quality(rest, weights))


def _solve(
    residuals: Callable[[Array], tuple[Array, Array]], x: Array, free: int, is_robust: bool
) -> tuple[Array, Array, Array]:
    """Reweighted Gauss–Newton over the first ``free`` unknowns; returns unknowns, weights and residuals."""
    for _ in range(_ITERATIONS):
        rest, rows = residuals(x)
        weights = _weights(rest) if is_robust else np.ones(len(rest))
        part = rows[:, :free] * weights[:, None]
        step = np.linalg.lstsq(part.T @ rows[:, :free], -part.T @ rest, rcond=1e-12)[0]
        x = x + np.pad(step, (0, len(x) - free))
        if np.abs(step).max() < 1e-9:
            break
    rest, _ = residuals(x)
    if not np.isfinite(x).all():
        raise InputError("cylinder: the points do not lie on one")
    return x, weights, rest


def _weights(residuals: Array) -> Array:
    """Tukey's weights for the scale of the median residual."""
    return tukey_weights(residuals / max(robust_sigma(residuals), 1e-9))


def _quality(residuals: Array, weights: Array) -> tuple[float, int]:
    """Rms residual and number of the points with a weight above 0.1."""
    used = weights > 0.1
    return float(np.sqrt(np.mean(residuals[used] ** 2))), int(np.count_nonzero(used))


def _frame(direction: Array) -> Array:
    """(3,3) rows: two unit vectors orthogonal to the direction, and the direction."""
    z = direction / np.linalg.norm(direction)
    x = np.cross(z, np.eye(3)[np.argmin(np.abs(z))])
    x = x / np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z])


def _checked(points: Array, minimum: int, name: str) -> Array:
    """The points as float64. Raises InputError when there are too few, or one is not finite."""
    points = np.asarray(points, dtype=np.float64)
    if len(points) < minimum or not np.isfinite(points).all():
        raise InputError(f"{name}: expected at least {minimum} points, all finite; got {len(points)}")
    return points
