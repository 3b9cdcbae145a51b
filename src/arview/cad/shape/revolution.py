"""The axis about which most of a surface is a surface of revolution, as of a mug, a flange or a bottle.

The normals of a surface of revolution all meet its axis. A point p with normal n, whose line has Plücker coordinates
(n, p × n), meets the axis (c, c̄) when c · (p × n) + c̄ · n = 0: Pottmann & Randrup, "Rotational and helical surface
approximation for reverse engineering" (Computing 60, 1998). Parts of the surface that are not round, such as a handle,
are outliers, so that the axis is found from samples (RANSAC: Fischler & Bolles, 1981).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from arview.geometry import Array, apply, exp_so3, rigid

POINTS = 800
"""Points of the surface that are compared."""
SAMPLES, SAMPLE_SIZE = 150, 5
"""Samples drawn, and points in each: an axis and its pitch have five degrees of freedom."""
MAX_SKEW = 0.08
"""Sine of the angle between a normal and the plane through the axis, up to which the surface is round there."""
MIN_ROUND_SHARE = 0.55
"""Share of the area, without what lies across the axis, from which a part is nearly round."""

TURNS_DEG = tuple(range(15, 360, 15))
"""Turns about the axis at which the part is compared with itself."""
DENSE_POINTS = 20_000
"""Points of the surface that turned points are compared with."""
SAME_SHARE, SAME_DISTANCE = 0.985, 0.012
"""A turn changes nothing that brings this share of the points within this distance, in diameters, of the surface."""


class RoundAxis(NamedTuple):
    """An axis about which a part is nearly round.

    Attributes:
        direction: (3,) unit vector in the model frame.
        point_in_model: (3,) mm, on the axis.
        share: of the surface that is round, without what lies across the axis.
        turns: (T,4,4) turns of the model about the axis that change it.
    """

    direction: Array
    point_in_model: Array
    share: float
    turns: Array


def find_round_axis(vertices: Array, faces: NDArray[np.int32]) -> RoundAxis | None:
    """The axis about which most of a surface is round; None without one.

    Args:
        vertices: (V,3) mm.
        faces: (F,3).
    """
    rng = np.random.default_rng(len(faces))
    points, normals = _sampled(vertices, faces, POINTS, rng)
    center = points.mean(axis=0)
    size_mm = float(np.sqrt(np.mean(np.sum((points - center) ** 2, axis=1))))
    about = (points - center) / size_mm
    lines = np.concatenate([np.cross(about, normals), normals], axis=1)
    axes = _axes_of(lines[rng.choice(POINTS, size=(SAMPLES, SAMPLE_SIZE))])
    best = axes[np.argmax(_round_shares(about, normals, axes)[0])]
    axes = _axes_of(lines[_round_shares(about, normals, best[None])[1][0]][None])
    (best,), (best_share,) = axes, _round_shares(about, normals, axes)[0]
    if best_share < MIN_ROUND_SHARE:
        return None
    direction, through = best[:3], center + size_mm * np.cross(best[:3], best[3:])
    rotations = [exp_so3(direction * np.deg2rad(angle_deg)) for angle_deg in TURNS_DEG]
    tree = cKDTree(_sampled(vertices, faces, DENSE_POINTS, rng)[0])
    same_mm = SAME_DISTANCE * float(np.linalg.norm(np.ptp(vertices, axis=0)))
    turns = [rigid(rotation, through - rotation @ through) for rotation in rotations]
    changing = [turn for turn in turns if np.mean(tree.query(apply(turn, points))[0] < same_mm) < SAME_SHARE]
    return RoundAxis(direction, through, float(best_share), np.array(changing).reshape(-1, 4, 4))


def _sampled(vertices: Array, faces: NDArray[np.int32], count: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Random points (N,3) of a surface, and the unit normals there."""
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.linalg.norm(normals, axis=1)
    chosen = rng.choice(len(faces), size=count, p=areas / areas.sum())
    return np.einsum("ijk,ij->ik", corners[chosen], rng.dirichlet(np.ones(3), count)), normals[chosen] / areas[
        chosen, None
    ]


def _axes_of(lines: Array) -> Array:
    """Direction and moment (M,6) of the axes that sets of lines (M,N,6), given by moment and direction, meet best."""
    products = np.swapaxes(lines, 1, 2) @ lines
    inverse = np.linalg.pinv(products[:, 3:, 3:], rcond=1e-9)
    moment_of = -inverse @ products[:, 3:, :3]
    directions = np.linalg.eigh(products[:, :3, :3] + products[:, :3, 3:] @ moment_of)[1][:, :, 0]
    moments = np.einsum("mij,mj->mi", moment_of, directions)
    # The component along the axis is the pitch of a helix.
    moments -= directions * np.sum(directions * moments, axis=1, keepdims=True)
    return np.concatenate([directions, moments], axis=1)


def _round_shares(about: Array, normals: Array, axes: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Share (M,) of a surface that is round about axes (M,6), and at which points (M,N) it is.

    What lies across an axis counts for nothing.
    """
    directions = axes[:, None, :3]
    around = np.cross(directions, about - np.cross(directions, axes[:, None, 3:]))
    around /= np.maximum(np.linalg.norm(around, axis=2, keepdims=True), 1e-9)
    across = np.sqrt(np.maximum(1.0 - (axes[:, :3] @ normals.T) ** 2, 0.0))
    is_round = np.abs(np.einsum("mnk,nk->mn", around, normals)) <= MAX_SKEW * np.maximum(across, MAX_SKEW)
    return np.sum(across * is_round, axis=1) / np.maximum(across.sum(axis=1), 1e-9), is_round
