"""Projection of a part's points and lines into the picture, as all kernels of refinement and search use it."""

from __future__ import annotations

import numpy as np

from arview.camera import Camera
from arview.core.kernel import kernel
from arview.geometry import Array


def intrinsics_of(camera: Camera) -> Array:
    """Intrinsics as the kernels take them: (10,) fx fy cx cy k1 k2 p1 p2 k3 is_distorted."""
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy, *camera.dist, 1.0 if camera.is_distorted else 0.0])


@kernel(inline=True)
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


@kernel
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
