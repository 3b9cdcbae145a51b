"""Gauss-Newton kernels shared by all modalities: point-to-line Jacobian, 6×6 solver and pose update.

The pose is perturbed on the right: ``cam_from_body @ exp_se3(twist)``, with the origin of the body frame at the model's
centre. For a residual along a unit image direction n, J = [p × a, a] with a = Rᵀ (∂π/∂X)ᵀ n.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from arview.core.kernel import kernel


@kernel(inline=True)
def add_line(
    system: Any,
    point: Any,
    cam_from_body: Any,
    x: Any,
    y: Any,
    z: Any,
    nu: Any,
    nv: Any,
    intrinsics: Any,
    residual: Any,
    weight: Any,
) -> Any:
    """Add weight · Jᵀ (J, r) of one residual along (nu, nv) to a system, in whole rows that the compiler vectorises.

    Args:
        system: (6,8) Hessian, gradient and a column of zeros, see `add_system`.
        point: (3,) in the body frame; x, y, z is the same point in the camera's frame.
        residual: px.
    """
    inverse_z = 1.0 / z
    ax = nu * intrinsics[0] * inverse_z
    ay = nv * intrinsics[1] * inverse_z
    az = -(ax * x + ay * y) * inverse_z
    r = cam_from_body
    bx = r[0, 0] * ax + r[1, 0] * ay + r[2, 0] * az
    by = r[0, 1] * ax + r[1, 1] * ay + r[2, 1] * az
    bz = r[0, 2] * ax + r[1, 2] * ay + r[2, 2] * az
    j0 = point[1] * bz - point[2] * by
    j1 = point[2] * bx - point[0] * bz
    j2 = point[0] * by - point[1] * bx
    jac = (j0, j1, j2, bx, by, bz, residual, 0.0)
    for a in range(6):
        wa = weight * jac[a]
        for b in range(8):
            system[a, b] += wa * jac[b]


@kernel(inline=True)
def add_system(hessian: Any, gradient: Any, system: Any) -> Any:
    """Add a system (6,8) of `add_line` to a Hessian (6,6), of which only the lower triangle is filled, and gradient."""
    for a in range(6):
        gradient[a] += system[a, 6]
        for b in range(a + 1):
            hessian[a, b] += system[a, b]


@kernel
def solve_step(
    hessian: NDArray[np.float64], gradient: NDArray[np.float64], damping: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Twist (6,) that solves (H + diag(damping)) x = -g by Cholesky decomposition; zeros for a singular system.

    ``hessian`` is given by its lower triangle.
    """
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


@kernel
def trust_in(
    hessian: NDArray[np.float64], gradient: NDArray[np.float64], squares: float, count: float, weight: float
) -> float:
    """Trust in one modality, 0–1, by the scatter of its residuals about its own optimum.

    Their variance relative to the one that they claim is the modality's variance component (Förstner, "Ein Verfahren
    zur Schätzung von Varianz- und Kovarianzkomponenten", 1979). A motion of the part, which a pose explains, does not
    count. The trust is the inverse of its square where it exceeds 1, because errors beyond the claimed noise are common
    to many neighbouring residuals.

    Args:
        hessian, gradient: (6,6) lower triangle and (6,) of the modality alone.
        squares: sum of its squared residuals, each divided by its claimed variance.
        count: effective number of its residuals.
        weight: factor of ``hessian`` and ``gradient``.
    """
    if count <= 7.0:
        return 1.0
    twist = solve_step(hessian, gradient, np.full(6, 1e-6 * weight))
    explained = 0.0
    for i in range(6):
        explained -= gradient[i] * twist[i]
    variance = (squares - explained / weight) / (count - 6.0)
    return 1.0 / max(variance, 1.0) ** 2


@kernel
def apply_twist(cam_from_body: NDArray[np.float64], twist: NDArray[np.float64]) -> NDArray[np.float64]:
    """``cam_from_body`` (4,4) after a twist (rotation rad, translation mm) on the right.

    The rotation follows Rodrigues' formula; the translation is applied along the axes of the body before the rotation.
    """
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


@kernel
def relative_twist(cam_from_before: NDArray[np.float64], cam_from_after: NDArray[np.float64]) -> NDArray[np.float64]:
    """Twist (6,) with ``apply_twist(cam_from_before, twist) = cam_from_after``, for rotations below 180°."""
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
