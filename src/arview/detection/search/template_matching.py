"""Matching of templates on response maps, over the whole image.

The score of a template at a place is the mean response under its points: Hinterstoisser et al., "Gradient Response Maps
for Real-Time Detection of Textureless Objects" (PAMI 2012). Matches are compared by how far they stand out from the
typical score of the same template in this image, times a gain for views with many distinct lines, so that plain views
do not win in clutter. Each group of similar views keeps its own best, because some views fit any clutter and would
displace the others. The threshold of a group rises as better matches are found, which cuts most of the work short.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from arview.core.kernel import kernel
from arview.detection.features.response_maps import ORIENTATIONS
from arview.detection.search.template_bank import (
    FIRST_POINTS,
    SECTORS,
    TRIMMED_SHARE,
    min_adjacent_pair,
    sector_of,
)

FIRST_MARGIN = 0.035
"""Margin by which the mean of the first points may stay below the required score."""
TILE = 1024
"""Places summed together, so that their sums stay in the first-level cache."""
SAMPLE, SAMPLE_EVERY = 64, 192
"""Length and spacing of the runs of places from which a template's typical score is estimated."""
TYPICAL_SHARE = 0.7
"""Share of a template's typical score in this image that is subtracted from its matches."""
BLOCK = 64
"""Places skipped together where none reaches the threshold."""
KEY_STEP = 0.005
"""Width of the bins in which keys are counted."""
MIN_INSIDE = 0.4
"""Share of an outline inside the picture below which it matches nowhere; few points fit anything."""


def decimate(maps: NDArray[np.uint8], step: int) -> NDArray[np.uint8]:
    """Response maps split into the phases of a grid, each contiguous, in 0–63.

    Args:
        maps: (8,H,W) uint8.
        step: spacing of the grid.

    Returns:
        (8, step, step, ceil(H / step), ceil(W / step)) uint8.
    """
    count, height, width = maps.shape
    rows, columns = -(-height // step), -(-width // step)
    padded = np.zeros((count, rows * step, columns * step), dtype=np.uint8)
    np.right_shift(maps, 2, out=padded[:, :height, :width])
    return np.ascontiguousarray(padded.reshape(count, rows, step, columns, step).transpose(0, 2, 4, 1, 3))


def decimate_with_border(maps: NDArray[np.uint8], step: int, pad_px: int, margin_px: int) -> NDArray[np.uint8]:
    """Response maps as `decimate` splits them, with a wider border and a ninth plane that is 1 inside the picture.

    Args:
        maps: (8,H,W) uint8.
        step: spacing of the grid.
        pad_px: empty border of the maps.
        margin_px: empty border added to it.
    """
    count, height, width = maps.shape
    wide = np.zeros((count + 1, height + 2 * margin_px, width + 2 * margin_px), dtype=np.uint8)
    wide[:-1, margin_px : margin_px + height, margin_px : margin_px + width] = maps
    border = pad_px + margin_px
    wide[-1, border:-border, border:-border] = 4  # 1 after `decimate`
    return decimate(wide, step)


@kernel
def _add_points(
    total: NDArray[np.uint16],
    flat: NDArray[np.uint8],
    source: NDArray[np.int64],
    shift: NDArray[np.int64],
    start: int,
    size: int,
    first: int,
    last: int,
) -> None:
    """Add the responses under points ``first`` to ``last`` to the sums of a tile, four points at a time in 8 bits."""
    for i in range(first, last, 4):
        a = flat[source[i], shift[i] + start : shift[i] + start + size]
        b = flat[source[i + 1], shift[i + 1] + start : shift[i + 1] + start + size]
        c = flat[source[i + 2], shift[i + 2] + start : shift[i + 2] + start + size]
        d = flat[source[i + 3], shift[i + 3] + start : shift[i + 3] + start + size]
        for k in range(size):
            total[k] += np.uint8(a[k] + b[k] + c[k] + d[k])


@kernel
def _add_trimmed(
    total: NDArray[np.uint16],
    own: NDArray[np.uint16],
    lowest: NDArray[np.uint16],
    flat: NDArray[np.uint8],
    source: NDArray[np.int64],
    shift: NDArray[np.int64],
    start: int,
    size: int,
) -> None:
    """Add the responses under the first points, without the adjacent pair of sectors that has the lowest sum."""
    each = FIRST_POINTS // SECTORS
    for sector in range(SECTORS):
        one = own[sector]
        one[:size] = 0
        _add_points(
            one, flat, source, shift=shift, start=start, size=size, first=sector * each, last=(sector + 1) * each
        )
        for k in range(size):
            total[k] += one[k]
    lowest[:size] = 65535
    for sector in range(SECTORS):
        one, two = own[sector - 1], own[sector]
        for k in range(size):
            lowest[k] = min(lowest[k], np.uint16(one[k] + two[k]))
    for k in range(size):
        total[k] -= lowest[k]


@kernel
def _threshold(votes: NDArray[np.int64], kept: int) -> float:
    """Key that about ``kept`` of the matches counted in ``votes`` (1024,) reach."""
    above = 0
    for level in range(len(votes) - 1, 0, -1):
        above += votes[level]
        if above >= kept:
            return level * KEY_STEP
    return 0.0


@kernel
def _surviving(
    keys: NDArray[np.float64], groups: NDArray[np.int32], found: int, votes: NDArray[np.int64], kept: int
) -> NDArray[np.int64]:
    """Indices of those of the first ``found`` matches that still reach the thresholds of their groups."""
    thresholds = np.array([_threshold(votes[g], kept) for g in range(len(votes))])
    return np.array([i for i in range(found) if keys[i] >= thresholds[groups[i]]], dtype=np.int64)


@kernel(inline=True)
def _place_points(offsets: Any, bins: Any, step: Any, columns: Any, source: Any, shift: Any) -> Any:
    """Write plane and offset of each point of a template in the decimated maps, and return its largest dx and dy."""
    reach_x = 0
    reach_y = 0
    for i in range(bins.shape[0]):
        dx, dy = offsets[i, 0], offsets[i, 1]
        reach_x = max(reach_x, dx)
        reach_y = max(reach_y, dy)
        source[i] = (bins[i] * step + dy % step) * step + dx % step
        shift[i] = (dy // step) * columns + dx // step
    return reach_x, reach_y


@kernel(inline=True)
def _sum_first_points(
    total: Any, own: Any, lowest: Any, flat: Any, source: Any, shift: Any, span: Any, is_trimmed: Any
) -> Any:
    """Write the sums of the first points at ``span`` places to ``total``, tile by tile."""
    for start in range(0, span, TILE):
        size = min(TILE, span - start)
        total[start : start + size] = 0
        if is_trimmed:
            _add_trimmed(
                total[start : start + size], own, lowest, flat=flat, source=source, shift=shift, start=start, size=size
            )
        else:
            _add_points(
                total[start : start + size],
                flat,
                source,
                shift=shift,
                start=start,
                size=size,
                first=0,
                last=FIRST_POINTS,
            )


@kernel(inline=True)
def _sum_at(flat: Any, source: Any, shift: Any, k: Any, sums: Any, is_trimmed: Any) -> Any:
    """Sum under all points at place ``k``, without the lowest adjacent pair of sectors if trimmed."""
    sums[:] = 0
    for i in range(source.shape[0]):
        sums[sector_of(i)] += np.int64(flat[source[i], shift[i] + k])
    return np.sum(sums) - (min_adjacent_pair(sums) if is_trimmed else 0)


@kernel(inline=True)
def _sampled_mean(total: Any, span: Any) -> Any:
    """Mean over sampled places."""
    count = 0
    sampled = np.uint64(0)
    for start in range(0, span, SAMPLE_EVERY):
        size = min(SAMPLE, span - start)
        for k in range(start, start + size):
            sampled += np.uint64(total[k])
        count += size
    return sampled / count


@kernel
def visible_score(score: float, share: float, floor: float) -> float:
    """Mean response under an outline of which only a share is inside the picture.

    What it exceeds a typical response by shrinks with the square root of the share, as the standard error of a mean
    grows: fewer points fit by chance more often.

    Args:
        score: sum of the responses over the number of all points, 0–1; those outside the picture add nothing.
        share: of the points that are inside.
        floor: typical response.
    """
    if share >= 1.0:
        return score
    if share < MIN_INSIDE:
        return 0.0
    root = np.sqrt(share)
    return score / root + floor * (1.0 - root)


@kernel(inline=True)
def _add_inside(inside: Any, flat: Any, source: Any, shift: Any, span: Any) -> Any:
    """Write how many of the first points are inside the picture at ``span`` places."""
    for start in range(0, span, TILE):
        size = min(TILE, span - start)
        inside[start : start + size] = 0
        _add_points(
            inside[start : start + size], flat, source, shift=shift, start=start, size=size, first=0, last=FIRST_POINTS
        )


@kernel(inline=True)
def _make_visible(total: Any, inside: Any, span: Any, counted: Any, floor: Any, full: Any) -> Any:
    """Replace the sums at ``span`` places by those of `visible_score`; ``counted`` of the first points count."""
    factors, offsets = np.zeros(FIRST_POINTS + 1), np.zeros(FIRST_POINTS + 1)
    for n in range(FIRST_POINTS + 1):
        offsets[n] = full * visible_score(0.0, min(n / counted, 1.0), floor)
        factors[n] = visible_score(1.0, min(n / counted, 1.0), floor) - offsets[n] / full
    for k in range(span):
        n = inside[k]
        if n < counted:
            total[k] = np.uint16(factors[n] * total[k] + offsets[n])


@kernel(inline=True)
def _is_peak(total: Any, k: Any, span: Any, columns: Any) -> Any:
    """Whether place ``k`` is the maximum among its four neighbours; of equal neighbours the last one is."""
    value = total[k]
    if (k > 0 and total[k - 1] > value) or (k + 1 < span and total[k + 1] >= value):
        return False
    return not ((k >= columns and total[k - columns] > value) or (k + columns < span and total[k + columns] >= value))


@kernel
def _compact(
    keys: NDArray[np.float64],
    templates: NDArray[np.int32],
    cells: NDArray[np.int32],
    groups: NDArray[np.int32],
    found: int,
    votes: NDArray[np.int64],
    kept: int,
) -> int:
    """Move the surviving matches to the front of full buffers, and return their number.

    More than half of the buffer survives only if thousands have the same key; any of these will do.
    """
    left = _surviving(keys, groups[templates], found, votes, kept)
    found = min(len(left), len(keys) // 2)
    keys[:found] = keys[left[:found]]
    templates[:found] = templates[left[:found]]
    cells[:found] = cells[left[:found]]
    return found


@kernel
def _places(cells: NDArray[np.int32], columns: int, step: int) -> NDArray[np.int32]:
    """Places (M,2) int32 in full pixels of cells (M,) of the grid."""
    places = np.empty((len(cells), 2), dtype=np.int32)
    for n in range(len(cells)):
        places[n, 0] = cells[n] % columns * step
        places[n, 1] = cells[n] // columns * step
    return places


@kernel
def match_templates(
    phases: NDArray[np.uint8], offsets: NDArray[np.int32], bins: NDArray[np.uint8], gains: NDArray[np.float64],
    groups: NDArray[np.int32], first_template: int, last_template: int, kept: int, min_score: float,
    votes: NDArray[np.int64], is_trimmed: bool
) -> tuple[NDArray[np.float64], NDArray[np.int32], NDArray[np.int32]]:  # fmt: skip
    """Matches that stand out most, of each group of templates.

    Args:
        phases: decimated response maps of `decimate` or `decimate_with_border`. With the latter, an outline cut by the
            picture's border is scored by its points inside, see `visible_score`.
        offsets, bins, gains, groups: see `TemplateBank`.
        first_template, last_template: range of the templates that are matched.
        kept: approximate number of matches returned for each group over all calls that share ``votes``; some more are
            returned that later matches outdo.
        min_score: mean response below which a match is noise.
        votes: (GROUPS, 1024) int64 histograms of the groups' keys in steps of `KEY_STEP`, updated.
        is_trimmed: leave out the two adjacent sectors with the lowest responses, which may be occluded.

    Returns:
        keys (M,), templates (M,), and places (M,2) of the offsets' origin in full pixels.
    """
    step = phases.shape[1]
    rows, columns = phases.shape[3], phases.shape[4]
    flat = phases.reshape((phases.shape[0] * step * step, rows * columns))
    points = bins.shape[1]
    total = np.empty(rows * columns + BLOCK, dtype=np.uint16)
    source, shift = np.empty(points, dtype=np.int64), np.empty(points, dtype=np.int64)
    room = 4 * kept * len(votes) + 4096
    keys = np.empty(room)
    templates, cells = np.empty(room, dtype=np.int32), np.empty(room, dtype=np.int32)
    found = 0
    has_border = phases.shape[0] > ORIENTATIONS
    inside = np.empty(rows * columns + BLOCK if has_border else 1, dtype=np.uint16)
    own, lowest = np.empty((SECTORS, TILE), dtype=np.uint16), np.empty(TILE, dtype=np.uint16)
    mask, sums = source, np.empty(SECTORS, dtype=np.int64)
    counted = 1.0 - TRIMMED_SHARE if is_trimmed else 1.0
    full, first_full = 63.0 * points * counted, 63.0 * FIRST_POINTS * counted
    for t in range(first_template, last_template):
        reach_x, reach_y = _place_points(offsets[t], bins[t], step, columns, source, shift)
        last_row = rows - reach_y // step - 1
        last_column = columns - reach_x // step - 1
        if last_row < 1 or last_column < 1:
            continue
        span = (last_row - 1) * columns + last_column
        _sum_first_points(total, own, lowest, flat, source, shift, span, is_trimmed)
        typical = TYPICAL_SHARE * _sampled_mean(total, span) / first_full
        if has_border:
            mask = source % (step * step) + ORIENTATIONS * step * step
            _add_inside(inside, flat, mask, shift, span)
            typical *= FIRST_POINTS / max(_sampled_mean(inside, span), 1.0)
            _make_visible(total, inside, span, counted * FIRST_POINTS, typical, first_full)
        required = max(min_score, typical + _threshold(votes[groups[t]], kept) / gains[t])
        if required > 1.0:
            continue
        limit = np.uint16(max((required - FIRST_MARGIN) * first_full, 1.0))
        for start in range(0, span, BLOCK):
            stop = min(start + BLOCK, span)
            highest = np.uint16(0)
            for k in range(start, stop):
                highest = max(highest, total[k])
            if highest < limit:
                continue
            for k in range(start, stop):
                if total[k] < limit or k % columns >= last_column or not _is_peak(total, k, span, columns):
                    continue
                share = _sum_at(flat, source, shift, k, sums, is_trimmed) / full
                if has_border:
                    shown = _sum_at(flat, mask, shift, k, sums, False) / (counted * points)
                    share = visible_score(share, min(shown, 1.0), typical)
                if share < required:
                    continue
                if found == room:
                    found = _compact(keys, templates, cells, groups, found, votes, kept)
                keys[found] = (share - typical) * gains[t]
                templates[found] = t
                cells[found] = k
                votes[groups[t], min(int(keys[found] / KEY_STEP), votes.shape[1] - 1)] += 1
                found += 1
    best = _surviving(keys, groups[templates[:found]], found, votes, kept)
    return keys[best], templates[best], _places(cells[best], columns, step)
