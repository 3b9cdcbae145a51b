"""Alignment of texture patches: image pyramid, templates, and inverse-compositional Lucas-Kanade.

Baker & Matthews, "Lucas-Kanade 20 years on" (IJCV 2004), for translations only. Brightness gain and offset are
projected out of the steepest-descent images (Hager & Belhumeur, PAMI 1998), so that exposure may change between frames.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.core.kernel import kernel

Scalar = float | np.float32
Pyramid = tuple[NDArray[np.uint8], ...]


def build_pyramid(gray: NDArray[np.uint8], levels: int) -> Pyramid:
    """``levels`` images (H,W) uint8, each half the size of the last; (u, v) on level l is (u, v)·2^l on the first."""
    pyramid = [np.ascontiguousarray(gray)]
    for _ in range(levels - 1):
        pyramid.append(cv2.pyrDown(pyramid[-1]))
    return tuple(pyramid)


@kernel(fastmath=True)
def sample_patch(
    image: NDArray[np.uint8], u: float, v: float, warp: NDArray[np.float64], half: int, out: NDArray[np.float32]
) -> bool:
    """Fill ``out`` (2·half+1)² with the image at (u, v) + warp · offset; False when the patch leaves the image."""
    height, width = image.shape
    reach_u = half * (abs(warp[0, 0]) + abs(warp[0, 1]))
    reach_v = half * (abs(warp[1, 0]) + abs(warp[1, 1]))
    if u - reach_u < 0 or v - reach_v < 0 or u + reach_u >= width - 1 or v + reach_v >= height - 1:
        return False
    for row in range(2 * half + 1):
        x = u - warp[0, 0] * half + warp[0, 1] * (row - half)
        y = v - warp[1, 0] * half + warp[1, 1] * (row - half)
        for column in range(2 * half + 1):
            ix, iy = int(x), int(y)
            ax, ay = np.float32(x - ix), np.float32(y - iy)
            p, q = np.float32(image[iy, ix]), np.float32(image[iy + 1, ix])
            top = p + ax * (np.float32(image[iy, ix + 1]) - p)
            bottom = q + ax * (np.float32(image[iy + 1, ix + 1]) - q)
            out[row, column] = top + ay * (bottom - top)
            x += warp[0, 0]
            y += warp[1, 0]
    return True


@kernel(fastmath=True)
def prepare_template(
    patch: NDArray[np.float32],
    side: int,
    template: NDArray[np.float32],
    across: NDArray[np.float32],
    down: NDArray[np.float32],
) -> tuple[tuple[Scalar, Scalar, Scalar], Scalar]:
    """Fill ``template`` with zero mean and unit norm, and its gradients orthogonal to it and to a constant.

    Args:
        patch: (side+2)² with a border of one pixel.
        side: of the template, px.
        template, across, down: (side²,) outputs.

    Returns:
        Entries (0,0), (0,1) and (1,1) of the inverse of the (2,2) normal matrix, and the norm of the template, which is
        0 for a patch without usable texture.
    """
    count = side * side
    mean_t, mean_x, mean_y = np.float32(0.0), np.float32(0.0), np.float32(0.0)
    k = 0
    for row in range(1, side + 1):
        for column in range(1, side + 1):
            template[k] = patch[row, column]
            across[k] = np.float32(0.5) * (patch[row, column + 1] - patch[row, column - 1])
            down[k] = np.float32(0.5) * (patch[row + 1, column] - patch[row - 1, column])
            mean_t += template[k]
            mean_x += across[k]
            mean_y += down[k]
            k += 1
    mean_t /= count
    mean_x /= count
    mean_y /= count
    tt, tx, ty = np.float32(0.0), np.float32(0.0), np.float32(0.0)
    for k in range(count):
        template[k] -= mean_t
        across[k] -= mean_x
        down[k] -= mean_y
        tt += template[k] * template[k]
        tx += template[k] * across[k]
        ty += template[k] * down[k]
    if tt < count:
        return (0.0, 0.0, 0.0), 0.0
    tx /= tt
    ty /= tt
    xx, xy, yy = np.float32(0.0), np.float32(0.0), np.float32(0.0)
    for k in range(count):
        across[k] -= tx * template[k]
        down[k] -= ty * template[k]
        xx += across[k] * across[k]
        xy += across[k] * down[k]
        yy += down[k] * down[k]
    det = xx * yy - xy * xy
    if det < 1e-3 * xx * yy or det <= 0.0:
        return (0.0, 0.0, 0.0), 0.0
    norm = np.sqrt(tt)
    for k in range(count):
        template[k] /= norm
    return (yy / det, -xy / det, xx / det), norm


@kernel(fastmath=True)
def align_template(
    image: NDArray[np.uint8],
    u: Scalar,
    v: Scalar,
    side: int,
    template: NDArray[np.float32],
    across: NDArray[np.float32],
    down: NDArray[np.float32],
    normal: tuple[Scalar, Scalar, Scalar],
    norm: Scalar,
    steps: int,
    stop_px: float,
) -> tuple[Scalar, Scalar, Scalar]:
    """Align a prepared template with the image, starting at (u, v).

    The gradients are orthogonal to the template and to a constant, so that gain and offset do not enter the residual;
    the gain only scales the step.

    Args:
        image: (H,W) uint8.
        side, template, across, down, normal, norm: of the template, see `prepare_template`.
        steps: largest number of updates.
        stop_px: the alignment has converged when an update is shorter.

    Returns:
        u, v and the normalised correlation, -1 = failed.
    """
    height, width = image.shape
    half = side // 2
    start_u, start_v = u, v
    for _ in range(steps):
        x, y = u - half, v - half
        ix, iy = int(np.floor(x)), int(np.floor(y))
        if ix < 0 or iy < 0 or ix + side >= width or iy + side >= height:
            return u, v, -1.0
        fx, fy = np.float32(x - ix), np.float32(y - iy)
        one = np.float32(1.0)
        w00, w01 = (one - fx) * (one - fy), fx * (one - fy)
        w10, w11 = (one - fx) * fy, fx * fy
        gx, gy, gt = np.float32(0.0), np.float32(0.0), np.float32(0.0)
        total, square = np.float32(0.0), np.float32(0.0)
        for row in range(side):
            upper, lower = image[iy + row], image[iy + row + 1]
            for column in range(side):
                value = (
                    w00 * np.float32(upper[ix + column])
                    + w01 * np.float32(upper[ix + column + 1])
                    + w10 * np.float32(lower[ix + column])
                    + w11 * np.float32(lower[ix + column + 1])
                )
                k = row * side + column
                gx += across[k] * value
                gy += down[k] * value
                gt += template[k] * value
                total += value
                square += value * value
        variance = square - total * total / (side * side)
        correlation = gt / np.sqrt(max(variance, np.float32(1.0)))
        gain = gt / norm
        if gain < 0.1:
            return u, v, -1.0
        du = (normal[0] * gx + normal[1] * gy) / gain
        dv = (normal[1] * gx + normal[2] * gy) / gain
        if du * du + dv * dv < stop_px * stop_px:
            return u - du, v - dv, correlation
        length = np.sqrt(du * du + dv * dv)
        if length > 1.5:
            du *= 1.5 / length
            dv *= 1.5 / length
        u -= du
        v -= dv
        if abs(u - start_u) > half or abs(v - start_v) > half:
            return u, v, -1.0
    return u, v, -1.0


@kernel(fastmath=True)
def common_shift(
    key_image: NDArray[np.uint8],
    image: NDArray[np.uint8],
    scale: int,
    key_pixels: NDArray[np.float64],
    pixels: NDArray[np.float64],
    warps: NDArray[np.float64],
    chosen: NDArray[np.int64],
    reach: int,
) -> tuple[float, float, float]:
    """Shift (du, dv), px of the finest level, that aligns the chosen patches best with a coarse image.

    The third value is the mean squared correlation there; 0 where the best shift is at the border of the search.

    The search is exhaustive over ±``reach`` px of the coarse level and refined by parabolas. A shift is scored by the
    sum of squared positive correlations, so that patches on another surface count little.
    """
    side, half = 7, 3
    span = 2 * reach + 1
    height, width = image.shape
    score = np.zeros((span, span))
    patch = np.empty((side, side), dtype=np.float32)
    for i in chosen:
        u, v = pixels[i, 0] / scale, pixels[i, 1] / scale
        iu, iv = int(np.round(u)), int(np.round(v))
        ku = key_pixels[i, 0] / scale + warps[i, 0, 0] * (iu - u) + warps[i, 0, 1] * (iv - v)
        kv = key_pixels[i, 1] / scale + warps[i, 1, 0] * (iu - u) + warps[i, 1, 1] * (iv - v)
        if not sample_patch(key_image, ku, kv, warps[i], half, patch):
            continue
        mean = np.float32(0.0)
        for row in range(side):
            for column in range(side):
                mean += patch[row, column]
        mean /= side * side
        norm = np.float32(0.0)
        for row in range(side):
            for column in range(side):
                patch[row, column] -= mean
                norm += patch[row, column] * patch[row, column]
        if norm < side * side:
            continue
        for sv in range(span):
            top = iv + sv - reach - half
            if top < 0 or top + side > height:
                continue
            for su in range(span):
                left = iu + su - reach - half
                if left < 0 or left + side > width:
                    continue
                dot, total, square = np.float32(0.0), np.float32(0.0), np.float32(0.0)
                for row in range(side):
                    line = image[top + row]
                    for column in range(side):
                        value = np.float32(line[left + column])
                        dot += patch[row, column] * value
                        total += value
                        square += value * value
                variance = square - total * total / (side * side)
                if dot > 0.0 and variance > side * side:
                    score[sv, su] += dot * dot / (norm * variance)
    bv, bu = reach, reach
    for sv in range(span):
        for su in range(span):
            if score[sv, su] > score[bv, bu]:
                bv, bu = sv, su
    du, dv = float(bu - reach), float(bv - reach)
    is_inside = 0 < bu < span - 1 and 0 < bv < span - 1
    quality = score[bv, bu] / max(len(chosen), 1) if is_inside else 0.0
    if 0 < bu < span - 1:
        bend = score[bv, bu - 1] - 2.0 * score[bv, bu] + score[bv, bu + 1]
        if bend < 0.0:
            du += 0.5 * (score[bv, bu - 1] - score[bv, bu + 1]) / bend
    if 0 < bv < span - 1:
        bend = score[bv - 1, bu] - 2.0 * score[bv, bu] + score[bv + 1, bu]
        if bend < 0.0:
            dv += 0.5 * (score[bv - 1, bu] - score[bv + 1, bu]) / bend
    return du * scale, dv * scale, quality
