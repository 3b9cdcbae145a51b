"""Least-squares matching: refines a surface element to the grey levels of the sources, with its standard deviation.

Gauss-Newton on inverse depth and its two slopes over all sources that see the element, each with its own gain and
offset (Gruen 1985; Furukawa & Ponce 2010). The result depends on the photos, not on the hypothesis it started from.
"""

from __future__ import annotations

import numpy as np
from numba import float32
from numpy.typing import NDArray

from arview.core.kernel import kernel
from arview.reconstruction.dense.kernels import (
    CENTRED,
    DX,
    DY,
    FU,
    FV,
    GREY,
    JACOBIAN,
    NOISE,
    RADIUS,
    SAMPLES,
    WEIGHT,
    A,
    B,
    C,
    D,
    Problem,
    falls_inside,
    is_facing,
    sample,
    take_window,
    warp,
)

_ZERO, _ONE = float32(0.0), float32(1.0)
_SEES = float32(0.5)
"""Correlation from which a source counts as seeing the element."""
_MAX_LAST_STEP = 0.1
"""Largest last step in px of an element that is kept; one still moving depends on its start."""
_SLOPE_PRIOR = 0.05
"""Weight of the slopes' start values as a share of the information on w; it stabilises slopes where texture is poor."""


@kernel(fastmath=True, numpy_errors=True)
def _normal_equations(
    pixels: NDArray[np.float32], sizes: NDArray[np.int32], warps: NDArray[np.float32], s: NDArray[np.float32],
    index: NDArray[np.int32], k: int, h: tuple[float | np.float32, ...], variance: float | np.float32,
    noise: float | np.float32, system: NDArray[np.float64]
) -> float | np.float32:  # fmt: skip
    """Add source k, with gain and offset eliminated, to the system (upper H, gradient, squares); return its
    correlation.
    """
    sample(pixels, sizes, s, index, k, h)
    tx, ty, tz = warps[k, 9], warps[k, 10], warps[k, 11]
    x0, xu, xv, y0, yu, yv, z0, zu, zv = h
    first, second, both = _ZERO, _ZERO, _ZERO
    for i in range(SAMPLES):
        dx, dy = s[DX, i], s[DY, i]
        inverse = _ONE / (z0 + zu * dx + zv * dy)
        u = (x0 + xu * dx + xv * dy) * inverse
        v = (y0 + yu * dx + yv * dy) * inverse
        right, lower_right = s[B, i] - s[A, i], s[D, i] - s[C, i]
        top, low = s[A, i] + s[FU, i] * right, s[C, i] + s[FU, i] * lower_right
        grey = top + s[FV, i] * (low - top)
        along = right + s[FV, i] * (lower_right - right)
        s[JACOBIAN, i] = (along * (tx - u * tz) + (low - top) * (ty - v * tz)) * inverse
        s[GREY, i] = grey
        first += s[WEIGHT, i] * grey
        second += s[WEIGHT, i] * grey * grey
        both += s[CENTRED, i] * grey
    contrast = max(second - first * first, _ZERO)
    score = both / np.sqrt((variance + noise) * (contrast + noise))
    if score < _SEES:
        return score
    gain = both / (contrast + noise)
    # Eliminate offset and gain: the means, and the components along the grey levels.
    m0, m1, m2, g0, g1, g2 = _ZERO, _ZERO, _ZERO, _ZERO, _ZERO, _ZERO
    for i in range(SAMPLES):
        w, j, away = s[WEIGHT, i], s[JACOBIAN, i], s[GREY, i] - first
        jx, jy = j * s[DX, i] / float32(RADIUS), j * s[DY, i] / float32(RADIUS)
        m0 += w * j
        m1 += w * jx
        m2 += w * jy
        g0 += w * j * away
        g1 += w * jx * away
        g2 += w * jy * away
    share = _ONE / (contrast + noise)
    h00, h01, h02, h11, h12, h22 = _ZERO, _ZERO, _ZERO, _ZERO, _ZERO, _ZERO
    r0, r1, r2, squares = _ZERO, _ZERO, _ZERO, _ZERO
    for i in range(SAMPLES):
        w, j, away = s[WEIGHT, i], s[JACOBIAN, i], s[GREY, i] - first
        j0 = gain * (j - m0 - g0 * share * away)
        j1 = gain * (j * s[DX, i] / float32(RADIUS) - m1 - g1 * share * away)
        j2 = gain * (j * s[DY, i] / float32(RADIUS) - m2 - g2 * share * away)
        # CENTRED holds weight times value, so the residual is weighted once.
        residual = s[CENTRED, i] - w * gain * away
        h00 += w * j0 * j0
        h01 += w * j0 * j1
        h02 += w * j0 * j2
        h11 += w * j1 * j1
        h12 += w * j1 * j2
        h22 += w * j2 * j2
        r0 += j0 * residual
        r1 += j1 * residual
        r2 += j2 * residual
        squares += residual * residual / max(w, float32(1e-6))
    system[0] += h00
    system[1] += h01
    system[2] += h02
    system[3] += h11
    system[4] += h12
    system[5] += h22
    system[6] += r0
    system[7] += r1
    system[8] += r2
    system[9] += squares
    system[10] += _ONE
    system[11] += score
    return score


@kernel(numpy_errors=True)
def _solve(q: NDArray[np.float64]) -> tuple[float, ...]:
    """Step (3,) of the damped system, and the variance of its first unknown for unit noise."""
    a, b, c = q[0], q[1], q[2]
    d, e, f = q[3] + _SLOPE_PRIOR * q[0], q[4], q[5] + _SLOPE_PRIOR * q[0]
    c00, c01, c02 = d * f - e * e, c * e - b * f, b * e - c * d
    determinant = a * c00 + b * c01 + c * c02
    if not determinant > 1e-12 * a * d * f:
        return 0.0, 0.0, 0.0, np.inf
    c11, c12, c22 = a * f - c * c, b * c - a * e, a * d - b * b
    r0, r1, r2 = q[6], q[7], q[8]
    return (
        (c00 * r0 + c01 * r1 + c02 * r2) / determinant,
        (c01 * r0 + c11 * r1 + c12 * r2) / determinant,
        (c02 * r0 + c12 * r1 + c22 * r2) / determinant,
        c00 / determinant,
    )


@kernel(numpy_errors=True)
def polish(
    p: Problem,
    s: NDArray[np.float32],
    index: NDArray[np.int32],
    planes: NDArray[np.float32],
    scores: NDArray[np.float32],
    sigmas: NDArray[np.float32],
    step_px: int,
    iterations: int,
    unit_w: float,
) -> None:
    """Refine the planes (H,W,3) in place; write mean correlation (H,W) and standard deviation of w (H,W).

    The problem is ``step_px`` (1 or 2) times as fine as the planes, and ``unit_w`` is the change of w that moves a
    pixel by one in the sources. A pixel that fewer than two sources see, or that moves by more than two pixels, gets
    score 0.
    """
    grey, region, pixels, _, sizes, warps, numbers = p
    height, width = scores.shape
    count = sizes.shape[0]
    floor = numbers[NOISE]
    system = np.empty(12, np.float64)
    needed = min(2, count)
    for y in range(height):
        for x in range(width):
            scores[y, x], sigmas[y, x] = _ZERO, np.inf
            w = planes[y, x, 0]
            at_x, at_y = float32(step_px * x + 0.5 * (step_px - 1)), float32(step_px * y + 0.5 * (step_px - 1))
            if w <= _ZERO or region[int(at_y), int(at_x)] == 0:
                continue
            du, dv = planes[y, x, 1] / float32(step_px), planes[y, x, 2] / float32(step_px)
            variance = take_window(grey, s, at_x, at_y)
            total = 0.0
            for i in range(SAMPLES):
                total += s[WEIGHT, i] * s[WEIGHT, i]
            samples = 1.0 / total
            start, step, lasting, sigma = w, 0.0, True, np.inf
            for _ in range(iterations):
                system[:] = 0.0
                for k in range(count):
                    h = warp(warps, k, at_x, at_y, w, du, dv)
                    if falls_inside(sizes, k, h):
                        _normal_equations(
                            pixels,
                            sizes,
                            warps,
                            s=s,
                            index=index,
                            k=k,
                            h=h,
                            variance=variance,
                            noise=floor,
                            system=system,
                        )
                if system[10] < needed:
                    lasting = False
                    break
                step, step_u, step_v, known = _solve(system)
                freedom = max(system[10] * samples - 3.0, 1.0)
                noise = max(system[9] * samples / freedom, 0.5 * floor)
                sigma = np.sqrt(noise * known / samples)
                limit = 0.7 * unit_w / max(abs(step), 0.7 * unit_w)
                w += float32(limit * step)
                du += float32(limit * step_u / RADIUS)
                dv += float32(limit * step_v / RADIUS)
                if not (abs(w - start) < 2.0 * unit_w and is_facing(numbers, at_x, at_y, w, du, dv)):
                    lasting = False
                    break
                if abs(step) < 0.03 * unit_w:
                    break
            if lasting and abs(step) < _MAX_LAST_STEP * unit_w:
                planes[y, x, 0], planes[y, x, 1], planes[y, x, 2] = w, du * float32(step_px), dv * float32(step_px)
                scores[y, x], sigmas[y, x] = float32(system[11] / system[10]), float32(sigma)
