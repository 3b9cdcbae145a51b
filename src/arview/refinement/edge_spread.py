"""Edge spread: how soft the edges of the part are in a picture, from the profiles across its projected edges.

A step of height h blurred with a Gaussian of standard deviation σ has the largest slope h / (√(2π) σ). Height and slope
are measured on the strongest step near every projected edge, so only the part's own edges count: the picture may be
sharp elsewhere. Compare Hu & de Haan, "Low cost robust blur estimator" (ICIP 2006).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from arview.core.kernel import kernel
from arview.refinement.kernels import nearest_view
from arview.refinement.projection import ViewArrays, project_lines
from arview.rendering import EDGE_CONTOUR, EDGE_SHARP

SPREAD_REACH = 12
"""Samples to either side of an edge, one pixel apart."""
SPREAD_NEAR = 4
"""Steps farther from the edge than this many samples are not used."""
SPREAD_MIN_STEP = 6.0
"""Weaker steps, in grey levels per sample, are not used, because noise widens them."""
SPREAD_FLANK = 0.15
"""The step ends where the slope falls below this share of its maximum."""
SPREAD_OF_SMOOTHING, SPREAD_OF_SAMPLING = 0.67, 0.48
"""Variance, px², that smoothing over 3×3 pixels, and interpolation and the difference of samples add to a step."""
SPREAD_MIN_POINTS = 12
"""Edge points with a usable step needed for an estimate."""


@kernel
def edge_spread(
    smooth: NDArray[np.uint8],
    part: ViewArrays,
    cam_from_body: NDArray[np.float64],
    intrinsics: NDArray[np.float64],
    step_mm: float,
) -> float:
    """Median standard deviation, px, of the blur of the part's edges at a pose; -1 where too few edges are seen.

    Args:
        smooth: (H,W) uint8, `smoothed`.
        part: `ViewArrays`.
        cam_from_body: (4,4) pose, right to a few pixels.
        intrinsics: as of `intrinsics_of`.
        step_mm: length along a tangent by which its projection is measured.
    """
    view = nearest_view(part.directions, cam_from_body)
    first, last = part.edge_starts[view], part.edge_starts[view + 1]
    lines = project_lines(
        part.edge_points[first:last:2], part.edge_tangents[first:last:2], True, cam_from_body, intrinsics, step_mm
    )
    kinds = part.edge_kinds[first:last:2]
    height, width = smooth.shape
    pitch = intrinsics[10]
    added = SPREAD_OF_SMOOTHING + SPREAD_OF_SAMPLING / max(pitch, 1.0) ** 2
    size = 2 * SPREAD_REACH + 1
    profile = np.empty(size)
    spreads = np.empty(kinds.shape[0])
    count = 0
    for i in range(kinds.shape[0]):
        if lines.depths[i] <= 0 or (kinds[i] & (EDGE_CONTOUR | EDGE_SHARP)) == 0:
            continue
        u, v = (lines.pixels[i, 0] + 0.5) * pitch - 0.5, (lines.pixels[i, 1] + 0.5) * pitch - 0.5
        nu, nv = pitch * lines.normals[i, 0], pitch * lines.normals[i, 1]
        reach_x, reach_y = SPREAD_REACH * abs(nu) + 1.0, SPREAD_REACH * abs(nv) + 1.0
        if u - reach_x < 0 or v - reach_y < 0 or u + reach_x > width - 2 or v + reach_y > height - 2:
            continue
        for k in range(size):
            x, y = u + (k - SPREAD_REACH) * nu, v + (k - SPREAD_REACH) * nv
            ix, iy = int(x), int(y)
            ax, ay = x - ix, y - iy
            top = smooth[iy, ix] * (1.0 - ax) + smooth[iy, ix + 1] * ax
            bottom = smooth[iy + 1, ix] * (1.0 - ax) + smooth[iy + 1, ix + 1] * ax
            profile[k] = top * (1.0 - ay) + bottom * ay
        best = 0
        steepest = 0.0
        for k in range(SPREAD_REACH - SPREAD_NEAR, SPREAD_REACH + SPREAD_NEAR + 1):
            slope = 0.5 * (profile[k + 1] - profile[k - 1])
            if abs(slope) > abs(steepest):
                best, steepest = k, slope
        if abs(steepest) < SPREAD_MIN_STEP:
            continue
        sign = 1.0 if steepest > 0 else -1.0
        limit = SPREAD_FLANK * abs(steepest)
        low, high = best, best
        while low > 1 and sign * 0.5 * (profile[low] - profile[low - 2]) > limit:
            low -= 1
        while high < size - 2 and sign * 0.5 * (profile[high + 2] - profile[high]) > limit:
            high += 1
        step = sign * (profile[high] - profile[low])
        sigma = step / (2.5066 * abs(steepest))
        spreads[count] = np.sqrt(max(sigma * sigma - added, 0.0))
        count += 1
    if count < SPREAD_MIN_POINTS:
        return -1.0
    return float(np.median(spreads[:count]))
