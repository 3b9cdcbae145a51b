"""Region modality: where along its normal does each contour point part the part's colours from the background's?

Colour histograms of both sides give every pixel a probability; a line of pixels across the contour then gives a
posterior over the contour's displacement, taken as a Gaussian: Stoiber et al., "SRT3D: A Sparse Region-Based 3D
Object Tracking Approach for the Real World" (IJCV 2022), after Prisacariu & Reid, "PWP3D" (IJCV 2012).
Own here: the information that a flat posterior seems to hold (the width of its support) is taken out again, so that
lines that see nothing weigh nothing.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from arview.core.kernel import kernel
from arview.geometry import Array
from arview.refinement.gauss_newton import add_line
from arview.refinement.projection import project

BINS = 16
"""Histogram bins per colour channel; 16³ log-odds stay in the first-level cache."""
_DISPLACEMENTS = 12
_SEGMENTS = 19


def _edge_function() -> Array:
    """(19, 12): 2 h - 1, h the probability of "part" of segment r under displacement d (SRT3D eq. 13)."""
    r = np.arange(_SEGMENTS) - 0.5 * (_SEGMENTS - 1)
    d = np.arange(_DISPLACEMENTS) - 0.5 * (_DISPLACEMENTS - 1)
    return np.ascontiguousarray(-0.86 * np.tanh((r[:, None] - d[None, :]) / (2.0 * 0.5)))


EDGE_FUNCTION = _edge_function()


def value_bins(gain: float) -> NDArray[np.int64]:
    """(256,) histogram bin of a channel value in a picture ``gain`` times brighter than the colours learned."""
    return np.minimum(np.arange(256) / gain / (256 / BINS), BINS - 1).astype(np.int64)


@kernel
def add_histograms(image, bin_of, pixels, normals, depths, runs_mm, focal, fore, back, reach_px, gap_px):  # type: ignore[no-untyped-def]
    """Count the colours within ``reach_px`` inside and outside of the contour into fore and back (4096,)."""
    height, width = image.shape[0], image.shape[1]
    for i in range(pixels.shape[0]):
        z = depths[i]
        if z <= 0:
            continue
        for side in range(2):
            run = runs_mm[i, side] * focal / z
            reach = min(reach_px, run - gap_px)
            sign = -1.0 if side == 0 else 1.0
            step = gap_px
            while step <= reach:
                x = int(np.round(pixels[i, 0] + sign * step * normals[i, 0]))
                y = int(np.round(pixels[i, 1] + sign * step * normals[i, 1]))
                if 0 <= x < width and 0 <= y < height:
                    index = bin_of[image[y, x, 0]] * 256 + bin_of[image[y, x, 1]] * 16 + bin_of[image[y, x, 2]]
                    if side == 0:
                        fore[index] += 1.0
                    else:
                        back[index] += 1.0
                step += 1.0


@kernel
def log_odds(fore, back, out):  # type: ignore[no-untyped-def]
    """Log-odds (4096,) of "part" against "background" per colour; unseen colours say nothing."""
    total_fore = fore.sum() + 1e-9
    total_back = back.sum() + 1e-9
    for i in range(fore.shape[0]):
        # A pseudo-count keeps rare colours from being believed.
        f = fore[i] / total_fore + 2e-4
        b = back[i] / total_back + 2e-4
        out[i] = np.log(f / b)


@kernel(fastmath=True)
def measure_region(image, bin_of, pixels, normals, depths, runs_mm, focal, odds, edge_function, scale):  # type: ignore[no-untyped-def]
    """Displacement of the contour along each line.

    ``bin_of`` (256,) gives the histogram bin of a channel's value, exposure taken out.

    Returns mean (N,) px along the outward normal, information (N,) 1/px² (0 = the line says nothing), and agreement
    (N,) 0–1: how much better the colours fit a contour than no contour, -1 for lines that were not looked at.
    """
    height, width = image.shape[0], image.shape[1]
    count = pixels.shape[0]
    mean = np.zeros(count)
    information = np.zeros(count)
    agreement = np.full(count, -1.0)
    posterior = np.empty(12)
    flat = 1.0 / 12.0
    half = 0.5 * 19 * scale
    # Long segments are sampled, not summed: neighbours say the same.
    hop = max(1, scale // 3)
    soften = 0.55 * np.sqrt(scale) / (1 + (scale - 1) // hop)
    for i in range(count):
        z = depths[i]
        if z <= 0:
            continue
        run_in = runs_mm[i, 0] * focal / z
        run_out = runs_mm[i, 1] * focal / z
        # The line must stay on one side each for as long as the edge function matters.
        if run_in < 2.5 * scale or run_out < 2.5 * scale:
            continue
        u, v = pixels[i, 0], pixels[i, 1]
        nu, nv = normals[i, 0], normals[i, 1]
        if (
            min(u - half * abs(nu), v - half * abs(nv)) < 0.5
            or u + half * abs(nu) > width - 1.5
            or v + half * abs(nv) > height - 1.5
        ):
            continue
        for d in range(12):
            posterior[d] = 1.0
        for s in range(19):
            total = 0.0
            for k in range(0, scale, hop):
                t = (s - 9.5) * scale + k + 0.5
                # Beyond the run the line is on something else again: it says nothing there.
                if t < -run_in or t > run_out:
                    continue
                x = int(u + t * nu + 0.5)
                y = int(v + t * nv + 0.5)
                total += odds[bin_of[image[y, x, 0]] * 256 + bin_of[image[y, x, 1]] * 16 + bin_of[image[y, x, 2]]]
            # A soft sign in place of tanh: probability of "part" less that of "background".
            total *= soften
            lean = total / np.sqrt(1.0 + total * total)
            for d in range(12):
                posterior[d] *= 1.0 + edge_function[s, d] * lean
        norm = 0.0
        for d in range(12):
            norm += posterior[d]
        if norm < 1e-30:
            continue
        m = 0.0
        for d in range(12):
            m += (d - 5.5) * posterior[d]
        m /= norm
        variance = 0.0
        for d in range(12):
            variance += (d - 5.5 - m) ** 2 * posterior[d]
        variance = variance / norm + 1.0 / 12.0
        gain = 1.0 / variance - flat
        agreement[i] = norm / (norm + 12.0)
        if gain <= 0.0:
            continue
        shrink = (1.0 / variance) / gain
        mean[i] = scale * min(max(m * shrink, -8.0), 8.0)
        information[i] = gain / (scale * scale)
    return mean, information, agreement


@kernel
def add_region(  # type: ignore[no-untyped-def]
    hessian,
    gradient,
    points,
    cam_from_body,
    intrinsics,
    pixels,
    normals,
    mean,
    information,
    weight,
    robust_px,
):
    """Add the lines' Gaussians to the 6×6 system at the current pose; returns cost and number of lines."""
    r = cam_from_body
    used = 0
    for i in range(points.shape[0]):
        if information[i] <= 0.0:
            continue
        p = points[i]
        x = r[0, 0] * p[0] + r[0, 1] * p[1] + r[0, 2] * p[2] + r[0, 3]
        y = r[1, 0] * p[0] + r[1, 1] * p[1] + r[1, 2] * p[2] + r[1, 3]
        z = r[2, 0] * p[0] + r[2, 1] * p[1] + r[2, 2] * p[2] + r[2, 3]
        if z < 1.0:
            continue
        u, v = project(x, y, z, intrinsics)
        residual = (u - pixels[i, 0]) * normals[i, 0] + (v - pixels[i, 1]) * normals[i, 1] - mean[i]
        w = weight * information[i] / (1.0 + (residual / robust_px) ** 2)
        add_line(hessian, gradient, p, r, x, y, z, normals[i, 0], normals[i, 1], intrinsics, residual, w)
        used += 1
    return used
