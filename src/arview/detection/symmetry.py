"""Rotational symmetries of a part, exact and near, and the evidence that separates near-symmetric poses.

Rotations about the centre of the bounding box are tried: multiples of 30° and 45° about the model's axes, or of 72°
where more of these are symmetries, half turns about the diagonals between them and thirds about the space diagonals. A
rotation that maps the CAD's edges onto themselves is an exact symmetry; one that maps most of them is a near symmetry,
which only the remaining edges can distinguish. Symmetries whose axis misses the centre of the box are not found.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from arview.geometry import Array, exp_so3
from arview.guideviews import GuideViewSet
from arview.refinement import EdgeSteps
from arview.rendering import EDGE_SHARP

USUAL_ANGLES_DEG, FIFTHS_DEG = sorted({*range(30, 360, 30), *range(45, 360, 45)}), range(72, 360, 72)
"""Angles that are tried about the model's axes."""


NEAR_DISTANCE = 0.025
EXACT_DISTANCE = 0.012
"""Distance in diameters within which rotated edges match others in a near and in an exact symmetry."""
NEAR_SHARE = 0.9
EXACT_SHARE = 0.997
"""Share of the edges that a near and an exact symmetry match."""
MAX_VIEWS = 60
MAX_POINTS = 6000
"""Numbers of guide views and edge points that are tested."""
MAX_TESTED, MIN_TESTED = 1500, 30
"""Number of points that are tested at most, and below which nothing is said of a rotation."""
RANGE_MARGIN_DEG = 6.0
"""Angle from the nearest guide view within which a direction is in the declared range."""
CELL = 0.006
"""Size in diameters of the cells of which one edge point is kept."""
MIN_SHARP_SHARE = 0.2
"""Share of design edges from which they alone are tested; organic shapes have only silhouettes."""
MIN_AXIS_ROTATIONS = 3
"""Symmetries about one axis, near ones among them, from which a part is nearly round."""


SHARED_PX = 3.0
SHARED_COSINE = 0.8
"""Distance and parallelism within which an edge of one pose lies on one of the other."""
SPACING_PX = 12.0
"""Largest distance between the points of two edges that are compared."""
NEIGHBOURS = 12
"""Nearest points that are compared."""
CORRELATED_POINTS = 4.0
"""Neighbouring points whose support is correlated."""
MIN_POINTS = 4
"""Number of points below which nothing is concluded."""
SUPPORT_DEVIATION = 0.5
"""Standard deviation of the support of a point."""


@dataclass(frozen=True)
class RotationalSymmetries:
    """Rotations of the part about its centre that map it onto itself, without the identity.

    Attributes:
        exact: (N,3,3) rotations that change nothing.
        near: (N,3,3) rotations that change little.
        axes: (A,3) axes about which the part is nearly round, so that its outline fits at any angle.
    """

    exact: Array
    near: Array
    axes: Array


def find_rotational_symmetries(views: GuideViewSet) -> RotationalSymmetries:
    """Rotations of a part onto itself, found on the edges of its guide views.

    A rotation is tested on the edges seen from where the part, rotated, is seen too; one that leads out of the declared
    range from everywhere is none, because nothing beyond the range is known or searched.
    """
    points, view_of, directions = _edge_points(views)
    tree = cKDTree(points)
    reach = np.cos(np.deg2rad(RANGE_MARGIN_DEG))
    step = max(1, len(points) // MAX_TESTED)

    def among(rotations: Array) -> RotationalSymmetries:
        exact, near = [], []
        for rotation in rotations:
            is_in_range = np.max(directions @ rotation.T @ views.directions.T, axis=1) > reach
            tested = points[is_in_range[view_of]][::step]
            if len(tested) < MIN_TESTED:
                continue
            distance, _ = tree.query(tested @ rotation.T, distance_upper_bound=NEAR_DISTANCE * views.diameter_mm)
            if np.mean(distance < EXACT_DISTANCE * views.diameter_mm) >= EXACT_SHARE:
                exact.append(rotation)
            elif np.mean(np.isfinite(distance)) >= NEAR_SHARE:
                near.append(rotation)
        return RotationalSymmetries(
            np.array(exact).reshape(-1, 3, 3), np.array(near).reshape(-1, 3, 3), np.empty((0, 3))
        )

    def about(axis: Array) -> RotationalSymmetries:
        # A rotation by a fifth is close to one by five twelfths, so that only one of both sets is used.
        usual, fifths = (among(rotations_about(axis, angles_deg)) for angles_deg in (USUAL_ANGLES_DEG, FIFTHS_DEG))
        found = max(usual, fifths, key=lambda found: len(found.exact) + len(found.near))
        is_round = len(found.near) > 0 and len(found.exact) + len(found.near) >= MIN_AXIS_ROTATIONS
        return replace(found, axes=axis[None]) if is_round else found

    groups = [*map(about, np.eye(3)), among(_diagonal_rotations())]
    exact, near, axes = (
        np.concatenate([getattr(group, field.name) for group in groups]) for field in fields(RotationalSymmetries)
    )
    return RotationalSymmetries(exact, near, axes)


def _edge_points(views: GuideViewSet) -> tuple[Array, NDArray[np.intp], Array]:
    """Edges seen from all around: points (N,3) about the centre, the view of each, and the directions of the views."""
    step = max(1, len(views) // MAX_VIEWS)
    shown = [views.view(i).features for i in range(0, len(views), step)]
    points = np.concatenate([features.edge_points for features in shown])
    view_of = np.repeat(np.arange(len(shown)), [len(features.edge_points) for features in shown])
    sharp = np.concatenate([features.edge_kinds for features in shown]) & EDGE_SHARP > 0
    kept = sharp if np.mean(sharp) > MIN_SHARP_SHARE else np.ones(len(points), dtype=bool)
    points, view_of = points[kept] - views.center_in_model, view_of[kept]
    # One point per cell, so that edges seen in many views count once.
    cells = np.round(points / (CELL * views.diameter_mm)).astype(np.int64)
    _, first = np.unique(cells, axis=0, return_index=True)
    chosen: NDArray[np.intp] = np.sort(first)[:: max(1, len(first) // MAX_POINTS)]
    return np.asarray(points[chosen]), view_of[chosen], np.asarray(views.directions[::step])


def rotations_about(axis: Array, angles_deg: Iterable[float]) -> Array:
    """Rotations (N,3,3) about a unit axis (3,)."""
    return np.stack([exp_so3(axis * np.deg2rad(angle)) for angle in angles_deg])


def _diagonal_rotations() -> Array:
    """Rotations (N,3,3) by a half turn about diagonals between two axes, by thirds about those between three."""
    turns = []
    for a, b in ((0, 1), (0, 2), (1, 2)):
        for sign in (-1.0, 1.0):
            axis = np.zeros(3)
            axis[a], axis[b] = 1.0, sign
            turns.append(rotations_about(axis / np.linalg.norm(axis), (180.0,)))
    for x in (-1.0, 1.0):
        for y in (-1.0, 1.0):
            turns.append(rotations_about(np.array([x, y, 1.0]) / np.sqrt(3.0), (120.0, 240.0)))
    return np.concatenate(turns)


def edge_margin(a: EdgeSteps, b: EdgeSteps) -> float:
    """Difference of support, in standard deviations, between the edges that only pose a has and those that only b has.

    Near-symmetric poses share most edges, and comparing all of them drowns the few that differ in noise. An edge that
    exists is supported like the shared ones, one that does not is supported by chance only; half of the shared support
    separates both.
    """
    is_own_a, is_own_b = _is_own(a, b), _is_own(b, a)
    own_a, own_b = a.support[is_own_a], b.support[is_own_b]
    count = len(own_a) + len(own_b)
    if count < MIN_POINTS:
        return 0.0
    shared = np.concatenate([a.support[~is_own_a], b.support[~is_own_b]])
    middle = 0.5 * (shared.mean() if len(shared) else 1.0)
    lead = np.sum(own_a - middle) - np.sum(own_b - middle)
    return float(lead / (SUPPORT_DEVIATION * np.sqrt(count * CORRELATED_POINTS)))


def _is_own(a: EdgeSteps, b: EdgeSteps) -> NDArray[np.bool_]:
    """Which edges of a lie on no parallel edge of b."""
    near, index = cKDTree(b.pixels).query(a.pixels, k=NEIGHBOURS, distance_upper_bound=SPACING_PX)
    index = np.minimum(index, len(b.pixels) - 1)
    # The distance is measured across the edge, because the points along it are apart.
    across_px = np.abs(np.einsum("nj,nkj->nk", a.normals, b.pixels[index] - a.pixels[:, None]))
    is_parallel = np.abs(np.einsum("nj,nkj->nk", a.normals, b.normals[index])) > SHARED_COSINE
    is_shared = np.isfinite(near) & (across_px < SHARED_PX) & is_parallel
    return np.asarray(~np.any(is_shared, axis=1))
