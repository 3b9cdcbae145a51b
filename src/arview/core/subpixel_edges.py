"""Sub-pixel steps of brightness across predicted edges.

One-dimensional search along the normal (Harris, RAPID 1990; several hypotheses per point: Vacchetti, Lepetit & Fua,
ISMAR 2004). Profiles are means over short parallel lines, in linear light, where blur does not displace a step.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.core.kernel import kernel
from arview.geometry import Array

HYPOTHESES = 4
"""Number of steps kept per point, the strongest."""
STEP_PX = 0.5
"""Distance between the samples of a profile."""


def linear_light(gray: NDArray[np.uint8]) -> NDArray[np.float32]:
    """(H,W) grey levels 0–255 in linear light by the sRGB curve, smoothed slightly against noise."""
    levels = np.arange(256) / 255.0
    linear = 255.0 * np.where(levels <= 0.04045, levels / 12.92, ((levels + 0.055) / 1.055) ** 2.4)
    return np.ascontiguousarray(cv2.GaussianBlur(linear.astype(np.float32)[gray], (0, 0), 0.7))


@kernel
def find_steps(
    gray: NDArray[np.float32],
    pixels: NDArray[np.float64],
    normals: NDArray[np.float64],
    reach_px: float,
    half_width_px: float,
    threshold: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """Find the extrema of the slope along the normal of each point.

    Args:
        gray: (H,W) float32 in linear light.
        pixels, normals: (N,2) predicted edge points and unit normals in the picture.
        reach_px: search range to either side.
        half_width_px: five parallel lines within this distance to either side along the edge are averaged.
        threshold: weakest slope, grey levels per px.

    Returns:
        offsets (N,K) px along the normal; slopes (N,K) signed grey levels per px, 0 = none; seen (N,) whether the
        profile lies inside the picture.
    """
    height, width = gray.shape
    count = pixels.shape[0]
    half = int(np.ceil(reach_px / STEP_PX)) + 2
    size = 2 * half + 1
    offsets = np.zeros((count, HYPOTHESES))
    slopes = np.zeros((count, HYPOTHESES))
    seen = np.zeros(count, dtype=np.bool_)
    profile = np.empty(size)
    slope = np.empty(size)
    margin = half * STEP_PX + half_width_px + 1.0
    for i in range(count):
        u, v, nu, nv = pixels[i, 0], pixels[i, 1], normals[i, 0], normals[i, 1]
        if not (u > margin and v > margin and u < width - 2 - margin and v < height - 2 - margin):
            continue
        seen[i] = True
        for k in range(size):
            total = 0.0
            for j in range(-2, 3):
                along = 0.5 * j * half_width_px
                x = u + (k - half) * STEP_PX * nu - along * nv
                y = v + (k - half) * STEP_PX * nv + along * nu
                ix, iy = int(x), int(y)
                ax, ay = x - ix, y - iy
                top = gray[iy, ix] * (1.0 - ax) + gray[iy, ix + 1] * ax
                bottom = gray[iy + 1, ix] * (1.0 - ax) + gray[iy + 1, ix + 1] * ax
                total += top * (1.0 - ay) + bottom * ay
            profile[k] = total / 5.0
        slope[0] = slope[size - 1] = 0.0
        for k in range(1, size - 1):
            slope[k] = (profile[k + 1] - profile[k - 1]) / (2.0 * STEP_PX)
        kept = 0
        for k in range(2, size - 2):
            s = abs(slope[k])
            a, b = abs(slope[k - 1]), abs(slope[k + 1])
            if s < threshold or s < a or s <= b or slope[k] * slope[k - 1] < 0 or slope[k] * slope[k + 1] < 0:
                continue
            slot = kept
            if kept == HYPOTHESES:
                slot = int(np.argmin(np.abs(slopes[i])))
                if abs(slopes[i, slot]) >= s:
                    continue
            else:
                kept += 1
            bend = a - 2.0 * s + b
            offsets[i, slot] = (k - half + (0.5 * (a - b) / bend if bend < 0 else 0.0)) * STEP_PX
            slopes[i, slot] = slope[k]
    return offsets, slopes, seen


def choose_steps(offsets: Array, slopes: Array, spread_px: float, half_slope: float) -> tuple[Array, Array]:
    """Choose for each point the hypothesis with the best product of strength and nearness.

    Args:
        offsets, slopes: (N,K) of `find_steps`.
        spread_px: standard deviation of the Gaussian that weights nearness.
        half_slope: slope at which strength has half its full weight.

    Returns:
        offset (N,) px and signed slope (N,); slope 0 = none.
    """
    strength = np.abs(slopes)
    score = strength / (strength + half_slope) * np.exp(-0.5 * (offsets / spread_px) ** 2)
    best = np.argmax(score, axis=1)
    rows = np.arange(len(offsets))
    return offsets[rows, best], slopes[rows, best]
