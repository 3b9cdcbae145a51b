"""Placement of labels: two columns beside the part, stable from frame to frame so that they stay readable.

Boundary labelling (Bekos et al., "Boundary labeling", 2007) with two columns. Within a column the order is kept from
frame to frame; the rows are found by dynamic programming over the area that a label covers, its distance from its
component and the distance it would have to move. Because the old and the new rows of a column do not overlap and have
the same order, rows in between do not overlap either, so labels can glide without crossing. A label that must change
column or order fades out and reappears at its new place.

Where leaders cross each other or labels, places without crossings are searched (`arview.overlay.leaders`): at once in
the first picture, later when the crossings last. A label for which there is no such place is left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from arview.core.kernel import kernel
from arview.geometry import Array
from arview.overlay.ghost import CELL_PX
from arview.overlay.leaders import LabelPlaces, count_crossings, leader_points, uncrossed

_ROW_PX = 4
"""Grid of the rows that are tried; a label does not move to a row nearer than this."""
_FADE_FRAMES = 6
"""Frames in which a label fades in or out."""
_REST_FRAMES = 30
"""Frames for which a label stays in a new column or order."""
_REQUIRED_INERTIA = 3.0
"""Factor of the cost of moving a label that must be shown, because it is away while it moves."""
_CROSSED_FRAMES = 6
"""Frames for which leaders may cross before other places are searched; twice as long after each search."""
_PLAN_FRAMES = 90
"""Frames for which labels stay in the columns in which they do not cross."""
_GLIDE = 0.16
"""Fraction of the remaining way that a label moves in a frame."""
_COVER_COST = 60.0
"""Cost of a label that covers components with its whole area; a distance of a tenth of the image's height costs 1."""
_ANCHOR_AREA = 1.5
"""Area that counts as covered where a label covers the anchor of another, in squared heights of a row of text."""
_STUB = 1.6
"""Length of the horizontal beginning of a leader, in gaps between labels."""
_SEARCH_ROWS = 100
"""Rows that are tried, at least, where crossings are removed."""
_SIDE_HYSTERESIS = 1.5
"""Advantage that the other column must have before a label changes, in the costs of ``_choose_side``."""


@dataclass(frozen=True)
class LabelRequest:
    """A label to be placed; requests are in order of urgency.

    Attributes:
        key: identifies the label from frame to frame.
        width, height: of its box, px.
        anchor_px: (2,) image point of its component.
        is_required: others give way to the label.
    """

    key: str
    width: int
    height: int
    anchor_px: Array
    is_required: bool = False


@dataclass(frozen=True)
class PlacedLabel:
    """Box of a label: upper left (x, y), size in px, on the left or right of the part, opacity 0–1.

    ``leader`` are the points of its line, from the box to the anchor.
    """

    key: str
    x: int
    y: int
    width: int
    height: int
    on_left: bool
    opacity: float
    leader: tuple[tuple[float, float], ...] = ()


@dataclass
class _Slot:
    """State of one label from frame to frame."""

    request: LabelRequest
    urgency: int
    on_left: bool
    y: float
    opacity: float
    age: int = 0
    is_leaving: bool = False

    @property
    def anchor_y(self) -> float:
        return float(self.request.anchor_px[1])


class LabelLayout:
    """Places labels in an image, stable from frame to frame.

    Labels lie between ``top_px`` and ``bottom_px`` of an image ``width`` px wide and never overlap. None is wider than
    ``widest_px``, which must leave room for two side by side.
    """

    def __init__(self, width: int, top_px: int, bottom_px: int, margin_px: int, gap_px: int, widest_px: int) -> None:
        self._width, self._top, self._bottom = width, top_px, bottom_px
        self._limits = (width - margin_px - widest_px - gap_px, margin_px + widest_px + gap_px)
        self._margin, self._gap = margin_px, gap_px
        self._rows = np.arange(top_px, bottom_px, _ROW_PX, dtype=np.float64)
        self._left: list[_Slot] = []
        self._right: list[_Slot] = []
        self._edges: tuple[float, float] | None = None
        self._stub = _STUB * gap_px
        self._plan: dict[str, tuple[bool, float]] = {}
        self._plan_frames = 0
        self._crossed_frames, self._wait_frames = 0, _CROSSED_FRAMES

    def set_bottom(self, bottom_px: int) -> None:
        """Change where labels must end."""
        if bottom_px != self._bottom:
            self._bottom = bottom_px
            self._rows = np.arange(self._top, bottom_px, _ROW_PX, dtype=np.float64)

    def reset(self) -> None:
        """Forget all labels: the next ones appear at once at their places."""
        self._left, self._right, self._edges = [], [], None
        self._plan.clear()
        self._crossed_frames, self._wait_frames = 0, _CROSSED_FRAMES

    def place(
        self,
        requests: list[LabelRequest],
        part_px: tuple[float, float],
        cells: NDArray[np.float32],
        others_px: Sequence[Array] = (),
    ) -> list[PlacedLabel]:
        """Boxes for one frame.

        Args:
            requests: labels wanted, the most urgent first.
            part_px: first and last column of the image that the part covers.
            cells: weighted covered area, px², of each cell of CELL_PX × CELL_PX of the image.
            others_px: (2,) image points, each, of components without a label that should not be covered either.

        Returns:
            Labels to draw, in any order; those for which there is no room are left out.
        """
        is_first = not (self._left or self._right)
        self._plan_frames += 1
        if self._plan_frames > _PLAN_FRAMES:
            self._plan.clear()
        self._move_edges(part_px)
        self._update_slots(requests)
        anchors = np.array([*(request.anchor_px for request in requests), *others_px], dtype=np.float64).reshape(-1, 2)
        integral = _integral(cells, anchors, _ANCHOR_AREA * (4.0 * self._gap) ** 2)
        goals = [self._goals(column, integral) for column in (self._left, self._right)]
        if not is_first and self._crosses_more(goals):
            goals = [np.array([slot.y for slot in column]) for column in (self._left, self._right)]
        for column, tops in zip((self._left, self._right), goals, strict=True):
            self._move(column, tops, is_first)
        self._uncross(integral, is_first)
        for column in (self._left, self._right):
            self._fade(column)
        return [self._box(slot) for slot in (*self._left, *self._right) if slot.opacity > 0]

    def _move_edges(self, part_px: tuple[float, float]) -> None:
        """Move the inner edges of both columns towards the part's sides."""
        limit_left, limit_right = self._limits
        goal_left = min(part_px[0] - self._gap, limit_left)
        goal_right = max(part_px[1] + self._gap, limit_right)
        if self._edges is None:
            left, right = goal_left, goal_right
        else:
            left, right = (self._glide(*pair) for pair in zip(self._edges, (goal_left, goal_right), strict=True))
        left, right = min(left, limit_left), max(right, limit_right)
        if right - left < self._gap:
            left, right = goal_left, goal_right
        self._edges = (left, right)

    def _glide(self, now: float, goal: float) -> float:
        fastest = max(3.0, self._bottom / 110.0)
        return now + min(max(_GLIDE * (goal - now), -fastest), fastest)

    def _x(self, request: LabelRequest, on_left: bool) -> float:
        assert self._edges is not None
        if on_left:
            return max(float(self._margin), self._edges[0] - request.width)
        return min(float(self._width - self._margin - request.width), self._edges[1])

    def _box(self, slot: _Slot) -> PlacedLabel:
        request = slot.request
        x, y = round(self._x(request, slot.on_left)), round(slot.y)
        box = (float(x), float(y), float(request.width), float(request.height))
        leader = tuple(leader_points(box, not slot.on_left, request.anchor_px, self._stub))
        return PlacedLabel(request.key, x, y, request.width, request.height, slot.on_left, slot.opacity, leader)

    def _update_slots(self, requests: list[LabelRequest]) -> None:
        """Update the anchors, choose columns, mark labels that must leave, insert new ones."""
        known = {slot.request.key: slot for slot in (*self._left, *self._right)}
        wanted = {request.key for request in requests}
        for key, slot in known.items():
            slot.age += 1
            if key not in wanted:
                slot.is_leaving = True
        free_px = {side: float(self._bottom - self._top) for side in (True, False)}
        for urgency, request in enumerate(requests):
            present = known.get(request.key)
            on_left = self._choose_side(request, present, free_px)
            if on_left is None:
                if present is not None:
                    present.is_leaving = True
                continue
            free_px[on_left] -= request.height + self._gap
            if present is None:
                self._insert(_Slot(request, urgency, on_left, np.nan, 0.0))
                continue
            present.request, present.urgency = request, urgency
            # A label that is fading out disappears completely, and reappears as a new one.
            present.is_leaving = present.is_leaving or present.on_left != on_left
        for column in (self._left, self._right):
            self._mark_disorder(column)

    def _choose_side(self, request: LabelRequest, present: _Slot | None, free_px: dict[bool, float]) -> bool | None:
        """True for left, False for right, None if neither column has room."""
        assert self._edges is not None
        planned = self._plan.get(request.key)
        if planned is not None and free_px[planned[0]] >= request.height + self._gap:
            return planned[0]
        room = [side for side in (True, False) if free_px[side] >= request.height + self._gap]
        if present is not None and present.age < _REST_FRAMES and present.on_left in room:
            return present.on_left
        costs = {}
        for side in room:
            edge = self._edges[0] if side else self._edges[1]
            space = edge - self._margin if side else self._width - self._margin - edge
            lack = min(max((request.width - space) / request.width, 0.0), 1.0)
            reach = abs(float(request.anchor_px[0]) - edge) / self._width
            fullness = 1.0 - free_px[side] / (self._bottom - self._top)
            costs[side] = 10.0 * reach + 5.0 * lack + 3.0 * fullness
            if present is not None and present.on_left == side:
                costs[side] -= _SIDE_HYSTERESIS
        return min(costs, key=costs.__getitem__) if costs else None

    def _insert(self, slot: _Slot) -> None:
        column = self._left if slot.on_left else self._right
        planned = self._plan.get(slot.request.key)
        if planned is None:
            place = sum(other.anchor_y < slot.anchor_y for other in column)
        else:
            tops = [other.anchor_y if np.isnan(other.y) else other.y for other in column]
            place = sum(top < planned[1] for top in tops)
        column.insert(place, slot)

    def _mark_disorder(self, column: list[_Slot]) -> None:
        """Let the less urgent of two neighbours leave if the order of their anchors has clearly changed."""
        for upper, lower in pairwise(column):
            by = upper.anchor_y - lower.anchor_y
            if by < 1.5 * max(upper.request.height, lower.request.height):
                continue
            if upper.is_leaving or lower.is_leaving or min(upper.age, lower.age) < _REST_FRAMES:
                continue
            (upper if upper.urgency > lower.urgency else lower).is_leaving = True
            return

    def _goals(self, column: list[_Slot], integral: Array) -> Array:
        """Best top (N,) of every label of a column, in its order."""
        self._drop_overflow(column)
        if not column:
            return np.zeros(0)
        heights = np.array([slot.request.height + self._gap for slot in column], dtype=np.float64)
        x0 = np.array([self._x(slot.request, slot.on_left) for slot in column])
        widths = np.array([slot.request.width for slot in column], dtype=np.float64)
        anchors = np.array([slot.anchor_y for slot in column]) - 0.5 * (heights - self._gap)
        previous = np.array([self._planned_y(slot) for slot in column])
        return _best_rows(
            self._rows, heights, self._gap, self._bottom, x0, widths, anchors, previous, integral, _COVER_COST
        )

    def _planned_y(self, slot: _Slot) -> float:
        planned = self._plan.get(slot.request.key)
        return planned[1] if np.isnan(slot.y) and planned is not None else slot.y

    def _move(self, column: list[_Slot], goals: Array, is_first: bool) -> None:
        """Move the labels of a column towards their goals, and show new ones where there is room."""
        for slot, goal in zip(column, goals, strict=True):
            if is_first or slot.opacity == 0:
                planned = self._planned_y(slot)
                slot.y = float(goal) if np.isnan(planned) or is_first else planned
            elif abs(goal - slot.y) > _ROW_PX:
                slot.y = self._glide(slot.y, float(goal))
        self._part([slot for slot in column if slot.opacity > 0])
        for place, slot in enumerate(column):
            if slot.opacity > 0 or slot.is_leaving:
                continue
            above = all(self._is_above(other, slot) for other in column[:place] if other.opacity > 0)
            below = all(self._is_above(slot, other) for other in column[place + 1 :] if other.opacity > 0)
            if above and below and (is_first or not self._would_cross(slot)):
                slot.opacity = 1.0 if is_first else 1.0 / _FADE_FRAMES

    def _places(self, slots: list[_Slot], tops: Array) -> LabelPlaces:
        assert self._edges is not None
        left, right = self._edges
        low, high = float(self._margin), float(self._width - self._margin)
        x = [[max(low, left - one.request.width), min(high - one.request.width, right)] for one in slots]
        return LabelPlaces(
            np.array(x, dtype=np.float64).reshape(-1, 2),
            np.array([[slot.request.width, slot.request.height] for slot in slots], dtype=np.float64).reshape(-1, 2),
            np.array([slot.request.anchor_px for slot in slots], dtype=np.float64).reshape(-1, 2),
            np.array([0 if slot.on_left else 1 for slot in slots], dtype=np.int64),
            np.asarray(tops, dtype=np.float64),
            np.array([_REQUIRED_INERTIA if slot.request.is_required else 1.0 for slot in slots]),
        )

    def _crosses_more(self, goals: list[Array]) -> bool:
        """Whether more leaders would cross at the goals than do at the present places."""
        pairs = [
            (slot, goal)
            for column, tops in zip((self._left, self._right), goals, strict=True)
            for slot, goal in zip(column, tops, strict=True)
            if slot.opacity > 0 and not slot.is_leaving
        ]
        if len(pairs) < 2 or all(abs(goal - slot.y) <= _ROW_PX for slot, goal in pairs):
            return False
        slots = [slot for slot, _ in pairs]
        then = self._places(slots, np.array([goal for _, goal in pairs]))
        now = replace(then, y=np.array([slot.y for slot in slots]))
        return bool(count_crossings(then, self._stub).sum() > count_crossings(now, self._stub).sum())

    def _would_cross(self, new: _Slot) -> bool:
        """Whether a label that is not drawn yet would cross those that are."""
        slots = [slot for slot in (*self._left, *self._right) if slot.opacity > 0 and not slot.is_leaving]
        places = self._places([*slots, new], np.array([slot.y for slot in (*slots, new)]))
        crossings = count_crossings(places, self._stub)
        return bool(crossings[-1].any() or crossings[:, -1].any())

    def _uncross(self, integral: Array, is_first: bool) -> None:
        """Remove crossings: at once in the first picture, later if they last or keep a required label away."""
        slots = [
            slot
            for slot in (*self._left, *self._right)
            if not slot.is_leaving and (slot.opacity > 0 or slot.request.is_required)
        ]
        places = self._places(slots, np.array([slot.y for slot in slots]))
        is_waiting = any(slot.opacity == 0 for slot in slots)
        if not slots or not (is_waiting or count_crossings(places, self._stub).any()):
            self._crossed_frames, self._wait_frames = 0, _CROSSED_FRAMES
            return
        self._crossed_frames += 1
        if not is_first and self._crossed_frames < self._wait_frames:
            return
        kept, found = self._searched(slots, places, integral)
        # Where nothing can be mended, the next search waits longer.
        self._crossed_frames, self._wait_frames = 0, 2 * self._wait_frames
        self._plan_frames = 0
        self._plan = {slot.request.key: (found.sides[i] == 0, float(found.y[i])) for i, slot in enumerate(kept)}
        if is_first:
            self._left = [slot for slot in self._left if slot.opacity == 0]
            self._right = [slot for slot in self._right if slot.opacity == 0]
            for slot in kept:
                slot.on_left, slot.y = self._plan[slot.request.key]
                (self._left if slot.on_left else self._right).append(slot)
            for column in (self._left, self._right):
                column.sort(key=lambda slot: slot.y)
            return
        for slot in slots:
            planned = self._plan.get(slot.request.key)
            if planned is None or planned[0] != slot.on_left or abs(planned[1] - slot.y) > _ROW_PX:
                slot.is_leaving = True

    def _searched(self, slots: list[_Slot], places: LabelPlaces, integral: Array) -> tuple[list[_Slot], LabelPlaces]:
        """Labels that stay, and their places, without crossings: those that cannot be placed so are left out."""
        step = max(_ROW_PX, (self._bottom - self._top) // _SEARCH_ROWS)
        rows = np.append(np.arange(self._top, self._bottom, step, dtype=np.float64), float(self._bottom))
        kept = list(slots)
        while True:
            found = uncrossed(places, rows, self._gap, self._stub, integral, self._width)
            crossings = count_crossings(found, self._stub)
            crossed = crossings.sum(axis=0) + crossings.sum(axis=1)
            if not crossed.any():
                return kept, found
            crossing = np.flatnonzero(crossed)
            worst = max(crossing, key=lambda i: (not kept[i].request.is_required, crossed[i], kept[i].urgency))
            del kept[worst]
            places = self._places(kept, np.delete(found.y, worst))
            places = replace(places, sides=np.delete(found.sides, worst))

    def _drop_overflow(self, column: list[_Slot]) -> None:
        """Remove new labels while labels that are fading out still fill the column."""
        while sum(s.request.height + self._gap for s in column) > self._bottom - self._top - _ROW_PX * len(column):
            hidden = [slot for slot in column if slot.opacity == 0]
            column.remove(max(hidden or column, key=lambda slot: slot.urgency))

    def _part(self, drawn: list[_Slot]) -> None:
        """Move labels of a column apart where they touch, and back inside the column."""
        low = float(self._top)
        for slot in drawn:
            slot.y = max(slot.y, low)
            low = slot.y + slot.request.height + self._gap
        high = float(self._bottom)
        for slot in reversed(drawn):
            slot.y = min(slot.y, high - slot.request.height)
            high = slot.y - self._gap

    def _is_above(self, upper: _Slot, lower: _Slot) -> bool:
        return upper.y + upper.request.height + self._gap <= lower.y

    def _fade(self, column: list[_Slot]) -> None:
        for slot in list(column):
            if slot.is_leaving:
                slot.opacity -= 1.0 / _FADE_FRAMES
                if slot.opacity <= 0:
                    column.remove(slot)
            elif slot.opacity > 0:
                slot.opacity = min(1.0, slot.opacity + 1.0 / _FADE_FRAMES)


@kernel
def _integral(cells: NDArray[np.float32], anchors: NDArray[np.float64], area: float) -> NDArray[np.float64]:
    """Integral image of the area that labels should not cover: components, and some more at each anchor (K,2)."""
    rows, columns = cells.shape
    result = np.zeros((rows + 1, columns + 1))
    for i in range(len(anchors)):
        u, v = anchors[i] / CELL_PX
        if 0.0 <= u < columns and 0.0 <= v < rows:
            result[int(v) + 1, int(u) + 1] += area
    for row in range(rows):
        total = 0.0
        for column in range(columns):
            total += cells[row, column] + result[row + 1, column + 1]
            result[row + 1, column + 1] = result[row, column + 1] + total
    return result


@kernel
def _best_rows(
    rows: NDArray[np.float64],
    heights: NDArray[np.float64],
    gap: int,
    bottom: int,
    x0: NDArray[np.float64],
    widths: NDArray[np.float64],
    anchors: NDArray[np.float64],
    previous: NDArray[np.float64],
    integral: NDArray[np.float64],
    cover_cost: float,
) -> NDArray[np.float64]:
    """Rows (N,) of the labels of a column, in order and without overlap, of least total cost (dynamic programming).

    ``heights`` include the gap below. The costs of a label are for the area that it covers, its squared distance from
    the anchor and its distance from the previous row (NaN: none).
    """
    count, steps = len(heights), len(rows)
    grid_h, grid_w = integral.shape[0] - 1, integral.shape[1] - 1
    best = np.full((count, steps), np.inf)
    choice = np.zeros((count, steps), dtype=np.int64)
    span = 0.1 * bottom
    for i in range(count):
        c0 = max(0, min(grid_w, int(x0[i] // CELL_PX)))
        c1 = max(0, min(grid_w, int((x0[i] + widths[i]) // CELL_PX) + 1))
        area = widths[i] * (heights[i] - gap)
        low_value, low_index, reached = np.inf, -1, 0
        for k in range(steps):
            if rows[k] + heights[i] - gap > bottom:
                break
            base = 0.0
            if i > 0:
                while reached < steps and rows[reached] + heights[i - 1] <= rows[k]:
                    if best[i - 1, reached] < low_value:
                        low_value, low_index = best[i - 1, reached], reached
                    reached += 1
                if low_index < 0:
                    continue
                base = low_value
                choice[i, k] = low_index
            r0 = max(0, min(grid_h, int(rows[k] // CELL_PX)))
            r1 = max(0, min(grid_h, int((rows[k] + heights[i] - gap) // CELL_PX) + 1))
            covered = integral[r1, c1] - integral[r0, c1] - integral[r1, c0] + integral[r0, c0]
            cost = cover_cost * covered / area + ((rows[k] - anchors[i]) / span) ** 2
            if not np.isnan(previous[i]):
                cost += abs(rows[k] - previous[i]) / span
            best[i, k] = base + cost
    result = np.empty(count)
    k = int(np.argmin(best[count - 1]))
    for i in range(count - 1, -1, -1):
        result[i] = rows[k]
        k = choice[i, k]
    return result
