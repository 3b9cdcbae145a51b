"""How far rust, chalk and burrs beside the rim of a hole or pin may have moved its edge.

They move the edge over some arc of the rim. Written as a Fourier series over the angle, as roundness is (ISO 12181-1),
the first harmonic of this error is a shift of the whole rim, which its residuals cannot show; the next harmonics do
show in them. The power of such errors falls with the order, so that the first has somewhat more than these.
"""

from __future__ import annotations

import numpy as np

from arview.geometry import Array
from arview.measurement.datums.datum_fit import robust_weights

_HARMONICS = (2, 3, 4)
"""Harmonics from which the first is inferred; higher ones are of texture, which moves no rim."""
_FIRST = 1.5
"""Power of the first harmonic by the mean power of those: it halves from the second to the fourth."""
_SECTORS = 12
"""Parts of the circle in all of which a rim must be seen for its harmonics to be told apart."""


def waves(radial: Array, angles: Array) -> Array:
    """(N,6) change of the offsets by the harmonics of a rim, from that by its radius (N,) at angles (N,) in rad."""
    turns = np.outer(angles, _HARMONICS)
    return np.asarray(radial[:, None] * np.concatenate([np.cos(turns), np.sin(turns)], axis=1))


def rim_shift_mm(design: Array, offsets: Array, variances: Array, angles: Array, expected_mm: float) -> float:
    """Standard uncertainty, along each axis, of a rim's position by errors that move its edge over an arc.

    The variance is the mean of the expected one and of that inferred from the rim's own harmonics: both have the weight
    of six observations, the conjugate estimate of a variance (Gelman et al., Bayesian Data Analysis, 2.6). Six
    amplitudes alone tell a variance only within a factor of three. A rim that is not seen all around shows too little
    of itself.

    Args:
        design: (N,4) derivative of the offsets by the shift and the radius of the rim.
        offsets: (N,) mm.
        variances: (N,) of the offsets; only their ratios count.
        angles: (N,) around the axis, rad.
        expected_mm: standard deviation to expect of rims of this kind.
    """
    sectors = np.floor((angles % (2 * np.pi)) * _SECTORS / (2 * np.pi))
    if len(np.unique(sectors)) < _SECTORS or len(offsets) < 5 * _SECTORS:
        return expected_mm
    both = np.concatenate([design, waves(design[:, 3], angles)], axis=1)
    share, _ = robust_weights(both, offsets, variances)
    weighted = both * (share / variances)[:, None]
    amplitudes = (np.linalg.pinv(weighted.T @ both, rcond=1e-9, hermitian=True) @ (weighted.T @ offsets))[4:]
    return float(np.sqrt(0.5 * (expected_mm**2 + _FIRST * np.mean(amplitudes**2))))
