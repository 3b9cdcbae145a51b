"""Rigid transforms as (4,4) float64 matrices named ``b_from_a``, and the few operations on them.

A twist is (6,) = (rotation vector in rad, translation); perturbations are applied on the right
(``b_from_a @ exp_se3(twist_in_a)``), i.e. in the frame of the body, unless a name says otherwise.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from arview.errors import InputError

Array = NDArray[np.float64]


def invert(b_from_a: Array) -> Array:
    """Inverse ``a_from_b`` of a rigid (4,4) transform."""
    a_from_b = np.eye(4)
    rotation_t = b_from_a[:3, :3].T
    a_from_b[:3, :3] = rotation_t
    a_from_b[:3, 3] = -rotation_t @ b_from_a[:3, 3]
    return a_from_b


def apply(b_from_a: Array, points_in_a: ArrayLike) -> Array:
    """Points (..., 3) in frame a mapped to frame b by a (4,4) transform."""
    points = np.asarray(points_in_a, dtype=np.float64)
    return points @ b_from_a[:3, :3].T + b_from_a[:3, 3]


def rigid(rotation: ArrayLike, translation: ArrayLike) -> Array:
    """(4,4) transform from a (3,3) rotation and a (3,) translation."""
    b_from_a = np.eye(4)
    b_from_a[:3, :3] = np.asarray(rotation, dtype=np.float64).reshape(3, 3)
    b_from_a[:3, 3] = np.asarray(translation, dtype=np.float64).reshape(3)
    return b_from_a


def skew(v: ArrayLike) -> Array:
    """(3,3) cross-product matrix of a (3,) vector."""
    x, y, z = np.asarray(v, dtype=np.float64)
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def exp_so3(rotation_vector_rad: ArrayLike) -> Array:
    """(3,3) rotation of a (3,) rotation vector (Rodrigues)."""
    w = np.asarray(rotation_vector_rad, dtype=np.float64)
    theta = float(np.linalg.norm(w))
    k = skew(w)
    if theta < 1e-8:
        return np.eye(3) + k + 0.5 * k @ k
    return np.eye(3) + np.sin(theta) / theta * k + (1.0 - np.cos(theta)) / theta**2 * k @ k


def log_so3(rotation: Array) -> Array:
    """(3,) rotation vector in rad of a (3,3) rotation, angle in [0, pi]."""
    vee = 0.5 * np.array(
        [
            rotation[2, 1] - rotation[1, 2],
            rotation[0, 2] - rotation[2, 0],
            rotation[1, 0] - rotation[0, 1],
        ]
    )
    sin_angle = float(np.linalg.norm(vee))
    cos_angle = 0.5 * (float(np.trace(rotation)) - 1.0)
    angle = float(np.arctan2(sin_angle, cos_angle))
    if sin_angle > 1e-6:
        return vee * (angle / sin_angle)
    if cos_angle > 0:
        return vee
    # Angle close to pi: the axis is the dominant column of (R + I) / 2.
    outer = 0.5 * (rotation + np.eye(3))
    column = int(np.argmax(np.diag(outer)))
    axis = outer[:, column] / np.linalg.norm(outer[:, column])
    return axis * angle


def exp_se3(twist: ArrayLike) -> Array:
    """(4,4) transform of a (6,) twist (rotation vector in rad, translation)."""
    xi = np.asarray(twist, dtype=np.float64)
    w, v = xi[:3], xi[3:]
    theta = float(np.linalg.norm(w))
    k = skew(w)
    if theta < 1e-6:
        left_jacobian = np.eye(3) + 0.5 * k
    else:
        left_jacobian = np.eye(3) + (1.0 - np.cos(theta)) / theta**2 * k + (theta - np.sin(theta)) / theta**3 * k @ k
    return rigid(exp_so3(w), left_jacobian @ v)


def log_se3(b_from_a: Array) -> Array:
    """(6,) twist (rotation vector in rad, translation) of a rigid transform."""
    w = log_so3(b_from_a[:3, :3])
    theta = float(np.linalg.norm(w))
    k = skew(w)
    if theta < 1e-6:
        inverse_jacobian = np.eye(3) - 0.5 * k
    else:
        half = 0.5 * theta
        inverse_jacobian = np.eye(3) - 0.5 * k + (1.0 - half / np.tan(half)) / theta**2 * k @ k
    return np.concatenate([w, inverse_jacobian @ b_from_a[:3, 3]])


def rotation_angle_rad(rotation_a: Array, rotation_b: Array) -> float:
    """Angle in rad between two rotations, each (3,3) or the upper left of (4,4)."""
    return float(np.linalg.norm(log_so3(rotation_a[:3, :3].T @ rotation_b[:3, :3])))


def are_near(a: Array, b: Array, reach: float, angle_deg: float) -> bool:
    """Whether two poses (4,4) of one thing are nearer than a distance, in their unit, and an angle."""
    # It is asked often: of the distance first, and of cos of the angle, from the trace.
    apart = a[:3, 3] - b[:3, 3]
    if float(apart @ apart) >= reach * reach or reach <= 0.0:
        return False
    cosine = 0.5 * (float(np.vdot(a[:3, :3], b[:3, :3])) - 1.0)
    return cosine > math.cos(math.radians(angle_deg))


def turn_ball(reach_deg: float, step_deg: float) -> Array:
    """(R,3,3) rotations on a body-centred grid of rotation vectors inside a ball, none at all among them."""
    steps = int(np.ceil(reach_deg / step_deg))
    axis = np.arange(-steps, steps + 1) * step_deg
    corners = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    vectors = np.concatenate([corners, corners + 0.5 * step_deg])
    vectors = vectors[np.linalg.norm(vectors, axis=1) <= reach_deg]
    return np.stack([exp_so3(np.deg2rad(v)) for v in vectors])


def turns_to_rays(rays: Array) -> Array:
    """The smallest rotations (..., 3,3) that take +Z to unit rays (..., 3) in front of the camera."""
    # Rodrigues with the axis z × ray.
    x, y, z = np.moveaxis(rays, -1, 0)
    k = 1.0 / (1.0 + z)
    rows = [[1.0 - k * x * x, -k * x * y, x], [-k * x * y, 1.0 - k * y * y, y], [-x, -y, z]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def orthonormalise(b_from_a: Array) -> Array:
    """Nearest rigid transform: the rotation block is projected onto SO(3) by SVD."""
    u, _, vt = np.linalg.svd(b_from_a[:3, :3])
    rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    return rigid(rotation, b_from_a[:3, 3])


def look_at(camera_in_model: ArrayLike, target_in_model: ArrayLike, up_in_model: ArrayLike) -> Array:
    """``cam_from_model`` of an OpenCV camera at a point, looking at a target, +Y away from ``up``."""
    eye = np.asarray(camera_in_model, dtype=np.float64)
    forward = np.asarray(target_in_model, dtype=np.float64) - eye
    forward = forward / np.linalg.norm(forward)
    up = np.asarray(up_in_model, dtype=np.float64)
    right = np.cross(forward, up)
    if np.linalg.norm(right) < 1e-6 * np.linalg.norm(up):
        right = np.cross(forward, np.array([0.0, 1.0, 0.0]) if abs(forward[1]) < 0.9 else np.array([1.0, 0, 0]))
    right = right / np.linalg.norm(right)
    down = np.cross(forward, right)
    rotation = np.stack([right, down, forward])
    return rigid(rotation, -rotation @ eye)


def direction_from(cam_from_model: Array, center_in_model: Array) -> Array:
    """Unit vector (3,), in the model frame, from a part's centre (3,) towards the camera at a pose (4,4)."""
    offset = -cam_from_model[:3, :3].T @ cam_from_model[:3, 3] - center_in_model
    return np.asarray(offset / np.linalg.norm(offset), dtype=np.float64)


def from_segment(arms: Array, half: Array) -> Array:
    """The arms (…,D) from the nearest point of a line between ``-half`` and ``half`` (D,), which may be a point."""
    along = np.clip(arms @ half / max(float(half @ half), 1e-30), -1.0, 1.0)
    return np.asarray(arms - along[..., None] * half)


def check_rigid(matrix: ArrayLike, name: str) -> Array:
    """Return the (4,4) matrix as float64 after checking that it is a finite rigid transform.

    Raises:
        InputError: wrong shape, NaN, a scaled or mirrored rotation, or a last row other than 0 0 0 1.
    """
    try:
        b_from_a = np.asarray(matrix, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name}: expected a 4×4 matrix of numbers, got {matrix!r}") from error
    if b_from_a.shape != (4, 4):
        raise InputError(f"{name}: expected a 4×4 matrix, got shape {b_from_a.shape}")
    if not np.all(np.isfinite(b_from_a)):
        raise InputError(f"{name}: the matrix holds NaN or infinity")
    if not np.allclose(b_from_a[3], [0, 0, 0, 1], atol=1e-6):
        raise InputError(f"{name}: last row is {b_from_a[3].tolist()}, expected [0, 0, 0, 1] (row-major)")
    rotation = b_from_a[:3, :3]
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3) or np.linalg.det(rotation) < 0:
        raise InputError(f"{name}: the rotation block is not a rotation (scaled, sheared or mirrored)")
    return orthonormalise(b_from_a)
