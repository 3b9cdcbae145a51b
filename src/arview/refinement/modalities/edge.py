"""Edge modality: intensity steps across the projected CAD edges, several hypotheses a point, robust.

RAPID (Harris 1990) and its successors with multiple hypotheses (Vacchetti, Lepetit & Fua, ISMAR 2004) and
M-estimators (Drummond & Cipolla 2002; Comport et al. 2006). The local extrema of the slope across an edge are the
hypotheses; at every solver step a point takes the one that best joins nearness and strength.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.core.kernel import kernel
from arview.guideviews.mesh_edges import EDGE_CONTOUR, EDGE_SHARP
from arview.refinement.gauss_newton import add_line
from arview.refinement.projection import project

SOFT_EDGE_TRUST = 0.2
"""Weight of folds of a curved surface against outline and design edges: they need not show, and texture is near."""
HYPOTHESES = 5
"""Steps kept per point, the strongest."""


def smoothed(gray: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """A grey picture (H,W) as the edge modality takes it: averaged over 3×3."""
    return np.asarray(cv2.blur(gray, (3, 3)))


@kernel
def measure_edges(gray, pixels, normals, depths, reach, step_px, threshold):  # type: ignore[no-untyped-def]
    """Intensity steps along the normal of each point.

    Args:
        gray: (H,W) uint8, smoothed by 3×3: it stands for averaging over neighbouring lines.
        pixels, normals, depths: of the projected points, see `project_lines`.
        reach: samples to either side.
        step_px: distance between samples.
        threshold: weakest step, grey levels over two samples.

    Returns:
        positions (N,K) px along the normal, strengths (N,K) grey levels with the sign of the step, 0 = none;
        seen (N,) whether the profile was inside the picture.
    """
    height, width = gray.shape
    count = pixels.shape[0]
    positions = np.zeros((count, 5))
    strengths = np.zeros((count, 5))
    seen = np.zeros(count, dtype=np.bool_)
    size = 2 * reach + 3
    profile = np.empty(size)
    slope = np.zeros(size)
    for i in range(count):
        if depths[i] <= 0:
            continue
        u, v = pixels[i, 0], pixels[i, 1]
        nu, nv = normals[i, 0], normals[i, 1]
        if u < 2 or v < 2 or u > width - 4 or v > height - 4:
            continue
        first, last = 0, size - 1
        half = 0.5 * (size - 1)
        for k in range(size):
            t = (k - half) * step_px
            x = u + t * nu
            y = v + t * nv
            ix, iy = int(x), int(y)
            if x >= 0 and y >= 0 and ix < width - 1 and iy < height - 1:
                ax, ay = x - ix, y - iy
                top = gray[iy, ix] * (1.0 - ax) + gray[iy, ix + 1] * ax
                bottom = gray[iy + 1, ix] * (1.0 - ax) + gray[iy + 1, ix + 1] * ax
                profile[k] = top * (1.0 - ay) + bottom * ay
            elif k < half:
                first = k + 1
            else:
                last = min(last, k - 1)
        if last - first < 4:
            continue
        seen[i] = True
        for k in range(first + 1, last):
            slope[k] = 0.5 * (profile[k + 1] - profile[k - 1])
        kept = 0
        for k in range(first + 2, last - 1):
            s = abs(slope[k])
            if s < threshold or s < abs(slope[k - 1]) or s <= abs(slope[k + 1]):
                continue
            if slope[k] * slope[k - 1] < 0 and slope[k] * slope[k + 1] < 0:
                continue
            a, b = abs(slope[k - 1]), abs(slope[k + 1])
            bend = a - 2.0 * s + b
            offset = 0.5 * (a - b) / bend if bend < -1e-9 else 0.0
            position = (k - half + min(max(offset, -0.5), 0.5)) * step_px
            slot = kept
            if kept == 5:
                slot = 0
                for j in range(1, 5):
                    if abs(strengths[i, j]) < abs(strengths[i, slot]):
                        slot = j
                if abs(strengths[i, slot]) >= s:
                    continue
            else:
                kept += 1
            positions[i, slot] = position
            strengths[i, slot] = slope[k]
    return positions, strengths, seen


@kernel
def add_edges(  # type: ignore[no-untyped-def]
    hessian, gradient, points, kinds, cam_from_body, intrinsics, pixels, normals, positions, strengths,
    strength_half, sigma_px, spread_px, weight
):  # fmt: skip
    """Add the chosen hypothesis of each point to the 6×6 system.

    ``kinds`` are EDGE_* bits. ``spread_px`` is how far the pose may still be off: hypotheses are judged by
    strength × Gaussian of that width,
    and residuals beyond about twice it fade out (Tukey). Returns the summed weighted squared residual and weight.
    """
    r = cam_from_body
    cut = 2.5 * spread_px
    sum_weight = 0.0
    sum_square = 0.0
    for i in range(points.shape[0]):
        best = 0.0
        residual = 0.0
        strength = 0.0
        if strengths[i, 0] == 0.0:
            continue
        p = points[i]
        x = r[0, 0] * p[0] + r[0, 1] * p[1] + r[0, 2] * p[2] + r[0, 3]
        y = r[1, 0] * p[0] + r[1, 1] * p[1] + r[1, 2] * p[2] + r[1, 3]
        z = r[2, 0] * p[0] + r[2, 1] * p[1] + r[2, 2] * p[2] + r[2, 3]
        if z < 1.0:
            continue
        u, v = project(x, y, z, intrinsics)
        here = (u - pixels[i, 0]) * normals[i, 0] + (v - pixels[i, 1]) * normals[i, 1]
        for j in range(5):
            s = abs(strengths[i, j])
            if s == 0.0:
                break
            e = here - positions[i, j]
            score = s / (s + strength_half) * np.exp(-0.5 * (e / spread_px) ** 2)
            if score > best:
                best = score
                residual = e
                strength = s
        if best == 0.0 or abs(residual) >= cut:
            continue
        fade = 1.0 - (residual / cut) ** 2
        w = weight * fade * fade * strength / (strength + strength_half) / (sigma_px * sigma_px)
        if (kinds[i] & (EDGE_CONTOUR | EDGE_SHARP)) == 0:
            w *= SOFT_EDGE_TRUST
        add_line(hessian, gradient, p, r, x, y, z, normals[i, 0], normals[i, 1], intrinsics, residual, w)
        sum_weight += w
        sum_square += w * residual * residual
    return sum_square, sum_weight
