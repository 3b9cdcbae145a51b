"""Projection of points and lines of the part into the picture, used by all kernels of refinement and search."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from arview.camera import Camera, require_brown
from arview.core.kernel import kernel
from arview.geometry import Array


class ProjectedLines(NamedTuple):
    """Points of the part with a direction each, in the picture.

    Attributes:
        pixels: (N,2) distorted px.
        normals: (N,2) unit directions in the picture.
        depths: (N,) mm along the optical axis; -1 for points that are not in front of the camera or whose direction
            vanishes in the picture. Pixels and normals of such points are undefined.
    """

    pixels: Array
    normals: Array
    depths: Array


class ViewArrays(NamedTuple):
    """All guide views of a part as flat arrays. Points are in the body frame, whose origin is the part's centre.

    Attributes:
        directions: (N,3) unit directions from the part's centre to the camera of each view.
        contour_starts: (N+1,) first contour point of each view.
        contour_points: (C,3) float32 mm.
        contour_normals: (C,3) float32, outward unit normals of the contour.
        contour_runs_mm: (C,2) how far the picture stays part inwards and background outwards of the contour.
        edge_starts: (N+1,) first edge point of each view.
        edge_points: (E,3) float32 mm.
        edge_tangents: (E,3) float32, unit tangents of the edges.
        edge_kinds: (E,) EDGE_* bits.
    """

    directions: NDArray[np.float64]
    contour_starts: NDArray[np.int64]
    contour_points: NDArray[np.float32]
    contour_normals: NDArray[np.float32]
    contour_runs_mm: NDArray[np.float32]
    edge_starts: NDArray[np.int64]
    edge_points: NDArray[np.float32]
    edge_tangents: NDArray[np.float32]
    edge_kinds: NDArray[np.uint8]


def intrinsics_of(camera: Camera, pitch: float = 1.0) -> Array:
    """Intrinsics in the form of the kernels: (11,) fx fy cx cy k1 k2 p1 p2 k3 is_distorted pitch.

    The pitch is the size of the camera's pixels in pixels of the picture that is measured: below 1 in an enlarged
    picture, of which only the pixels that are needed are interpolated.

    Raises:
        InputError: a camera with another lens model, which the kernels do not know.
    """
    if camera.lens is not None:
        camera = require_brown(camera, "tracking")
    is_distorted = 1.0 if camera.is_distorted else 0.0
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy, *camera.dist.tolist(), is_distorted, pitch])


@kernel(inline=True)
def project(x: float, y: float, z: float, intrinsics: NDArray[np.float64]) -> tuple[float, float]:
    """Pixel (u, v) of a point in the camera's frame; ``intrinsics`` as of `intrinsics_of`."""
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
def project_lines(
    points: NDArray[np.float64] | NDArray[np.float32],
    directions: NDArray[np.float64] | NDArray[np.float32],
    across: bool,
    cam_from_body: NDArray[np.float64],
    intrinsics: NDArray[np.float64],
    step_mm: float,
) -> ProjectedLines:
    """Project points with directions, see `ProjectedLines`.

    Args:
        points: (N,3) mm in the body frame.
        directions: (N,3) unit directions at the points.
        across: turn the projected directions by 90°, which makes the image normals of tangents.
        cam_from_body: (4,4).
        intrinsics: as of `intrinsics_of`.
        step_mm: length along a direction by which its projection is measured.
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
    return ProjectedLines(pixels, normals, depths)
