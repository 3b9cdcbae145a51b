"""Keyframes of the texture modality: pictures of known pose with corners on the part's surface.

Corners are found by the minimum eigenvalue of the gradient's covariance (Shi & Tomasi, CVPR 1994). Their 3D points and
normals come from rays cast at the CAD, so that a keyframe needs a single picture.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.core.kernel import kernel
from arview.geometry import Array, invert
from arview.refinement.modalities.patch_alignment import Pyramid
from arview.refinement.projection import project
from arview.rendering import Hierarchy, RayCaster, cast_ray

_RESPONSE = (8.0 / (4 * 255)) ** 2
"""Response of cornerMinEigenVal (3×3 Sobel, uint8) to a mean squared gradient of one (grey level/px)²."""


LEVELS = 4
"""Levels of the image pyramid. The common shift is searched for at the coarsest, where 4 px are 32 px of the
picture."""
MAX_CORNERS = 90
"""Corners kept in a keyframe."""
MIN_CORNERS = 12
"""Corners needed for a keyframe."""
CORNER_DISTANCE_PX = 7.0
"""Smallest distance between two corners."""
CORNER_CONTRAST = 3.0
"""Weakest corner: rms gradient along the weaker direction, grey levels per px of the half-size picture."""
MARGIN_PX = 6.0
"""The surface must continue this far around a corner, so that patches hold no background."""
FLATNESS_PX = 1.5
"""Largest height of these surroundings over the tangent plane, px of the keyframe."""
MIN_FACING = 0.2
"""Smallest cosine between surface normal and line of sight; foreshortened patches match badly."""
MIN_NCC = 0.8
"""Smallest normalised correlation of an aligned patch with its keyframe."""


class Anchors(NamedTuple):
    """Corners of a keyframe in the form of the kernels.

    Attributes:
        pixels: (N,2) corners, px from the first pixel of the keyframe's cropped pyramid.
        points: (N,3) mm in the body frame.
        tangents: (N,2,3) unit vectors that span the surface; their cross product points away from the camera.
        jacobians: (N,2,2) px per mm along the tangents.
        trust: (N,) 0–1; falls when a corner is found away from where the pose places it.
    """

    pixels: Array
    points: Array
    tangents: Array
    jacobians: Array
    trust: Array


@dataclass(eq=False)
class Keyframe:
    """A picture of the part with a known pose.

    Attributes:
        cam_from_body: (4,4) pose.
        pyramid: crop around the part of each level of the image pyramid.
        anchors: corners on the part.
        last_used: counter value of the last use.
    """

    cam_from_body: Array
    pyramid: Pyramid
    anchors: Anchors
    last_used: int


@kernel(inline=True)
def to_camera(m: Any, x: Any, y: Any, z: Any) -> Any:
    """Point (x, y, z) transformed by a rigid transform (4,4)."""
    return (
        m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3],
        m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3],
        m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3],
    )


@kernel
def tangent_jacobian(
    point: NDArray[np.float64],
    tangents: NDArray[np.float64],
    cam_from_body: NDArray[np.float64],
    intrinsics: NDArray[np.float64],
    out: NDArray[np.float64],
) -> tuple[float, float, float]:
    """Pixel u, v and depth of a point; depth -1 behind the camera.

    Fills ``out`` (2,2) with px per mm along the two tangents, by central differences over about 4 px.
    """
    x, y, z = to_camera(cam_from_body, point[0], point[1], point[2])
    if z < 1.0:
        return 0.0, 0.0, -1.0
    step = 2.0 * z / intrinsics[0]
    for k in range(2):
        tx, ty, tz = step * tangents[k, 0], step * tangents[k, 1], step * tangents[k, 2]
        x1, y1, z1 = to_camera(cam_from_body, point[0] + tx, point[1] + ty, point[2] + tz)
        x2, y2, z2 = to_camera(cam_from_body, point[0] - tx, point[1] - ty, point[2] - tz)
        if z1 < 1.0 or z2 < 1.0:
            return 0.0, 0.0, -1.0
        u1, v1 = project(x1, y1, z1, intrinsics)
        u2, v2 = project(x2, y2, z2, intrinsics)
        out[0, k] = (u1 - u2) / (2.0 * step)
        out[1, k] = (v1 - v2) / (2.0 * step)
    u, v = project(x, y, z, intrinsics)
    return u, v, z


@kernel
def _best_corners(response: NDArray[np.float32], threshold: float, cell: int) -> NDArray[np.float64]:
    """Strongest pixel of each square of ``cell`` × ``cell`` pixels that is a local maximum: (N,3) u, v, response."""
    height, width = response.shape
    rows, columns = (height + cell - 1) // cell, (width + cell - 1) // cell
    found = np.empty((rows * columns, 3))
    count = 0
    for row in range(rows):
        for column in range(columns):
            best, u, v = threshold, -1, -1
            for y in range(row * cell, min((row + 1) * cell, height)):
                for x in range(column * cell, min((column + 1) * cell, width)):
                    if response[y, x] > best:
                        best, u, v = response[y, x], x, y
            peak = u >= 0
            for y in range(max(v - 1, 0), min(v + 2, height)):
                for x in range(max(u - 1, 0), min(u + 2, width)):
                    peak = peak and response[y, x] <= best
            if peak:
                found[count, 0], found[count, 1], found[count, 2] = u, v, best
                count += 1
    return found[:count].copy()


@kernel
def _unproject(u: float, v: float, intrinsics: NDArray[np.float64]) -> tuple[float, float]:
    """Undistorted x, y at z = 1 of a pixel, by fixed-point iteration."""
    x = xd = (u - intrinsics[2]) / intrinsics[0]
    y = yd = (v - intrinsics[3]) / intrinsics[1]
    if intrinsics[9] != 0.0:
        for _ in range(20):
            ue, ve = project(x, y, 1.0, intrinsics)
            x += xd - (ue - intrinsics[2]) / intrinsics[0]
            y += yd - (ve - intrinsics[3]) / intrinsics[1]
    return x, y


@kernel
def _place_corners(
    hierarchy: Hierarchy, body_from_cam: NDArray[np.float64], corners: NDArray[np.float64],
    intrinsics: NDArray[np.float64], margin_px: float, distance_px: float, flatness_px: float, min_facing: float,
    max_count: int
) -> tuple[int, NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:  # fmt: skip
    """Corners that lie on a smooth piece of the part's surface, strongest first.

    Rays are cast through the corner and ``margin_px`` left, right, above and below it. The surface normal is taken
    across these four hits, which smooths the tessellation. Corners near steps and creases, which stand off that plane,
    are refused.

    Returns:
        Number of corners kept, and their indices (max_count,), points (max_count,3) and tangents (max_count,2,3) in
        the body frame.
    """
    kept = np.empty(max_count, dtype=np.int64)
    points = np.empty((max_count, 3))
    tangents = np.empty((max_count, 2, 3))
    around = np.empty((5, 3))
    n = np.empty(3)
    sight = np.empty(3)
    r = body_from_cam
    used = 0
    for i in range(corners.shape[0]):
        if used == max_count:
            break
        is_taken = False
        for k in range(used):
            du, dv = corners[i, 0] - corners[kept[k], 0], corners[i, 1] - corners[kept[k], 1]
            if du * du + dv * dv < distance_px * distance_px:
                is_taken = True
                break
        if is_taken:
            continue
        whole = True
        middle = 0.0
        for k in range(5):
            side = margin_px if k % 2 == 0 else -margin_px
            du, dv = (0.0 if k == 0 or k > 2 else side), (side if k > 2 else 0.0)
            rx, ry = _unproject(corners[i, 0] + du, corners[i, 1] + dv, intrinsics)
            dx = r[0, 0] * rx + r[0, 1] * ry + r[0, 2]
            dy = r[1, 0] * rx + r[1, 1] * ry + r[1, 2]
            dz = r[2, 0] * rx + r[2, 1] * ry + r[2, 2]
            depth, face = cast_ray(
                hierarchy, r[0, 3], r[1, 3], oz=r[2, 3], dx=dx, dy=dy, dz=dz, limit=1e30, any_hit=False
            )
            if face < 0:
                whole = False
                break
            if k == 0:
                middle = depth
                sight[0], sight[1], sight[2] = dx, dy, dz
            around[k, 0] = r[0, 3] + depth * dx
            around[k, 1] = r[1, 3] + depth * dy
            around[k, 2] = r[2, 3] + depth * dz
        if not whole:
            continue
        a, b = around[2] - around[1], around[4] - around[3]
        n[0], n[1], n[2] = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
        size = np.sqrt(np.sum(n * n))
        if size < 1e-12:
            continue
        n /= size
        limit = flatness_px * middle / intrinsics[0]
        for k in range(1, 5):
            if abs(np.sum((around[k] - around[0]) * n)) > limit:
                whole = False
        if not whole or abs(np.sum(n * sight)) < min_facing * np.sqrt(np.sum(sight * sight)):
            continue
        a /= np.sqrt(np.sum(a * a))
        kept[used] = i
        points[used] = around[0]
        # The second tangent is n × t0, so that t0 × t1 = n, which points away from the camera as a × b does.
        tangents[used, 0] = a
        tangents[used, 1, 0] = n[1] * a[2] - n[2] * a[1]
        tangents[used, 1, 1] = n[2] * a[0] - n[0] * a[2]
        tangents[used, 1, 2] = n[0] * a[1] - n[1] * a[0]
        used += 1
    return used, kept, points, tangents


@kernel
def _all_jacobians(
    points: NDArray[np.float64],
    tangents: NDArray[np.float64],
    cam_from_body: NDArray[np.float64],
    intrinsics: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Jacobians (N,2,2) of all points, see `tangent_jacobian`."""
    jacobians = np.empty((points.shape[0], 2, 2))
    for i in range(points.shape[0]):
        tangent_jacobian(points[i], tangents[i], cam_from_body, intrinsics, jacobians[i])
    return jacobians


def make_keyframe(
    pyramid: Pyramid,
    cam_from_body: Array,
    outline: Array,
    caster: RayCaster,
    intrinsics: Array,
) -> Keyframe | None:
    """Keyframe of a picture; None when too few corners lie on the part.

    Args:
        pyramid: image pyramid of the picture.
        cam_from_body: (4,4) pose of the part.
        outline: (K,2) convex polygon around the part, px.
        caster: ray caster of the part in the body frame.
        intrinsics: (10,) as of `intrinsics_of`.
    """
    rectangle = _rectangle(outline, pyramid)
    if rectangle is None:
        return None
    left, top, right, bottom = rectangle
    # The half-size picture has less noise, takes a quarter of the time, and its corners are as wide as the patches.
    half = pyramid[1][top >> 1 : bottom >> 1, left >> 1 : right >> 1]
    response = cv2.cornerMinEigenVal(half, 3, ksize=3)
    mask = np.zeros(response.shape, dtype=np.uint8)
    cv2.fillConvexPoly(mask, np.round((outline - (left, top)) / 2.0).astype(np.int32), 1)
    response *= mask
    cell = max(2, round(0.5 * CORNER_DISTANCE_PX))
    corners = _best_corners(response, _RESPONSE * CORNER_CONTRAST**2, cell)
    corners = 2.0 * corners[np.argsort(-corners[:, 2]), :2] + (left, top)
    used, kept, points, tangents = _place_corners(
        caster.hierarchy,
        invert(cam_from_body),
        corners,
        intrinsics,
        MARGIN_PX,
        CORNER_DISTANCE_PX,
        FLATNESS_PX,
        MIN_FACING,
        MAX_CORNERS,
    )
    if used < MIN_CORNERS:
        return None
    points, tangents = points[:used].copy(), tangents[:used].copy()
    return Keyframe(
        cam_from_body=cam_from_body.copy(),
        pyramid=tuple(
            image[top >> level : (bottom >> level) + 1, left >> level : (right >> level) + 1].copy()
            for level, image in enumerate(pyramid)
        ),
        anchors=Anchors(
            pixels=corners[kept[:used]] - (left, top),
            points=points,
            tangents=tangents,
            jacobians=_all_jacobians(points, tangents, cam_from_body, intrinsics),
            trust=np.ones(used),
        ),
        last_used=0,
    )


def _rectangle(outline: Array, pyramid: Pyramid) -> tuple[int, int, int, int] | None:
    """Left, top, right and bottom px of a rectangle around an outline (K,2), on the grid of the coarsest level."""
    height, width = pyramid[0].shape
    grid = 1 << (len(pyramid) - 1)
    # The margin leaves room for warped patches of the coarser levels.
    low = np.maximum(outline.min(axis=0) - 5 * grid, 0.0)
    high = np.minimum(outline.max(axis=0) + 5 * grid, (width, height))
    if np.any(high - low < 16):
        return None
    left, top = int(low[0]) // grid * grid, int(low[1]) // grid * grid
    return left, top, int(high[0]), int(high[1])
