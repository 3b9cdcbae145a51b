"""Multi-view PatchMatch with slanted planes: for each pixel, the surface element that looks alike in the other photos.

Random and given hypotheses are propagated to neighbours on a checkerboard and perturbed (Barnes 2009, Bleyer 2011, Shen
2012; parallel scheme and far neighbours: Galliani 2015, Xu & Tao 2019), coarse to fine, with the sources' depth maps as
additional evidence (Schönberger 2016). Every random number is hashed from pixel and seed, and a sweep reads only the
other colour of the checkerboard, so that the result does not depend on threads.
"""

from __future__ import annotations

import numpy as np
from numba import float32, uint32
from numpy.typing import NDArray

from arview.core.kernel import kernel
from arview.reconstruction.dense.kernels import FX, FY, Problem, element_cost, take_window

_ZERO = float32(0.0)
NEIGHBOURS = np.array(
    [
        [[0, -1], [-1, -2], [1, -2], [0, -3]],
        [[0, 1], [-1, 2], [1, 2], [0, 3]],
        [[-1, 0], [-2, -1], [-2, 1], [-3, 0]],
        [[1, 0], [2, -1], [2, 1], [3, 0]],
        [[0, -5], [0, -7], [0, -9], [0, -11]],
        [[0, 5], [0, 7], [0, 9], [0, 11]],
        [[-5, 0], [-7, 0], [-9, 0], [-11, 0]],
        [[5, 0], [7, 0], [9, 0], [11, 0]],
    ]
)
"""Near and far neighbours of the other colour as (dx, dy); the best of each row is tried."""


@kernel
def draw(seed: int, x: int, y: int, turn: int) -> float | np.float32:
    """A number in [-1, 1) hashed from the arguments (mixing step of MurmurHash3)."""
    h = uint32(seed) ^ (uint32(x) * uint32(0x9E3779B1)) ^ (uint32(y) * uint32(0x85EBCA77))
    h = uint32(h ^ (uint32(turn) * uint32(0xC2B2AE3D)))
    h = uint32(h ^ (h >> uint32(16))) * uint32(0x85EBCA6B)
    h = uint32(h)
    h = uint32(h ^ (h >> uint32(13))) * uint32(0xC2B2AE35)
    h = uint32(h)
    h = uint32(h ^ (h >> uint32(16)))
    return float32(np.float64(h) / 2147483648.0 - 1.0)


@kernel(fastmath=True)
def try_hypotheses(
    p: Problem,
    s: NDArray[np.float32],
    index: NDArray[np.int32],
    planes: NDArray[np.float32],
    costs: NDArray[np.float32],
    hypotheses: NDArray[np.float32],
    spread: float | np.float32,
    randoms: int,
    lowest: float | np.float32,
    highest: float | np.float32,
    seed: int,
) -> None:
    """Set each pixel to the best of given hypotheses (C,H,W,3) and of random ones.

    Random hypotheses are drawn within ``spread`` (in w) of the first given one, and between ``lowest`` and ``highest``.
    """
    grey, region, pixels, maps, sizes, warps, numbers = p
    height, width = costs.shape
    fx, fy = numbers[FX], numbers[FY]
    for y in range(height):
        for x in range(width):
            planes[y, x, 0] = _ZERO
            costs[y, x] = float32(2.0)
            if region[y, x] == 0:
                continue
            at_x, at_y = float32(x), float32(y)
            variance = take_window(grey, s, at_x, at_y)
            base, base_u, base_v = _ZERO, _ZERO, _ZERO
            for c in range(hypotheses.shape[0] + randoms):
                if c < hypotheses.shape[0]:
                    w, du, dv = hypotheses[c, y, x, 0], hypotheses[c, y, x, 1], hypotheses[c, y, x, 2]
                    if w <= _ZERO:
                        continue
                    if base == _ZERO:
                        base, base_u, base_v = w, du, dv
                else:
                    turn = 4 * c
                    if base > _ZERO and c & 1:
                        w, du, dv = base + spread * draw(seed, x, y, turn), base_u, base_v
                    else:
                        share = float32(0.5) + float32(0.5) * draw(seed, x, y, turn)
                        w = lowest + (highest - lowest) * share
                        du = w / fx * draw(seed, x, y, turn + 1)
                        dv = w / fy * draw(seed, x, y, turn + 2)
                cost = element_cost(
                    pixels,
                    maps,
                    sizes,
                    warps,
                    numbers,
                    s,
                    index,
                    x=at_x,
                    y=at_y,
                    w=w,
                    du=du,
                    dv=dv,
                    variance=variance,
                    limit=costs[y, x],
                )
                if cost < costs[y, x]:
                    costs[y, x] = cost
                    planes[y, x, 0], planes[y, x, 1], planes[y, x, 2] = w, du, dv


@kernel(fastmath=True)
def sweep(
    p: Problem,
    s: NDArray[np.float32],
    index: NDArray[np.int32],
    planes: NDArray[np.float32],
    costs: NDArray[np.float32],
    regions: NDArray[np.int64],
    color: int,
    step_w: float | np.float32,
    step_tilt: float | np.float32,
    seed: int,
) -> None:
    """Half a checkerboard iteration: planes of the best neighbours, then a perturbation of w and slope (tangent)."""
    grey, region, pixels, maps, sizes, warps, numbers = p
    height, width = costs.shape
    fx, fy = numbers[FX], numbers[FY]
    same_w = float32(0.1) * step_w
    for y in range(height):
        for x in range((y + color) & 1, width, 2):
            if region[y, x] == 0:
                continue
            at_x, at_y = float32(x), float32(y)
            variance = take_window(grey, s, at_x, at_y)
            w, du, dv, cost = planes[y, x, 0], planes[y, x, 1], planes[y, x, 2], costs[y, x]
            for r in range(regions.shape[0]):
                lowest, bx, by = float32(2.0), -1, -1
                for n in range(regions.shape[1]):
                    xx, yy = x + regions[r, n, 0], y + regions[r, n, 1]
                    if 0 <= xx < width and 0 <= yy < height and region[yy, xx] > 0 and costs[yy, xx] < lowest:
                        lowest, bx, by = costs[yy, xx], xx, yy
                if bx < 0:
                    continue
                new_u, new_v = planes[by, bx, 1], planes[by, bx, 2]
                new_w = planes[by, bx, 0] + new_u * float32(x - bx) + new_v * float32(y - by)
                tilt = max(abs(new_u - du) * fx, abs(new_v - dv) * fy)
                if abs(new_w - w) < same_w and tilt < float32(0.1) * step_tilt * w:
                    continue
                new = element_cost(
                    pixels,
                    maps,
                    sizes,
                    warps,
                    numbers,
                    s,
                    index,
                    x=at_x,
                    y=at_y,
                    w=new_w,
                    du=new_u,
                    dv=new_v,
                    variance=variance,
                    limit=cost,
                )
                if new < cost:
                    cost, w, du, dv = new, new_w, new_u, new_v
            if w > _ZERO:
                new_w = w + step_w * draw(seed, x, y, 0)
                new_u = du + w / fx * step_tilt * draw(seed, x, y, 1)
                new_v = dv + w / fy * step_tilt * draw(seed, x, y, 2)
                new = element_cost(
                    pixels,
                    maps,
                    sizes,
                    warps,
                    numbers,
                    s,
                    index,
                    x=at_x,
                    y=at_y,
                    w=new_w,
                    du=new_u,
                    dv=new_v,
                    variance=variance,
                    limit=cost,
                )
                if new < cost:
                    cost, w, du, dv = new, new_w, new_u, new_v
            costs[y, x] = cost
            planes[y, x, 0], planes[y, x, 1], planes[y, x, 2] = w, du, dv
