"""Centre of mass of a body from its triangles: volume centroid of a solid, area centroid of a sheet."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from arview.geometry import Array

MAX_OPEN_SHARE = 1e-3
"""Largest share of the length of all edges at which a surface is not closed, for it to enclose a volume."""


def is_closed(vertices: Array, faces: NDArray[np.int32]) -> bool:
    """Whether a surface encloses a volume: along every edge its faces meet in opposite directions.

    Vertices (V,3) at the same place, to a millionth of the size, count as one.
    """
    used = vertices[faces.ravel()]
    unit = max(float(np.ptp(used, axis=0).max()) * 1e-6, 1e-9)
    _, joined = np.unique(np.round((used - used.min(axis=0)) / unit), axis=0, return_inverse=True)
    corners = joined.reshape(-1, 3).astype(np.int64)
    start, end = corners.ravel(), np.roll(corners, -1, axis=1).ravel()
    count, forward = int(joined.max()) + 1, np.where(start < end, 1, -1)
    keys, inverse = np.unique(np.minimum(start, end) * count + np.maximum(start, end), return_inverse=True)
    balance = np.bincount(inverse.ravel(), weights=forward, minlength=len(keys))
    ends = vertices[np.roll(faces, -1, axis=1)].reshape(-1, 3)
    lengths = np.zeros(len(keys))
    lengths[inverse.ravel()] = np.linalg.norm(used - ends, axis=1)
    return bool(lengths[balance != 0].sum() <= MAX_OPEN_SHARE * lengths.sum())


def volume_centroid(vertices: Array, faces: NDArray[np.int32]) -> Array | None:
    """(3,) centroid of the volume that a closed surface encloses; None if it encloses none.

    The volume is the sum of signed tetrahedra between the faces and an inner point (divergence theorem).
    """
    inner = vertices[np.unique(faces)].mean(axis=0)
    a, b, c = (vertices[faces] - inner).transpose(1, 0, 2)
    volumes = np.einsum("ij,ij->i", a, np.cross(b, c)) / 6.0
    total = float(volumes.sum())
    if abs(total) <= 1e-9 * float(np.abs(volumes).sum()) or total == 0.0:
        return None
    return np.asarray(inner + (volumes[:, None] * (a + b + c)).sum(axis=0) / (4.0 * total))


def area_centroid(vertices: Array, faces: NDArray[np.int32]) -> Array:
    """(3,) centroid of a surface."""
    a, b, c = vertices[faces].transpose(1, 0, 2)
    areas = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    if areas.sum() <= 0.0:
        return np.asarray(vertices[np.unique(faces)].mean(axis=0))
    return np.asarray(np.average((a + b + c) / 3.0, axis=0, weights=areas))


def center_of_mass(vertices: Array, faces: NDArray[np.int32]) -> tuple[Array, bool]:
    """(3,) centre of mass at even density, and whether it is that of a volume; a surface that is open is a sheet."""
    if is_closed(vertices, faces):
        center = volume_centroid(vertices, faces)
        if center is not None:
            return center, True
    return area_centroid(vertices, faces), False
