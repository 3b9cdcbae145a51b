"""Template bank: outlines of a part's guide views, and templates made of them at many rolls and one size.

A template is a short list of (dx, dy, orientation), after Hinterstoisser et al., "Gradient Response Maps for Real-Time
Detection of Textureless Objects" (PAMI 2012). The points of an outline are ordered by sectors about its centre, so that
a trimmed score can leave out an occluded quarter of it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from arview.cad import ViewRange
from arview.core.kernel import kernel
from arview.detection.features.response_maps import orientation_bins
from arview.errors import InputError
from arview.geometry import Array
from arview.guideviews import GuideViewSet, ViewFeatures, icosphere_directions, view_lines
from arview.refinement import project_lines
from arview.rendering import EDGE_CONTOUR

FIRST_POINTS = 32
"""Points of a template that are summed everywhere; the others are summed only where the first ones score well."""
SECTORS = 8
"""Sectors of an outline about its centre, each with equally many points."""
TRIMMED_SHARE = 2.0 / SECTORS
"""Share of the outline that a trimmed score leaves out: the two adjacent sectors with the lowest responses."""
GROUPS = 42
"""Number of groups of similar views: directions of an icosphere with one subdivision, about 35° apart."""
DOMAIN_DIRECTION = np.array([0.36, 0.48, 0.8])
"""Direction that chooses one of several symmetric views; it lies on no axis or plane of a likely symmetry."""


POINTS = 64
"""Points of an outline, a multiple of `FIRST_POINTS`."""
MAX_INNER_SHARE = 0.35
"""Largest share of design edges inside the outline among the points."""
SUBDIVISIONS = 4
"""Icosahedron level of the directions that have an outline (4: 2,562, about 4° apart)."""
FAR_DEG = 8.5
"""Angle to the far neighbours of a direction, about twice the spacing of the directions."""


def rolls_between(a: Array, b: Array) -> Array:
    """Angles in rad about +Z that, after rotations ``a`` (..., 3,3), come nearest to rotations ``b``."""
    # The largest trace of Rz(roll) a bᵀ.
    between = b @ np.swapaxes(a, -1, -2)
    return np.asarray(np.arctan2(between[..., 1, 0] - between[..., 0, 1], between[..., 0, 0] + between[..., 1, 1]))


@dataclass(frozen=True)
class NeighbourViews:
    """Neighbouring directions of every direction.

    Attributes:
        views: (V,6) indices of the neighbours.
        rolls: (V,6) rad, roll at which a neighbour is most like the view.
    """

    views: NDArray[np.int32]
    rolls: Array


@dataclass(frozen=True)
class ViewOutlines:
    """Outlines of the part from directions spread over the declared range, seen along the optical axis.

    Attributes:
        points: (V,N,3) float32 points of outline and design edges in half diameters about the part's centre, in camera
            axes and in the order of `sector_order`.
        angles: (V,N) uint8 angles of their normals, 256 to the half turn.
        rotations: (V,3,3) of ``cam_from_body``.
        view_lines: (V,) distinct lines that the views show.
        groups: (V,) group of similar views, below `GROUPS`.
        near: nearest other directions.
        far: directions on all sides at `FAR_DEG`.
    """

    points: NDArray[np.float32]
    angles: NDArray[np.uint8]
    rotations: Array
    view_lines: Array
    groups: NDArray[np.int32]
    near: NeighbourViews
    far: NeighbourViews


@dataclass(frozen=True)
class TemplateBank:
    """Templates of one part at one size.

    Attributes:
        offsets: (T,N,2) int32 dx, dy ≥ 0 of the points.
        bins: (T,N) orientation bins of the points, see `orientation_bins`.
        origins: (T,2) place of the part's centre relative to the offsets.
        views: (T,) index of the outline.
        rolls: (T,) rad.
        groups: (T,) group of similar views.
        gains: (T,) factor of a match's key; larger for views that show many distinct lines.
    """

    offsets: NDArray[np.int32]
    bins: NDArray[np.uint8]
    origins: Array
    views: NDArray[np.int32]
    rolls: Array
    groups: NDArray[np.int32]
    gains: Array


def make_outlines(views: GuideViewSet, model_from_body: Array) -> ViewOutlines:
    """Outlines over the directions of the declared range.

    Args:
        views: guide views of the part; the one nearest to each direction of an icosphere is used.
        model_from_body: (4,4) from the part's centre to the model.

    Raises:
        InputError: no view shows an outline.
    """
    focal = 1000.0
    intrinsics = np.array([focal, focal, 0.0, 0.0, 0, 0, 0, 0, 0, 0])
    rows: list[tuple[Array, Array, Array, Array]] = []
    for index in _nearest_views(views, SUBDIVISIONS):
        view = views.view(int(index))
        cam_from_body = view.cam_from_model @ model_from_body
        found = _view_points(view.features, views.center_in_model, cam_from_body)
        if found is None:
            continue
        body, directions, across = found
        _, normals, depths = project_lines(body, directions, False, cam_from_body, intrinsics, 0.5)
        _, edge_normals, _ = project_lines(body, directions, True, cam_from_body, intrinsics, 0.5)
        normals = np.where(across, edge_normals, normals)
        # An edge along the line of sight has no direction in the image: replaced by another point.
        body[depths <= 0], normals[depths <= 0] = body[depths > 0][0], normals[depths > 0][0]
        shown = body @ cam_from_body[:3, :3].T / (0.5 * views.diameter_mm)
        angles = np.arctan2(normals[:, 1], normals[:, 0]) / np.pi
        order = sector_order(shown)
        rows.append((shown[order], angles[order], cam_from_body[:3, :3], views.directions[index]))
    if not rows:
        raise InputError("guide views: no view shows an outline; check the model and the declared distances")
    shown, angles, rotations, seen_from = (np.stack([row[k] for row in rows]) for k in range(4))
    near, far = _neighbours(seen_from, 6, FAR_DEG)
    line_counts = ViewLineCounts(views)
    return ViewOutlines(
        points=shown.astype(np.float32),
        angles=(np.round(angles * 256.0).astype(np.int64) % 256).astype(np.uint8),
        rotations=rotations,
        view_lines=np.array([line_counts.towards(direction) for direction in seen_from]),
        groups=np.argmax(seen_from @ icosphere_directions(1).T, axis=1).astype(np.int32),
        near=NeighbourViews(near, rolls_between(rotations[near], rotations[:, None])),
        far=NeighbourViews(far, rolls_between(rotations[far], rotations[:, None])),
    )


def sector_order(points: Array) -> NDArray[np.intp]:
    """Order (N,) of points (N,2 or more) by sectors about their mean; N is a multiple of `FIRST_POINTS`.

    Every block of `FIRST_POINTS` holds equally many points of each sector, one sector after another; `sector_of` gives
    the sector of a place in this order.
    """
    middle = points[:, :2].mean(axis=0)
    turn = np.argsort(np.arctan2(points[:, 1] - middle[1], points[:, 0] - middle[0]), kind="stable")
    sectors = turn.reshape(SECTORS, -1)
    mixed = sectors[:, np.random.default_rng(0).permutation(sectors.shape[1])]
    return mixed.reshape(SECTORS, -1, FIRST_POINTS // SECTORS).swapaxes(0, 1).ravel()


@kernel
def sector_of(place: int) -> int:
    """Sector of a point by its place in the order of `sector_order`."""
    return place // (FIRST_POINTS // SECTORS) % SECTORS


@kernel
def min_adjacent_pair(sums: NDArray[np.int64]) -> int:
    """Smallest sum of two adjacent sectors, from the sums (SECTORS,) of all."""
    smallest = sums[SECTORS - 1] + sums[0]
    for sector in range(1, SECTORS):
        smallest = min(smallest, sums[sector - 1] + sums[sector])
    return smallest


class ViewLineCounts:
    """Numbers of distinct lines that a part shows to each direction, computed when first needed.

    Args:
        views: guide views of the part.
        subdivisions: icosahedron level of the directions for which lines are counted.
    """

    def __init__(self, views: GuideViewSet, subdivisions: int = 3) -> None:
        self._views = views
        self._counted = _nearest_views(views, subdivisions)
        self._directions = views.directions[self._counted]
        self._known: dict[int, float] = {}

    def towards(self, direction: Array) -> float:
        """Distinct lines, at least 1, of the counted view nearest to a direction (3,)."""
        return self._of(int(self._counted[np.argmax(self._directions @ direction)]))

    @cached_property
    def mean(self) -> float:
        """Geometric mean over all counted views."""
        return float(np.exp(np.mean(np.log([self._of(int(index)) for index in self._counted]))))

    def _of(self, index: int) -> float:
        if index not in self._known:
            self._known[index] = max(view_lines(self._views.view(index), self._views.diameter_mm), 1.0)
        return self._known[index]


def _neighbours(directions: Array, count: int, far_deg: float) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Indices (V,count) of the nearest other unit vectors (V,3), and of some on all sides ``far_deg`` away."""
    tree = KDTree(directions)
    some = min(count, len(directions) - 1)
    near = tree.query(directions, np.arange(1, some + 2))[1][:, 1:]  # the first is the direction itself
    side = np.cross(directions, np.eye(3)[np.argmin(np.abs(directions), axis=1)])
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    other = np.cross(directions, side)
    far = np.empty((len(directions), count), dtype=np.int32)
    away = np.deg2rad(far_deg)
    for k, angle in enumerate(2.0 * np.pi * np.arange(count) / count):
        goal = np.cos(away) * directions + np.sin(away) * (np.cos(angle) * side + np.sin(angle) * other)
        far[:, k] = tree.query(goal)[1]
    return near.astype(np.int32), far


def _nearest_views(views: GuideViewSet, subdivisions: int) -> NDArray[np.intp]:
    """Indices of the views nearest to the directions of an icosphere within the declared range."""
    wanted = icosphere_directions(subdivisions)
    inside = views.view_range.contains_direction(wanted, 3.0)
    if not inside.any():
        return np.arange(len(views))
    return np.unique(KDTree(views.directions).query(wanted[inside])[1])


def outlines_near_icosphere(views: GuideViewSet, outlines: ViewOutlines, subdivisions: int) -> NDArray[np.intp]:
    """Indices of the outlines nearest to the directions of an icosphere of some icosahedron level."""
    wanted = np.stack([views.view(int(i)).cam_from_model[2, :3] for i in _nearest_views(views, subdivisions)])
    return np.unique(KDTree(outlines.rotations[:, 2]).query(wanted)[1])


def in_fundamental_domain(
    directions: Array, turns: Array, view_range: ViewRange, margin_deg: float = 14.0
) -> NDArray[np.bool_]:
    """Which of the directions to the camera represent all those that symmetries make equal.

    The fundamental domain is the part of the sphere that is closer to `DOMAIN_DIRECTION` than to its images under the
    symmetries. Images outside the declared range are ignored, and so are all symmetries where the rolls are limited.

    Args:
        directions: (V,3) unit vectors.
        turns: (R,3,3) rotations of the part onto itself.
        view_range: declared range.
        margin_deg: width by which the domain is extended, because templates on both sides of its border matter.
    """
    is_inside = np.ones(len(directions), dtype=np.bool_)
    low, high = view_range.roll_deg
    if high - low < 360.0:
        return is_inside
    for turn in turns:
        across = turn @ DOMAIN_DIRECTION - DOMAIN_DIRECTION
        is_farther = directions @ across > np.sin(np.deg2rad(margin_deg)) * np.linalg.norm(across)
        is_inside &= ~(is_farther & view_range.contains_direction(directions @ turn))
    return is_inside


def make_bank(
    outlines: ViewOutlines,
    chosen: NDArray[np.intp],
    rolls: Array,
    radius_px: float,
    nearness: float,
    gain_power: float = 0.2,
) -> TemplateBank:
    """Templates of chosen outlines at several rolls.

    Args:
        outlines: see `make_outlines`.
        chosen: (C,) indices of outlines.
        rolls: (R,) rad.
        radius_px: half the part's diameter in the templates.
        nearness: half the part's diameter relative to its distance.
        gain_power: power of the number of distinct lines by which matches of a view count.
    """
    # Shuffled, so that the threshold of `match_templates` rises early.
    mixed = np.random.default_rng(1).permutation(len(chosen) * len(rolls))
    shown, rolls = np.repeat(chosen, len(rolls))[mixed], np.tile(rolls, len(chosen))[mixed]
    points = outlines.points[shown].astype(np.float64)
    px = points[..., :2] * radius_px / (1.0 + nearness * points[..., 2:])
    c, s = np.cos(rolls)[:, None], np.sin(rolls)[:, None]
    turned = np.stack([c * px[..., 0] - s * px[..., 1], s * px[..., 0] + c * px[..., 1]], axis=-1)
    low = np.floor(turned.min(axis=1))
    angles = outlines.angles[shown] / 256.0 * np.pi + rolls[:, None]
    normals = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    return TemplateBank(
        offsets=np.round(turned - low[:, None]).astype(np.int32),
        bins=orientation_bins(normals.reshape(-1, 2)).reshape(angles.shape),
        origins=-low,
        views=shown.astype(np.int32),
        rolls=rolls,
        groups=outlines.groups[shown],
        gains=outlines.view_lines[shown] ** gain_power,
    )


def _view_points(
    features: ViewFeatures, center: Array, cam_from_body: Array
) -> tuple[Array, Array, NDArray[np.bool_]] | None:
    """Points of outline and design edges about the centre, with their directions.

    Returns:
        Points (N,3), directions (N,3): normals of the outline, tangents of edges, and (N,1) whether a direction is a
        tangent; None where the view shows too little of an outline.
    """
    contour = features.contour_points - center
    inner = (features.edge_kinds & EDGE_CONTOUR) == 0
    edges = features.edge_points[inner] - center
    is_ahead = (contour @ cam_from_body[2, :3] + cam_from_body[2, 3]) > 1.0
    contour, normals = contour[is_ahead], features.contour_normals[is_ahead]
    inner_count = min(len(edges), int(MAX_INNER_SHARE * POINTS))
    outer_count = POINTS - inner_count
    if len(contour) < 8:
        return None
    outer, inside = _spread(len(contour), outer_count), _spread(len(edges), inner_count)
    body = np.concatenate([contour[outer], edges[inside]])
    directions = np.concatenate([normals[outer], features.edge_tangents[inner][inside]])
    is_tangent = np.arange(len(body))[:, None] >= outer_count
    return np.ascontiguousarray(body), np.ascontiguousarray(directions), is_tangent


def _spread(available: int, wanted: int) -> NDArray[np.intp]:
    """Indices of ``wanted`` evenly spread items of ``available`` ones."""
    return np.floor((np.arange(wanted) + 0.5) * available / max(wanted, 1)).astype(np.intp)
