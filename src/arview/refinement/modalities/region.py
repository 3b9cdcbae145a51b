"""Region modality: displacement of the contour along its normals that best separates part and background by colour.

Colour histograms of both sides give a probability for every pixel. A line of pixels across the contour then gives a
posterior of the contour's displacement, approximated by a Gaussian: Stoiber et al., "SRT3D: A Sparse Region-Based 3D
Object Tracking Approach for the Real World" (IJCV 2022), after Prisacariu & Reid, "PWP3D" (IJCV 2012). In addition to
SRT3D, the information that a flat posterior seems to hold, because its support is bounded, is subtracted, so that lines
without any contrast have no weight, and lines that the outline hardly crosses have little.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from arview.core.kernel import kernel
from arview.geometry import Array
from arview.refinement.gauss_newton import add_line, add_system
from arview.refinement.projection import ProjectedLines, project

BINS = 16
"""Histogram bins per colour channel: 16³ log odds fit into the first-level cache."""
STEP_HEIGHT = 0.86
"""Largest difference between the probabilities of part and background at a pixel."""
_DISPLACEMENTS = 12
_SEGMENTS = 19


class ColorModel(NamedTuple):
    """Colours of part and background in the form of the kernels.

    Attributes:
        bin_of: (256,) histogram bin of a channel value, which takes a change of exposure out.
        odds: (BINS³,) log odds of part against background.
        edge_function: (19,12) see `EDGE_FUNCTION`.
    """

    bin_of: NDArray[np.int64]
    odds: Array
    edge_function: Array


class RegionLines(NamedTuple):
    """Displacement of the contour along N lines across it.

    Attributes:
        mean: (N,) px along the outward normal.
        information: (N,) 1/px²; 0 for a line without contrast.
        crossing: (N,) 0–1, probability that the outline crosses the line, against the whole line being part or
            background; -1 for lines that were not measured.
    """

    mean: Array
    information: Array
    crossing: Array


def _edge_function() -> Array:
    """(19,12) 2 h - 1, with the probability h of "part" for segment r at displacement d (SRT3D eq. 13)."""
    r = np.arange(_SEGMENTS) - 0.5 * (_SEGMENTS - 1)
    d = np.arange(_DISPLACEMENTS) - 0.5 * (_DISPLACEMENTS - 1)
    return np.ascontiguousarray(-STEP_HEIGHT * np.tanh((r[:, None] - d[None, :]) / (2.0 * 0.5)))


EDGE_FUNCTION = _edge_function()
"""Smoothed step from part to background: rows are the segments of a line, columns the displacements of the contour."""


def value_bins(gain: float) -> NDArray[np.int64]:
    """(256,) histogram bin of a channel value in a picture ``gain`` times brighter than the learned colours."""
    return np.minimum(np.arange(256) / gain / (256 / BINS), BINS - 1).astype(np.int64)


@kernel
def add_histograms(
    image: NDArray[np.uint8],
    bin_of: NDArray[np.int64],
    lines: ProjectedLines,
    runs_mm: NDArray[np.float32],
    intrinsics: NDArray[np.float64],
    fore: NDArray[np.float64],
    back: NDArray[np.float64],
    reach_px: float,
    gap_px: float,
) -> None:
    """Count the colours inside and outside the contour into ``fore`` and ``back`` (BINS³,).

    Args:
        image: (H,W,3) uint8 RGB.
        bin_of: (256,) histogram bin of a channel value.
        lines: `ProjectedLines` of the contour.
        runs_mm: (N,2) how far the picture stays part and background along each line.
        intrinsics: as of `intrinsics_of`.
        reach_px: pixels counted to either side.
        gap_px: pixels beside the contour that are left out.
    """
    pixels, normals, depths = lines.pixels, lines.normals, lines.depths
    height, width = image.shape[0], image.shape[1]
    pitch = intrinsics[10]
    for i in range(pixels.shape[0]):
        z = depths[i]
        if z <= 0:
            continue
        u, v = (pixels[i, 0] + 0.5) * pitch, (pixels[i, 1] + 0.5) * pitch
        for side in range(2):
            run = runs_mm[i, side] * intrinsics[0] / z
            reach = min(reach_px, run - gap_px)
            sign = -pitch if side == 0 else pitch
            step = gap_px
            while step <= reach:
                x = int(np.floor(u + sign * step * normals[i, 0]))
                y = int(np.floor(v + sign * step * normals[i, 1]))
                if 0 <= x < width and 0 <= y < height:
                    index = bin_of[image[y, x, 0]] * 256 + bin_of[image[y, x, 1]] * 16 + bin_of[image[y, x, 2]]
                    if side == 0:
                        fore[index] += 1.0
                    else:
                        back[index] += 1.0
                step += 1.0


@kernel
def log_odds(fore: NDArray[np.float64], back: NDArray[np.float64], out: NDArray[np.float64]) -> None:
    """Fill ``out`` (BINS³,) with the log odds of part against background per colour; 0 for colours never observed."""
    total_fore = fore.sum() + 1e-9
    total_back = back.sum() + 1e-9
    for i in range(fore.shape[0]):
        if fore[i] == 0.0 and back[i] == 0.0:
            out[i] = 0.0
            continue
        # A pseudo-count limits the odds of rare colours.
        f = fore[i] / total_fore + 2e-4
        b = back[i] / total_back + 2e-4
        out[i] = np.log(f / b)


@kernel(fastmath=True)
def measure_region(
    image: NDArray[np.uint8],
    colors: ColorModel,
    lines: ProjectedLines,
    runs_mm: NDArray[np.float32],
    intrinsics: NDArray[np.float64],
    scale: int,
) -> RegionLines:
    """Displacement of the contour along each line, see `RegionLines`.

    Args:
        image: (H,W,3) uint8 RGB.
        colors: `ColorModel`.
        lines: `ProjectedLines` of the contour.
        runs_mm: (N,2) how far the picture stays part and background along each line.
        intrinsics: as of `intrinsics_of`.
        scale: pixels per segment.
    """
    bin_of, odds, edge_function = colors.bin_of, colors.odds, colors.edge_function
    pixels, normals, depths = lines.pixels, lines.normals, lines.depths
    height, width = image.shape[0], image.shape[1]
    count = pixels.shape[0]
    mean, information, crossing = np.zeros(count), np.zeros(count), np.full(count, -1.0)
    posterior = np.empty(12)
    flat = 1.0 / 12.0
    focal, pitch = intrinsics[0], intrinsics[10]
    half = 0.5 * 19 * scale
    # Long segments are sampled, because neighbouring pixels are similar.
    sample_step = max(1, scale // 3)
    soften = 0.55 * np.sqrt(scale) / (1 + (scale - 1) // sample_step)
    for i in range(count):
        z = depths[i]
        if z <= 0:
            continue
        run_in = runs_mm[i, 0] * focal / z
        run_out = runs_mm[i, 1] * focal / z
        # The line must stay on either side as far as the edge function varies.
        if run_in < 2.5 * scale or run_out < 2.5 * scale:
            continue
        u, v = (pixels[i, 0] + 0.5) * pitch - 0.5, (pixels[i, 1] + 0.5) * pitch - 0.5
        nu, nv = normals[i, 0] * pitch, normals[i, 1] * pitch
        if (
            min(u - half * abs(nu), v - half * abs(nv)) < 0.5
            or u + half * abs(nu) > width - 1.5
            or v + half * abs(nv) > height - 1.5
        ):
            continue
        for d in range(12):
            posterior[d] = 1.0
        all_part, all_back = 1.0, 1.0
        for s in range(19):
            total = 0.0
            for k in range(0, scale, sample_step):
                t = (s - 9.5) * scale + k + 0.5
                # Beyond the run the line is on another surface.
                if t < -run_in or t > run_out:
                    continue
                x, y = int(u + t * nu + 0.5), int(v + t * nv + 0.5)
                total += odds[bin_of[image[y, x, 0]] * 256 + bin_of[image[y, x, 1]] * 16 + bin_of[image[y, x, 2]]]
            # Probability of "part" minus that of "background", by a soft sign instead of tanh.
            total *= soften
            lean = total / np.sqrt(1.0 + total * total)
            for d in range(12):
                posterior[d] *= 1.0 + edge_function[s, d] * lean
            all_part *= 1.0 + STEP_HEIGHT * lean
            all_back *= 1.0 - STEP_HEIGHT * lean
        norm = 0.0
        for d in range(12):
            norm += posterior[d]
        if norm < 1e-30:
            continue
        m, variance = _moments(posterior, norm)
        gain = 1.0 / variance - flat
        crossing[i] = norm / (norm + 12.0 * (all_part + all_back))
        if gain <= 0.0:
            continue
        shrink = (1.0 / variance) / gain
        mean[i] = scale * min(max(m * shrink, -8.0), 8.0)
        information[i] = gain / (scale * scale)
    return RegionLines(mean, information, crossing)


@kernel(fastmath=True)
def _moments(posterior: NDArray[np.float64], norm: float) -> tuple[float, float]:
    """Mean and variance, in segments, of a displacement with a posterior (12,) whose sum is ``norm``."""
    mean = 0.0
    for d in range(12):
        mean += (d - 5.5) * posterior[d]
    mean /= norm
    variance = 0.0
    for d in range(12):
        variance += (d - 5.5 - mean) ** 2 * posterior[d]
    return mean, variance / norm + 1.0 / 12.0


@kernel(fastmath=True)
def add_region(
    hessian: NDArray[np.float64],
    gradient: NDArray[np.float64],
    points: NDArray[np.float32],
    cam_from_body: NDArray[np.float64],
    intrinsics: NDArray[np.float64],
    lines: ProjectedLines,
    region: RegionLines,
    weight: float,
    robust_px: float,
) -> tuple[float, float]:
    """Add the Gaussians of the lines to the 6×6 system.

    Args:
        hessian, gradient: (6,6) and (6,) of the system.
        points: (N,3) contour points in the body frame.
        cam_from_body, intrinsics: current pose (4,4) and camera.
        lines: `ProjectedLines` of the points at the pose of the measurement.
        region: `RegionLines` measured there.
        weight: of the modality.
        robust_px: residual that halves the weight of a line.

    Returns:
        sum of the squared residuals, each divided by the variance that its line claims, and effective number of lines.
    """
    squares, count = 0.0, 0.0
    r = cam_from_body
    pixels, normals = lines.pixels, lines.normals
    mean, information, crossing = region
    system = np.zeros((6, 8))
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
        # A line that is likely to lie on one side as a whole still has a narrow posterior, at its end.
        trust = crossing[i] * crossing[i] / (1.0 + (residual / robust_px) ** 2)
        w = weight * information[i] * trust
        squares += information[i] * trust * residual * residual
        count += trust
        add_line(system, p, r, x, y, z, normals[i, 0], normals[i, 1], intrinsics, residual, w)
    add_system(hessian, gradient, system)
    return squares, count
