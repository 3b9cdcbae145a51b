"""Sub-pixel steps of brightness across predicted edges.

One-dimensional search along the normal (Harris, RAPID 1990; several hypotheses per point: Vacchetti, Lepetit & Fua,
ISMAR 2004). Profiles are means over short parallel lines, in linear light, where blur does not displace a step.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.core.kernel import kernel

HYPOTHESES = 4
"""Number of steps kept per point, the strongest."""
STEP_PX = 0.5
"""Distance between the samples of a profile."""


def linear_light(gray: NDArray[np.uint8]) -> NDArray[np.float32]:
    """(H,W) grey levels 0–255 in linear light by the sRGB curve, smoothed slightly against noise."""
    levels = np.arange(256) / 255.0
    linear = 255.0 * np.where(levels <= 0.04045, levels / 12.92, ((levels + 0.055) / 1.055) ** 2.4)
    return np.ascontiguousarray(cv2.GaussianBlur(linear.astype(np.float32)[gray], (0, 0), 0.7))


@kernel(numpy_errors=True)
def project_edges(
    points: NDArray[np.float64],
    tangents: NDArray[np.float64],
    view: NDArray[np.int64],
    poses: NDArray[np.float64],
    lenses: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Edge points in the pictures of cameras with Brown's distortion.

    Args:
        points, tangents: (N,3) of the edges, in the model.
        view: (N,) which camera sees each point.
        poses: (M,3,4) cam_from_model of each camera.
        lenses: (M,9) fx fy cx cy k1 k2 p1 p2 k3 of each camera.

    Returns:
        in_cam (N,3) points in the camera frame; pixels (N,2), NaN behind the camera; normals (N,2), unit, across the
        edge in the picture; by_cam (N,3), px along the normal by a shift of the point in the camera frame.
    """
    count = len(points)
    in_cam, pixels = np.empty((count, 3)), np.empty((count, 2))
    normals, by_cam = np.empty((count, 2)), np.empty((count, 3))
    tangent = np.empty(3)
    for i in range(count):
        pose, lens = poses[view[i]], lenses[view[i]]
        for k in range(3):
            turned = pose[k, 0] * points[i, 0] + pose[k, 1] * points[i, 1] + pose[k, 2] * points[i, 2]
            in_cam[i, k] = turned + pose[k, 3]
            tangent[k] = pose[k, 0] * tangents[i, 0] + pose[k, 1] * tangents[i, 1] + pose[k, 2] * tangents[i, 2]
        z = in_cam[i, 2] if in_cam[i, 2] > 0.0 else np.nan
        x, y = in_cam[i, 0] / z, in_cam[i, 1] / z
        fx, fy, k1, k2, p1, p2, k3 = lens[0] / z, lens[1] / z, lens[4], lens[5], lens[6], lens[7], lens[8]
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        bend = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3))
        pixels[i, 0] = lens[0] * (x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)) + lens[2]
        pixels[i, 1] = lens[1] * (y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y) + lens[3]
        xx = radial + x * x * bend + 2.0 * p1 * y + 6.0 * p2 * x
        xy = x * y * bend + 2.0 * p1 * x + 2.0 * p2 * y
        yy = radial + y * y * bend + 6.0 * p1 * y + 2.0 * p2 * x
        # Derivatives of u and v by the point, times the tangent: the direction of the edge in the picture.
        ux, uy, vx, vy = fx * xx, fx * xy, fy * xy, fy * yy
        uz, vz = -(ux * x + uy * y), -(vx * x + vy * y)
        along_u = ux * tangent[0] + uy * tangent[1] + uz * tangent[2]
        along_v = vx * tangent[0] + vy * tangent[1] + vz * tangent[2]
        length = np.sqrt(along_u * along_u + along_v * along_v)
        nu, nv = -along_v / length, along_u / length
        normals[i, 0], normals[i, 1] = nu, nv
        by_cam[i, 0], by_cam[i, 1], by_cam[i, 2] = nu * ux + nv * vx, nu * uy + nv * vy, nu * uz + nv * vz
    return in_cam, pixels, normals, by_cam


@kernel(fastmath={"reassoc", "contract", "arcp", "nsz"}, numpy_errors=True)
def find_steps(
    gray: NDArray[np.float32],
    pixels: NDArray[np.float64],
    normals: NDArray[np.float64],
    reach_px: float,
    half_width_px: float,
    threshold: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """Find the extrema of the slope along the normal of each point.

    Args:
        gray: (H,W) float32 in linear light.
        pixels, normals: (N,2) predicted edge points and unit normals in the picture; NaN are not searched for.
        reach_px: search range to either side.
        half_width_px: five parallel lines within this distance to either side along the edge are averaged.
        threshold: weakest slope, grey levels per px.

    Returns:
        offsets (N,K) px along the normal; slopes (N,K) signed grey levels per px, 0 = none; seen (N,) whether the
        profile lies inside the picture.
    """
    height, width = gray.shape
    levels = gray.ravel()
    count = pixels.shape[0]
    half = int(np.ceil(reach_px / STEP_PX)) + 2
    size = 2 * half + 1
    offsets = np.zeros((count, HYPOTHESES))
    slopes = np.zeros((count, HYPOTHESES))
    seen = np.zeros(count, dtype=np.bool_)
    profile = np.empty(size, dtype=np.float32)
    slope = np.zeros(size, dtype=np.float32)
    margin = half * STEP_PX + half_width_px + 1.0
    right, below = np.uint64(1), np.uint64(width)  # unsigned, so that numba need not look for negative indices
    per_px = np.float32(0.1 / STEP_PX)
    for i in range(count):
        u, v, nu, nv = pixels[i, 0], pixels[i, 1], normals[i, 0], normals[i, 1]
        if not (u > margin and v > margin and u < width - 2 - margin and v < height - 2 - margin and np.isfinite(nu)):
            continue
        seen[i] = True
        # From a pixel left of and above all samples, so that single precision suffices.
        column, row = int(u - margin), int(v - margin)
        first = row * width + column
        step_x, step_y = np.float32(STEP_PX * nu), np.float32(STEP_PX * nv)
        profile[:] = 0.0
        for j in range(-2, 3):
            along = 0.5 * j * half_width_px
            start_x = np.float32(u - column - half * STEP_PX * nu - along * nv)
            start_y = np.float32(v - row - half * STEP_PX * nv + along * nu)
            for k in range(size):
                x, y = start_x + np.float32(k) * step_x, start_y + np.float32(k) * step_y
                ix, iy = np.int32(x), np.int32(y)
                ax, ay = x - np.float32(ix), y - np.float32(iy)
                at = np.uint64(first + iy * width + ix)
                top, bottom = levels[at], levels[at + below]
                top += (levels[at + right] - top) * ax
                bottom += (levels[at + below + right] - bottom) * ax
                profile[k] += top + (bottom - top) * ay
        for k in range(1, size - 1):
            slope[k] = (profile[k + 1] - profile[k - 1]) * per_px
        kept = 0
        for k in range(2, size - 2):
            s = abs(slope[k])
            a, b = abs(slope[k - 1]), abs(slope[k + 1])
            if s < threshold or s < a or s <= b or slope[k] * slope[k - 1] < 0 or slope[k] * slope[k + 1] < 0:
                continue
            slot = kept
            if kept == HYPOTHESES:
                slot = int(np.argmin(np.abs(slopes[i])))
                if abs(slopes[i, slot]) >= s:
                    continue
            else:
                kept += 1
            bend = a - 2.0 * s + b
            offsets[i, slot] = (k - half + (0.5 * (a - b) / bend if bend < 0 else 0.0)) * STEP_PX
            slopes[i, slot] = slope[k]
    return offsets, slopes, seen


@kernel
def choose_steps(
    offsets: NDArray[np.float64], slopes: NDArray[np.float64], spread_px: float, half_slope: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Choose for each point the hypothesis with the best product of strength and nearness.

    Args:
        offsets, slopes: (N,K) of `find_steps`.
        spread_px: standard deviation of the Gaussian that weights nearness.
        half_slope: slope at which strength has half its full weight.

    Returns:
        offset (N,) px and signed slope (N,); slope 0 = none.
    """
    count = len(offsets)
    offset, slope = np.zeros(count), np.zeros(count)
    for i in range(count):
        best = 0.0
        for k in range(offsets.shape[1]):
            strength = abs(slopes[i, k])
            score = strength / (strength + half_slope) * np.exp(-0.5 * (offsets[i, k] / spread_px) ** 2)
            if score > best:
                best, offset[i], slope[i] = score, offsets[i, k], slopes[i, k]
    return offset, slope
