"""Kernels that PatchMatch and the refinement share: the appearance of one surface element in the sources.

A surface element at pixel (x, y) is the plane w(x + dx, y + dy) = w + dx du + dy dv of inverse depth. In a source with
p = A (x, y, 1) + w t its window is warped exactly (a homography), sampled bilinearly and compared with the view's
window by a weighted normalised cross-correlation (ZNCC). Everything is float32, which places pixels within 1e-4 px.

The kernels take plain arrays, the fields of `Problem` and the scratch: numba counts references of the arrays in a tuple
at each use, which would double the time.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import float32, int32, uint32
from numpy.typing import NDArray

from arview.core.kernel import kernel

RADIUS = 5
"""Radius of the window in pixels."""
SAMPLES = 40
"""Samples of a window: a multiple of 8, which SIMD instructions process together."""
# Rows of the scratch.
DX, DY, FALLOFF, WEIGHT, CENTRED, FU, FV, A, B, C, D, GREY, JACOBIAN, COSTS = range(14)
# Columns of `Problem.sizes` and, after the twelve of the warp, of `Problem.warps`.
FIRST, WIDTH, HEIGHT, MAP_FIRST, MAP_WIDTH, MAP_HEIGHT = range(6)
PARALLAX = 12
# Elements of `Problem.numbers`.
NOISE, GEOMETRIC, MAP_STEP, BEST, FX, FY, CX, CY = range(8)

MAX_ERROR_PX = float32(3.0)
"""Largest disagreement with a depth map that counts, in pixels."""
MIN_SQUARED_COSINE = float32(0.025)
"""Squared cosine of the largest angle between ray and normal: 81°."""
_WORST = float32(2.0)
"""Cost of an element that no source sees."""
_ZERO, _HALF, _ONE = float32(0.0), float32(0.5), float32(1.0)
COLOR_SCALE = float32(1.0 / 25.0)
"""Inverse of the grey difference to the window's centre at which a pixel has half its weight."""


class Problem(NamedTuple):
    """One view with its sources at one level, as flat arrays for kernels.

    Attributes:
        grey: (H,W) float32.
        region: (H,W) uint8, pixels to reconstruct.
        pixels: (sum of h·w,) float32, grey levels of the sources one after another.
        maps: (sum of h·w,3) float32, depth maps of the sources (planes), or (0,3).
        sizes: (S,6) int32, first pixel, width and height of the picture and of the map.
        warps: (S,13) float32, A row by row, t, and the parallax in px per unit of w.
        numbers: (8,) float32, variance of the noise, cost of one pixel of disagreement, pixels of this level per pixel
            of the maps, number of best sources, fx, fy, cx, cy.
    """

    grey: NDArray[np.float32]
    region: NDArray[np.uint8]
    pixels: NDArray[np.float32]
    maps: NDArray[np.float32]
    sizes: NDArray[np.int32]
    warps: NDArray[np.float32]
    numbers: NDArray[np.float32]


def make_scratch(shift: float = 0.0, is_dense: bool = False) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Working memory of one thread: (14,SAMPLES) with offsets and fall-off of the samples, and (SAMPLES,) indices.

    Args:
        shift: position of pixels relative to the centre: 0, or 0.5 for a centre between four pixels.
        is_dense: samples lie on every pixel of a small disc; otherwise on every other pixel of a larger one.
    """
    v, u = np.mgrid[-RADIUS - 1 : RADIUS + 2, -RADIUS - 1 : RADIUS + 2]
    is_sample = ((u + v) % 2 == 0) | is_dense
    u, v = u[is_sample] + shift, v[is_sample] + shift
    nearest = np.lexsort((u, v, u * u + v * v))[:SAMPLES]
    scratch = np.zeros((14, SAMPLES), dtype=np.float32)
    scratch[DX], scratch[DY] = u[nearest], v[nearest]
    scratch[FALLOFF] = np.exp(
        -(scratch[DX] ** 2 + scratch[DY] ** 2) / (2.0 * (0.4 if is_dense else 0.6) ** 2 * RADIUS**2)
    )
    return scratch, np.zeros(SAMPLES, dtype=np.int32)


@kernel(fastmath=True, numpy_errors=True)
def take_window(
    grey: NDArray[np.float32], s: NDArray[np.float32], x: float | np.float32, y: float | np.float32
) -> float | np.float32:
    """Write weights (sum 1) and weighted, centred grey levels of the view's window to the scratch; return its variance.

    Pixels unlike the centre have less weight (bilateral). (x, y) lies such that samples are pixels.
    """
    height, width = grey.shape
    middle = grey[int(y), int(x)]
    for i in range(SAMPLES):
        column, row = int(x + s[DX, i]), int(y + s[DY, i])
        s[CENTRED, i] = grey[min(max(row, 0), height - 1), min(max(column, 0), width - 1)]
    total, mean = _ZERO, _ZERO
    for i in range(SAMPLES):
        unlike = (s[CENTRED, i] - middle) * COLOR_SCALE
        weight = s[FALLOFF, i] / (_ONE + unlike * unlike)
        s[WEIGHT, i] = weight
        total += weight
        mean += weight * s[CENTRED, i]
    mean /= total
    inverse = _ONE / total
    variance = _ZERO
    for i in range(SAMPLES):
        weight = s[WEIGHT, i] * inverse
        away = s[CENTRED, i] - mean
        s[WEIGHT, i] = weight
        s[CENTRED, i] = weight * away
        variance += weight * away * away
    return variance


@kernel(fastmath=True, numpy_errors=True)
def warp(
    m: NDArray[np.float32],
    k: int,
    x: float | np.float32,
    y: float | np.float32,
    w: float | np.float32,
    du: float | np.float32,
    dv: float | np.float32,
) -> tuple[float | np.float32, ...]:
    """The homography of the window into source k, as three linear forms of (dx, dy): value and two slopes each."""
    tx, ty, tz = m[k, 9], m[k, 10], m[k, 11]
    x0 = m[k, 0] * x + m[k, 1] * y + m[k, 2] + w * tx
    y0 = m[k, 3] * x + m[k, 4] * y + m[k, 5] + w * ty
    z0 = m[k, 6] * x + m[k, 7] * y + m[k, 8] + w * tz
    xu, xv = m[k, 0] + du * tx, m[k, 1] + dv * tx
    yu, yv = m[k, 3] + du * ty, m[k, 4] + dv * ty
    zu, zv = m[k, 6] + du * tz, m[k, 7] + dv * tz
    return x0, xu, xv, y0, yu, yv, z0, zu, zv


@kernel(fastmath=True, numpy_errors=True)
def falls_inside(sizes: NDArray[np.int32], k: int, h: tuple[float | np.float32, ...]) -> bool:
    """Whether the whole warped window lies in source k."""
    x0, xu, xv, y0, yu, yv, z0, zu, zv = h
    reach = float32(RADIUS + 1)
    right, low = float32(sizes[k, WIDTH] - 2), float32(sizes[k, HEIGHT] - 2)
    for i in range(4):
        dx = reach if i & 1 else -reach
        dy = reach if i & 2 else -reach
        z = z0 + zu * dx + zv * dy
        u, v = x0 + xu * dx + xv * dy, y0 + yu * dx + yv * dy
        if not (z > _ZERO and u >= _ZERO and v >= _ZERO and u <= right * z and v <= low * z):
            return False
    return True


@kernel(fastmath=True, numpy_errors=True)
def sample(
    pixels: NDArray[np.float32],
    sizes: NDArray[np.int32],
    s: NDArray[np.float32],
    index: NDArray[np.int32],
    k: int,
    h: tuple[float | np.float32, ...],
) -> None:
    """Write four neighbours (A to D) and fractions (FU, FV) of each sample of the window in source k to the scratch."""
    x0, xu, xv, y0, yu, yv, z0, zu, zv = h
    first, width = sizes[k, FIRST], sizes[k, WIDTH]
    for i in range(SAMPLES):
        dx, dy = s[DX, i], s[DY, i]
        inverse = _ONE / (z0 + zu * dx + zv * dy)
        u = (x0 + xu * dx + xv * dy) * inverse
        v = (y0 + yu * dx + yv * dy) * inverse
        column, row = int32(u), int32(v)
        s[FU, i] = u - float32(column)
        s[FV, i] = v - float32(row)
        index[i] = first + row * width + column
    for i in range(SAMPLES):
        at = uint32(index[i])
        s[A, i] = pixels[at]
        s[B, i] = pixels[at + uint32(1)]
        at += uint32(width)
        s[C, i] = pixels[at]
        s[D, i] = pixels[at + uint32(1)]


@kernel(fastmath=True, numpy_errors=True)
def zncc(
    pixels: NDArray[np.float32],
    sizes: NDArray[np.int32],
    s: NDArray[np.float32],
    index: NDArray[np.int32],
    k: int,
    h: tuple[float | np.float32, ...],
    variance: float | np.float32,
    noise: float | np.float32,
) -> float | np.float32:
    """Correlation of the window with source k; noise adds to the contrast and so lowers it."""
    sample(pixels, sizes, s, index, k, h)
    first, second, both = _ZERO, _ZERO, _ZERO
    for i in range(SAMPLES):
        top = s[A, i] + s[FU, i] * (s[B, i] - s[A, i])
        low = s[C, i] + s[FU, i] * (s[D, i] - s[C, i])
        grey = top + s[FV, i] * (low - top)
        weighted = s[WEIGHT, i] * grey
        first += weighted
        second += weighted * grey
        both += s[CENTRED, i] * grey
    contrast = max(second - first * first, _ZERO)
    return both / np.sqrt((variance + noise) * (contrast + noise))


@kernel(fastmath=True, numpy_errors=True)
def disagreement_px(
    maps: NDArray[np.float32],
    sizes: NDArray[np.int32],
    warps: NDArray[np.float32],
    step: float | np.float32,
    k: int,
    h: tuple[float | np.float32, ...],
    w: float | np.float32,
) -> float | np.float32:
    """Distance of the element from the depth map of source k in px of parallax, at most 3."""
    u, v = (h[0] / h[6] + _HALF) / step, (h[3] / h[6] + _HALF) / step
    column, row = int(u), int(v)
    if column < 0 or row < 0 or column >= sizes[k, MAP_WIDTH] or row >= sizes[k, MAP_HEIGHT]:
        return MAX_ERROR_PX
    at = sizes[k, MAP_FIRST] + row * sizes[k, MAP_WIDTH] + column
    if maps[at, 0] <= _ZERO:
        return MAX_ERROR_PX
    there = maps[at, 0] + maps[at, 1] * (u - _HALF - float32(column)) + maps[at, 2] * (v - _HALF - float32(row))
    return min(abs(there - w / h[6]) * warps[k, PARALLAX], MAX_ERROR_PX)


@kernel(fastmath=True, numpy_errors=True)
def is_facing(
    numbers: NDArray[np.float32],
    x: float | np.float32,
    y: float | np.float32,
    w: float | np.float32,
    du: float | np.float32,
    dv: float | np.float32,
) -> bool:
    """Whether the element is in front of the camera and seen at less than 81° from its normal."""
    if not w > _ZERO:
        return False
    xn, yn = (x - numbers[CX]) / numbers[FX], (y - numbers[CY]) / numbers[FY]
    a, b = du * numbers[FX], dv * numbers[FY]
    c = w - a * xn - b * yn
    return w * w > MIN_SQUARED_COSINE * (a * a + b * b + c * c) * (xn * xn + yn * yn + _ONE)


@kernel(fastmath=True, numpy_errors=True)
def element_cost(
    pixels: NDArray[np.float32],
    maps: NDArray[np.float32],
    sizes: NDArray[np.int32],
    warps: NDArray[np.float32],
    numbers: NDArray[np.float32],
    s: NDArray[np.float32],
    index: NDArray[np.int32],
    x: float | np.float32,
    y: float | np.float32,
    w: float | np.float32,
    du: float | np.float32,
    dv: float | np.float32,
    variance: float | np.float32,
    limit: float | np.float32,
) -> float | np.float32:
    """Mean of the best sources' 1 - ZNCC plus disagreement with their depth maps: 0 (best) to 2.

    It returns 2 without the remaining sources as soon as the mean cannot fall below ``limit``.
    """
    if not is_facing(numbers, x, y, w, du, dv):
        return _WORST
    count = sizes.shape[0]
    best = min(int(numbers[BEST]), count)
    for k in range(count):
        h = warp(warps, k, x, y, w, du, dv)
        cost = _WORST
        if falls_inside(sizes, k, h):
            cost = min(
                _ONE - zncc(pixels, sizes, s, index=index, k=k, h=h, variance=variance, noise=numbers[NOISE]), _WORST
            )
            if maps.shape[0] > 0:
                cost += numbers[GEOMETRIC] * disagreement_px(maps, sizes, warps, numbers[MAP_STEP], k, h, w)
        j = k
        while j > 0 and s[COSTS, j - 1] > cost:
            s[COSTS, j] = s[COSTS, j - 1]
            j -= 1
        s[COSTS, j] = cost
        # Lower bound: the remaining sources may cost nothing.
        bound = _ZERO
        for i in range(best - (count - 1 - k)):
            bound += s[COSTS, i]
        if bound > limit * float32(best):
            return _WORST
    total = _ZERO
    for k in range(best):
        total += s[COSTS, k]
    return total / float32(best)
