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


@kernel
def _add_points(
    total: NDArray[np.uint16], flat: NDArray[np.uint8], source: NDArray[np.int64], shift: NDArray[np.int64],
    start: int, size: int, first: int, last: int
) -> None:  # fmt: skip
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
    total: NDArray[np.uint16], own: NDArray[np.uint16], lowest: NDArray[np.uint16], flat: NDArray[np.uint8],
    source: NDArray[np.int64], shift: NDArray[np.int64], start: int, size: int
) -> None:  # fmt: skip
    """Add the responses under the first points, without the adjacent pair of sectors that has the lowest sum."""
    each = FIRST_POINTS // SECTORS
    for sector in range(SECTORS):
        one = own[sector]
        one[:size] = 0
        _add_points(one, flat, source, shift, start, size, sector * each, (sector + 1) * each)
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
) -> NDArray[np.int64]:  # fmt: skip
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
) -> Any:  # fmt: skip
    """Write the sums of the first points at ``span`` places to ``total``, tile by tile."""
    for start in range(0, span, TILE):
        size = min(TILE, span - start)
        total[start : start + size] = 0
        if is_trimmed:
            _add_trimmed(total[start : start + size], own, lowest, flat, source, shift, start, size)
        else:
            _add_points(total[start : start + size], flat, source, shift, start, size, 0, FIRST_POINTS)


@kernel(inline=True)
def _typical_score(total: Any, span: Any, full: Any) -> Any:
    """Mean score of the first points over sampled places, times `TYPICAL_SHARE`; ``full`` is the largest sum."""
    count = 0
    sampled = np.uint64(0)
    for start in range(0, span, SAMPLE_EVERY):
        size = min(SAMPLE, span - start)
        for k in range(start, start + size):
            sampled += np.uint64(total[k])
        count += size
    return TYPICAL_SHARE * sampled / (count * full)


@kernel(inline=True)
def _is_peak(total: Any, k: Any, span: Any, columns: Any) -> Any:
    """Whether place ``k`` is the maximum among its four neighbours; of equal neighbours the last one is."""
    value = total[k]
    if (k > 0 and total[k - 1] > value) or (k + 1 < span and total[k + 1] >= value):
        return False
    return not ((k >= columns and total[k - columns] > value) or (k + columns < span and total[k + columns] >= value))


@kernel
def _compact(
    keys: NDArray[np.float64], templates: NDArray[np.int32], cells: NDArray[np.int32], groups: NDArray[np.int32],
    found: int, votes: NDArray[np.int64], kept: int
) -> int:  # fmt: skip
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
        phases: decimated response maps of `decimate`.
        offsets, bins, gains, groups: see `TemplateBank`.
        first_template, last_template: range of the templates that are matched.
        kept: approximate number of matches returned for each group over all calls that share ``votes``; some more are
            returned that later matches outdo.
        min_score: mean response below which a match is noise.
        votes: (GROUPS, 1024) int64 histograms of the groups' keys in steps of `KEY_STEP`, updated.
        is_trimmed: leave out the two adjacent sectors with the lowest responses, which may be occluded.

    Returns:
        keys (M,) by which matches compare, templates (M,), and places (M,2) of the offsets' origin in full pixels.
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
    own, lowest = np.empty((SECTORS, TILE), dtype=np.uint16), np.empty(TILE, dtype=np.uint16)
    sums = np.empty(SECTORS, dtype=np.int64)
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
        typical = _typical_score(total, span, first_full)
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
                if is_trimmed:
                    sums[:] = 0
                    for i in range(points):
                        sums[sector_of(i)] += np.int64(flat[source[i], shift[i] + k])
                    sum_all = np.sum(sums) - min_adjacent_pair(sums)
                else:
                    sum_all = np.int64(total[k])
                    for i in range(FIRST_POINTS, points):
                        sum_all += np.int64(flat[source[i], shift[i] + k])
                share = sum_all / full
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
