"""Lens models beyond Brown's five terms: rational, fisheye (with thin prism), field of view, division, inverse Brown.

A lens maps ideal normalised coordinates (x, y), those of a pinhole camera, to distorted ones. The formulas are those of
OpenCV (``cv2.projectPoints``, ``cv2.fisheye``) and COLMAP; the fisheye is that of Kannala and Brandt (PAMI 2006), the
field-of-view model that of Devernay and Faugeras (2001), the division model that of Fitzgibbon (CVPR 2001). The fisheye
with thin prism (COLMAP) applies Brown's and prism terms to the angle; librealsense's inverse Brown has Brown's formula
from distorted to ideal coordinates.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from arview.errors import InputError
from arview.geometry import Array

_NEWTON_STEPS = 40


class LensModel(StrEnum):
    """A lens model, by the name used in arview's camera files."""

    RATIONAL = "rational"
    FISHEYE = "fisheye"
    FOV = "fov"
    DIVISION = "division"
    THIN_PRISM_FISHEYE = "thin_prism_fisheye"
    INVERSE_BROWN = "inverse_brown"


TERM_NAMES: dict[LensModel, tuple[str, ...]] = {
    LensModel.RATIONAL: ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4"),
    LensModel.FISHEYE: ("k1", "k2", "k3", "k4"),
    LensModel.FOV: ("omega",),
    LensModel.DIVISION: ("k",),
    LensModel.THIN_PRISM_FISHEYE: ("k1", "k2", "p1", "p2", "k3", "k4", "s1", "s3"),
    LensModel.INVERSE_BROWN: ("k1", "k2", "p1", "p2", "k3"),
}
"""Names of the terms of each model, in their order."""


@dataclass(frozen=True)
class LensDistortion:
    """A lens model and its terms, in the order of `TERM_NAMES`; terms left out are zero.

    Raises:
        InputError: too many terms, or one that is not finite.
    """

    model: LensModel
    terms: tuple[float, ...]

    def __post_init__(self) -> None:
        names = TERM_NAMES[self.model]
        terms = tuple(float(term) for term in self.terms)
        if len(terms) > len(names):
            raise InputError(f"lens model {self.model}: {len(terms)} terms; expected {' '.join(names)}")
        if not all(math.isfinite(term) for term in terms):
            raise InputError(f"lens model {self.model}: a term is NaN or infinite; calibrate again or correct the file")
        object.__setattr__(self, "model", LensModel(self.model))
        object.__setattr__(self, "terms", terms + (0.0,) * (len(names) - len(terms)))

    def distort(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Distorted normalised coordinates of ideal ones."""
        if self.model is LensModel.RATIONAL:
            return _rational(self.terms, x, y)
        if self.model is LensModel.INVERSE_BROWN:
            return undistort_by_newton(self._brown, x, y)
        r = np.hypot(x, y)
        if self.model is LensModel.THIN_PRISM_FISHEYE:
            scale = np.where(r > 1e-12, np.arctan(r) / np.maximum(r, 1e-300), 1.0)
            return self._thin_prism(x * scale, y * scale)
        with np.errstate(divide="ignore", invalid="ignore"):
            scale = np.where(r > 1e-12, self._distorted_radius(r) / np.maximum(r, 1e-300), self._central_scale)
        return x * scale, y * scale

    def undistort(self, xd: Array, yd: Array) -> tuple[Array, Array]:
        """Ideal normalised coordinates of distorted ones; NaN where no ray in front of the camera is seen."""
        if self.model is LensModel.RATIONAL:
            return undistort_by_newton(self.distort, xd, yd)
        if self.model is LensModel.INVERSE_BROWN:
            return self._brown(np.asarray(xd, dtype=np.float64), np.asarray(yd, dtype=np.float64))
        if self.model is LensModel.THIN_PRISM_FISHEYE:
            a, b = undistort_by_newton(self._thin_prism, xd, yd)
            theta = np.hypot(a, b)
            with np.errstate(invalid="ignore"):
                scale = np.where(theta > 1e-12, np.tan(theta) / np.maximum(theta, 1e-300), 1.0)
                scale = np.where(theta < 0.5 * math.pi, scale, np.nan)
            return a * scale, b * scale
        rd = np.hypot(xd, yd)
        with np.errstate(divide="ignore", invalid="ignore"):
            scale = np.where(rd > 1e-12, self._ideal_radius(rd) / np.maximum(rd, 1e-300), 1.0 / self._central_scale)
        return xd * scale, yd * scale

    def turned_clockwise(self) -> LensDistortion:
        """The lens for a picture turned clockwise by a quarter turn."""
        if self.model is LensModel.INVERSE_BROWN:
            k1, k2, p1, p2, k3 = self.terms
            return LensDistortion(self.model, (k1, k2, p2, -p1, k3))
        if self.model is LensModel.THIN_PRISM_FISHEYE:
            k1, k2, p1, p2, k3, k4, s1, s3 = self.terms
            return LensDistortion(self.model, (k1, k2, p2, -p1, k3, k4, -s3, s1))
        if self.model is not LensModel.RATIONAL:
            return self
        k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = self.terms
        return LensDistortion(self.model, (k1, k2, p2, -p1, k3, k4, k5, k6, -s3, -s4, s1, s2))

    def _brown(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Brown's formula with the first five terms."""
        return _rational(self.terms[:5] + (0.0,) * 7, x, y)

    def _thin_prism(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Distorted coordinates of those of an equidistant lens."""
        k1, k2, p1, p2, k3, k4, s1, s3 = self.terms
        r2 = x * x + y * y
        with np.errstate(over="ignore", invalid="ignore"):
            radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)))
            xd = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x) + s1 * r2
            yd = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y + s3 * r2
        return xd, yd

    @property
    def _central_scale(self) -> float:
        """Distorted by ideal radius at the centre of the picture."""
        if self.model is LensModel.FOV and self.terms[0] ** 2 > _SMALL_OMEGA_2:
            return 2.0 * math.tan(0.5 * self.terms[0]) / self.terms[0]
        return 1.0

    def _distorted_radius(self, r: Array) -> Array:
        """Distorted radius of an ideal one, of a model that is symmetric around the centre."""
        if self.model is LensModel.FISHEYE:
            return _fisheye_radius(np.arctan(r), self.terms)
        if self.model is LensModel.FOV:
            omega = self.terms[0]
            if omega * omega <= _SMALL_OMEGA_2:
                return r
            return np.arctan(2.0 * r * math.tan(0.5 * omega)) / omega
        # r = rd / (1 + k rd²), solved for rd; NaN beyond the largest radius that the model can show.
        with np.errstate(invalid="ignore"):
            return 2.0 * r / (1.0 + np.sqrt(1.0 - 4.0 * self.terms[0] * r * r))

    def _ideal_radius(self, rd: Array) -> Array:
        """Ideal radius of a distorted one; NaN from 90° off the axis."""
        if self.model is LensModel.FISHEYE:
            theta = _fisheye_angle(rd, self.terms)
            return np.where(theta < 0.5 * math.pi, np.tan(theta), np.nan)
        if self.model is LensModel.FOV:
            omega = self.terms[0]
            if omega * omega <= _SMALL_OMEGA_2:
                return rd
            angle = rd * omega
            return np.where(angle < 0.5 * math.pi, np.tan(angle) / (2.0 * math.tan(0.5 * omega)), np.nan)
        with np.errstate(divide="ignore"):
            below = 1.0 + self.terms[0] * rd * rd
            return np.where(below > 0.0, rd / below, np.nan)


_SMALL_OMEGA_2 = 1e-12
"""Squared field-of-view parameter below which that lens is a pinhole."""


def _rational(terms: tuple[float, ...], x: Array, y: Array) -> tuple[Array, Array]:
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = terms
    r2 = x * x + y * y
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        radial = (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1.0 + r2 * (k4 + r2 * (k5 + r2 * k6)))
        xd = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x) + r2 * (s1 + r2 * s2)
        yd = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y + r2 * (s3 + r2 * s4)
    return xd, yd


def undistort_by_newton(
    distort: Callable[[Array, Array], tuple[Array, Array]], xd: Array, yd: Array, is_nearest: bool = False
) -> tuple[Array, Array]:
    """Ideal coordinates of distorted ones, by Newton's method with damped steps.

    Args:
        distort: distorted coordinates of ideal ones.
        xd, yd: distorted coordinates.
        is_nearest: where no ray is distorted to them, return where the search ended instead of NaN.
    """
    xd, yd = np.asarray(xd, dtype=np.float64), np.asarray(yd, dtype=np.float64)
    x, y = xd.copy(), yd.copy()
    step = 1e-6
    with np.errstate(all="ignore"):
        for _ in range(_NEWTON_STEPS):
            xe, ye = distort(x, y)
            right, up = distort(x + step, y), distort(x, y + step)
            a, c = (right[0] - xe) / step, (right[1] - ye) / step
            b, d = (up[0] - xe) / step, (up[1] - ye) / step
            det = a * d - b * c
            dx, dy = xd - xe, yd - ye
            u, v = (d * dx - b * dy) / det, (a * dy - c * dx) / det
            # A step is at most half the radius, so that it does not jump over a fold of the polynomial.
            length, most = np.hypot(u, v), 0.5 * np.hypot(x, y) + 0.05
            shrink = np.where(length > most, most / length, 1.0)
            x, y = x + shrink * u, y + shrink * v
            if not np.any(length > 1e-13):
                break
        xe, ye = distort(x, y)
        is_found = np.hypot(xe - xd, ye - yd) < 1e-8
    if is_nearest:
        is_found |= np.isfinite(x) & np.isfinite(y)
    return np.where(is_found, x, np.nan), np.where(is_found, y, np.nan)


def _fisheye_radius(theta: Array, terms: tuple[float, ...]) -> Array:
    k1, k2, k3, k4 = terms
    t2 = theta * theta
    return theta * (1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))


def _fisheye_angle(rd: Array, terms: tuple[float, ...]) -> Array:
    """Angle (rad) off the axis of a distorted radius, within the range in which the polynomial rises; else NaN."""
    grid = np.linspace(0.0, math.pi, 2049)
    radii = _fisheye_radius(grid, terms)
    falls = np.flatnonzero(np.diff(radii) <= 0.0)
    end = int(falls[0]) if len(falls) else len(grid) - 1
    theta = np.interp(rd, radii[: end + 1], grid[: end + 1], right=np.nan)
    k1, k2, k3, k4 = terms
    with np.errstate(divide="ignore", invalid="ignore"):
        for _ in range(4):
            t2 = theta * theta
            slope = 1.0 + t2 * (3.0 * k1 + t2 * (5.0 * k2 + t2 * (7.0 * k3 + t2 * 9.0 * k4)))
            move = (rd - _fisheye_radius(theta, terms)) / slope
            theta = theta + np.clip(move, -2e-3, 2e-3)
    return theta
