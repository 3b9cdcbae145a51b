"""Poses that look alike: the turns of a part onto itself, exact or nearly so, and which of several poses is right.

Turns about the middle of the bounding box are tried: multiples of 30° and 45° about the model's axes, or of 72° where
more of these are symmetries, half turns about the diagonals between them and thirds about those of the cube. A turn
that takes the CAD's edges onto themselves changes nothing (it is an exact symmetry); one that takes most of them there
makes a twin, which only the rest of the edges can tell from the right pose. Shapes whose axis misses the middle of the
box are not discovered.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from arview.geometry import Array, exp_so3
from arview.guideviews import GuideViewSet
from arview.guideviews.mesh_edges import EDGE_SHARP
from arview.refinement.evidence import EdgeSteps

NEAR_MM, EXACT_MM = 0.025, 0.012
"""Edges this near to others, in diameters, look alike in a picture; this near they are the same."""
NEAR_SHARE, EXACT_SHARE = 0.9, 0.997
"""Shares of the edges that a near and an exact symmetry take onto others."""
USUAL_DEG, FIFTHS_DEG = sorted({*range(30, 360, 30), *range(45, 360, 45)}), range(72, 360, 72)
LOOKED_AT_VIEWS, LOOKED_AT_POINTS = 60, 6000
LEAD = 3.4
"""A pose whose logit is so much higher than a twin's is the right one without a closer look."""
TELLING = 2.0
"""It is, too, when all that tells of two twins speaks for it by so much, see `Detector`: of 189 pictures of nearly
symmetric random solids the pose is right and alone in 104 with it, right among alternatives in 32, wrong with the right
one among its alternatives in 23, and wrong in 29."""
MANY_TURNS = 3
"""So many turns about one axis, near ones among them, make a part nearly round."""
SHARED_PX, SHARED_COS = 3.0, 0.8
"""Edges of two poses this near, and so nearly parallel, tell nothing of which is right."""
SPACING_PX, NEIGHBOURS = 12.0, 12
"""Points of an edge are at most about so far apart; so many nearest ones are looked at."""
TOGETHER, LEAST_TELLING = 4.0, 4
"""So many neighbouring points err together; with fewer points nothing is told."""
SUPPORT_DEVIATION = 0.5
"""Standard deviation of the support of a point."""


@dataclass(frozen=True)
class Symmetries:
    """Turns (N,3,3) of the part about its middle: ``exact`` ones change nothing, ``near`` ones hardly anything.

    ``axes`` (A,3) are those about which there are many, near ones among them: an outline that is nearly round holds a
    pose at any turn about its axis.
    """

    exact: Array
    near: Array
    axes: Array


def find_symmetries(views: GuideViewSet) -> Symmetries:
    """Turns of a part onto itself, found on the edges of its guide views; the identity is not among them."""
    points = _edge_points(views)
    tree = cKDTree(points)

    def among(turns: Array) -> Symmetries:
        exact, near = [], []
        for turn in turns:
            distance, _ = tree.query(points[::4] @ turn.T, distance_upper_bound=NEAR_MM * views.diameter_mm)
            if np.mean(distance < EXACT_MM * views.diameter_mm) >= EXACT_SHARE:
                exact.append(turn)
            elif np.mean(np.isfinite(distance)) >= NEAR_SHARE:
                near.append(turn)
        return Symmetries(np.array(exact).reshape(-1, 3, 3), np.array(near).reshape(-1, 3, 3), np.empty((0, 3)))

    def about(axis: Array) -> Symmetries:
        # What is a fifth is nearly five twelfths, too: one or the other.
        usual, fifths = (among(rotations_about(axis, angles_deg)) for angles_deg in (USUAL_DEG, FIFTHS_DEG))
        found = max(usual, fifths, key=lambda found: len(found.exact) + len(found.near))
        is_many = len(found.near) > 0 and len(found.exact) + len(found.near) >= MANY_TURNS
        return replace(found, axes=axis[None]) if is_many else found

    groups = [*map(about, np.eye(3)), among(_diagonal_turns())]
    exact, near, axes = (np.concatenate([getattr(some, of.name) for some in groups]) for of in fields(Symmetries))
    return Symmetries(exact, near, axes)


def _edge_points(views: GuideViewSet) -> Array:
    """Points (N,3) of the edges seen from all around, about the middle of the part."""
    step = max(1, len(views) // LOOKED_AT_VIEWS)
    looked_at = [views.view(i).features for i in range(0, len(views), step)]
    points = np.concatenate([features.edge_points for features in looked_at])
    sharp = np.concatenate([features.edge_kinds for features in looked_at]) & EDGE_SHARP > 0
    # Design edges say it best; an organic shape has none, and its silhouettes stand in.
    points = (points[sharp] if np.mean(sharp) > 0.2 else points) - views.center_in_model
    # One of many that lie in the same cell: edges seen in many views count once.
    cells = np.round(points / (0.006 * views.diameter_mm)).astype(np.int64)
    _, first = np.unique(cells, axis=0, return_index=True)
    chosen: NDArray[np.intp] = np.sort(first)[:: max(1, len(first) // LOOKED_AT_POINTS)]
    return np.asarray(points[chosen])


def rotations_about(axis: Array, angles_deg: Iterable[float]) -> Array:
    """(N,3,3) turns about an axis."""
    return np.stack([exp_so3(axis * np.deg2rad(angle)) for angle in angles_deg])


def _diagonal_turns() -> Array:
    """(N,3,3) half turns about the diagonals between two axes, thirds about those between three."""
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


def telling(a: EdgeSteps, b: EdgeSteps) -> float:
    """By how many deviations the edges that only pose a has are borne out better than those that only b has.

    Twins share most edges; comparing all of them drowns the few that tell in the noise of the others. An edge that is
    there is borne out as the shared ones are, one that is not only by chance: what lies between speaks for neither.
    """
    is_own_a, is_own_b = _is_own(a, b), _is_own(b, a)
    own_a, own_b = a.support[is_own_a], b.support[is_own_b]
    count = len(own_a) + len(own_b)
    if count < LEAST_TELLING:
        return 0.0
    shared = np.concatenate([a.support[~is_own_a], b.support[~is_own_b]])
    middle = 0.5 * (shared.mean() if len(shared) else 1.0)
    lead = np.sum(own_a - middle) - np.sum(own_b - middle)
    return float(lead / (SUPPORT_DEVIATION * np.sqrt(count * TOGETHER)))


def _is_own(a: EdgeSteps, b: EdgeSteps) -> NDArray[np.bool_]:
    """Which edges of a lie on no parallel one of b."""
    near, index = cKDTree(b.pixels).query(a.pixels, k=NEIGHBOURS, distance_upper_bound=SPACING_PX)
    index = np.minimum(index, len(b.pixels) - 1)
    # Across the edge, not to its points: these lie apart.
    across_px = np.abs(np.einsum("nj,nkj->nk", a.normals, b.pixels[index] - a.pixels[:, None]))
    is_parallel = np.abs(np.einsum("nj,nkj->nk", a.normals, b.normals[index])) > SHARED_COS
    is_shared = np.isfinite(near) & (across_px < SHARED_PX) & is_parallel
    return np.asarray(~np.any(is_shared, axis=1))
