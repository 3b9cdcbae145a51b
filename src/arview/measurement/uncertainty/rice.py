"""Bias of the length of a noisy displacement: the most likely true length of measured lengths.

With noise of standard deviation σ on each of n axes, a true length A gives measured lengths r with the density

    p(r) = r/σ² · (r/A)^(n/2 − 1) · exp(−(r² + A²) / 2σ²) · I_{n/2 − 1}(r A/σ²),

which is Rice's for two axes (S. O. Rice 1945); at A = 0 it is Rayleigh's for two and Maxwell's for three axes.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from arview.errors import InputError


def rice_estimate(lengths: ArrayLike, sigma: float, axes: int = 2) -> float:
    """Most likely true length for measured lengths (N,), or a single one; 0 where noise alone explains them.

    The maximum of the likelihood satisfies A = mean of r · I_{n/2}(rA/σ²) / I_{n/2 − 1}(rA/σ²); it is at 0 where the
    mean square is at most n σ².

    Raises:
        InputError: sigma ≤ 0, ``axes`` other than 1, 2, 3, no lengths, or one that is not finite.
    """
    from scipy.optimize import brentq
    from scipy.special import ive

    if not sigma > 0 or axes not in (1, 2, 3):
        raise InputError(f"rice: sigma {sigma}, axes {axes}; expected > 0, and 1, 2 or 3")
    r = np.atleast_1d(np.asarray(lengths, dtype=np.float64)) / sigma
    if len(r) == 0 or not np.isfinite(r).all():
        raise InputError("rice: no lengths, or one that is not finite")
    if float(np.mean(r**2)) <= axes * (1.0 + 1e-9):
        return 0.0

    def excess(a: float) -> float:
        return float(np.mean(r * ive(0.5 * axes, r * a) / ive(0.5 * axes - 1.0, r * a)) - a)

    return float(brentq(excess, 1e-6, float(r.mean()) + 1.0, xtol=1e-9) * sigma)
