"""Kernels of the object-space sweep: similarity of a patch in several photos as it moves along its normal."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from arview.core.kernel import kernel
from arview.measurement.photo.views import PhotoStack

_FAST = {"reassoc", "contract", "arcp", "nsz"}
"""LLVM flags that let sums be vectorised."""
_MIN_POINTS = 9
"""Patches with fewer points in use have no score."""


@kernel(fastmath=_FAST, numpy_errors=True)
def sweep_scores(
    patches: NDArray[np.float64],
    is_on: NDArray[np.bool_],
    shades: NDArray[np.float64],
    normals: NDArray[np.float64],
    steps: NDArray[np.float64],
    views: NDArray[np.int64],
    stack: PhotoStack,
    min_contrast: float,
) -> tuple[NDArray[np.float32], NDArray[np.int8], NDArray[np.float32]]:
    """Mean correlation (ZNCC) over all pairs of views of patches moved along their normals.

    Args:
        patches: (N,P,3) points in the model frame, mm.
        is_on: (N,P) which points are used.
        shades: (N,P,3) brightness changes that light may cause from view to view (mean and slopes), orthonormal over
            the points used; they are projected out.
        normals: (N,3) unit.
        steps: (S,) offsets along the normal, mm.
        views: (N,V) indices of photos, -1 for none.
        stack: the photos (`PhotoStack`).
        min_contrast: standard deviation in grey levels below which a view is ignored.

    Returns:
        scores (N,S), -1 where fewer than two views contribute; count (N,S) of contributing views; similarity (N,S,V)
        correlation of each view with the mean of the others, -1 for none.
    """
    pixels, starts, sizes, lenses, poses = stack
    n, p_all = is_on.shape
    s_all, v_all = len(steps), views.shape[1]
    scores = np.full((n, s_all), -1.0, dtype=np.float32)
    count = np.zeros((n, s_all), dtype=np.int8)
    similarity = np.full((n, s_all, v_all), -1.0, dtype=np.float32)
    in_cam = np.empty((v_all, 3, p_all))
    direction = np.empty((v_all, 3))
    values = np.empty((v_all, p_all))
    total = np.empty(p_all)
    shade = np.empty((3, p_all))
    u, v = np.empty(p_all), np.empty(p_all)
    for i in range(n):
        used = _to_cameras(
            patches[i],
            is_on[i],
            shades[i],
            normal=normals[i],
            views=views[i],
            poses=poses,
            in_cam=in_cam,
            direction=direction,
            shade=shade,
        )
        if used < _MIN_POINTS:
            continue
        for s in range(s_all):
            total[:used] = 0.0
            contributing = 0
            for k in range(v_all):
                m = views[i, k]
                similarity[i, s, k] = -1.0
                if m < 0:
                    continue
                _project(in_cam[k], direction[k], steps[s], lenses[m], used, u, v)
                if not _is_inside(u, v, used, sizes[m, 0], sizes[m, 1]):
                    continue
                _sample(pixels, starts[m], sizes[m, 0], u, v, used, values[k])
                if not _normalise(values[k], shade, used, min_contrast, total):
                    continue
                similarity[i, s, k] = 1.0
                contributing += 1
            count[i, s] = contributing
            if contributing >= 2:
                scores[i, s] = _compare(values, total, used, contributing, similarity[i, s])
    return scores, count, similarity


@kernel(fastmath=_FAST, numpy_errors=True)
def _to_cameras(
    patch: NDArray[np.float64],
    is_on: NDArray[np.bool_],
    shades: NDArray[np.float64],
    normal: NDArray[np.float64],
    views: NDArray[np.int64],
    poses: NDArray[np.float64],
    in_cam: NDArray[np.float64],
    direction: NDArray[np.float64],
    shade: NDArray[np.float64],
) -> int:
    """Points in use, packed, and the normal in the frames of the cameras; shades packed alike. Returns their number."""
    used = 0
    for p in range(len(is_on)):
        if is_on[p]:
            for v in range(len(views)):
                m = views[v]
                if m < 0:
                    continue
                for k in range(3):
                    in_cam[v, k, used] = (
                        poses[m, k, 0] * patch[p, 0]
                        + poses[m, k, 1] * patch[p, 1]
                        + poses[m, k, 2] * patch[p, 2]
                        + poses[m, k, 3]
                    )
            for k in range(3):
                shade[k, used] = shades[p, k]
            used += 1
    for v in range(len(views)):
        m = views[v]
        if m >= 0:
            for k in range(3):
                direction[v, k] = poses[m, k, 0] * normal[0] + poses[m, k, 1] * normal[1] + poses[m, k, 2] * normal[2]
    return used


@kernel(fastmath=_FAST, numpy_errors=True, inline=True)
def _project(in_cam: Any, direction: Any, step: Any, lens: Any, used: Any, u: Any, v: Any) -> Any:
    """Pixels (u, v) of the points moved by ``step`` along the normal, through a lens fx fy cx cy k1 k2 p1 p2 k3."""
    fx, fy, cx, cy = lens[0], lens[1], lens[2], lens[3]
    k1, k2, p1, p2, k3 = lens[4], lens[5], lens[6], lens[7], lens[8]
    step_x, step_y, step_z = step * direction[0], step * direction[1], step * direction[2]
    for p in range(used):
        inverse = 1.0 / (in_cam[2, p] + step_z)
        x = (in_cam[0, p] + step_x) * inverse
        y = (in_cam[1, p] + step_y) * inverse
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        u[p] = fx * (x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)) + cx
        v[p] = fy * (y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y) + cy


@kernel(fastmath=_FAST, numpy_errors=True, inline=True)
def _is_inside(u: Any, v: Any, used: Any, width: Any, height: Any) -> Any:
    """Whether all pixels lie inside the picture."""
    for p in range(used):
        a, b = u[p], v[p]
        if not (a >= 0.0 and b >= 0.0 and a < width - 1 and b < height - 1):
            return False
    return True


@kernel(fastmath=_FAST, numpy_errors=True, inline=True)
def _sample(pixels: Any, start: Any, width: Any, u: Any, v: Any, used: Any, values: Any) -> Any:
    """Bilinear grey levels of the picture that begins at ``start`` in the stack."""
    for p in range(used):
        a, b = u[p], v[p]
        ia, ib = int(a), int(b)
        fa, fb = a - ia, b - ib
        at = start + ib * width + ia
        top = pixels[at] * (1.0 - fa) + pixels[at + 1] * fa
        bottom = pixels[at + width] * (1.0 - fa) + pixels[at + width + 1] * fa
        values[p] = top * (1.0 - fb) + bottom * fb


@kernel(fastmath=_FAST, numpy_errors=True, inline=True)
def _normalise(values: Any, shade: Any, used: Any, min_contrast: Any, total: Any) -> Any:
    """Remove the shades from the values, scale them to length 1 and add them to ``total``; False without contrast."""
    mean, slope_a, slope_b = 0.0, 0.0, 0.0
    for p in range(used):
        mean += values[p] * shade[0, p]
        slope_a += values[p] * shade[1, p]
        slope_b += values[p] * shade[2, p]
    square = 0.0
    for p in range(used):
        values[p] -= mean * shade[0, p] + slope_a * shade[1, p] + slope_b * shade[2, p]
        square += values[p] * values[p]
    if square < used * min_contrast * min_contrast:
        return False
    scale = 1.0 / np.sqrt(square)
    for p in range(used):
        values[p] *= scale
        total[p] += values[p]
    return True


@kernel(fastmath=_FAST, numpy_errors=True)
def _compare(
    values: NDArray[np.float64],
    total: NDArray[np.float64],
    used: int,
    contributing: int,
    similarity: NDArray[np.float32],
) -> float:
    """Mean correlation of all pairs of views, and into ``similarity`` that of each with the mean of the others."""
    square = 0.0
    for p in range(used):
        square += total[p] * total[p]
    score = (square - contributing) / (contributing * (contributing - 1))
    for v in range(len(similarity)):
        if similarity[v] < 0.0:
            continue
        along = 0.0
        for p in range(used):
            along += values[v, p] * total[p]
        rest = np.sqrt(max(square - 2.0 * along + 1.0, 1e-12))
        similarity[v] = (along - 1.0) / rest
    return score


@kernel
def choose_views(
    visible: NDArray[np.bool_], cosines: NDArray[np.float64], directions: NDArray[np.float64], max_views: int
) -> NDArray[np.int64]:
    """Choose the views of each sample greedily: seen at a steep angle, and from directions 20° apart where possible.

    Args:
        visible: (N,M) which of M views see the sample.
        cosines: (N,M) cosine between the sample's normal and the direction to the camera.
        directions: (M,3) unit, towards the cameras.
        max_views: number of views to choose.

    Returns:
        (N,max_views) indices of views, -1 for none.
    """
    n, m_all = visible.shape
    views = np.full((n, max_views), -1, dtype=np.int64)
    apart = np.empty(m_all)
    for i in range(n):
        apart[:] = 1.0
        for k in range(max_views):
            best, score = -1, 0.0
            for m in range(m_all):
                if visible[i, m] and cosines[i, m] * apart[m] > score:
                    best, score = m, cosines[i, m] * apart[m]
            if best < 0:
                break
            views[i, k] = best
            for m in range(m_all):
                cosine = 0.0
                for c in range(3):
                    cosine += directions[m, c] * directions[best, c]
                apart[m] = min(apart[m], np.arccos(min(max(cosine, -1.0), 1.0)) / np.radians(20.0))
            apart[best] = 0.0
    return views


@kernel
def vote_shifts(
    scores: NDArray[np.float32],
    steps: NDArray[np.float64],
    normals: NDArray[np.float64],
    shifts: NDArray[np.float64],
    floor: float,
) -> NDArray[np.float64]:
    """Sum over samples of how far their score exceeds ``floor`` where each shift puts them along their normals.

    Args:
        scores: (N,S) of `sweep_scores`.
        steps: (S,) equally spaced offsets of the scores, mm.
        normals: (N,3) unit.
        shifts: (T,3) candidate translations, mm.
        floor: score that counts as no support.

    Returns:
        (T,) votes.
    """
    votes = np.zeros(shifts.shape[0])
    first, pitch = steps[0], steps[1] - steps[0]
    for t in range(shifts.shape[0]):
        total = 0.0
        for i in range(scores.shape[0]):
            along = normals[i, 0] * shifts[t, 0] + normals[i, 1] * shifts[t, 1] + normals[i, 2] * shifts[t, 2]
            place = (along - first) / pitch
            k = int(np.floor(place))
            if 0 <= k < len(steps) - 1:
                part = place - k
                total += max(scores[i, k] * (1.0 - part) + scores[i, k + 1] * part - floor, 0.0)
        votes[t] = total
    return votes
