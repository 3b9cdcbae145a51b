"""Subspaces of rigid motions: which directions data determine, what two have in common, what is left of one."""

from __future__ import annotations

import numpy as np

from arview.geometry import Array
from arview.measurement.datums.equations import DOF_NAMES

MIN_SHARE_OF_SIZE = 0.02
"""Displacement, in sizes of the part, of a datum's points by a unit motion, from which the motion is determined."""


def shift_origin(origin: Array) -> Array:
    """(3,7) matrix S that moves equations to another origin: subtract ``normals @ S`` from their rows."""
    x, y, z = origin
    shift = np.zeros((3, 7))
    shift[:, :3] = [[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]
    shift[:, 6] = origin
    return shift


def observable_directions(rows: Array, allowed: Array, weights: Array) -> Array:
    """(6,K) orthonormal directions within ``allowed`` (6,F) that weighted, scaled rows (N,6) determine."""
    if allowed.shape[1] == 0:
        return allowed
    share = weights / weights.sum()
    projected = (rows * np.sqrt(share)[:, None]) @ allowed
    _, values, right = np.linalg.svd(projected, full_matrices=False)
    size = np.sqrt((share[:, None] * rows**2).sum())
    return allowed @ right[values > MIN_SHARE_OF_SIZE * size].T


def direction_names(directions: Array) -> str:
    """Directions as ``rx ry tz``; oblique ones as their number."""
    directions = directions[:, np.abs(directions).max(axis=0) > 0]
    share = (directions**2).sum(axis=1)
    if np.allclose(share.round(2) % 1.0, 0.0, atol=0.02):
        return " ".join(name for name, one in zip(DOF_NAMES, share, strict=True) if one > 0.5)
    return f"{directions.shape[1]} oblique directions"
