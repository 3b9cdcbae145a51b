"""Edges of the part in one picture as linear equations in its pose and the camera's intrinsics."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from arview.core.kernel import kernel
from arview.geometry import Array
from arview.refinement import CUT_OFF, HYPOTHESES, EdgeProfiles, ProjectedLines, project
from arview.rendering import EDGE_SHARP

POSE_COLUMNS, SHARED_COLUMNS = 6, 4
"""Unknowns of a pose, and of the camera: logarithm of the focal length, principal point (2), radial distortion k1."""


class EdgeEquations(NamedTuple):
    """One equation for each of N edge points: jacobian · unknowns = -residual.

    Attributes:
        jacobian: (N,10) px: twist (rotation rad, translation mm) on the right of the pose; logarithm of the focal
            length, at which the distance of the part's centre changes by the same factor; principal point, px of the
            kept picture; k1.
        residuals: (N,) px along the edge's normal, predicted minus measured.
        weights: (N,) 0–1; 0: not measured.
    """

    jacobian: NDArray[np.float64]
    residuals: NDArray[np.float64]
    weights: NDArray[np.float64]


@kernel
def edge_equations(
    points: NDArray[np.float32],
    kinds: NDArray[np.uint8],
    pose: NDArray[np.float64],
    intrinsics: NDArray[np.float64],
    lines: ProjectedLines,
    profiles: EdgeProfiles,
    spread_px: float,
    strength_half: float,
    smooth_weight: float,
) -> EdgeEquations:
    """Equations of the best grey-level step of each point, chosen and weighted as by the edge modality.

    At a fixed picture size of the part's centre only its relative depth tells the focal length, so the column of the
    focal length moves the centre along the optical axis as well: that keeps the system well conditioned.

    Args:
        points, kinds: (N,3) mm about the part's centre, and their EDGE_* bits.
        pose: (4,4) at which the equations are linearised.
        intrinsics: (10,) of the picture.
        lines, profiles: measured at a pose nearby.
        spread_px: expected distance of the prediction from the edges.
        strength_half: strength of a step, in grey levels, that has half the weight of a very strong one.
        smooth_weight: weight of points on no sharp edge: the outline of a curved surface slides over it.
    """
    count = points.shape[0]
    jacobian = np.zeros((count, POSE_COLUMNS + SHARED_COLUMNS))
    residuals = np.zeros(count)
    weights = np.zeros(count)
    r = pose
    depth = pose[2, 3]
    cut = CUT_OFF * spread_px
    for i in range(count):
        if profiles.strengths[i, 0] == 0.0:
            continue
        p = points[i]
        x = r[0, 0] * p[0] + r[0, 1] * p[1] + r[0, 2] * p[2] + r[0, 3]
        y = r[1, 0] * p[0] + r[1, 1] * p[1] + r[1, 2] * p[2] + r[1, 3]
        z = r[2, 0] * p[0] + r[2, 1] * p[1] + r[2, 2] * p[2] + r[2, 3]
        if z < 1.0:
            continue
        u, v = project(x, y, z, intrinsics)
        nu, nv = lines.normals[i, 0], lines.normals[i, 1]
        here = (u - lines.pixels[i, 0]) * nu + (v - lines.pixels[i, 1]) * nv
        best, residual, strength, total = 0.0, 0.0, 0.0, 0.0
        for j in range(HYPOTHESES):
            s = abs(profiles.strengths[i, j])
            if s == 0.0:
                break
            e = here - profiles.positions[i, j]
            score = s / (s + strength_half) * np.exp(-0.5 * (e / spread_px) ** 2)
            total += score
            if score > best:
                best, residual, strength = score, e, s
        if best == 0.0 or abs(residual) >= cut:
            continue
        fade = 1.0 - (residual / cut) ** 2
        # A point with several steps nearby may have taken the wrong one.
        w = fade * fade * strength / (strength + strength_half) * (best / total) ** 2
        if (kinds[i] & EDGE_SHARP) == 0:
            w *= smooth_weight
        residuals[i] = residual
        weights[i] = w
        xn, yn = x / z, y / z
        ax = nu * intrinsics[0] / z
        ay = nv * intrinsics[1] / z
        az = -(ax * xn + ay * yn)
        bx = r[0, 0] * ax + r[1, 0] * ay + r[2, 0] * az
        by = r[0, 1] * ax + r[1, 1] * ay + r[2, 1] * az
        bz = r[0, 2] * ax + r[1, 2] * ay + r[2, 2] * az
        row = jacobian[i]
        row[0] = p[1] * bz - p[2] * by
        row[1] = p[2] * bx - p[0] * bz
        row[2] = p[0] * by - p[1] * bx
        row[3], row[4], row[5] = bx, by, bz
        row[6] = nu * (u - intrinsics[2]) + nv * (v - intrinsics[3]) + az * depth
        row[7], row[8] = nu, nv
        row[9] = (nu * intrinsics[0] * xn + nv * intrinsics[1] * yn) * (xn * xn + yn * yn)
    return EdgeEquations(jacobian, residuals, weights)


def line_labels(points: Array, tangents: Array, diameter_mm: float, cell_share: float) -> NDArray[np.int64]:
    """Labels (N,) of edge points (N,3) mm with unit tangents (N,3): equal where they lie on one line of the part.

    Points of one edge share what the CAD does not have, such as a rounded corner. A line is told by its direction,
    whatever its sign, and by its foot point, both rounded; ``cell_share`` is the rounding in diameters.
    """
    largest = np.argmax(np.abs(tangents), axis=1)
    signs = np.sign(np.take_along_axis(tangents, largest[:, None], axis=1))
    way = tangents * np.where(signs == 0.0, 1.0, signs)
    foot = points - np.sum(points * way, axis=1, keepdims=True) * way
    cells = np.concatenate([np.round(3.0 * way), np.round(foot / (cell_share * diameter_mm))], axis=1).astype(np.int64)
    label = np.zeros(len(cells), dtype=np.int64)
    for column in cells.T:
        label = label * 64 + (column + 32) % 64
    return label
