"""How well image edges support each component at its nominal placement, and at displaced ones.

For every component the kernels measure the share of its visible edge points that lie on image edges, at the best of
the small shifts that tolerance and pose error allow; the same share at the best of many larger shifts; and how the
colours change across its outline.

Source: scores of a shifted edge template by Borgefors (PAMI 1988).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from arview.assembly.image_edges import (
    ALIGNED,
    NOBODYS,
    SHARED,
    EdgePicture,
    EdgePictures,
    find_thin_edges,
    mark_owners,
    strength_at,
)
from arview.assembly.visible_edges import VisibleEdges
from arview.core.kernel import kernel
from arview.geometry import Array
from arview.refinement import project_lines

HALF_SCORE_STRENGTH = 20.0
"""Edge strength, in half grey levels per px, that scores half of what the strongest edge scores."""
MIN_INSIDE_SHARE = 0.8
"""Share of a component's own points that must be inside the picture."""
RUN_POINTS, MIN_RUN_POINTS = 10, 5
"""Neighbouring outline points over which a colour change is averaged, and how many of them must be usable."""
MAX_RUN_GAP_SQUARE = 144.0
"""Squared distance in px between a run's first and last point."""
MAX_RUN_CONTRAST = 10.0
"""Colour change of a run, in standard deviations, above which it counts no more."""
ACROSS = np.array([-1.0, 0.0, 1.0])
"""Steps along a point's normal at which an edge is looked for."""


class PointLimits(NamedTuple):
    """Limits of the measurement. A NamedTuple, not a dataclass, because kernels take it.

    Attributes:
        min_slope: weakest image edge, grey levels per px of the strongest channel.
        max_points: points measured per component.
        min_points: points that a component must show to be measured at all.
        well_supported: share of supported points from which on displaced placements are not tried, to save time.
        typical_displaced: share that is then assumed at the best displaced placement.
        color_reach_px: distance from an edge at which colours are compared.
    """

    min_slope: float = 1.5
    max_points: int = 48
    min_points: int = 14
    well_supported: float = 0.8
    typical_displaced: float = 0.45
    color_reach_px: float = 3.0


DISPLACED_MM = 2.5
"""Largest deviation from the nominal placement that is allowed."""
DISPLACED_SHARE = 0.02
"""Largest deviation that is allowed, in diameters of the part; the smaller of it and ``DISPLACED_MM`` holds."""
POSE_PX = 1.0
"""Error of the pose, which is added to the largest allowed deviation."""
SHIFT_COST = 0.2
"""Share of points by which the support must grow at the largest allowed shift."""
SEARCHED_MM = 24.0
"""Largest shift that is tried."""
SEARCHED_SHARE = 0.15
"""Largest shift that is tried, in diameters of the part."""
SEARCHED_PX = 44.0
"""Largest shift that is tried in the picture; the smallest of the three limits holds."""
SEARCH_GAP_PX = 2.0
"""Gap between allowed and larger shifts."""
MIN_SEARCH_PX = 6.0
"""Range of larger shifts beyond the allowed ones where the bounds above leave less."""
SEARCH_STEP_PX = 3
"""Grid of the larger shifts."""
POINTS: PointLimits = PointLimits()
"""Limits of the measurement at each point."""


class EdgeSupport(NamedTuple):
    """Edge measurements of each component in one picture; all (C,), -1 where too little of a component is visible.

    Attributes:
        supported: share of its points on image edges at the nominal placement.
        displaced: share of its points on image edges at the best displaced placement.
        contrast: mean colour change across its outline in standard deviations; -1 without an outline of its own.
        determined: number of points that determine its position in the least determined image direction.
    """

    supported: Array
    displaced: Array
    contrast: Array
    determined: Array


class MeasuredSupport(NamedTuple):
    """Edge support by all of a component's points, and by those alone that lie apart from other components' edges.

    The picture may be smaller than the guide views, in which points were compared: there an image edge near some of
    them may be a neighbour's. It is no evidence for the component, but one that is not found is evidence against it.

    Attributes:
        support: by all points.
        unshared: by those apart; -1 where they are too few. The same as `support` where none is shared.
    """

    support: EdgeSupport
    unshared: EdgeSupport


class FoundPoints(NamedTuple):
    """Edge points in a picture: pixels (N,2), whether each lies on an image edge (N,), at which shift (2,) in px."""

    pixels: Array
    is_found: NDArray[np.bool_]
    shift: NDArray[np.int64]


class Projection(NamedTuple):
    """Pose (4,4) and intrinsics (10,) of a picture, and the length in mm over which directions are projected."""

    cam_from_body: Array
    intrinsics: Array
    step_mm: float


class Shifts(NamedTuple):
    """Shifts in px: (S,2) int64 near ones with the share (S,) that each must gain, and (T,2) int64 far ones."""

    near: NDArray[np.int64]
    near_costs: Array
    far: NDArray[np.int64]


class _Projected(NamedTuple):
    """Edge points in the picture: pixels (N,2), image normals (N,2), depths (N,) mm."""

    pixels: Array
    normals: Array
    depths: Array


class EdgeSupportMeter:
    """Measures the edge support of the components in pictures of one part.

    Args:
        diameter_mm: of the part.
    """

    def __init__(self, diameter_mm: float) -> None:
        self._diameter_mm = diameter_mm
        self._pictures = EdgePictures()

    def measure(
        self,
        image: NDArray[np.uint8],
        edges: VisibleEdges,
        cam_from_body: Array,
        intrinsics: Array,
        px_per_mm: float,
        is_absent: NDArray[np.bool_] | None = None,
    ) -> MeasuredSupport:
        """Edge support of all components.

        Args:
            image: (H,W,3) RGB, the picture around the part.
            edges: visible from about its direction.
            cam_from_body: (4,4) pose about the model's centre.
            intrinsics: (10,) of the picture, see `intrinsics_of`.
            px_per_mm: scale at the part's centre.
            is_absent: (C,) components whose edges are not those of any edge in the picture; None: there are none.
        """
        none = np.zeros(len(edges.starts) - 1, dtype=bool)
        picture = self._pictures.of(image)
        projection = Projection(cam_from_body, intrinsics, 0.01 * self._diameter_mm)
        self._measured = picture, projection
        all_points, unshared = measure_edge_support(
            picture,
            edges,
            none if is_absent is None else is_absent,
            projection,
            self._shifts(px_per_mm),
            POINTS,
        )
        return MeasuredSupport(EdgeSupport(*all_points), EdgeSupport(*unshared))

    def found_points(self, edges: VisibleEdges, is_wanted: NDArray[np.bool_]) -> FoundPoints:
        """Own edge points of some components (C,) in the picture measured last, at the best shift of all together.

        Args:
            edges: those that were measured.
            is_wanted: (C,) the components.
        """
        points = self._points(edges, is_wanted[edges.component] & edges.is_own)
        reach = int(np.ceil(POSE_PX)) + 1
        hits = [(self._hits(points, shift), shift) for shift in _disc(0.0, reach, 1)]
        is_found, shift = max(hits, key=lambda one: (np.count_nonzero(one[0]), -int(np.sum(one[1] ** 2))))
        return FoundPoints(points.pixels, is_found, shift)

    def found_behind(self, edges: VisibleEdges, shift: NDArray[np.int64]) -> FoundPoints:
        """All points of other edges in the picture measured last, at a shift (2,) of `found_points`."""
        points = self._points(edges, np.ones(len(edges.component), dtype=bool))
        return FoundPoints(points.pixels, self._hits(points, shift), shift)

    def _points(self, edges: VisibleEdges, is_wanted: NDArray[np.bool_]) -> _Projected:
        """Those of some edge points (N,) that are inside the picture measured last."""
        picture, (cam_from_body, intrinsics, step_mm) = self._measured
        pixels, normals, depths = project_lines(
            edges.points_in_body, edges.tangents, True, cam_from_body, intrinsics, step_mm
        )
        margin = int(np.ceil(POSE_PX)) + 3
        size = np.array(picture.strength.shape[::-1])
        kept = is_wanted & (depths > 0) & (pixels > margin).all(axis=1) & (pixels < size - 1 - margin).all(axis=1)
        return _Projected(pixels[kept], normals[kept], depths[kept])

    def _hits(self, points: _Projected, shift: NDArray[np.int64]) -> NDArray[np.bool_]:
        """(N,) points on edges of their direction at a shift (2,), at most a pixel off along the normal."""
        picture = self._measured[0]
        places = np.round(points.pixels[:, None] + ACROSS[:, None] * points.normals[:, None] + shift).astype(np.intp)
        u, v = places[..., 0], places[..., 1]
        directions, normals = picture.directions[:, v, u].astype(np.int64), np.round(127.0 * points.normals)[:, None]
        along = np.abs(directions[0] * normals[..., 0] + directions[1] * normals[..., 1])
        return np.asarray(((picture.strength[v, u] > 0) & (along > ALIGNED)).any(axis=1))

    def _shifts(self, px_per_mm: float) -> Shifts:
        """Shifts within the allowed deviation, and those beyond it within the searched distance."""
        diameter_mm = self._diameter_mm
        allowed = min(DISPLACED_MM, DISPLACED_SHARE * diameter_mm) * px_per_mm + POSE_PX
        searched = min(SEARCHED_MM * px_per_mm, SEARCHED_SHARE * diameter_mm * px_per_mm, SEARCHED_PX)
        near = _disc(0.0, allowed, 1)
        far = _disc(allowed + SEARCH_GAP_PX, max(searched, allowed + MIN_SEARCH_PX), SEARCH_STEP_PX)
        return Shifts(near, SHIFT_COST * np.sum(near**2, axis=1) / allowed**2, far)


def _disc(inner_px: float, outer_px: float, step: int) -> NDArray[np.int64]:
    """(S,2) points of a grid between two radii."""
    reach = step * int(outer_px // step)
    axis = np.arange(-reach, reach + 1, step)
    points = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    radius = np.linalg.norm(points, axis=1)
    return np.ascontiguousarray(points[(radius >= inner_px) & (radius <= outer_px)], dtype=np.int64)


@kernel
def _best_shift(
    picture: EdgePicture,
    c: int,
    places: NDArray[np.int64],
    along: NDArray[np.int64],
    count: int,
    scores: NDArray[np.float64],
    shifts: NDArray[np.int64],
    costs: NDArray[np.float64],
    lowest: int,
) -> float:
    """Share of ``count`` points on edges at the best shift, by the sum of scores less its cost.

    Args:
        picture: with thin edges and owners.
        c: component.
        places, along: (K,3,2) pixels across the edge at each point, and (K,2) normals in 127ths.
        scores: (256,) by edge strength.
        shifts, costs: (S,2) px, and the share (S,) that each must gain.
        lowest: see `strength_at`.
    """
    directions, strength, owners = picture.directions, picture.strength, picture.owners
    best = -1e9
    share = 0.0
    for s in range(shifts.shape[0]):
        total = -costs[s] * count
        hits = 0
        for k in range(count):
            e = strength_at(directions, strength, owners, c, places[k], along[k], shifts[s, 0], shifts[s, 1], lowest)
            hits += e > 0
            total += scores[e]
            if total + (count - 1 - k) < best:
                break
        if total > best:
            best, share = total, hits / count
    return share


@kernel
def _contrast(
    image: NDArray[np.uint8],
    edges: VisibleEdges,
    is_own: NDArray[np.bool_],
    projected: _Projected,
    c: int,
    reach_px: float,
) -> float:
    """Mean colour change across a component's outline in standard deviations, over runs of points; -1 without runs."""
    pixels, normals, depths = projected.pixels, projected.normals, projected.depths
    sides = edges.sides
    first, last = edges.starts[c], edges.starts[c + 1]
    height, width = image.shape[:2]
    total = 0.0
    runs = 0
    i = first
    while i < last:
        j = i
        n = 0
        change = np.zeros(3)
        square = np.zeros(3)
        while (
            j < last
            and j - i < RUN_POINTS
            and sides[j, 0] == sides[i, 0]
            and sides[j, 1] == sides[i, 1]
            and depths[j] > 0
            and (pixels[j, 0] - pixels[i, 0]) ** 2 + (pixels[j, 1] - pixels[i, 1]) ** 2 < MAX_RUN_GAP_SQUARE
        ):
            u, v, nu, nv = pixels[j, 0] + 0.5, pixels[j, 1] + 0.5, normals[j, 0] * reach_px, normals[j, 1] * reach_px
            xa, ya, xb, yb = int(u - nu), int(v - nv), int(u + nu), int(v + nv)
            if is_own[j] and min(xa, xb) >= 0 and min(ya, yb) >= 0 and max(xa, xb) < width and max(ya, yb) < height:
                n += 1
                for q in range(3):
                    d = float(image[yb, xb, q]) - float(image[ya, xa, q])
                    change[q] += d
                    square[q] += d * d
            j += 1
        if n >= MIN_RUN_POINTS and sides[i, 0] != sides[i, 1]:
            runs += 1
            largest = 0.0
            for q in range(3):
                mean = change[q] / n
                deviation = np.sqrt(max(square[q] / n - mean * mean, 1.0) / n)
                largest = max(largest, abs(mean) / (deviation + 0.5))
            total += min(largest, MAX_RUN_CONTRAST)
        i = max(j, i + 1)
    return total / runs if runs > 0 else -1.0


@kernel
def _unshared_points(edges: VisibleEdges, projected: _Projected, owners: NDArray[np.int16]) -> NDArray[np.bool_]:
    """(N,) own points near which no edge of another component passes in this picture, see `mark_owners`."""
    pixels = projected.pixels
    height, width = owners.shape
    is_unshared = edges.is_own.copy()
    for i in range(pixels.shape[0]):
        u, v = int(np.round(pixels[i, 0])), int(np.round(pixels[i, 1]))
        if projected.depths[i] > 0 and 0 <= u < width and 0 <= v < height and owners[v, u] == SHARED:
            is_unshared[i] = False
    return is_unshared


@kernel
def _usable_points(
    edges: VisibleEdges,
    is_own: NDArray[np.bool_],
    projected: _Projected,
    c: int,
    shape: tuple[int, int],
    usable: NDArray[np.int64],
) -> tuple[int, float]:
    """Own points (N,) of a component inside the picture: sets their indices in ``usable``.

    Returns:
        how many there are, 0 if too large a share is outside; and how many determine the position in the least
        determined direction (the smaller eigenvalue of the normals' scatter matrix).
    """
    pixels, normals, depths = projected.pixels, projected.normals, projected.depths
    height, width = shape
    own = 0
    inside = 0
    xx, yy, xy = 0.0, 0.0, 0.0
    for i in range(edges.starts[c], edges.starts[c + 1]):
        if not is_own[i]:
            continue
        own += 1
        if depths[i] > 0 and 3 < pixels[i, 0] < width - 4 and 3 < pixels[i, 1] < height - 4:
            usable[inside] = i
            inside += 1
            xx += normals[i, 0] ** 2
            yy += normals[i, 1] ** 2
            xy += normals[i, 0] * normals[i, 1]
    if inside < MIN_INSIDE_SHARE * own:
        inside = 0
    return inside, 0.5 * (xx + yy) - np.sqrt(0.25 * (xx - yy) ** 2 + xy * xy)


@kernel
def _place_points(
    projected: _Projected, usable: NDArray[np.int64], places: NDArray[np.int64], along: NDArray[np.int64]
) -> int:
    """Choose evenly spread points of those usable: sets their pixels and normals, see `_best_shift`.

    Returns:
        how many they are.
    """
    pixels, normals = projected.pixels, projected.normals
    inside = usable.shape[0]
    count = min(inside, places.shape[0])
    for k in range(count):
        i = usable[int((k + 0.5) * inside / count)]
        along[k, 0] = int(np.round(127.0 * normals[i, 0]))
        along[k, 1] = int(np.round(127.0 * normals[i, 1]))
        for t in range(3):
            places[k, t, 0] = int(pixels[i, 0] + (t - 1) * normals[i, 0] + 0.5)
            places[k, t, 1] = int(pixels[i, 1] + (t - 1) * normals[i, 1] + 0.5)
    return count


@kernel
def measure_edge_support(
    picture: EdgePicture,
    edges: VisibleEdges,
    is_absent: NDArray[np.bool_],
    projection: Projection,
    shifts: Shifts,
    limits: PointLimits,
) -> MeasuredSupport:
    """`MeasuredSupport` of all components.

    Args:
        picture: an `EdgePicture`; its working memory is overwritten.
        edges: `VisibleEdges` from about the direction of the picture.
        is_absent: (C,) components that are not there: edges in the picture may be those of the others beside them.
        projection: `Projection` of the picture.
        shifts: `Shifts` to try.
        limits: see `PointLimits`.
    """
    shape = picture.strength.shape
    count = edges.starts.shape[0] - 1
    projected = _Projected(
        *project_lines(
            edges.points_in_body,
            edges.tangents,
            True,
            projection.cam_from_body,
            projection.intrinsics,
            projection.step_mm,
        )
    )
    pixels = projected.pixels
    find_thin_edges(picture, limits.min_slope)
    found = np.full((8, count), -1.0)
    support = EdgeSupport(found[0], found[1], found[2], found[3])
    unshared = EdgeSupport(found[4], found[5], found[6], found[7])
    usable = np.empty(pixels.shape[0], dtype=np.int64)
    places = np.empty((limits.max_points, 3, 2), dtype=np.int64)
    along = np.empty((limits.max_points, 2), dtype=np.int64)
    scores = np.arange(256) / (np.arange(256) + HALF_SCORE_STRENGTH)
    no_costs = np.zeros(shifts.far.shape[0])
    # First those that may be there, among these alone; then the others, among all.
    for is_second in (False, True):
        if is_second and not is_absent.any():
            break
        is_left_out = is_absent & (not is_second)
        mark_owners(pixels, projected.depths, edges.component, is_left_out, picture.owners)
        is_unshared = _unshared_points(edges, projected, picture.owners)
        for c in range(count):
            if is_absent[c] != is_second:
                continue
            inside, determined = _usable_points(edges, edges.is_own, projected, c, shape, usable)
            if inside < limits.min_points:
                continue
            kept = _place_points(projected, usable[:inside], places, along)
            here = _best_shift(picture, c, places, along, kept, scores, shifts.near, shifts.near_costs, SHARED)
            support.supported[c] = here
            support.displaced[c] = limits.typical_displaced
            if here < limits.well_supported:
                support.displaced[c] = _best_shift(
                    picture, c, places, along, kept, scores, shifts.far, no_costs, SHARED
                )
            reach_px = limits.color_reach_px
            support.contrast[c] = _contrast(picture.image, edges, edges.is_own, projected, c, reach_px)
            support.determined[c] = determined
            left, determined = _usable_points(edges, is_unshared, projected, c, shape, usable)
            if left == inside:
                found[4:, c] = found[:4, c]
                continue
            if left < limits.min_points:
                continue
            kept = _place_points(projected, usable[:left], places, along)
            unshared.supported[c] = _best_shift(
                picture, c, places, along, kept, scores, shifts.near, shifts.near_costs, NOBODYS
            )
            unshared.displaced[c] = support.displaced[c]
            unshared.contrast[c] = _contrast(picture.image, edges, is_unshared, projected, c, reach_px)
            unshared.determined[c] = determined
    return MeasuredSupport(support, unshared)
