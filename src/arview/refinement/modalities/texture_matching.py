"""Kernels of the texture modality: matching of a keyframe's corners in a frame, and their part of the 6×6 system."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from arview.core.kernel import kernel
from arview.geometry import Array
from arview.refinement.gauss_newton import add_line, add_system, apply_twist, solve_step
from arview.refinement.modalities.keyframes import Anchors, tangent_jacobian, to_camera
from arview.refinement.modalities.patch_alignment import align_template, common_shift, prepare_template, sample_patch
from arview.refinement.projection import project
from arview.rendering import Hierarchy, cast_ray


class MatchSettings(NamedTuple):
    """Options of the matching in the form of the kernels."""

    search_px: int
    check_occlusion: bool
    min_facing: float
    min_trust: float
    min_ncc: float
    neighbour_px: float


class PatchMatches(NamedTuple):
    """Result of `match_texture` for the N corners of a keyframe.

    Attributes:
        pixels: (N,2) where each corner was found or predicted, px.
        weights: (N,) 0–1; 0 = not found.
        expected: (N,) whether the corner should be in view.
    """

    pixels: Array
    weights: Array
    expected: NDArray[np.bool_]


VIEW_STEP_RAD = 0.17
"""Difference in direction of view that asks for a new keyframe."""
ROLL_STEP_RAD = 0.26
"""Difference in roll that asks for a new keyframe."""
SCALE_STEP = 0.15
"""Relative difference in distance that asks for a new keyframe."""
MIN_TRUST = 0.2
"""Trust below which a corner is no longer used."""
TRUST_RATE = 0.1
"""Share by which a corner's trust follows each frame."""
TRUSTED_PX = 2.0
"""Distance from where the pose places it within which a found corner gains trust."""
NEIGHBOURS = 7
"""Nearest neighbours with which the displacement of a patch is compared."""
PATCH_SIDE = 9
"""Side of the patches, px."""
NEAR_SQUARED_NCC = 0.7
"""Mean squared correlation on the coarsest level from which the patches are where they were predicted, to a pixel of
it, so that they are neither searched for farther away nor aligned on level 2."""
COARSE_NCC = 0.6
"""Smallest correlation of a patch on the coarse level from which a pose is estimated."""


@kernel
def _agree_with_neighbours(
    predicted: NDArray[np.float64], pixels: NDArray[np.float64], weights: NDArray[np.float64], limit_px: float
) -> None:
    """Clear the weights of points whose displacement differs from the median of their nearest neighbours."""
    count = predicted.shape[0]
    near = NEIGHBOURS
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


@kernel(fastmath=True)
def add_matches(
    hessian: NDArray[np.float64],
    gradient: NDArray[np.float64],
    points: NDArray[np.float64],
    cam_from_body: NDArray[np.float64],
    intrinsics: NDArray[np.float64],
    pixels: NDArray[np.float64],
    weights: NDArray[np.float64],
    sigma_px: float,
    robust_px: float,
) -> tuple[float, float, int]:
    """Add the reprojection residuals of matched points to the 6×6 system.

    Args:
        hessian, gradient: (6,6) and (6,) of the system.
        points: (N,3) in the body frame.
        cam_from_body, intrinsics: current pose (4,4) and camera.
        pixels, weights: (N,2) and (N,) of the matches.
        sigma_px: standard deviation of a correct match.
        robust_px: residual at which the weight has faded to 0 (Tukey).

    Returns:
        Sum of the weighted squared residuals, sum of the weights, and number of points within ``robust_px``.
    """
    r = cam_from_body
    system = np.zeros((6, 8))
    sum_square = 0.0
    sum_weight = 0.0
    inliers = 0
    for i in range(points.shape[0]):
        if weights[i] <= 0.0:
            continue
        p = points[i]
        x, y, z = to_camera(r, p[0], p[1], p[2])
        if z < 1.0:
            continue
        u, v = project(x, y, z, intrinsics)
        eu, ev = u - pixels[i, 0], v - pixels[i, 1]
        square = (eu * eu + ev * ev) / (robust_px * robust_px)
        if square >= 1.0:
            continue
        w = weights[i] * (1.0 - square) ** 2 / (sigma_px * sigma_px)
        add_line(system, p, r, x, y, z, 1.0, 0.0, intrinsics, eu, w)
        add_line(system, p, r, x, y, z, 0.0, 1.0, intrinsics, ev, w)
        sum_square += w * (eu * eu + ev * ev)
        sum_weight += w
        inliers += 1
    add_system(hessian, gradient, system)
    return sum_square, sum_weight, inliers


@kernel
def align_pose(
    points: NDArray[np.float64],
    cam_from_body: NDArray[np.float64],
    intrinsics: NDArray[np.float64],
    pixels: NDArray[np.float64],
    weights: NDArray[np.float64],
    damping: NDArray[np.float64],
    sigma_px: float,
) -> NDArray[np.float64]:
    """Pose (4,4) that projects points on their pixels; the robust limit shrinks from 40 to 3 px."""
    hessian = np.zeros((6, 6))
    gradient = np.zeros(6)
    robust_px = 40.0
    for _ in range(8):
        hessian[:] = 0.0
        gradient[:] = 0.0
        add_matches(
            hessian,
            gradient,
            points,
            cam_from_body,
            intrinsics,
            pixels,
            weights,
            sigma_px=sigma_px,
            robust_px=robust_px,
        )
        cam_from_body = apply_twist(cam_from_body, solve_step(hessian, gradient, damping))
        robust_px = max(3.0, 0.6 * robust_px)
    return cam_from_body


@kernel
def _count_near(
    points: NDArray[np.float64],
    cam_from_body: NDArray[np.float64],
    intrinsics: NDArray[np.float64],
    pixels: NDArray[np.float64],
    weights: NDArray[np.float64],
    limit_px: float,
) -> int:
    """Number of points of positive weight that project to within ``limit_px`` of their pixels."""
    count = 0
    for i in range(points.shape[0]):
        x, y, z = to_camera(cam_from_body, points[i, 0], points[i, 1], points[i, 2])
        if weights[i] > 0.0 and z >= 1.0:
            u, v = project(x, y, z, intrinsics)
            if (u - pixels[i, 0]) ** 2 + (v - pixels[i, 1]) ** 2 < limit_px * limit_px:
                count += 1
    return count


@kernel
def _find_visible(
    anchors: Anchors, hierarchy: Hierarchy, cam_from_body: NDArray[np.float64], settings: MatchSettings
) -> NDArray[np.bool_]:
    """Whether each trusted anchor (N,) faces the camera and is not hidden behind the part itself."""
    r = cam_from_body
    eye = np.empty(3)
    for a in range(3):
        eye[a] = -(r[0, a] * r[0, 3] + r[1, a] * r[1, 3] + r[2, a] * r[2, 3])
    wanted = np.zeros(anchors.points.shape[0], dtype=np.bool_)
    for i in range(wanted.shape[0]):
        if anchors.trust[i] < settings.min_trust:
            continue
        p, t = anchors.points[i], anchors.tangents[i]
        dx, dy, dz = eye[0] - p[0], eye[1] - p[1], eye[2] - p[2]
        facing = (
            (t[0, 2] * t[1, 1] - t[0, 1] * t[1, 2]) * dx
            + (t[0, 0] * t[1, 2] - t[0, 2] * t[1, 0]) * dy
            + (t[0, 1] * t[1, 0] - t[0, 0] * t[1, 1]) * dz
        )
        if facing < settings.min_facing * np.sqrt(dx * dx + dy * dy + dz * dz):
            continue
        face = -1
        if settings.check_occlusion:
            # The ray starts 1 % along its way, so that it does not hit the surface itself.
            x, y, z = p[0] + 0.01 * dx, p[1] + 0.01 * dy, p[2] + 0.01 * dz
            _, face = cast_ray(hierarchy, x, y, z, dx, dy, dz, limit=0.99, any_hit=True)
        wanted[i] = face < 0
    return wanted


@kernel
def _predict(
    anchors: Anchors,
    cam_from_body: NDArray[np.float64],
    intrinsics: NDArray[np.float64],
    width: int,
    height: int,
    wanted: NDArray[np.bool_],
    predicted: NDArray[np.float64],
    warps: NDArray[np.float64],
) -> None:
    """Fill the predicted pixels (N,2) and the warps (N,2,2) of the tangent planes from frame to keyframe px.

    Clears ``wanted`` (N,) where the patch is outside the picture or much larger or smaller than in the keyframe.
    """
    jacobian = np.empty((2, 2))
    for i in range(wanted.shape[0]):
        if not wanted[i]:
            continue
        wanted[i] = False
        u, v, z = tangent_jacobian(anchors.points[i], anchors.tangents[i], cam_from_body, intrinsics, jacobian)
        if z <= 0.0 or u < 6 or v < 6 or u > width - 7 or v > height - 7:
            continue
        det = jacobian[0, 0] * jacobian[1, 1] - jacobian[0, 1] * jacobian[1, 0]
        if abs(det) < 1e-12:
            continue
        p, w = anchors.jacobians[i], warps[i]
        w[0, 0] = (p[0, 0] * jacobian[1, 1] - p[0, 1] * jacobian[1, 0]) / det
        w[0, 1] = (p[0, 1] * jacobian[0, 0] - p[0, 0] * jacobian[0, 1]) / det
        w[1, 0] = (p[1, 0] * jacobian[1, 1] - p[1, 1] * jacobian[1, 0]) / det
        w[1, 1] = (p[1, 1] * jacobian[0, 0] - p[1, 0] * jacobian[0, 1]) / det
        area = w[0, 0] * w[1, 1] - w[0, 1] * w[1, 0]
        if area < 0.1 or area > 10.0:
            continue
        predicted[i, 0], predicted[i, 1] = u, v
        wanted[i] = True


@kernel
def _align_level(
    level: int,
    key_pyramid: tuple[NDArray[np.uint8], ...],
    pyramid: tuple[NDArray[np.uint8], ...],
    key_pixels: NDArray[np.float64],
    warps: NDArray[np.float64],
    wanted: NDArray[np.bool_],
    min_ncc: float,
    pixels: NDArray[np.float64],
    scores: NDArray[np.float64],
) -> None:
    """Align the wanted patches on one level, starting at ``pixels`` (N,2) in place; fills scores (N,), 0 = failed."""
    side = PATCH_SIDE
    patch = np.empty((side + 2, side + 2), dtype=np.float32)
    template = np.empty(side * side, dtype=np.float32)
    across = np.empty(side * side, dtype=np.float32)
    down = np.empty(side * side, dtype=np.float32)
    key_image, image = key_pyramid[level], pyramid[level]
    scale = 1 << level
    for i in range(pixels.shape[0]):
        scores[i] = 0.0
        if not wanted[i]:
            continue
        u, v = key_pixels[i, 0] / scale, key_pixels[i, 1] / scale
        if not sample_patch(key_image, u, v, warps[i], side // 2 + 1, patch):
            continue
        normal, norm = prepare_template(patch, side, template, across, down)
        if norm == 0.0:
            continue
        u, v = pixels[i, 0] / scale, pixels[i, 1] / scale
        u, v, ncc = align_template(
            image, u, v, side, template, across, down, normal=normal, norm=norm, steps=12, stop_px=0.03
        )
        if ncc >= min_ncc:
            pixels[i, 0], pixels[i, 1] = u * scale, v * scale
            scores[i] = ncc


@kernel
def match_texture(
    key_pyramid: tuple[NDArray[np.uint8], ...],
    pyramid: tuple[NDArray[np.uint8], ...],
    anchors: Anchors,
    hierarchy: Hierarchy,
    cam_from_body: NDArray[np.float64],
    intrinsics: NDArray[np.float64],
    damping: NDArray[np.float64],
    settings: MatchSettings,
) -> PatchMatches:
    """Find the corners of a keyframe in a new frame, see `PatchMatches`.

    All patches are first shifted together on the coarsest level. Where they are not near the prediction, they are then
    aligned one by one on level 2; if these agree on a pose, it replaces the prediction. Patches are then aligned on
    levels 1 and 0.

    Args:
        key_pyramid, pyramid: image pyramids of keyframe and frame.
        anchors: `Anchors` of the keyframe.
        hierarchy: of the part's triangles in the body frame, see `RayCaster`.
        cam_from_body: (4,4) predicted pose.
        intrinsics: (10,) as of `intrinsics_of`.
        damping: (6,) of the pose on level 2, as in `solve_step`.
        settings: `MatchSettings`.
    """
    points, min_ncc = anchors.points, settings.min_ncc
    count = points.shape[0]
    height, width = pyramid[0].shape
    top = len(pyramid) - 1
    predicted = np.zeros((count, 2))
    warps = np.empty((count, 2, 2))
    scores = np.zeros(count)
    expected = _find_visible(anchors, hierarchy, cam_from_body, settings)
    _predict(anchors, cam_from_body, intrinsics, width, height, expected, predicted, warps=warps)
    seen = np.flatnonzero(expected)
    pixels = predicted.copy()
    is_near = False
    if settings.search_px > 0 and len(seen) > 0:
        chosen = seen[:: max(1, len(seen) // 24)]
        coarse_key, image, scale = key_pyramid[top], pyramid[top], 1 << top
        shift = common_shift(coarse_key, image, scale, anchors.pixels, predicted, warps, chosen, reach=1)
        is_near = shift[2] > NEAR_SQUARED_NCC
        if not is_near:
            reach = settings.search_px
            shift = common_shift(coarse_key, image, scale, anchors.pixels, predicted, warps, chosen, reach=reach)
        pixels[:, 0] += shift[0]
        pixels[:, 1] += shift[1]
    if top > 1 and not is_near:
        _align_level(2, key_pyramid, pyramid, anchors.pixels, warps, expected, COARSE_NCC, pixels=pixels, scores=scores)
        found = np.count_nonzero(scores)
        coarse = align_pose(points, cam_from_body, intrinsics, pixels, scores, damping, 1.0)
        near = _count_near(points, coarse, intrinsics, pixels, scores, 5.0)
        if near >= 8 and near > 0.6 * found:
            _predict(anchors, coarse, intrinsics, width, height, expected, predicted, warps=warps)
            pixels[:] = predicted
    _align_level(1, key_pyramid, pyramid, anchors.pixels, warps, expected, min_ncc, pixels=pixels, scores=scores)
    # A patch found only at half resolution, because of blur or noise, is half as accurate.
    weights = np.maximum(scores - min_ncc, 0.0) / (4.0 * (1.0 - min_ncc))
    _align_level(0, key_pyramid, pyramid, anchors.pixels, warps, expected, min_ncc, pixels=pixels, scores=scores)
    for i in range(count):
        if scores[i] > 0.0:
            weights[i] = (scores[i] - min_ncc) / (1.0 - min_ncc)
    _agree_with_neighbours(predicted, pixels, weights, settings.neighbour_px)
    return PatchMatches(pixels, weights, expected)


@kernel
def nearest_pose(poses: NDArray[np.float64], cam_from_body: NDArray[np.float64]) -> tuple[int, float]:
    """Pose (N,4,4) nearest in direction of view, roll and distance, and its distance in the steps for new keyframes."""
    best, least = 0, np.inf
    b = cam_from_body
    eye = np.ascontiguousarray(b[:3, :3].T) @ np.ascontiguousarray(b[:3, 3])
    distance = np.sqrt((eye * eye).sum())
    for k in range(poses.shape[0]):
        a = poses[k]
        back = np.ascontiguousarray(a[:3, :3].T)
        other = back @ np.ascontiguousarray(a[:3, 3])
        range_mm = np.sqrt((other * other).sum())
        view = np.arccos(min(max((eye * other).sum() / (range_mm * distance), -1.0), 1.0))
        turn = np.ascontiguousarray(b[:3, :3]) @ back
        roll = abs(np.arctan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1]))
        scale = abs(np.log(distance / range_mm)) / np.log(1.0 + SCALE_STEP)
        steps = max(view / VIEW_STEP_RAD, roll / ROLL_STEP_RAD, scale)
        if steps < least:
            best, least = k, steps
    return best, least


@kernel
def learn_trust(
    trust: NDArray[np.float64],
    points: NDArray[np.float64],
    found: NDArray[np.int64],
    pixels: NDArray[np.float64],
    cam_from_body: NDArray[np.float64],
    intrinsics: NDArray[np.float64],
) -> int:
    """Move the trust (N,) in those corners that were found towards whether they are where a pose places them.

    Args:
        trust: in place.
        points: (N,3) of the corners in the body frame.
        found: (M,) indices of those that were found.
        pixels: (M,2) where.
        cam_from_body: (4,4) accepted pose.
        intrinsics: as of `intrinsics_of`.

    Returns:
        Number of corners with enough trust. When most that were found disagree, the pose may be wrong, and nothing is
        learned: all corners are counted.
    """
    good = np.zeros(found.shape[0])
    for k in range(found.shape[0]):
        p = points[found[k]]
        x, y, z = to_camera(cam_from_body, p[0], p[1], p[2])
        if z >= 1.0:
            u, v = project(x, y, z, intrinsics)
            good[k] = 1.0 if (u - pixels[k, 0]) ** 2 + (v - pixels[k, 1]) ** 2 <= TRUSTED_PX**2 else 0.0
    if 2.0 * good.sum() < found.shape[0]:
        return trust.shape[0]
    for k in range(found.shape[0]):
        trust[found[k]] += TRUST_RATE * (good[k] - trust[found[k]])
    count = 0
    for one in trust:
        if one >= MIN_TRUST:
            count += 1
    return count
