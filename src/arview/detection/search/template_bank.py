"""The first search: every guide view at every roll, place and distance, by oriented-gradient templates.

The picture becomes a response map for each of eight edge orientations, spread so that small errors of the template
do not matter; a template is a short list of (dx, dy, orientation) and its score at a place is the mean response
under its points: Hinterstoisser et al., "Gradient Response Maps for Real-Time Detection of Textureless Objects"
(PAMI 2012). Own here: matches are compared by how far they stand out from what the same template scores elsewhere
in this picture, and by how many distinct lines they explain, so that plain views do not win in clutter; each group of
like views at each scale keeps its best, for some fit any clutter and would crowd out the others; and the bar that a
match must clear rises as better ones of its group are found, so that most of the work is cut short.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from arview.core.kernel import kernel
from arview.detection.features.response_maps import orientation_bins
from arview.errors import InputError
from arview.geometry import Array, rolls_between
from arview.guideviews import GuideViewSet
from arview.guideviews.extract import ViewFeatures
from arview.guideviews.mesh_edges import EDGE_CONTOUR
from arview.guideviews.sphere import icosphere_directions
from arview.guideviews.uniqueness import view_lines
from arview.refinement.projection import project_lines

FIRST_POINTS = 32
"""So many points of a template are looked at everywhere, the others only where these bode well."""
SECTORS = 8
"""Of an outline, about its middle, equally many points in each. Two side by side may be spared."""
TRIMMED_SHARE = 2.0 / SECTORS
FIRST_MARGIN = 0.035
"""The mean of the first points may be so much lower than the score asked for."""
TILE = 1024
"""Places looked at together: their sums stay in the nearest cache."""
SAMPLE, SAMPLE_EVERY = 64, 192
"""Runs of places from which a template's usual score is taken."""
USUAL_SHARE = 0.7
"""So much of what a template scores anywhere in a picture says nothing of a place."""
LINES_POWER = 0.2
"""Of the distinct lines of a view, by which its matches count."""
BLOCK = 64
"""Places passed over together where none of them bodes well."""
KEY_STEP = 0.005
"""Keys are counted in steps of this."""
OUTLINE_SUBDIVISIONS, LINES_SUBDIVISIONS = 4, 3
"""Of the icospheres of directions that have an outline (2,562, about 4° apart), and whose lines are counted."""
GROUP_SUBDIVISIONS, GROUPS = 1, 42
"""Of the icosphere whose directions part the views in groups, about 35° apart."""
FAR_DEG = 8.5
"""Twice as far as the directions are apart."""


@dataclass(frozen=True)
class NeighbourViews:
    """Directions around each of some: their indices (V,6), and (V,6) rad, the roll that brings each closest."""

    views: NDArray[np.int32]
    turns: Array


@dataclass(frozen=True)
class ViewOutlines:
    """What the part shows from directions spread over the declared range, seen along the optical axis.

    Attributes:
        points: (V,N,3) float32 of outline and design edges, in halves of the part's diameter about its centre, in
            the axes of the camera; in the order `sector_order`.
        angles: (V,N) uint8 of their normals, 256 to the half turn.
        rotations: (V,3,3) of ``cam_from_body``.
        lines: (V,) distinct lines shown.
        groups: (V,) of like views, `GROUPS` at most.
        near: the nearest other directions; far: some on all sides, `FAR_DEG` away.
    """

    points: NDArray[np.float32]
    angles: NDArray[np.uint8]
    rotations: Array
    lines: Array
    groups: NDArray[np.int32]
    near: NeighbourViews
    far: NeighbourViews


@dataclass(frozen=True)
class TemplateBank:
    """Templates of one part.

    Attributes:
        offsets: (T,N,2) int32 dx, dy ≥ 0 of the points; bins: (T,N) orientations, see `orientation_bins`.
        origins: (T,2) place of the part's centre in the frame of the offsets.
        views: (T,) of the outlines; rolls: (T,) rad; groups: (T,) of like views.
        gains: (T,) by which a match counts: more for views that show many distinct lines.
    """

    offsets: NDArray[np.int32]
    bins: NDArray[np.uint8]
    origins: Array
    views: NDArray[np.int32]
    rolls: Array
    groups: NDArray[np.int32]
    gains: Array


def make_outlines(views: GuideViewSet, model_from_body: Array, points: int) -> ViewOutlines:
    """ViewOutlines over the directions of the declared range.

    Args:
        views: of the part; the nearest to each direction of an icosphere is taken.
        model_from_body: (4,4) to the model's centre.
        points: per view; views with few points repeat some.

    Raises:
        InputError: no view shows an outline.
    """
    focal = 1000.0
    intrinsics = np.array([focal, focal, 0.0, 0.0, 0, 0, 0, 0, 0, 0])
    rows: list[tuple[Array, Array, Array, Array]] = []
    for index in _nearest_views(views, OUTLINE_SUBDIVISIONS):
        view = views.view(int(index))
        cam_from_body = view.cam_from_model @ model_from_body
        found = _view_points(view.features, views.center_in_model, cam_from_body, points)
        if found is None:
            continue
        body, directions, across = found
        _, normals, depths = project_lines(body, directions, False, cam_from_body, intrinsics, 0.5)
        _, edge_normals, _ = project_lines(body, directions, True, cam_from_body, intrinsics, 0.5)
        normals = np.where(across, edge_normals, normals)
        # A direction along the line of sight has none in the picture: another point stands in.
        body[depths <= 0], normals[depths <= 0] = body[depths > 0][0], normals[depths > 0][0]
        shown = body @ cam_from_body[:3, :3].T / (0.5 * views.diameter_mm)
        angles = np.arctan2(normals[:, 1], normals[:, 0]) / np.pi
        order = sector_order(shown)
        rows.append((shown[order], angles[order], cam_from_body[:3, :3], views.directions[index]))
    if not rows:
        raise InputError("guide views: no view shows an outline; check the model and the declared distances")
    shown, angles, rotations, seen_from = (np.stack([row[k] for row in rows]) for k in range(4))
    near, far = _around(seen_from, 6)
    shown_lines = ViewLineCounts(views)
    return ViewOutlines(
        points=shown.astype(np.float32),
        angles=(np.round(angles * 256.0).astype(np.int64) % 256).astype(np.uint8),
        rotations=rotations,
        lines=np.array([shown_lines.towards(direction) for direction in seen_from]),
        groups=np.argmax(seen_from @ icosphere_directions(GROUP_SUBDIVISIONS).T, axis=1).astype(np.int32),
        near=NeighbourViews(near, rolls_between(rotations[near], rotations[:, None])),
        far=NeighbourViews(far, rolls_between(rotations[far], rotations[:, None])),
    )


def sector_order(shown: Array) -> NDArray[np.intp]:
    """An order of points (N,2+), N a multiple of `FIRST_POINTS`: of each so many, some of one sector after another.

    Sectors lie about the middle; a point's is `sector_of` its place in the order.
    """
    middle = shown[:, :2].mean(axis=0)
    turn = np.argsort(np.arctan2(shown[:, 1] - middle[1], shown[:, 0] - middle[0]), kind="stable")
    sectors = turn.reshape(SECTORS, -1)
    mixed = sectors[:, np.random.default_rng(0).permutation(sectors.shape[1])]
    return mixed.reshape(SECTORS, -1, FIRST_POINTS // SECTORS).swapaxes(0, 1).ravel()


@kernel
def sector_of(place):  # type: ignore[no-untyped-def]
    """The sector of a point by its place in the order of outlines."""
    return place // (FIRST_POINTS // SECTORS) % SECTORS


@kernel
def min_adjacent_pair(sums):  # type: ignore[no-untyped-def]
    """The least that two sectors side by side have of the sums (SECTORS,) of all."""
    least = sums[SECTORS - 1] + sums[0]
    for sector in range(1, SECTORS):
        least = min(least, sums[sector - 1] + sums[sector])
    return least


class ViewLineCounts:
    """Distinct lines that a part shows to each direction, counted when first asked for."""

    def __init__(self, views: GuideViewSet) -> None:
        self._views = views
        self._counted = _nearest_views(views, LINES_SUBDIVISIONS)
        self._directions = views.directions[self._counted]
        self._known: dict[int, float] = {}

    def towards(self, direction: Array) -> float:
        """Lines, at least 1, of that view of an icosphere which is nearest to a direction (3,)."""
        return self._of(int(self._counted[np.argmax(self._directions @ direction)]))

    @cached_property
    def usual(self) -> float:
        """Geometric mean over all of these views."""
        return float(np.exp(np.mean(np.log([self._of(int(index)) for index in self._counted]))))

    def _of(self, index: int) -> float:
        if index not in self._known:
            self._known[index] = max(view_lines(self._views.view(index), self._views.diameter_mm), 1.0)
        return self._known[index]


def _around(directions: Array, count: int) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Of unit vectors (V,3), indices (V,count) of the nearest others, and of some on all sides `FAR_DEG` away."""
    tree = KDTree(directions)
    some = min(count, len(directions) - 1)
    near = tree.query(directions, np.arange(1, some + 2))[1][:, 1:]  # the first is the direction itself
    side = np.cross(directions, np.eye(3)[np.argmin(np.abs(directions), axis=1)])
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    other = np.cross(directions, side)
    far = np.empty((len(directions), count), dtype=np.int32)
    away = np.deg2rad(FAR_DEG)
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
    return np.unique(np.argmax(wanted[inside] @ views.directions.T, axis=1))


def outlines_around(views: GuideViewSet, outlines: ViewOutlines, subdivisions: int) -> NDArray[np.intp]:
    """Indices of the outlines nearest to the directions of an icosphere; 2 gives 162 directions, about 17° apart."""
    wanted = np.stack([views.view(int(i)).cam_from_model[2, :3] for i in _nearest_views(views, subdivisions)])
    return np.unique(np.argmax(wanted @ outlines.rotations[:, 2].T, axis=1))


def make_bank(
    outlines: ViewOutlines, chosen: NDArray[np.intp], rolls: Array, radius_px: float, nearness: float
) -> TemplateBank:
    """Templates of chosen outlines at all of some rolls.

    Args:
        outlines: see `make_outlines`; chosen: (C,) indices of them.
        rolls: (R,) rad.
        radius_px: half the part's diameter in the templates.
        nearness: half the part's diameter over its distance.
    """
    # Mixed, so that the bar rises early.
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
        gains=outlines.lines[shown] ** LINES_POWER,
    )


def _view_points(
    features: ViewFeatures, center: Array, cam_from_body: Array, points: int
) -> tuple[Array, Array, NDArray[np.bool_]] | None:
    """Outline and design-edge points (N,3) in the body, directions (N,3), and (N,1) whether these run along an edge."""
    contour = features.contour_points - center
    inner = (features.edge_kinds & EDGE_CONTOUR) == 0
    edges = features.edge_points[inner] - center
    is_ahead = (contour @ cam_from_body[2, :3] + cam_from_body[2, 3]) > 1.0
    contour, normals = contour[is_ahead], features.contour_normals[is_ahead]
    inner_count = min(len(edges), int(0.35 * points))
    outer_count = points - inner_count
    if len(contour) < 8:
        return None
    outer, inside = _spread(len(contour), outer_count), _spread(len(edges), inner_count)
    body = np.concatenate([contour[outer], edges[inside]])
    directions = np.concatenate([normals[outer], features.edge_tangents[inner][inside]])
    across = np.arange(len(body))[:, None] >= outer_count
    return np.ascontiguousarray(body), np.ascontiguousarray(directions), across


def _spread(available: int, wanted: int) -> NDArray[np.intp]:
    return np.floor((np.arange(wanted) + 0.5) * available / max(wanted, 1)).astype(np.intp)


def decimate(maps: NDArray[np.uint8], step: int) -> NDArray[np.uint8]:
    """(8, step, step, ceil(H/step), ceil(W/step)): phases of the maps apart, each contiguous, in 0–63."""
    count, height, width = maps.shape
    rows, columns = -(-height // step), -(-width // step)
    padded = np.zeros((count, rows * step, columns * step), dtype=np.uint8)
    np.right_shift(maps, 2, out=padded[:, :height, :width])
    return np.ascontiguousarray(padded.reshape(count, rows, step, columns, step).transpose(0, 2, 4, 1, 3))


@kernel
def _add_points(total, flat, source, shift, start, size, first, last):  # type: ignore[no-untyped-def]
    """Add the responses under points first to last to the sums of a tile, four points at a time in 8 bits."""
    for i in range(first, last, 4):
        a = flat[source[i], shift[i] + start : shift[i] + start + size]
        b = flat[source[i + 1], shift[i + 1] + start : shift[i + 1] + start + size]
        c = flat[source[i + 2], shift[i + 2] + start : shift[i + 2] + start + size]
        d = flat[source[i + 3], shift[i + 3] + start : shift[i + 3] + start + size]
        for k in range(size):
            total[k] += np.uint8(a[k] + b[k] + c[k] + d[k])


@kernel
def _add_but_a_pair(total, own, least, flat, source, shift, start, size):  # type: ignore[no-untyped-def]
    """Add the responses under the first points, but those of the pair of sectors that have the least."""
    each = FIRST_POINTS // SECTORS
    for sector in range(SECTORS):
        one = own[sector]
        one[:size] = 0
        _add_points(one, flat, source, shift, start, size, sector * each, (sector + 1) * each)
        for k in range(size):
            total[k] += one[k]
    least[:size] = 65535
    for sector in range(SECTORS):
        one, two = own[sector - 1], own[sector]
        for k in range(size):
            least[k] = min(least[k], np.uint16(one[k] + two[k]))
    for k in range(size):
        total[k] -= least[k]


@kernel
def _bar(votes, kept):  # type: ignore[no-untyped-def]
    """The key that about ``kept`` of the matches counted in ``votes`` (1024,) reach."""
    above = 0
    for level in range(len(votes) - 1, 0, -1):
        above += votes[level]
        if above >= kept:
            return level * KEY_STEP
    return 0.0


@kernel
def _still_in(keys, groups, found, votes, kept):  # type: ignore[no-untyped-def]
    """Indices of those of the first ``found`` matches that clear the bars of their groups by now."""
    bars = np.array([_bar(votes[g], kept) for g in range(len(votes))])
    return np.array([i for i in range(found) if keys[i] >= bars[groups[i]]], dtype=np.int64)


@kernel
def match_templates(  # type: ignore[no-untyped-def]
    phases, offsets, bins, gains, groups, first_template, last_template, kept, lowest, votes, is_trimmed
):
    """The matches that stand out most, of each group of templates.

    Args:
        phases: from `decimate`.
        offsets, bins, gains, groups: see `TemplateBank`; the templates from first to last are matched.
        kept: about so many matches of each group are returned, over all calls that share ``votes``, and some that
            later ones outdo.
        lowest: mean response below which a match is noise.
        votes: (GROUPS, 1024) int64, how many matches of a group have a key of so many `KEY_STEP`, over all calls that
            share it.
        is_trimmed: the two sectors side by side with the least do not count: something may hide them.

    Returns:
        keys (M,) by which matches compare, templates (M,), places (M,2) of the offsets' origin in full pixels.
    """
    step = phases.shape[1]
    rows, columns = phases.shape[3], phases.shape[4]
    flat = phases.reshape((phases.shape[0] * step * step, rows * columns))
    points = bins.shape[1]
    total = np.empty(rows * columns + BLOCK, dtype=np.uint16)
    source = np.empty(points, dtype=np.int64)
    shift = np.empty(points, dtype=np.int64)
    room = 4 * kept * len(votes) + 4096
    keys = np.empty(room)
    templates = np.empty(room, dtype=np.int32)
    cells = np.empty(room, dtype=np.int32)
    found = 0
    own = np.empty((SECTORS, TILE), dtype=np.uint16)
    least = np.empty(TILE, dtype=np.uint16)
    sums = np.empty(SECTORS, dtype=np.int64)
    counted = 1.0 - TRIMMED_SHARE if is_trimmed else 1.0
    full = 63.0 * points * counted
    first_full = 63.0 * FIRST_POINTS * counted
    for t in range(first_template, last_template):
        reach_x = 0
        reach_y = 0
        for i in range(points):
            dx, dy = offsets[t, i, 0], offsets[t, i, 1]
            reach_x = max(reach_x, dx)
            reach_y = max(reach_y, dy)
            source[i] = (bins[t, i] * step + dy % step) * step + dx % step
            shift[i] = (dy // step) * columns + dx // step
        last_row = rows - reach_y // step - 1
        last_column = columns - reach_x // step - 1
        if last_row < 1 or last_column < 1:
            continue
        span = (last_row - 1) * columns + last_column
        for start in range(0, span, TILE):
            size = min(TILE, span - start)
            total[start : start + size] = 0
            if is_trimmed:
                _add_but_a_pair(total[start : start + size], own, least, flat, source, shift, start, size)
            else:
                _add_points(total[start : start + size], flat, source, shift, start, size, 0, FIRST_POINTS)
        # What this template scores anywhere in this picture.
        count = 0
        anywhere = np.uint64(0)
        for start in range(0, span, SAMPLE_EVERY):
            size = min(SAMPLE, span - start)
            for k in range(start, start + size):
                anywhere += np.uint64(total[k])
            count += size
        usual = USUAL_SHARE * anywhere / (count * first_full)
        gain = gains[t]
        asked = max(lowest, usual + _bar(votes[groups[t]], kept) / gain)
        if asked > 1.0:
            continue
        limit = np.uint16(max((asked - FIRST_MARGIN) * first_full, 1.0))
        for start in range(0, span, BLOCK):
            stop = min(start + BLOCK, span)
            highest = np.uint16(0)
            for k in range(start, stop):
                highest = max(highest, total[k])
            if highest < limit:
                continue
            for k in range(start, stop):
                value = total[k]
                if value < limit or k % columns >= last_column:
                    continue
                # One of several places side by side is enough.
                if (k > 0 and total[k - 1] > value) or (k + 1 < span and total[k + 1] >= value):
                    continue
                if (k >= columns and total[k - columns] > value) or (
                    k + columns < span and total[k + columns] >= value
                ):
                    continue
                if is_trimmed:
                    sums[:] = 0
                    for i in range(points):
                        sums[sector_of(i)] += np.int64(flat[source[i], shift[i] + k])
                    sum_all = np.sum(sums) - min_adjacent_pair(sums)
                else:
                    sum_all = np.int64(value)
                    for i in range(FIRST_POINTS, points):
                        sum_all += np.int64(flat[source[i], shift[i] + k])
                share = sum_all / full
                if share < asked:
                    continue
                if found == room:
                    left = _still_in(keys, groups[templates], found, votes, kept)
                    # So many of one group only if thousands compare alike: any of them will do.
                    found = min(len(left), room // 2)
                    keys[:found] = keys[left[:found]]
                    templates[:found] = templates[left[:found]]
                    cells[:found] = cells[left[:found]]
                keys[found] = (share - usual) * gain
                templates[found] = t
                cells[found] = k
                votes[groups[t], min(int(keys[found] / KEY_STEP), votes.shape[1] - 1)] += 1
                found += 1
    best = _still_in(keys, groups[templates[:found]], found, votes, kept)
    places = np.empty((len(best), 2), dtype=np.int32)
    for n in range(len(best)):
        places[n, 0] = cells[best[n]] % columns * step
        places[n, 1] = cells[best[n]] // columns * step
    return keys[best], templates[best], places


@kernel
def select_distinct(rotations, positions, reach, cosine, distance_ratio, most):  # type: ignore[no-untyped-def]
    """Indices of at most ``most`` poses, best first as given, none near a better one.

    Args:
        rotations: (N,3,3); positions: (N,3) mm, best first.
        reach: of the position across the line of sight, as a share of the distance (N,).
        cosine: of the angle within which two are near; distance_ratio: the same for the distance.
    """
    chosen = np.empty(most, dtype=np.int64)
    count = 0
    total = rotations.shape[0]
    if total == 0:
        return chosen[:0]
    # Chosen ones in chains by the cell that they lie in: only those of cells nearby are compared.
    x, y = positions[:, 0] / positions[:, 2], positions[:, 1] / positions[:, 2]
    low_x, low_y = x.min(), y.min()
    cell = max(reach.max(), (x.max() - low_x) / 100.0, (y.max() - low_y) / 100.0, 1e-9)
    columns, rows = int((x.max() - low_x) / cell) + 3, int((y.max() - low_y) / cell) + 3
    head = np.full((rows, columns), -1, dtype=np.int64)
    following = np.empty(total, dtype=np.int64)
    for i in range(total):
        column, row = int((x[i] - low_x) / cell) + 1, int((y[i] - low_y) / cell) + 1
        is_near = False
        for around in range(9):
            j = head[row + around // 3 - 1, column + around % 3 - 1]
            while j >= 0:
                if abs(x[i] - x[j]) < reach[j] and abs(y[i] - y[j]) < reach[j]:
                    ratio = positions[i, 2] / positions[j, 2]
                    if ratio <= distance_ratio and ratio * distance_ratio >= 1.0:
                        trace = 0.0
                        for a in range(3):
                            for b in range(3):
                                trace += rotations[i, a, b] * rotations[j, a, b]
                        if 0.5 * (trace - 1.0) >= cosine:
                            is_near = True
                            break
                j = following[j]
            if is_near:
                break
        if not is_near:
            following[i] = head[row, column]
            head[row, column] = i
            chosen[count] = i
            count += 1
            if count == most:
                break
    return chosen[:count]
