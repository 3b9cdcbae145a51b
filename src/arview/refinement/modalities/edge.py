"""Edge modality: grey-level steps across the projected edges of the CAD, with several hypotheses per point.

RAPID (Harris 1990) and its successors with multiple hypotheses (Vacchetti, Lepetit & Fua, ISMAR 2004) and
M-estimators (Drummond & Cipolla 2002; Comport et al. 2006). The local extrema of the slope across an edge are the
hypotheses. At every update of the pose each point uses the hypothesis with the best product of strength and nearness.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.core.kernel import kernel
from arview.geometry import Array
from arview.refinement.gauss_newton import add_line, add_system
from arview.refinement.modalities.region import ColorModel
from arview.refinement.projection import ProjectedLines, project
from arview.rendering import EDGE_CONTOUR, EDGE_SHARP, EDGE_SILHOUETTE

INNER_SILHOUETTE_WEIGHT, FOLD_WEIGHT = 0.1, 0.02
"""Weights of a round rim in front of the part itself, and of a fold of a curved surface, relative to outline and design
edges. Both may be invisible, and highlights and texture are often near them."""
COLOR_REACH_PX = 4
"""Pixels to either side of a step whose colours are compared."""
COLOR_GAIN = 4.0
"""Logarithm by which a step with the same colours on both sides is weaker where another one separates them fully."""
TWICE_AVERAGED = 0.85
"""Scale up to which a picture is averaged twice."""
SMOOTHED_SIGMA_PX = 0.82
"""Standard deviation of the average over three pixels in a row."""
LEVEL_UNIT = 1 << 14
"""Units of a profile in one grey level."""
HYPOTHESES = 5
"""Steps kept per point, the strongest ones."""
CUT_OFF = 2.5
"""Residuals from this multiple of the expected spread on do not count (Tukey's estimator)."""


class EdgeProfiles(NamedTuple):
    """Grey-level steps along the normals of N points.

    Attributes:
        positions: (N,K) px along the normal, relative to the point.
        strengths: (N,K) slope in grey levels over two samples, with the sign of the step; 0 = no step.
        visible: (N,) whether the profile is inside the picture.
    """

    positions: Array
    strengths: Array
    visible: NDArray[np.bool_]


def smoothed(gray: NDArray[np.uint8], scale: float = 1.0) -> NDArray[np.uint8]:
    """Grey picture (H,W), averaged over 3×3 pixels of a picture larger by a scale, the input of the edge modality.

    From twice the size on interpolation smooths enough. Averaged twice, it is as of a picture smaller by √½.
    """
    if scale <= 1.0:
        averaged = cv2.blur(gray, (3, 3))
        return np.asarray(averaged if scale > TWICE_AVERAGED else cv2.blur(averaged, (3, 3)))
    return np.ascontiguousarray(gray if scale >= 2.0 else cv2.GaussianBlur(gray, (3, 3), SMOOTHED_SIGMA_PX / scale))


@kernel
def _sample_profile(
    flat: NDArray[np.uint8], width: int, u: float, v: float, du: float, dv: float, profile: NDArray[np.int32]
) -> None:
    """Fill a profile (N,) with interpolated grey levels, in units of 2^-14, of a picture (H·W,) from (u, v) on.

    Places are in 2^-16 px: integers take half the time of floating point.
    """
    x, y, dx, dy = (
        np.int64(u * 65536.0) + 256,
        np.int64(v * 65536.0) + 256,
        np.int64(du * 65536.0),
        np.int64(dv * 65536.0),
    )
    for k in range(profile.shape[0]):
        at = np.uint64((y >> 16) * width + (x >> 16))
        below = at + np.uint64(width)
        ax, ay = (x >> 9) & 127, (y >> 9) & 127
        upper, lower = np.int64(flat[at]), np.int64(flat[below])
        upper = (upper << 7) + ax * (np.int64(flat[at + np.uint64(1)]) - upper)
        lower = (lower << 7) + ax * (np.int64(flat[below + np.uint64(1)]) - lower)
        profile[k] = np.int32((upper << 7) + ay * (lower - upper))
        x += dx
        y += dy


@kernel
def measure_edges(
    gray: NDArray[np.uint8], lines: ProjectedLines, reach: int, step_px: float, threshold: float, pitch: float
) -> EdgeProfiles:
    """Grey-level steps along the normal of each point, see `EdgeProfiles`.

    Args:
        gray: (H,W) uint8, `smoothed`, which replaces averaging over neighbouring profiles.
        lines: `ProjectedLines` of the points.
        reach: samples to either side.
        step_px: distance between samples.
        threshold: weakest step, grey levels over two samples.
        pitch: of the points' pixels, see `intrinsics_of`.
    """
    pixels, normals, depths = lines.pixels, lines.normals, lines.depths
    height, width = gray.shape
    count = pixels.shape[0]
    positions = np.zeros((count, HYPOTHESES))
    strengths = np.zeros((count, HYPOTHESES))
    visible = np.zeros(count, dtype=np.bool_)
    half = reach + 1
    last_sample = 2 * half
    profile = np.empty(last_sample + 1, dtype=np.int32)
    flat = gray.reshape(-1)
    least = np.int32(2.0 * threshold * LEVEL_UNIT)
    for i in range(count):
        if depths[i] <= 0:
            continue
        u, v = (pixels[i, 0] + 0.5) * pitch - 0.5, (pixels[i, 1] + 0.5) * pitch - 0.5
        du, dv = normals[i, 0] * step_px * pitch, normals[i, 1] * step_px * pitch
        if u < 2 or v < 2 or u > width - 4 or v > height - 4:
            continue
        first, last = 0, last_sample
        if min(u - half * abs(du), v - half * abs(dv)) < 0.0 or (
            u + half * abs(du) >= width - 1.01 or v + half * abs(dv) >= height - 1.01
        ):
            for k in range(last_sample + 1):
                x, y = u + (k - half) * du, v + (k - half) * dv
                if x < 0.0 or y < 0.0 or x >= width - 1.01 or y >= height - 1.01:
                    if k < half:
                        first = k + 1
                    else:
                        last = min(last, k - 1)
        if last - first < 4:
            continue
        visible[i] = True
        _sample_profile(
            flat, width, u + (first - half) * du, v + (first - half) * dv, du, dv, profile[first : last + 1]
        )
        kept = 0
        for k in range(first + 2, last - 1):
            here = profile[k + 1] - profile[k - 1]
            if abs(here) < least:
                continue
            before, after = profile[k] - profile[k - 2], profile[k + 2] - profile[k]
            s, a, b = abs(here), abs(before), abs(after)
            if s < a or s <= b or (min(a, b) > 0 and (here < 0) != (before < 0) and (here < 0) != (after < 0)):
                continue
            bend = a - 2.0 * s + b
            offset = 0.5 * (a - b) / bend if bend < 0.0 else 0.0
            strength = here * (0.5 / LEVEL_UNIT)
            slot = kept
            if kept == HYPOTHESES:
                slot = 0
                for j in range(1, HYPOTHESES):
                    if abs(strengths[i, j]) < abs(strengths[i, slot]):
                        slot = j
                if abs(strengths[i, slot]) >= abs(strength):
                    continue
            else:
                kept += 1
            positions[i, slot] = (k - half + min(max(offset, -0.5), 0.5)) * step_px
            strengths[i, slot] = strength
    return EdgeProfiles(positions, strengths, visible)


@kernel(fastmath=True)
def weigh_by_color(
    image: NDArray[np.uint8],
    colors: ColorModel,
    lines: ProjectedLines,
    kinds: NDArray[np.uint8],
    profiles: EdgeProfiles,
    pitch: float,
) -> None:
    """Weaken steps of the outline that do not separate colours of the part from colours of the background, in place.

    Highlights, shading close to a round rim and edges in the background are often stronger steps than the outline. Of
    the steps of a point, those count less that have less part inside and background outside than the best one: after
    Seo et al., "Optimal local searching for fast and robust textureless 3D object tracking in highly cluttered
    backgrounds" (TVCG 2014). Where colours tell nothing, all steps keep their strength.

    Args:
        image: (H,W,3) uint8 RGB.
        colors: `ColorModel`.
        lines: `ProjectedLines` of the points; normals of outline points point outwards.
        kinds: (N,) EDGE_* bits of the points.
        profiles: `EdgeProfiles` of the points, whose strengths are changed.
        pitch: of the points' pixels, see `intrinsics_of`.
    """
    bin_of, odds = colors.bin_of, colors.odds
    height, width = image.shape[0], image.shape[1]
    positions, strengths = profiles.positions, profiles.strengths
    separation = np.zeros(HYPOTHESES)
    for i in range(kinds.shape[0]):
        if (kinds[i] & (EDGE_CONTOUR | EDGE_SHARP)) != EDGE_CONTOUR:
            continue
        u, v = (lines.pixels[i, 0] + 0.5) * pitch, (lines.pixels[i, 1] + 0.5) * pitch
        nu, nv = lines.normals[i, 0] * pitch, lines.normals[i, 1] * pitch
        best = 0.0
        for j in range(HYPOTHESES):
            if strengths[i, j] == 0.0:
                break
            total = 0.0
            for k in range(-COLOR_REACH_PX, COLOR_REACH_PX + 1):
                if k == 0:
                    continue
                t = positions[i, j] + k
                x = min(max(int(u + t * nu), 0), width - 1)
                y = min(max(int(v + t * nv), 0), height - 1)
                lean = odds[bin_of[image[y, x, 0]] * 256 + bin_of[image[y, x, 1]] * 16 + bin_of[image[y, x, 2]]]
                lean /= np.sqrt(1.0 + lean * lean)
                total += lean if k < 0 else -lean
            separation[j] = total / (2 * COLOR_REACH_PX)
            best = max(best, separation[j])
        for j in range(HYPOTHESES):
            if strengths[i, j] == 0.0:
                break
            strengths[i, j] *= np.exp(COLOR_GAIN * (separation[j] - best))


@kernel(fastmath=True)
def add_edges(
    hessian: NDArray[np.float64],
    gradient: NDArray[np.float64],
    points: NDArray[np.float32],
    kinds: NDArray[np.uint8],
    cam_from_body: NDArray[np.float64],
    intrinsics: NDArray[np.float64],
    lines: ProjectedLines,
    profiles: EdgeProfiles,
    strength_half: float,
    sigma_px: float,
    spread_px: float,
    weight: float,
) -> None:
    """Add the best hypothesis of each point to the 6×6 system.

    Args:
        hessian, gradient: (6,6) and (6,) of the system.
        points, kinds: (N,3) in the body frame, and their EDGE_* bits.
        cam_from_body, intrinsics: current pose (4,4) and camera.
        lines: `ProjectedLines` of the points at the pose of the measurement.
        profiles: `EdgeProfiles` measured there.
        strength_half: strength in grey levels that has half the weight of a very strong step.
        sigma_px: standard deviation of a correct step.
        spread_px: expected distance of the pose from the edges: the best hypothesis maximises strength × Gaussian of
            this width.
        weight: of the modality.
    """
    r = cam_from_body
    pixels, normals = lines.pixels, lines.normals
    positions, strengths = profiles.positions, profiles.strengths
    cut = CUT_OFF * spread_px
    system = np.zeros((6, 8))
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
        if strengths[i, 1] == 0.0:
            best, residual, strength = 1.0, here - positions[i, 0], abs(strengths[i, 0])
        for j in range(HYPOTHESES if best == 0.0 else 0):
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
            w *= INNER_SILHOUETTE_WEIGHT if (kinds[i] & EDGE_SILHOUETTE) > 0 else FOLD_WEIGHT
        add_line(system, p, r, x, y, z, normals[i, 0], normals[i, 1], intrinsics, residual, w)
    add_system(hessian, gradient, system)
