"""Triangulation of target corners from photos whose poses are known.

Least squares of the reprojection error through the lens, with the poses held fixed (Hartley & Zisserman, "Multiple
View Geometry", 2004), starting from the point nearest to all rays.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from arview.camera import Camera
from arview.fiducials import CornerKey
from arview.geometry import Array

CornerSightings = tuple[Camera, Array, NDArray[np.intp], Array]
"""One photo: camera, ``cam_from_scan``, index of each corner that it shows, and their pixels (N,2)."""


MIN_ANGLE_DEG = 2.0
"""Corners seen under a smaller parallax are not triangulated."""
MIN_SIGMA_PX = 0.05
"""Lower bound of the standard deviation assumed for a corner."""
MAX_SIGMAS = 4.0
"""Observations whose residual exceeds this many standard deviations are dropped."""
HUBER_SIGMAS = 1.5
"""Residual at which Huber's weights (1964) start to fall."""
ITERATIONS = 8
"""Iterations of Gauss-Newton."""


@dataclass(frozen=True)
class TriangulatedCorners:
    """Corners triangulated from several photos.

    Attributes:
        points: (3,) of each corner in the frame and unit of the reconstruction.
        covariances: (3,3) of each corner, same unit squared.
        sigma_px: robust standard deviation of the residuals, per coordinate.
    """

    points: dict[CornerKey, Array]
    covariances: dict[CornerKey, Array]
    sigma_px: float


def triangulate_corners(
    cameras: Sequence[Camera],
    cams_from_scan: Sequence[Array],
    corners_by_photo: Sequence[dict[CornerKey, Array]],
) -> TriangulatedCorners:
    """Triangulate every corner that at least two photos show, robustly.

    Args:
        cameras, cams_from_scan: of each photo; poses (4,4).
        corners_by_photo: pixels (2,) of the corners found in each photo.
    """
    keys = sorted({key for corners in corners_by_photo for key in corners})
    index = {key: i for i, key in enumerate(keys)}
    views: list[CornerSightings] = [
        (camera, pose, np.array([index[k] for k in corners], dtype=np.intp), np.array(list(corners.values())))
        for camera, pose, corners in zip(cameras, cams_from_scan, corners_by_photo, strict=True)
        if corners
    ]
    points, good = _linear_points(views, len(keys), MIN_ANGLE_DEG)
    normal = np.zeros((len(keys), 3, 3))
    sigma_px = np.inf
    for _ in range(ITERATIONS):
        normal, right, counts, errors = _normal_equations(views, points, good, sigma_px)
        good &= counts >= 2
        if not good.any():
            break
        sizes = np.concatenate(errors)
        # The median length of a two-dimensional normal error is 1.1774 σ.
        sigma_px = max(MIN_SIGMA_PX, float(np.median(sizes)) / 1.1774)
        points[good] += np.linalg.solve(normal[good], right[good][:, :, None])[:, :, 0]
    chosen = np.flatnonzero(good)
    covariances = {keys[i]: np.linalg.inv(normal[i]) * sigma_px**2 for i in chosen}
    return TriangulatedCorners({keys[i]: points[i] for i in chosen}, covariances, sigma_px)


def _linear_points(
    views: Sequence[CornerSightings], count: int, min_angle_deg: float
) -> tuple[Array, NDArray[np.bool_]]:
    """The points (count,3) nearest to all of their rays, and for which of them the parallax suffices."""
    normal, right = np.zeros((count, 3, 3)), np.zeros((count, 3))
    directions: list[list[Array]] = [[] for _ in range(count)]
    for camera, pose, which, pixels in views:
        rays = camera.unproject(pixels) @ pose[:3, :3]
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
        np.add.at(normal, which, across)
        np.add.at(right, which, across @ (-pose[:3, :3].T @ pose[:3, 3]))
        for i, ray in zip(which, rays, strict=True):
            directions[i].append(ray)
    good = np.array([len(d) >= 2 and _spread_deg(np.array(d)) > min_angle_deg for d in directions], dtype=bool)
    points = np.zeros((count, 3))
    points[good] = np.linalg.solve(normal[good], right[good][:, :, None])[:, :, 0]
    return points, good


def _normal_equations(
    views: Sequence[CornerSightings], points: Array, good: NDArray[np.bool_], sigma_px: float
) -> tuple[Array, Array, NDArray[np.int_], list[Array]]:
    """Normal matrix (N,3,3), right side (N,3), observations used (N,), and the residual lengths of each photo."""
    normal, right = np.zeros((len(points), 3, 3)), np.zeros((len(points), 3))
    counts, errors = np.zeros(len(points), dtype=int), []
    for camera, pose, which, pixels in views:
        in_cam = points[which] @ pose[:3, :3].T + pose[:3, 3]
        projected = camera.project(in_cam)
        residual = pixels - projected
        size = np.linalg.norm(residual, axis=1)
        keep = good[which] & (size < MAX_SIGMAS * sigma_px)
        errors.append(size[keep])
        jacobian = camera.slopes(in_cam) @ pose[:3, :3]
        # Huber's weights for the standard deviation of the previous iteration.
        weights = np.where(keep, np.minimum(1.0, HUBER_SIGMAS * sigma_px / np.maximum(size, 1e-12)), 0.0)
        weighted = np.nan_to_num(jacobian * weights[:, None, None])
        np.add.at(normal, which, np.einsum("nij,nik->njk", weighted, np.nan_to_num(jacobian)))
        np.add.at(right, which, np.einsum("nij,ni->nj", weighted, np.nan_to_num(residual)))
        np.add.at(counts, which, keep)
    return normal, right, counts, errors


def _spread_deg(rays: Array) -> float:
    """Largest angle between the first and another of some unit rays (N,3)."""
    return float(np.rad2deg(np.arccos(np.clip((rays @ rays[0]).min(), -1.0, 1.0))))
