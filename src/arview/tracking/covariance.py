"""Covariance of a tracked pose: what each edge point measures for itself, and what all points of a frame share."""

from __future__ import annotations

import numpy as np

from arview.core.kernel import kernel
from arview.geometry import Array

POINTS_BETWEEN_FRAMES, POINTS_OF_FRAME = 8.0, 4.0
"""Neighbouring edge points that share one error, because points along one edge are measured every few pixels: where the
poses of two frames are compared, and for the pose of one frame."""
COMMON_SHIFT_PX, COMMON_SIZE_PX = 0.6, 0.3
"""Standard deviations of what all points share: a shift, and a change of the part's radius or its turn. Errors of lens,
CAD and light do not average out."""
MOTION_SHIFT, MOTION_SIZE = 0.1, 0.05
"""Shares of the motion since the last frame by which they grow: blur and rolling shutter move all points alike."""


@kernel
def covariance_of(information: Array, quality: float, diameter_mm: float, correlated_points: float) -> Array:
    """Covariance (6,6) of a twist (rad, mm) for an information (6,6) and the quality of its pose.

    It is the inverse of the information, enlarged by the number of points that share an error, and limited by half a
    radian and half a diameter.
    """
    scale = correlated_points / max(quality, 0.05)
    total = information / scale
    for i in range(6):
        total[i, i] += 4.0 if i < 3 else 4.0 / diameter_mm**2
    return np.asarray(np.linalg.inv(total), dtype=np.float64)


@kernel
def common_covariance(cam_from_body: Array, radius_px: float, diameter_mm: float, motion: Array) -> Array:
    """Covariance (6,6) of the errors that all points of a frame share.

    Args:
        cam_from_body: (4,4) pose.
        radius_px: half the diameter of the part in the picture.
        diameter_mm: of the part.
        motion: (6,) twist (rad, mm) of the part since the last frame.
    """
    r = cam_from_body
    distance_mm, mm_per_px = max(r[2, 3], 1.0), 0.5 * diameter_mm / radius_px
    shift_mm = np.ascontiguousarray(r[:3, :3]) @ np.ascontiguousarray(motion[3:])
    turned_px = radius_px * np.sqrt((motion[:3] * motion[:3]).sum() + (shift_mm[2] / distance_mm) ** 2)
    motion_px = np.sqrt(turned_px**2 + (shift_mm[0] / mm_per_px) ** 2 + (shift_mm[1] / mm_per_px) ** 2)
    shift_px = np.hypot(COMMON_SHIFT_PX, MOTION_SHIFT * motion_px)
    turn_rad = np.hypot(COMMON_SIZE_PX, MOTION_SIZE * motion_px) / radius_px
    covariance = np.zeros((6, 6))
    for i in range(3):
        covariance[i, i] = turn_rad**2
        for j in range(3):
            across = (shift_px * mm_per_px) ** 2 * (r[0, i] * r[0, j] + r[1, i] * r[1, j])
            covariance[3 + i, 3 + j] = across + (turn_rad * distance_mm) ** 2 * r[2, i] * r[2, j]
    return covariance
