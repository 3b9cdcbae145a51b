"""Z-buffer of a triangle mesh in numba: depth and face index of each pixel.

A scanline rasteriser over 1/z, which is linear in the image (perspective-correct interpolation: Blinn, "Hyperbolic
interpolation", IEEE CG&A 1992). A pixel belongs to a triangle when its centre (integer coordinates, as in OpenCV) lies
inside; triangles that cross the near plane are clipped (Sutherland & Hodgman 1974).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from arview.core.kernel import kernel
from arview.geometry import Array


@kernel(inline=True)
def _fill(
    u0: Any,
    v0: Any,
    w0: Any,
    u1: Any,
    v1: Any,
    w1: Any,
    u2: Any,
    v2: Any,
    w2: Any,
    face: Any,
    x_low: Any,
    y_low: Any,
    inverse_depth: Any,
    face_ids: Any,
) -> Any:
    """Draw one projected triangle into the buffers; w is 1/z at the corners, (x_low, y_low) the first pixel."""
    height, width = inverse_depth.shape
    area = (u1 - u0) * (v2 - v0) - (u2 - u0) * (v1 - v0)
    if abs(area) < 1e-12:
        return
    w_du = ((w1 - w0) * (v2 - v0) - (w2 - w0) * (v1 - v0)) / area
    w_dv = ((w2 - w0) * (u1 - u0) - (w1 - w0) * (u2 - u0)) / area
    w_at_origin = w0 - u0 * w_du - v0 * w_dv
    # Corner 0 on top, 2 at the bottom; the long side runs from 0 to 2, the short ones meet at 1.
    if v1 < v0:
        u0, v0, u1, v1 = u1, v1, u0, v0
    if v2 < v0:
        u0, v0, u2, v2 = u2, v2, u0, v0
    if v2 < v1:
        u1, v1, u2, v2 = u2, v2, u1, v1
    long_slope = (u2 - u0) / (v2 - v0) if v2 > v0 else 0.0
    upper_slope = (u1 - u0) / (v1 - v0) if v1 > v0 else 0.0
    lower_slope = (u2 - u1) / (v2 - v1) if v2 > v1 else 0.0
    row_first = max(int(np.ceil(v0)), y_low)
    row_last = min(int(np.floor(v2)), y_low + height - 1)
    for row in range(row_first, row_last + 1):
        long = u0 + (row - v0) * long_slope
        short = u1 + (row - v1) * (upper_slope if row < v1 or v2 == v1 else lower_slope)
        column_first = max(int(np.ceil(min(long, short))), x_low)
        column_last = min(int(np.floor(max(long, short))), x_low + width - 1)
        if column_first > column_last:
            continue
        w = w_at_origin + column_first * w_du + row * w_dv
        r = row - y_low
        for c in range(column_first - x_low, column_last - x_low + 1):
            if w > inverse_depth[r, c]:
                inverse_depth[r, c] = w
                face_ids[r, c] = face
            w += w_du


@kernel
def fill_buffers(
    points: NDArray[np.float64], faces: NDArray[np.int32] | NDArray[np.int64], fx: float, fy: float, cx: float,
    cy: float, near: float, x_low: int, y_low: int, inverse_depth: NDArray[np.float64], face_ids: NDArray[np.int32]
) -> None:  # fmt: skip
    """The kernel of `rasterise`: draws into buffers (H,W) that hold 0 and -1 at first."""
    height, width = inverse_depth.shape
    count = points.shape[0]
    u = np.empty(count)
    v = np.empty(count)
    w = np.empty(count)
    for i in range(count):
        z = points[i, 2]
        if z > near:
            w[i] = 1.0 / z
            u[i] = fx * points[i, 0] * w[i] + cx
            v[i] = fy * points[i, 1] * w[i] + cy
        else:
            w[i] = -1.0
    polygon = np.empty((4, 3))
    for face in range(faces.shape[0]):
        a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
        behind = (w[a] < 0) + (w[b] < 0) + (w[c] < 0)
        if behind == 3:
            continue
        if behind == 0:
            if (
                max(u[a], max(u[b], u[c])) < x_low
                or min(u[a], min(u[b], u[c])) > x_low + width - 1
                or max(v[a], max(v[b], v[c])) < y_low
                or min(v[a], min(v[b], v[c])) > y_low + height - 1
            ):
                continue
            _fill(
                u[a],
                v[a],
                w[a],
                u[b],
                v[b],
                w[b],
                u[c],
                v[c],
                w[c],
                face,
                x_low,
                y_low,
                inverse_depth,
                face_ids,
            )
            continue
        corners = 0
        for k in range(3):
            i = faces[face, k]
            j = faces[face, (k + 1) % 3]
            zi, zj = points[i, 2], points[j, 2]
            if zi > near:
                polygon[corners, 0], polygon[corners, 1], polygon[corners, 2] = u[i], v[i], w[i]
                corners += 1
            if (zi > near) != (zj > near):
                t = (near - zi) / (zj - zi)
                x = points[i, 0] + t * (points[j, 0] - points[i, 0])
                y = points[i, 1] + t * (points[j, 1] - points[i, 1])
                polygon[corners, 0] = fx * x / near + cx
                polygon[corners, 1] = fy * y / near + cy
                polygon[corners, 2] = 1.0 / near
                corners += 1
        for k in range(1, corners - 1):
            _fill(
                polygon[0, 0], polygon[0, 1], polygon[0, 2],
                polygon[k, 0], polygon[k, 1], polygon[k, 2],
                polygon[k + 1, 0], polygon[k + 1, 1], polygon[k + 1, 2],
                face, x_low, y_low, inverse_depth, face_ids,
            )  # fmt: skip


def rasterise(
    points_in_cam: Array,
    faces: NDArray[np.int32],
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    width: int,
    height: int,
    near_mm: float | None = None,
    origin: tuple[int, int] = (0, 0),
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Z-buffer of a mesh in the view of an ideal pinhole camera.

    Args:
        points_in_cam: (V,3) vertices in the camera frame, mm.
        faces: (F,3) vertex indices; both sides are drawn.
        fx, fy, cx, cy: intrinsics in px, pixel centres at integers.
        width, height: size of the buffer, px.
        near_mm: depth of the near plane, at which geometry is clipped; None takes 1, or a hundredth of the largest
            depth if that is less, for parts of a millimetre.
        origin: (u, v) of the buffer's first pixel, to draw a window of a larger image.

    Returns:
        inverse depth (H,W) in 1/mm, 0 where there is no face; face index (H,W), -1 where there is none.
    """
    inverse_depth = np.zeros((height, width))
    face_ids = np.full((height, width), -1, dtype=np.int32)
    if near_mm is None:
        near_mm = min(1.0, max(0.01 * float(np.max(points_in_cam[:, 2], initial=0.0)), 1e-6))
    fill_buffers(
        np.ascontiguousarray(points_in_cam, dtype=np.float64),
        faces,
        fx,
        fy,
        cx,
        cy,
        near_mm,
        origin[0],
        origin[1],
        inverse_depth,
        face_ids,
    )
    return inverse_depth, face_ids
