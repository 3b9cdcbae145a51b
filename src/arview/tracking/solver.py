"""Shared kernels of the modalities: projection with distortion, the point-to-line Jacobian, the 6×6 solve.

The pose is perturbed on the right about the model's centre: ``cam_from_body @ exp_se3(twist)`` with the body frame
at the centre. For a residual along a unit image direction n, J = [p × a, a] with a = Rᵀ (∂π/∂X)ᵀ n.
"""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, nogil=True, inline="always")
def project(x, y, z, intrinsics):  # type: ignore[no-untyped-def]
    """Pixel of a camera-frame point; ``intrinsics`` is (10,) fx fy cx cy k1 k2 p1 p2 k3 is_distorted."""
    xn = x / z
    yn = y / z
    if intrinsics[9] != 0.0:
        r2 = xn * xn + yn * yn
        radial = 1.0 + r2 * (intrinsics[4] + r2 * (intrinsics[5] + r2 * intrinsics[8]))
        xd = xn * radial + 2.0 * intrinsics[6] * xn * yn + intrinsics[7] * (r2 + 2.0 * xn * xn)
        yd = yn * radial + intrinsics[6] * (r2 + 2.0 * yn * yn) + 2.0 * intrinsics[7] * xn * yn
        xn, yn = xd, yd
    return intrinsics[0] * xn + intrinsics[2], intrinsics[1] * yn + intrinsics[3]


@njit(cache=True, nogil=True)
def project_lines(points, directions, across, cam_from_body, intrinsics, step_mm):  # type: ignore[no-untyped-def]
    """Pixels (N,2) of body points and unit image directions (N,2) of 3D directions at them, and depths (N,).

    With ``across`` the direction is turned a quarter: the image normal of a tangent. Depth is -1 for points that are
    not in front of the camera or whose direction vanishes in the picture.
    """
    count = points.shape[0]
    pixels = np.empty((count, 2))
    normals = np.empty((count, 2))
    depths = np.empty(count)
    r = cam_from_body
    for i in range(count):
        px, py, pz = points[i, 0], points[i, 1], points[i, 2]
        x = r[0, 0] * px + r[0, 1] * py + r[0, 2] * pz + r[0, 3]
        y = r[1, 0] * px + r[1, 1] * py + r[1, 2] * pz + r[1, 3]
        z = r[2, 0] * px + r[2, 1] * py + r[2, 2] * pz + r[2, 3]
        if z < 1.0:
            depths[i] = -1.0
            continue
        qx = px + step_mm * directions[i, 0]
        qy = py + step_mm * directions[i, 1]
        qz = pz + step_mm * directions[i, 2]
        x2 = r[0, 0] * qx + r[0, 1] * qy + r[0, 2] * qz + r[0, 3]
        y2 = r[1, 0] * qx + r[1, 1] * qy + r[1, 2] * qz + r[1, 3]
        z2 = r[2, 0] * qx + r[2, 1] * qy + r[2, 2] * qz + r[2, 3]
        if z2 < 1.0:
            depths[i] = -1.0
            continue
        u, v = project(x, y, z, intrinsics)
        u2, v2 = project(x2, y2, z2, intrinsics)
        du, dv = u2 - u, v2 - v
        norm = np.sqrt(du * du + dv * dv)
        if norm < 1e-9:
            depths[i] = -1.0
            continue
        pixels[i, 0] = u
        pixels[i, 1] = v
        if across:
            normals[i, 0] = -dv / norm
            normals[i, 1] = du / norm
        else:
            normals[i, 0] = du / norm
            normals[i, 1] = dv / norm
        depths[i] = z
    return pixels, normals, depths


@njit(cache=True, nogil=True, inline="always")
def add_line(hessian, gradient, point, cam_from_body, x, y, z, nu, nv, intrinsics, residual, weight):  # type: ignore[no-untyped-def]
    """Add weight · (Jᵀ J, Jᵀ r) of one residual along (nu, nv) to the system; lower triangle only."""
    ax = nu * intrinsics[0] / z
    ay = nv * intrinsics[1] / z
    az = -(ax * x + ay * y) / z
    r = cam_from_body
    bx = r[0, 0] * ax + r[1, 0] * ay + r[2, 0] * az
    by = r[0, 1] * ax + r[1, 1] * ay + r[2, 1] * az
    bz = r[0, 2] * ax + r[1, 2] * ay + r[2, 2] * az
    j0 = point[1] * bz - point[2] * by
    j1 = point[2] * bx - point[0] * bz
    j2 = point[0] * by - point[1] * bx
    jac = (j0, j1, j2, bx, by, bz)
    for a in range(6):
        wa = weight * jac[a]
        gradient[a] += wa * residual
        for b in range(a + 1):
            hessian[a, b] += wa * jac[b]


@njit(cache=True, nogil=True)
def solve_step(hessian, gradient, damping):  # type: ignore[no-untyped-def]
    """Twist (6,) that solves (H + diag(damping)) x = -g, H given by its lower triangle; zeros when singular."""
    lower = np.zeros((6, 6))
    twist = np.zeros(6)
    for i in range(6):
        for j in range(i + 1):
            total = hessian[i, j]
            if i == j:
                total += damping[i]
            for k in range(j):
                total -= lower[i, k] * lower[j, k]
            if i == j:
                if not total > 1e-12:
                    return twist
                lower[i, i] = np.sqrt(total)
            else:
                lower[i, j] = total / lower[j, j]
    for i in range(6):
        total = -gradient[i]
        for k in range(i):
            total -= lower[i, k] * twist[k]
        twist[i] = total / lower[i, i]
    for i in range(5, -1, -1):
        total = twist[i]
        for k in range(i + 1, 6):
            total -= lower[k, i] * twist[k]
        twist[i] = total / lower[i, i]
    return twist


@njit(cache=True, nogil=True)
def apply_twist(cam_from_body, twist):  # type: ignore[no-untyped-def]
    """``cam_from_body`` after a small twist on the right: rotation by Rodrigues, then translation in the body."""
    wx, wy, wz = twist[0], twist[1], twist[2]
    theta = np.sqrt(wx * wx + wy * wy + wz * wz)
    if theta < 1e-9:
        s, c = 1.0, 0.5
    else:
        s = np.sin(theta) / theta
        c = (1.0 - np.cos(theta)) / (theta * theta)
    rotation = np.empty((3, 3))
    rotation[0, 0] = 1.0 - c * (wy * wy + wz * wz)
    rotation[0, 1] = -s * wz + c * wx * wy
    rotation[0, 2] = s * wy + c * wx * wz
    rotation[1, 0] = s * wz + c * wx * wy
    rotation[1, 1] = 1.0 - c * (wx * wx + wz * wz)
    rotation[1, 2] = -s * wx + c * wy * wz
    rotation[2, 0] = -s * wy + c * wx * wz
    rotation[2, 1] = s * wx + c * wy * wz
    rotation[2, 2] = 1.0 - c * (wx * wx + wy * wy)
    result = np.empty((4, 4))
    for i in range(3):
        for j in range(3):
            total = 0.0
            for k in range(3):
                total += cam_from_body[i, k] * rotation[k, j]
            result[i, j] = total
        total = cam_from_body[i, 3]
        for k in range(3):
            total += cam_from_body[i, k] * twist[3 + k]
        result[i, 3] = total
        result[3, i] = 0.0
    result[3, 3] = 1.0
    return result


@njit(cache=True, nogil=True)
def relative_twist(cam_from_before, cam_from_after):  # type: ignore[no-untyped-def]
    """Twist (6,) with ``apply_twist(cam_from_before, twist) = cam_from_after``, for turns below 180°."""
    a, b = cam_from_before, cam_from_after
    turn = np.zeros((3, 3))
    twist = np.zeros(6)
    for i in range(3):
        for k in range(3):
            twist[3 + i] += a[k, i] * (b[k, 3] - a[k, 3])
            for j in range(3):
                turn[i, j] += a[k, i] * b[k, j]
    x = 0.5 * (turn[2, 1] - turn[1, 2])
    y = 0.5 * (turn[0, 2] - turn[2, 0])
    z = 0.5 * (turn[1, 0] - turn[0, 1])
    sine = np.sqrt(x * x + y * y + z * z)
    angle = np.arctan2(sine, 0.5 * (turn[0, 0] + turn[1, 1] + turn[2, 2] - 1.0))
    factor = angle / sine if sine > 1e-9 else 1.0
    twist[0], twist[1], twist[2] = factor * x, factor * y, factor * z
    return twist
