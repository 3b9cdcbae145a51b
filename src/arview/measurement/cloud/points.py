"""Preparation of a cloud for measuring: invalid points are removed, the others averaged on a grid."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from arview.errors import InputError
from arview.geometry import Array
from arview.reconstruction import DenseCloud

_CHUNK = 4_000_000
"""Points averaged at a time, so that memory does not grow with the cloud."""


@dataclass(frozen=True)
class CloudPoints:
    """Points of a cloud; all values are finite.

    Attributes:
        points: (N,3) mm.
        normals: (N,3) unit, zero where unknown.
        sigma: (N,) standard deviations along the normals, mm.
    """

    points: Array
    normals: Array
    sigma: Array

    def __len__(self) -> int:
        return len(self.points)

    def only(self, chosen: NDArray[np.bool_] | NDArray[np.int64]) -> CloudPoints:
        """The chosen points."""
        return CloudPoints(self.points[chosen], self.normals[chosen], self.sigma[chosen])


def prepare_cloud(cloud: DenseCloud, box: Array, grid_mm: float, min_points: int) -> CloudPoints:
    """Points of a cloud inside a box (2,3), averaged on a grid; non-finite and repeated points are tolerated.

    Raises:
        InputError: fewer than ``min_points`` are left.
    """
    if len(cloud.points) == 0:
        raise InputError("cloud: is empty; reconstruct again with more photos or more texture around the part")
    parts, broken = [], 0
    for start in range(0, len(cloud.points), _CHUNK):
        part = slice(start, start + _CHUNK)
        points = np.asarray(cloud.points[part], dtype=np.float64)
        with np.errstate(invalid="ignore"):
            inside = np.all((points >= box[0]) & (points <= box[1]), axis=1)
        broken += int(np.count_nonzero(~np.isfinite(points).all(axis=1)))
        normals = np.nan_to_num(np.asarray(cloud.normals[part][inside], dtype=np.float64))
        sigma = np.asarray(cloud.sigma[part][inside], dtype=np.float64)
        parts.append(CloudPoints(points[inside], normals, np.where(sigma > 1e-6, sigma, np.nan)))
        if len(parts) > 1:
            parts = [grid_average(join(parts), grid_mm)]
    kept = join(parts)
    if len(kept) < min_points:
        raise InputError(
            f"cloud: {len(kept)} of {len(cloud.points)} points lie at the part ({broken} are NaN); at least "
            f"{min_points} are needed: is it in mm and in the frame of the CAD?"
        )
    typical = float(np.nanmedian(kept.sigma)) if np.isfinite(kept.sigma).any() else 0.05
    filled = CloudPoints(kept.points, kept.normals, np.where(np.isfinite(kept.sigma), kept.sigma, typical))
    return grid_average(filled, grid_mm)


def typical_spacing(cloud: CloudPoints) -> float:
    """Distance between neighbouring points: of points that lie at random, the side of the square that each has."""
    from scipy.spatial import cKDTree

    few = cloud.points[:: max(1, len(cloud) // 5000)]
    return float(2.0 * np.median(cKDTree(cloud.points).query(few, k=2)[0][:, 1]))


def join(parts: list[CloudPoints]) -> CloudPoints:
    """All points in one."""
    return CloudPoints(
        np.concatenate([p.points for p in parts]),
        np.concatenate([p.normals for p in parts]),
        np.concatenate([p.sigma for p in parts]),
    )


def grid_average(cloud: CloudPoints, grid_mm: float) -> CloudPoints:
    """One point for each cell of a grid and main direction of the normal, so that both sides of a thin wall are kept.

    Points are weighted by 1/σ². Since errors of neighbours are correlated, σ of the average is that of a typical point.
    """
    if grid_mm <= 0 or len(cloud) == 0:
        return cloud
    cell = np.floor(cloud.points / grid_mm).astype(np.int64)
    cell -= cell.min(axis=0)
    size, main = cell.max(axis=0) + 1, np.argmax(np.abs(cloud.normals), axis=1)
    side = 2 * main + (np.take_along_axis(cloud.normals, main[:, None], axis=1)[:, 0] < 0)
    key = ((cell[:, 0] * size[1] + cell[:, 1]) * size[2] + cell[:, 2]) * 6 + side
    order = np.argsort(key, kind="stable")
    key = key[order]
    first = np.flatnonzero(np.concatenate([[True], key[1:] != key[:-1]]))
    weight = 1.0 / np.nan_to_num(cloud.sigma[order], nan=0.05) ** 2
    count = np.diff(np.append(first, len(key)))
    total = np.add.reduceat(weight, first)
    points = np.add.reduceat(cloud.points[order] * weight[:, None], first, axis=0) / total[:, None]
    normals = np.add.reduceat(cloud.normals[order] * weight[:, None], first, axis=0)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return CloudPoints(points, normals / np.where(length > 1e-9, length, np.inf), np.sqrt(count / total))
