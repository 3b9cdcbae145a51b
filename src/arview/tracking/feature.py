"""Feature modality: the part's own texture, tracked from keyframes of known pose so that it does not drift.

A keyframe holds corners (Shi & Tomasi, CVPR 1994) with their 3D points and surface normals from the CAD. In a
new frame every patch is warped into the predicted view by its tangent plane (PTAM: Klein & Murray, ISMAR
2007) and aligned coarse to fine by inverse-compositional Lucas-Kanade (Baker & Matthews, IJCV 2004).
Brightness gain and offset are projected out of the steepest-descent images (Hager & Belhumeur, PAMI 1998), so
exposure may jump. Before that, all patches together search one common shift at the coarsest level, as PTAM's
small image does, for large motion.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from arview.camera import Camera
from arview.errors import InputError
from arview.geometry import Array, invert
from arview.tracking.patch import (
    Pyramid,
    align_template,
    build_pyramid,
    common_shift,
    prepare_template,
    sample_patch,
)
from arview.tracking.raycast import RayCaster, cast_ray
from arview.tracking.solver import add_line, apply_twist, project, solve_step

_RESPONSE = (8.0 / (4 * 255)) ** 2
"""What cornerMinEigenVal (3×3 Sobel, uint8) gives for a mean squared gradient of one (grey level/px)²."""


@dataclass(frozen=True)
class FeatureOptions:
    """Options of the feature modality.

    Attributes:
        levels: of the pyramid; the common shift is searched at the last: 4 px there are 32 px in the picture.
        search_px: reach of the common shift at the last level, px of that level; 0 leaves the search out.
        max_corners, min_corners: per keyframe; with fewer than the least, no keyframe is made.
        corner_distance_px: least distance of two corners.
        corner_contrast: weakest corner, rms gradient along the weaker direction, grey levels per px
            of the half-size picture.
        margin_px: the surface must go on for so far around a corner, or the patch would hold background.
        flatness_px: largest height of that surroundings over the tangent plane, px of the keyframe.
        min_facing: least cosine between surface normal and line of sight; foreshortened patches match badly.
        check_occlusion: cast a shadow ray from each point to the camera.
        min_ncc: least normalised correlation of an aligned patch with its keyframe.
        neighbour_px: largest deviation from the median displacement of the nearest neighbours.
        view_step_rad, roll_step_rad, scale_step: a view differing by more asks for a new keyframe.
        max_keyframes: the least recently used is dropped beyond.
    """

    levels: int = 4
    search_px: int = 4
    max_corners: int = 120
    min_corners: int = 12
    corner_distance_px: float = 7.0
    corner_contrast: float = 3.0
    margin_px: float = 6.0
    flatness_px: float = 1.5
    min_facing: float = 0.2
    check_occlusion: bool = True
    min_ncc: float = 0.8
    neighbour_px: float = 3.0
    view_step_rad: float = 0.17
    roll_step_rad: float = 0.26
    scale_step: float = 0.15
    max_keyframes: int = 12

    def __post_init__(self) -> None:
        if not 2 <= self.levels <= 6:
            raise InputError(f"feature options: levels is {self.levels}, expected 2 to 6")
        if not 0 < self.min_corners <= self.max_corners:
            raise InputError(
                f"feature options: min_corners {self.min_corners} is not in 1 to max_corners {self.max_corners}"
            )
        if not 0.0 < self.min_ncc < 1.0:
            raise InputError(f"feature options: min_ncc is {self.min_ncc}, expected within 0 to 1")


class Matches(NamedTuple):
    """Features found in one frame.

    Attributes:
        points_in_body: (N,3) mm.
        pixels: (N,2) where each was found, distorted px.
        weights: (N,) 0–1, by how well the patch fits; times 1/σ² in `add_features`.
        tried: how many were expected in view, to judge the share found.
    """

    points_in_body: Array
    pixels: Array
    weights: Array
    tried: int


@dataclass
class Keyframe:
    """A view of the part with a known pose.

    ``pyramid`` is the part's rectangle of each level, its first pixel at ``origin`` (u, v) / 2^level.
    ``tangents`` are (N,2,3) unit vectors spanning the surface at ``points_in_body`` (N,3), ``pixels`` (N,2)
    the corners, and ``pixel_from_tangent`` (N,2,2) px per mm along the tangents. ``trust`` (N,) 0–1 falls
    when a feature is not found.
    """

    cam_from_body: Array
    pyramid: Pyramid
    origin: tuple[int, int]
    points_in_body: Array
    tangents: Array
    pixels: Array
    pixel_from_tangent: Array
    trust: Array
    last_used: int = 0


@njit(cache=True, nogil=True, inline="always")
def _to_camera(m, x, y, z):  # type: ignore[no-untyped-def]
    return (
        m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3],
        m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3],
        m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3],
    )


@njit(cache=True, nogil=True)
def _pixel_from_tangent(point, tangents, cam_from_body, intrinsics, out):  # type: ignore[no-untyped-def]
    """Pixel, depth, and (2,2) px per mm along the two tangents (central differences over about 4 px)."""
    x, y, z = _to_camera(cam_from_body, point[0], point[1], point[2])
    if z < 1.0:
        return 0.0, 0.0, -1.0
    step = 2.0 * z / intrinsics[0]
    for k in range(2):
        tx, ty, tz = step * tangents[k, 0], step * tangents[k, 1], step * tangents[k, 2]
        x1, y1, z1 = _to_camera(cam_from_body, point[0] + tx, point[1] + ty, point[2] + tz)
        x2, y2, z2 = _to_camera(cam_from_body, point[0] - tx, point[1] - ty, point[2] - tz)
        if z1 < 1.0 or z2 < 1.0:
            return 0.0, 0.0, -1.0
        u1, v1 = project(x1, y1, z1, intrinsics)
        u2, v2 = project(x2, y2, z2, intrinsics)
        out[0, k] = (u1 - u2) / (2.0 * step)
        out[1, k] = (v1 - v2) / (2.0 * step)
    u, v = project(x, y, z, intrinsics)
    return u, v, z


@njit(cache=True, nogil=True)
def _best_corners(response, threshold, cell):  # type: ignore[no-untyped-def]
    """The strongest pixel of each ``cell`` × ``cell`` square if a local maximum: (N,3) u, v, response."""
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


@njit(cache=True, nogil=True)
def _unproject(u, v, intrinsics):  # type: ignore[no-untyped-def]
    """Ideal x, y at z = 1 of a pixel; distortion is removed by iteration."""
    x = xd = (u - intrinsics[2]) / intrinsics[0]
    y = yd = (v - intrinsics[3]) / intrinsics[1]
    if intrinsics[9] != 0.0:
        for _ in range(20):
            ue, ve = project(x, y, 1.0, intrinsics)
            x += xd - (ue - intrinsics[2]) / intrinsics[0]
            y += yd - (ve - intrinsics[3]) / intrinsics[1]
    return x, y


@njit(cache=True, nogil=True)
def _place_corners(
    hierarchy, body_from_cam, corners, intrinsics, margin_px, distance_px, flatness_px, min_facing, most
):  # type: ignore[no-untyped-def]
    """Corners that lie on a smooth piece of the part's surface, strongest first.

    Rays go through the corner and ``margin_px`` left, right, above and below it. The surface normal is taken
    across these four hits, which smooths the tessellation; steps and creases stand off that plane and are
    refused. Returns the number kept, their indices (most,), points (most,3) and tangents (most,2,3) in the
    body.
    """
    kept = np.empty(most, dtype=np.int64)
    points = np.empty((most, 3))
    tangents = np.empty((most, 2, 3))
    around = np.empty((5, 3))
    n = np.empty(3)
    sight = np.empty(3)
    r = body_from_cam
    used = 0
    for i in range(corners.shape[0]):
        if used == most:
            break
        crowded = False
        for k in range(used):
            du, dv = corners[i, 0] - corners[kept[k], 0], corners[i, 1] - corners[kept[k], 1]
            if du * du + dv * dv < distance_px * distance_px:
                crowded = True
                break
        if crowded:
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
            depth, face = cast_ray(hierarchy, r[0, 3], r[1, 3], r[2, 3], dx, dy, dz, 1e30, False)
            if face < 0:
                whole = False
                break
            if k == 0:
                middle = depth
                sight[0], sight[1], sight[2] = dx, dy, dz
            around[k, 0], around[k, 1], around[k, 2] = (
                r[0, 3] + depth * dx,
                r[1, 3] + depth * dy,
                r[2, 3] + depth * dz,
            )
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
        # The second tangent is n × t0, so that t0 × t1 = n, which looks away from the camera as a × b does.
        tangents[used, 0] = a
        tangents[used, 1, 0] = n[1] * a[2] - n[2] * a[1]
        tangents[used, 1, 1] = n[2] * a[0] - n[0] * a[2]
        tangents[used, 1, 2] = n[0] * a[1] - n[1] * a[0]
        used += 1
    return used, kept, points, tangents


@njit(cache=True, nogil=True)
def _agree_with_neighbours(predicted, pixels, weights, limit_px):  # type: ignore[no-untyped-def]
    """Clear the weights of points displaced unlike the median of their seven nearest neighbours."""
    count = predicted.shape[0]
    near = 7
    index = np.empty(near, dtype=np.int64)
    distance = np.empty(near)
    du, dv = np.empty(near), np.empty(near)
    wrong = np.zeros(count, dtype=np.bool_)
    for i in range(count):
        if weights[i] == 0.0:
            continue
        found = 0
        for j in range(count):
            if j == i or weights[j] == 0.0:
                continue
            d = (predicted[i, 0] - predicted[j, 0]) ** 2 + (predicted[i, 1] - predicted[j, 1]) ** 2
            if found < near:
                k = found
                found += 1
            elif d < distance[near - 1]:
                k = near - 1
            else:
                continue
            while k > 0 and distance[k - 1] > d:
                distance[k], index[k] = distance[k - 1], index[k - 1]
                k -= 1
            distance[k], index[k] = d, j
        if found < 3:
            continue
        for k in range(found):
            du[k] = pixels[index[k], 0] - predicted[index[k], 0]
            dv[k] = pixels[index[k], 1] - predicted[index[k], 1]
        eu = pixels[i, 0] - predicted[i, 0] - np.median(du[:found])
        ev = pixels[i, 1] - predicted[i, 1] - np.median(dv[:found])
        wrong[i] = eu * eu + ev * ev > limit_px * limit_px
    for i in range(count):
        if wrong[i]:
            weights[i] = 0.0


@njit(cache=True, nogil=True)
def add_features(hessian, gradient, points, cam_from_body, intrinsics, pixels, weights, sigma_px, robust_px):  # type: ignore[no-untyped-def]
    """Add the reprojection residuals of matched points to the 6×6 system.

    Residuals fade out towards ``robust_px`` (Tukey). Returns the summed weighted squared residual, the summed
    weight, and the number of points within ``robust_px``.
    """
    r = cam_from_body
    sum_square = 0.0
    sum_weight = 0.0
    inliers = 0
    for i in range(points.shape[0]):
        if weights[i] <= 0.0:
            continue
        p = points[i]
        x, y, z = _to_camera(r, p[0], p[1], p[2])
        if z < 1.0:
            continue
        u, v = project(x, y, z, intrinsics)
        eu, ev = u - pixels[i, 0], v - pixels[i, 1]
        square = (eu * eu + ev * ev) / (robust_px * robust_px)
        if square >= 1.0:
            continue
        w = weights[i] * (1.0 - square) ** 2 / (sigma_px * sigma_px)
        add_line(hessian, gradient, p, r, x, y, z, 1.0, 0.0, intrinsics, eu, w)
        add_line(hessian, gradient, p, r, x, y, z, 0.0, 1.0, intrinsics, ev, w)
        sum_square += w * (eu * eu + ev * ev)
        sum_weight += w
        inliers += 1
    return sum_square, sum_weight, inliers


@njit(cache=True, nogil=True)
def _align_pose(points, cam_from_body, intrinsics, pixels, weights, damping, sigma_px):  # type: ignore[no-untyped-def]
    """Pose that lays points on their pixels: Gauss-Newton, robust limit shrinking from 40 to 3 px."""
    hessian = np.zeros((6, 6))
    gradient = np.zeros(6)
    robust_px = 40.0
    for _ in range(8):
        hessian[:] = 0.0
        gradient[:] = 0.0
        add_features(
            hessian, gradient, points, cam_from_body, intrinsics, pixels, weights, sigma_px, robust_px
        )
        cam_from_body = apply_twist(cam_from_body, solve_step(hessian, gradient, damping))
        robust_px = max(3.0, 0.6 * robust_px)
    return cam_from_body


@njit(cache=True, nogil=True)
def _count_near(points, cam_from_body, intrinsics, pixels, weights, limit_px):  # type: ignore[no-untyped-def]
    """How many points of positive weight project to within ``limit_px`` of their pixels."""
    count = 0
    for i in range(points.shape[0]):
        x, y, z = _to_camera(cam_from_body, points[i, 0], points[i, 1], points[i, 2])
        if weights[i] > 0.0 and z >= 1.0:
            u, v = project(x, y, z, intrinsics)
            if (u - pixels[i, 0]) ** 2 + (v - pixels[i, 1]) ** 2 < limit_px * limit_px:
                count += 1
    return count


@njit(cache=True, nogil=True)
def _predict(
    key_frames, points, tangents, cam_from_body, intrinsics, wanted, width, height, predicted, warps
):  # type: ignore[no-untyped-def]
    """Fill predicted pixels (N,2) and the warps (N,2,2) from frame to keyframe px of the tangent planes.

    ``key_frames`` is (N,2,2) keyframe px per mm along the tangents. Clears ``wanted`` where the patch is out
    of the picture or too much larger or smaller than in the keyframe.
    """
    jacobian = np.empty((2, 2))
    for i in range(points.shape[0]):
        if not wanted[i]:
            continue
        wanted[i] = False
        u, v, z = _pixel_from_tangent(points[i], tangents[i], cam_from_body, intrinsics, jacobian)
        if z <= 0.0 or u < 6 or v < 6 or u > width - 7 or v > height - 7:
            continue
        det = jacobian[0, 0] * jacobian[1, 1] - jacobian[0, 1] * jacobian[1, 0]
        if abs(det) < 1e-12:
            continue
        p, w = key_frames[i], warps[i]
        w[0, 0] = (p[0, 0] * jacobian[1, 1] - p[0, 1] * jacobian[1, 0]) / det
        w[0, 1] = (p[0, 1] * jacobian[0, 0] - p[0, 0] * jacobian[0, 1]) / det
        w[1, 0] = (p[1, 0] * jacobian[1, 1] - p[1, 1] * jacobian[1, 0]) / det
        w[1, 1] = (p[1, 1] * jacobian[0, 0] - p[1, 0] * jacobian[0, 1]) / det
        area = w[0, 0] * w[1, 1] - w[0, 1] * w[1, 0]
        if area < 0.1 or area > 10.0:
            continue
        predicted[i, 0], predicted[i, 1] = u, v
        wanted[i] = True


@njit(cache=True, nogil=True)
def _facing_camera(points, tangents, trust, hierarchy, cam_from_body, min_facing, check_occlusion):  # type: ignore[no-untyped-def]
    """(N,) whether each trusted point faces the camera and is not hidden behind the part itself."""
    r = cam_from_body
    eye = np.empty(3)
    for a in range(3):
        eye[a] = -(r[0, a] * r[0, 3] + r[1, a] * r[1, 3] + r[2, a] * r[2, 3])
    wanted = np.zeros(points.shape[0], dtype=np.bool_)
    for i in range(points.shape[0]):
        if trust[i] < 0.2:
            continue
        t = tangents[i]
        dx, dy, dz = eye[0] - points[i, 0], eye[1] - points[i, 1], eye[2] - points[i, 2]
        facing = (
            (t[0, 2] * t[1, 1] - t[0, 1] * t[1, 2]) * dx
            + (t[0, 0] * t[1, 2] - t[0, 2] * t[1, 0]) * dy
            + (t[0, 1] * t[1, 0] - t[0, 0] * t[1, 1]) * dz
        )
        if facing < min_facing * np.sqrt(dx * dx + dy * dy + dz * dz):
            continue
        face = -1
        if check_occlusion:
            # From 1 % along the way on, so that the surface itself is not hit.
            _, face = cast_ray(
                hierarchy, points[i, 0] + 0.01 * dx, points[i, 1] + 0.01 * dy, points[i, 2] + 0.01 * dz,
                dx, dy, dz, 0.99, True,
            )  # fmt: skip
        wanted[i] = face < 0
    return wanted


@njit(cache=True, nogil=True)
def _align_level(level, key_image, image, key_pixels, warps, wanted, min_ncc, pixels, scores):  # type: ignore[no-untyped-def]
    """Align wanted patches on one level from ``pixels`` on, in place; scores (N,) = correlation or 0."""
    side = 9
    patch = np.empty((side + 2, side + 2), dtype=np.float32)
    template = np.empty(side * side, dtype=np.float32)
    across = np.empty(side * side, dtype=np.float32)
    down = np.empty(side * side, dtype=np.float32)
    scale = 1 << level
    for i in range(pixels.shape[0]):
        scores[i] = 0.0
        if not wanted[i]:
            continue
        u, v = key_pixels[i, 0] / scale, key_pixels[i, 1] / scale
        if not sample_patch(key_image, u, v, warps[i], side // 2 + 1, patch):
            continue
        a, b, c, norm = prepare_template(patch, side, template, across, down)
        if norm == 0.0:
            continue
        u, v, ncc = align_template(
            image,
            pixels[i, 0] / scale,
            pixels[i, 1] / scale,
            side,
            template,
            across,
            down,
            a,
            b,
            c,
            norm,
            12,
            0.03,
        )
        if ncc >= min_ncc:
            pixels[i, 0], pixels[i, 1] = u * scale, v * scale
            scores[i] = ncc


@njit(cache=True, nogil=True)
def match_features(key_pyramid, pyramid, key_pixels, points, tangents, pixel_from_tangent, trust, hierarchy,
                   cam_from_body, intrinsics, damping, search_px, check_occlusion, min_facing, min_ncc,
                   neighbour_px):  # type: ignore[no-untyped-def]  # fmt: skip
    """Find a keyframe's features in a new frame.

    Common shift on the coarsest level; patches alone on level 2; a pose from these, where they agree on one,
    predicts anew; patches alone on levels 1 and 0.

    Args:
        key_pyramid, pyramid: of keyframe and frame, tuples of (H,W) uint8.
        key_pixels, points, tangents, pixel_from_tangent, trust: of the keyframe, see `Keyframe`; the pixels
        are
            relative to the cropped pyramid.
        hierarchy: of the part's triangles in the body, for self-occlusion.
        cam_from_body: (4,4) predicted pose.
        damping: (6,) of the coarse pose, see `solve_step`.

    Returns:
        pixels (N,2); weights (N,), 0 = not found; expected (N,) whether the feature should be in view.
    """
    count = points.shape[0]
    height, width = pyramid[0].shape
    levels = len(pyramid)
    predicted = np.zeros((count, 2))
    warps = np.empty((count, 2, 2))
    scores = np.zeros(count)
    expected = _facing_camera(points, tangents, trust, hierarchy, cam_from_body, min_facing, check_occlusion)
    _predict(
        pixel_from_tangent,
        points,
        tangents,
        cam_from_body,
        intrinsics,
        expected,
        width,
        height,
        predicted,
        warps,
    )
    seen = np.flatnonzero(expected)
    pixels = predicted.copy()
    if search_px > 0 and len(seen) > 0:
        top = levels - 1
        chosen = seen[:: max(1, len(seen) // 24)]
        du, dv = common_shift(
            key_pyramid[top], pyramid[top], 1 << top, key_pixels, predicted, warps, chosen, search_px
        )
        for i in seen:
            pixels[i, 0] += du
            pixels[i, 1] += dv
    if levels > 2:
        _align_level(2, key_pyramid[2], pyramid[2], key_pixels, warps, expected, 0.6, pixels, scores)
        found = np.count_nonzero(scores)
        if found >= 8:
            coarse = _align_pose(points, cam_from_body, intrinsics, pixels, scores, damping, 1.0)
            near = _count_near(points, coarse, intrinsics, pixels, scores, 5.0)
            if near >= 8 and near > 0.6 * found:
                _predict(
                    pixel_from_tangent,
                    points,
                    tangents,
                    coarse,
                    intrinsics,
                    expected,
                    width,
                    height,
                    predicted,
                    warps,
                )
                pixels[:] = predicted
    _align_level(1, key_pyramid[1], pyramid[1], key_pixels, warps, expected, min_ncc, pixels, scores)
    # A patch found at half resolution only (motion blur, noise) is worth half the accuracy.
    weights = np.maximum(scores - min_ncc, 0.0) / (4.0 * (1.0 - min_ncc))
    _align_level(0, key_pyramid[0], pyramid[0], key_pixels, warps, expected, min_ncc, pixels, scores)
    for i in range(count):
        if scores[i] > 0.0:
            weights[i] = (scores[i] - min_ncc) / (1.0 - min_ncc)
    _agree_with_neighbours(predicted, pixels, weights, neighbour_px)
    return pixels, weights, expected


class FeatureModality:
    """Texture of one part, matched from a bank of keyframes."""

    def __init__(
        self,
        vertices_in_body: Array,
        faces: NDArray[np.int32],
        camera: Camera,
        options: FeatureOptions | None = None,
    ) -> None:
        """Prepare for a part of vertices (V,3) mm about its centre and faces (F,3), and a camera."""
        self.options = options or FeatureOptions()
        self.camera = camera
        self.keyframes: list[Keyframe] = []
        self._caster = RayCaster(vertices_in_body, faces)
        used = np.asarray(vertices_in_body)[np.unique(faces)]
        low, high = used.min(axis=0), used.max(axis=0)
        self._damping = np.full(6, 1.0 / 0.3**2)
        self._damping[3:] /= float((high - low) @ (high - low))
        pick = np.array(list(np.ndindex(2, 2, 2)), dtype=np.float64)
        self._box_corners = low + pick * (high - low)
        self._intrinsics = np.array(
            [camera.fx, camera.fy, camera.cx, camera.cy, *camera.dist, 1.0 if camera.is_distorted else 0.0]
        )
        self._clock = 0
        self._last: tuple[Keyframe, NDArray[np.intp], Array] | None = None

    def pyramid(self, gray: NDArray[np.uint8]) -> Pyramid:
        """Pyramid of a gray image (H,W) as `measure` and `add_keyframe` take it."""
        if gray.shape != (self.camera.height, self.camera.width):
            raise InputError(
                f"feature modality: image is {gray.shape[1]}×{gray.shape[0]}, "
                f"the camera {self.camera.width}×{self.camera.height}"
            )
        return build_pyramid(gray, self.options.levels)

    def clear(self) -> None:
        """Forget all keyframes."""
        self.keyframes.clear()
        self._last = None

    def _view_distance(self, keyframe: Keyframe, cam_from_body: Array) -> float:
        """How far a pose is from a keyframe; 1 = at a step of view direction, roll or scale."""
        o = self.options
        eye_a = -keyframe.cam_from_body[:3, :3].T @ keyframe.cam_from_body[:3, 3]
        eye_b = -cam_from_body[:3, :3].T @ cam_from_body[:3, 3]
        range_a, range_b = float(np.linalg.norm(eye_a)), float(np.linalg.norm(eye_b))
        view = np.arccos(np.clip(eye_a @ eye_b / (range_a * range_b), -1.0, 1.0))
        turn = cam_from_body[:3, :3] @ keyframe.cam_from_body[:3, :3].T
        roll = abs(np.arctan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1]))
        scale = abs(np.log(range_b / range_a)) / np.log1p(o.scale_step)
        return float(max(view / o.view_step_rad, roll / o.roll_step_rad, scale))

    def _nearest(self, cam_from_body: Array) -> tuple[Keyframe | None, float]:
        """The keyframe nearest in view direction, roll and scale, and its distance."""
        distances = [self._view_distance(keyframe, cam_from_body) for keyframe in self.keyframes]
        if not distances:
            return None, np.inf
        best = int(np.argmin(distances))
        return self.keyframes[best], distances[best]

    def wants_keyframe(self, cam_from_body: Array, tracked_count: int) -> bool:
        """Whether a keyframe here would help: the view is new, or a bit new and few features were found."""
        keyframe, distance = self._nearest(cam_from_body)
        if keyframe is None or distance > 1.0:
            return True
        return tracked_count < self.options.min_corners and distance > 0.3

    def add_keyframe(self, gray: NDArray[np.uint8] | Pyramid, cam_from_body: Array) -> int:
        """Keep this frame, whose pose must be good; returns the number of features, 0 = too few.

        ``gray`` is an image (H,W) uint8 or its pyramid. A keyframe nearer than 0.3 of a step is replaced.
        """
        o = self.options
        pyramid = gray if isinstance(gray, tuple) else self.pyramid(gray)
        outline = self._outline(cam_from_body)
        rectangle = self._rectangle(outline)
        if rectangle is None:
            return 0
        left, top, right, bottom = rectangle
        # Corners of the half-size picture: four times as quick, quieter, and as wide as the patches.
        half = pyramid[1][top >> 1 : bottom >> 1, left >> 1 : right >> 1]
        response = cv2.cornerMinEigenVal(half, 3, ksize=3)
        mask = np.zeros(response.shape, dtype=np.uint8)
        cv2.fillConvexPoly(mask, np.round((outline - (left, top)) / 2.0).astype(np.int32), 1)
        response *= mask
        cell = max(2, round(0.5 * o.corner_distance_px))
        corners = _best_corners(response, _RESPONSE * o.corner_contrast**2, cell)
        corners = 2.0 * corners[np.argsort(-corners[:, 2]), :2] + (left, top)
        used, kept, points, tangents = _place_corners(
            self._caster.hierarchy, invert(cam_from_body), corners, self._intrinsics, o.margin_px,
            o.corner_distance_px, o.flatness_px, o.min_facing, o.max_corners,
        )  # fmt: skip
        if used < o.min_corners:
            return 0
        pixel_from_tangent = np.empty((used, 2, 2))
        for i in range(used):
            _pixel_from_tangent(
                points[i], tangents[i], cam_from_body, self._intrinsics, pixel_from_tangent[i]
            )
        self._clock += 1
        keyframe = Keyframe(
            cam_from_body=cam_from_body.copy(),
            pyramid=tuple(
                image[top >> level : (bottom >> level) + 1, left >> level : (right >> level) + 1].copy()
                for level, image in enumerate(pyramid)
            ),
            origin=(left, top),
            points_in_body=points[:used].copy(),
            tangents=tangents[:used].copy(),
            pixels=corners[kept[:used]] - (left, top),
            pixel_from_tangent=pixel_from_tangent,
            trust=np.ones(used),
            last_used=self._clock,
        )
        nearest, distance = self._nearest(cam_from_body)
        if nearest is not None and distance < 0.3:
            self.keyframes.remove(nearest)
        elif len(self.keyframes) >= o.max_keyframes:
            self.keyframes.remove(min(self.keyframes, key=lambda old: old.last_used))
        self.keyframes.append(keyframe)
        return int(used)

    def _outline(self, cam_from_body: Array) -> Array:
        """Convex polygon (N,2) px around the part's bounding box; empty when it reaches behind the camera."""
        pixels = self.camera.project(self._box_corners @ cam_from_body[:3, :3].T + cam_from_body[:3, 3])
        if not np.all(np.isfinite(pixels)):
            return np.empty((0, 2))
        return np.asarray(cv2.convexHull(pixels.astype(np.float32))[:, 0], dtype=np.float64)

    def _rectangle(self, pixels: Array) -> tuple[int, int, int, int] | None:
        """Left, top, right, bottom px around pixels (N,2) in the image, on the coarsest level's grid."""
        if len(pixels) == 0:
            return None
        grid = 1 << (self.options.levels - 1)
        # Room for the warped patches of the coarser levels.
        room = 5 * grid
        left, top = (np.maximum(pixels.min(axis=0) - room, 0).astype(int) // grid) * grid
        right, bottom = np.minimum(pixels.max(axis=0) + room, (self.camera.width, self.camera.height)).astype(
            int
        )
        if right - left < 16 or bottom - top < 16:
            return None
        return int(left), int(top), int(right), int(bottom)

    def measure(self, pyramid: Pyramid, cam_from_body: Array) -> Matches:
        """Find the features of the nearest keyframe in a frame.

        Args:
            pyramid: of the frame, see `pyramid`.
            cam_from_body: (4,4) predicted pose, to within about 30 px in the picture at 640×480.
        """
        o = self.options
        keyframe, _ = self._nearest(cam_from_body)
        if keyframe is None:
            self._last = None
            return Matches(np.empty((0, 3)), np.empty((0, 2)), np.empty(0), 0)
        self._clock += 1
        keyframe.last_used = self._clock
        pixels, weights, expected = match_features(
            keyframe.pyramid, pyramid, keyframe.pixels, keyframe.points_in_body, keyframe.tangents,
            keyframe.pixel_from_tangent, keyframe.trust, self._caster.hierarchy, cam_from_body, self._intrinsics,
            self._damping, o.search_px, o.check_occlusion, o.min_facing, o.min_ncc, o.neighbour_px,
        )  # fmt: skip
        found = np.flatnonzero(weights > 0.0)
        self._last = (keyframe, found, pixels[found])
        tried = int(np.count_nonzero(expected))
        return Matches(keyframe.points_in_body[found], pixels[found], weights[found], tried)

    def align(self, matches: Matches, cam_from_body: Array) -> Array:
        """Pose (4,4) from the matches alone, started at and held towards a pose: a pre-alignment."""
        return np.asarray(
            _align_pose(
                matches.points_in_body,
                cam_from_body,
                self._intrinsics,
                matches.pixels,
                matches.weights,
                self._damping,
                1.0,
            )
        )

    def settle(self, cam_from_body: Array, limit_px: float = 4.0) -> None:
        """Learn from the frame's accepted pose which features of the last `measure` can be trusted.

        A feature found more than ``limit_px`` from where the pose says (a reflection, a shadow, a hand that was in
        the keyframe) loses trust, and below 0.2 it is left out for good; one that is not found may be hidden and
        keeps it. A keyframe with too few features left is dropped.
        """
        if self._last is None:
            return
        keyframe, found, pixels = self._last
        points = keyframe.points_in_body[found] @ cam_from_body[:3, :3].T + cam_from_body[:3, 3]
        with np.errstate(invalid="ignore"):
            good = np.linalg.norm(self.camera.project(points) - pixels, axis=1) <= limit_px
        # When most disagree, the pose may be at fault.
        if 2 * np.count_nonzero(good) < len(found):
            return
        keyframe.trust[found] += 0.1 * (good - keyframe.trust[found])
        if np.count_nonzero(keyframe.trust >= 0.2) < self.options.min_corners and keyframe in self.keyframes:
            self.keyframes = [kept for kept in self.keyframes if kept is not keyframe]
        self._last = None
