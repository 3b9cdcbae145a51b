"""Projection by the lens models that are calibrated, with its derivatives by intrinsics and pose."""

from __future__ import annotations

from collections.abc import Sequence
from enum import StrEnum

import numpy as np

from arview.camera import Camera, LensDistortion, LensModel
from arview.errors import InputError
from arview.geometry import Array, rigid

_MAX_START_SLOPE = 2.5
"""Tangent of the angle off the axis (68°) up to which corners give the first pose of a view."""
_MIN_START_CORNERS = 6


class CalibratedLens(StrEnum):
    """A lens model that can be calibrated, by the name on the command line."""

    BROWN = "brown"
    FISHEYE = "fisheye"


PARAMETERS_OF: dict[CalibratedLens, tuple[str, ...]] = {
    CalibratedLens.BROWN: ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3"),
    CalibratedLens.FISHEYE: ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"),
}
"""Names of the intrinsics of each lens model, in the order of the covariance."""


def lens_of(camera: Camera) -> CalibratedLens:
    """The lens model of a camera; raises InputError for one that is not calibrated."""
    if camera.lens is None:
        return CalibratedLens.BROWN
    if camera.lens.model is LensModel.FISHEYE:
        return CalibratedLens.FISHEYE
    raise InputError(f"calibration: lens model {camera.lens.model}; expected {', '.join(CalibratedLens)}")


def intrinsics_of(camera: Camera) -> Array:
    """(P,) values of the intrinsics, in the order of PARAMETERS_OF."""
    terms: Sequence[float] = camera.dist.tolist() if camera.lens is None else camera.lens.terms
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy, *terms])


def fisheye_camera(width: int, height: int, intrinsics: Sequence[float]) -> Camera:
    """The fisheye camera of intrinsics in the order of PARAMETERS_OF."""
    fx, fy, cx, cy, *terms = (float(value) for value in intrinsics)
    return Camera(width, height, fx, fy, cx, cy, lens=LensDistortion(LensModel.FISHEYE, tuple(terms)))


def project(points: Array, camera: Camera, cam_from_points: Array) -> tuple[Array, Array, Array]:
    """Pixels (N,2) of points (N,3), and derivatives (2N,P) by the intrinsics and (2N,6) by the pose.

    The pose's derivatives are by a rotation, rad, and a translation, mm. For the fisheye the rotation is one in the
    camera frame, applied to the rotated points; for Brown it is OpenCV's rotation vector. Both span the same changes.
    """
    if lens_of(camera) is CalibratedLens.FISHEYE:
        return _project_fisheye(np.asarray(points, dtype=np.float64), camera, cam_from_points)
    import cv2

    turn = cv2.Rodrigues(cam_from_points[:3, :3])[0]
    pixels, jacobian = cv2.projectPoints(
        np.asarray(points, dtype=np.float64)[:, None], turn, cam_from_points[:3, 3], camera.matrix, camera.dist
    )
    return pixels.reshape(-1, 2), np.asarray(jacobian[:, 6:15]), np.asarray(jacobian[:, :6])


def pose_of_board(points_in_board: Array, pixels: Array, camera: Camera) -> Array | None:
    """(4,4) cam_from_board of a plane board's corners (N,3) mm at pixels (N,2); None where too few give rays."""
    import cv2

    rays = camera.unproject(pixels)[:, :2]
    with np.errstate(invalid="ignore"):
        usable = np.hypot(*rays.T) < _MAX_START_SLOPE  # false for NaN
    if np.count_nonzero(usable) < _MIN_START_CORNERS:
        return None
    try:
        found, turn, shift = cv2.solvePnP(
            points_in_board[usable][:, None], rays[usable][:, None], np.eye(3), None, flags=cv2.SOLVEPNP_ITERATIVE
        )
    except cv2.error:
        return None
    pose = rigid(cv2.Rodrigues(turn)[0], np.asarray(shift).ravel())
    depth = points_in_board[usable].mean(axis=0) @ pose[2, :3] + pose[2, 3]
    return pose if found and depth > 0.0 else None  # not for NaN


def _project_fisheye(points: Array, camera: Camera, cam_from_points: Array) -> tuple[Array, Array, Array]:
    """As `project`, for the fisheye of Kannala and Brandt, also for points more than 90° off the axis."""
    assert camera.lens is not None
    k1, k2, k3, k4 = camera.lens.terms
    turned = points @ cam_from_points[:3, :3].T
    x, y, z = (turned + cam_from_points[:3, 3]).T
    rho = np.maximum(np.hypot(x, y), 1e-12)
    length2 = np.maximum(rho**2 + z**2, 1e-24)
    theta = np.arctan2(rho, z)
    t2 = theta * theta
    radius = theta * (1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
    slope = 1.0 + t2 * (3.0 * k1 + t2 * (5.0 * k2 + t2 * (7.0 * k3 + t2 * 9.0 * k4)))
    a, b = x / rho, y / rho
    scale = radius / rho
    xd, yd = scale * x, scale * y
    pixels = np.stack([camera.fx * xd + camera.cx, camera.fy * yd + camera.cy], axis=-1)
    count = len(points)
    intrinsics = np.zeros((count, 2, 8))
    intrinsics[:, 0, 0], intrinsics[:, 1, 1] = xd, yd
    intrinsics[:, 0, 2] = intrinsics[:, 1, 3] = 1.0
    for k in range(4):
        power = theta ** (2 * k + 3)
        intrinsics[:, 0, 4 + k], intrinsics[:, 1, 4 + k] = camera.fx * a * power, camera.fy * b * power
    # Derivatives of (xd, yd) by the point in the camera frame.
    along = slope * z / length2 - scale
    by_z = -slope / length2
    by_point = np.empty((count, 2, 3))
    by_point[:, 0, 0], by_point[:, 0, 1], by_point[:, 0, 2] = scale + a * a * along, a * b * along, x * by_z
    by_point[:, 1, 0], by_point[:, 1, 1], by_point[:, 1, 2] = a * b * along, scale + b * b * along, y * by_z
    by_point *= np.array([camera.fx, camera.fy])[:, None]
    pose = np.empty((count, 2, 6))
    pose[:, :, :3] = np.cross(turned[:, None], by_point)
    pose[:, :, 3:] = by_point
    return pixels, intrinsics.reshape(-1, 8), pose.reshape(-1, 6)
