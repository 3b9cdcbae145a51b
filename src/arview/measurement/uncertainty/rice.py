"""Bias of the length of a noisy displacement: density and mean of the measured length, and the most likely true length.

With noise of standard deviation σ on each of n axes, a true length A gives measured lengths r with the density

    p(r) = r/σ² · (r/A)^(n/2 − 1) · exp(−(r² + A²) / 2σ²) · I_{n/2 − 1}(r A/σ²),

which is Rice's for two axes (S. O. Rice 1945); at A = 0 it is Rayleigh's for two and Maxwell's for three axes.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from arview.errors import InputError
from arview.geometry import Array


def rice_density(lengths: ArrayLike, true_length: float, sigma: float, axes: int = 2) -> Array:
    """Density of measured lengths (...,) for a true length and the noise of each axis.

    Raises:
        InputError: sigma ≤ 0, a negative true length, or ``axes`` other than 1, 2, 3.
    """
    from scipy.special import gamma, ive

    _check(true_length, sigma, axes)
    r = np.asarray(lengths, dtype=np.float64) / sigma
    a, order = true_length / sigma, 0.5 * axes - 1.0
    if a < 1e-6:
        density = 2.0 ** (-order) / gamma(0.5 * axes) * r ** (axes - 1) * np.exp(-0.5 * r**2)
    else:
        inside = np.where(r > 0, r, 1.0)
        density = inside * (inside / a) ** order * np.exp(-0.5 * (inside - a) ** 2) * ive(order, inside * a)
        at_zero = np.sqrt(2.0 / np.pi) * np.exp(-0.5 * a**2) if axes == 1 else 0.0
        density = np.where(r > 0, density, at_zero)
    return np.asarray(np.where(r >= 0, density / sigma, 0.0))


def rice_mean(true_length: float, sigma: float, axes: int = 2) -> float:
    """Mean of the measured lengths, which exceeds the true length."""
    from scipy.special import gamma, hyp1f1

    _check(true_length, sigma, axes)
    x = -0.5 * (true_length / sigma) ** 2
    if x < -500.0:  # far from zero, use the series in σ/A
        return true_length + 0.5 * (axes - 1) * sigma**2 / true_length
    factor = np.sqrt(2.0) * gamma(0.5 * (axes + 1)) / gamma(0.5 * axes)
    return float(sigma * factor * hyp1f1(-0.5, 0.5 * axes, x))


def rice_estimate(lengths: ArrayLike, sigma: float, axes: int = 2) -> float:
    """Most likely true length for measured lengths (N,), or a single one; 0 where noise alone explains them.

    The maximum of the likelihood satisfies A = mean of r · I_{n/2}(rA/σ²) / I_{n/2 − 1}(rA/σ²); it is at 0 where the
    mean square is at most n σ².

    Raises:
        InputError: no lengths, or one that is not finite; see also `rice_density`.
    """
    from scipy.optimize import brentq
    from scipy.special import ive

    _check(0.0, sigma, axes)
    r = np.atleast_1d(np.asarray(lengths, dtype=np.float64)) / sigma
    if len(r) == 0 or not np.isfinite(r).all():
        raise InputError("rice: no lengths, or one that is not finite")
    if float(np.mean(r**2)) <= axes * (1.0 + 1e-9):
        return 0.0

    def excess(a: float) -> float:
        return float(np.mean(r * ive(0.5 * axes, r * a) / ive(0.5 * axes - 1.0, r * a)) - a)

    return float(brentq(excess, 1e-6, float(r.mean()) + 1.0, xtol=1e-9) * sigma)


def _check(true_length: float, sigma: float, axes: int) -> None:
    if not sigma > 0 or true_length < 0 or axes not in (1, 2, 3):
        raise InputError(f"rice: sigma {sigma}, length {true_length}, axes {axes}; expected > 0, >= 0, and 1, 2 or 3")
