"""Sub-pixel brightness steps across predicted CAD edges.

One-dimensional search along the normal (Harris, RAPID 1990) with several hypotheses per point (Vacchetti, Lepetit &
Fua, ISMAR 2004). Profiles are averaged over short parallel lines, in linear light, where blur does not shift a step.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.core.kernel import kernel
from arview.geometry import Array

HYPOTHESES = 4
"""Number of strongest steps kept per point."""
STEP_PX = 0.5
"""Distance between samples of a profile."""


def linear_light(gray: NDArray[np.uint8]) -> NDArray[np.float32]:
    """(H,W) grey levels 0–255 in linear light (inverse sRGB curve), slightly smoothed against noise."""
    levels = np.arange(256) / 255.0
    linear = 255.0 * np.where(levels <= 0.04045, levels / 12.92, ((levels + 0.055) / 1.055) ** 2.4)
    return np.ascontiguousarray(cv2.GaussianBlur(linear.astype(np.float32)[gray], (0, 0), 0.7))


@kernel
def find_steps(gray, pixels, normals, reach_px, half_width_px, threshold):  # type: ignore[no-untyped-def]
    """Extrema of the slope along the normal of each point.

    Args:
        gray: (H,W) float32.
        pixels, normals: (N,2) predicted edge points and unit normals in the picture.
        reach_px: search length to either side of the point.
        half_width_px: half the width, along the edge, of the five parallel profiles that are averaged.
        threshold: weakest slope, grey levels per px.

    Returns:
        offsets (N,K) px along the normal; slopes (N,K), signed grey levels per px, 0 where there is no step; seen (N,),
        False where the profile would leave the picture.
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
    """Offset (N,) px and signed slope (N,) of the best hypothesis by strength and nearness; slope 0 means none."""
    strength = np.abs(slopes)
    score = strength / (strength + half_slope) * np.exp(-0.5 * (offsets / spread_px) ** 2)
    best = np.argmax(score, axis=1)
    rows = np.arange(len(offsets))
    return offsets[rows, best], slopes[rows, best]
