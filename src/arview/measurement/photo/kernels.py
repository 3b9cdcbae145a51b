"""Kernels of the sweep: how alike a patch looks in several photos, along its normal."""

from __future__ import annotations

import numpy as np

from arview.core.kernel import kernel

_FAST = {"reassoc", "contract", "arcp", "nsz"}
"""Sums may be done in any order: four numbers at a time."""


@kernel(fastmath=_FAST, numpy_errors=True)
def sweep_scores(patches, is_on, shades, normals, steps, views, stack, min_contrast):  # type: ignore[no-untyped-def]
    """Mean correlation (ZNCC) over all pairs of views of patches moved along their normals.

    Args:
        patches: (N,P,3) points in the model frame.
        is_on: (N,P) which are used.
        shades: (N,P,3) orthonormal over the points used: mean and slopes, which light may change from view to view.
        normals: (N,3).
        steps: (S,) mm.
        views: (N,V) indices of photos, -1 for none.
        stack: the photos (`PhotoStack`).
        min_contrast: standard deviation in grey levels; a view with less takes no part.

    Returns:
        scores (N,S), -1 where fewer than two views take part; count (N,S) of views that do; alike (N,S,V) correlation
        of each view with the mean of the others, -1 for none.
    """
    pixels, starts, sizes, lenses, poses = stack
    n, p_all = is_on.shape
    s_all, v_all = len(steps), views.shape[1]
    scores = np.full((n, s_all), -1.0, dtype=np.float32)
    count = np.zeros((n, s_all), dtype=np.int8)
    alike = np.full((n, s_all, v_all), -1.0, dtype=np.float32)
    ahead = np.empty((v_all, 3, p_all))
    toward = np.empty((v_all, 3))
    values = np.empty((v_all, p_all))
    total = np.empty(p_all)
    shade = np.empty((3, p_all))
    across, down = np.empty(p_all), np.empty(p_all)
    for i in range(n):
        used = 0
        for p in range(p_all):
            if is_on[i, p]:
                for v in range(v_all):
                    m = views[i, v]
                    if m < 0:
                        continue
                    for k in range(3):
                        ahead[v, k, used] = (
                            poses[m, k, 0] * patches[i, p, 0] + poses[m, k, 1] * patches[i, p, 1]
                            + poses[m, k, 2] * patches[i, p, 2] + poses[m, k, 3]
                        )  # fmt: skip
                for k in range(3):
                    shade[k, used] = shades[i, p, k]
                used += 1
        if used < 9:
            continue
        for v in range(v_all):
            m = views[i, v]
            if m >= 0:
                for k in range(3):
                    toward[v, k] = (
                        poses[m, k, 0] * normals[i, 0] + poses[m, k, 1] * normals[i, 1] + poses[m, k, 2] * normals[i, 2]
                    )
        for s in range(s_all):
            step = steps[s]
            total[:used] = 0.0
            taking = 0
            for v in range(v_all):
                m = views[i, v]
                alike[i, s, v] = -1.0
                if m < 0:
                    continue
                width, height, start = sizes[m, 0], sizes[m, 1], starts[m]
                fx, fy, cx, cy = lenses[m, 0], lenses[m, 1], lenses[m, 2], lenses[m, 3]
                k1, k2, p1, p2, k3 = lenses[m, 4], lenses[m, 5], lenses[m, 6], lenses[m, 7], lenses[m, 8]
                mean, slope_a, slope_b = 0.0, 0.0, 0.0
                step_x, step_y, step_z = step * toward[v, 0], step * toward[v, 1], step * toward[v, 2]
                for p in range(used):
                    inverse = 1.0 / (ahead[v, 2, p] + step_z)
                    x = (ahead[v, 0, p] + step_x) * inverse
                    y = (ahead[v, 1, p] + step_y) * inverse
                    r2 = x * x + y * y
                    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
                    across[p] = fx * (x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)) + cx
                    down[p] = fy * (y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y) + cy
                is_inside = True
                for p in range(used):
                    a, b = across[p], down[p]
                    if not (a >= 0.0 and b >= 0.0 and a < width - 1 and b < height - 1):
                        is_inside = False
                        break
                if not is_inside:
                    continue
                for p in range(used):
                    a, b = across[p], down[p]
                    ia, ib = int(a), int(b)
                    fa, fb = a - ia, b - ib
                    at = start + ib * width + ia
                    top = pixels[at] * (1.0 - fa) + pixels[at + 1] * fa
                    bottom = pixels[at + width] * (1.0 - fa) + pixels[at + width + 1] * fa
                    values[v, p] = top * (1.0 - fb) + bottom * fb
                for p in range(used):
                    mean += values[v, p] * shade[0, p]
                    slope_a += values[v, p] * shade[1, p]
                    slope_b += values[v, p] * shade[2, p]
                square = 0.0
                for p in range(used):
                    values[v, p] -= mean * shade[0, p] + slope_a * shade[1, p] + slope_b * shade[2, p]
                    square += values[v, p] * values[v, p]
                if square < used * min_contrast * min_contrast:
                    continue
                scale = 1.0 / np.sqrt(square)
                for p in range(used):
                    values[v, p] *= scale
                    total[p] += values[v, p]
                alike[i, s, v] = 1.0
                taking += 1
            count[i, s] = taking
            if taking < 2:
                continue
            square = 0.0
            for p in range(used):
                square += total[p] * total[p]
            scores[i, s] = (square - taking) / (taking * (taking - 1))
            for v in range(v_all):
                if alike[i, s, v] < 0.0:
                    continue
                along = 0.0
                for p in range(used):
                    along += values[v, p] * total[p]
                rest = np.sqrt(max(square - 2.0 * along + 1.0, 1e-12))
                alike[i, s, v] = (along - 1.0) / rest
    return scores, count, alike


@kernel
def choose_views(visible, cosines, directions, most):  # type: ignore[no-untyped-def]
    """The views (N,most) that see a sample best and from different sides, -1 for none.

    ``visible`` (N,M), ``cosines`` (N,M) to the normal, ``directions`` (M,3) to the cameras, unit. Greedy: steep and at
    least 20° from those taken counts full.
    """
    n, m_all = visible.shape
    views = np.full((n, most), -1, dtype=np.int64)
    apart = np.empty(m_all)
    for i in range(n):
        apart[:] = 1.0
        for k in range(most):
            best, worth = -1, 0.0
            for m in range(m_all):
                if visible[i, m] and cosines[i, m] * apart[m] > worth:
                    best, worth = m, cosines[i, m] * apart[m]
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
def vote_shifts(scores, steps, normals, shifts, floor):  # type: ignore[no-untyped-def]
    """(T,) sum over samples of their score, above ``floor``, where shifts (T,3) put them along their normals."""
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
