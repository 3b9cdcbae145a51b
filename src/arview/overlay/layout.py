"""Placement of labels: two columns beside the part, stable from frame to frame so that they stay readable.

Boundary labelling (Bekos et al., "Boundary labeling", 2007) with two columns. Within a column the order is kept from
frame to frame; the rows are found by dynamic programming over the area that a label covers, its distance from its
component and the distance it would have to move. Because the old and the new rows of a column do not overlap and have
the same order, rows in between do not overlap either, so labels can glide without crossing. A label that must change
column or order fades out and reappears at its new place.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from arview.core.kernel import kernel
from arview.geometry import Array
from arview.overlay.ghost import CELL_PX

_ROW_PX = 4
"""Grid of the rows that are tried; a label does not move to a row nearer than this."""
_FADE_FRAMES = 6
"""Frames in which a label fades in or out."""
_REST_FRAMES = 30
"""Frames for which a label stays in a new column or order."""
_GLIDE = 0.16
"""Fraction of the remaining way that a label moves in a frame."""
_COVER_COST = 60.0
"""Cost of a label that covers components with its whole area; a distance of a tenth of the image's height costs 1."""
_SIDE_HYSTERESIS = 1.5
"""Advantage that the other column must have before a label changes, in the costs of ``_choose_side``."""


@dataclass(frozen=True)
class LabelRequest:
    """A label to be placed; requests are in order of urgency.

    Attributes:
        key: identifies the label from frame to frame.
        width, height: of its box, px.
        anchor_px: (2,) image point of its component.
    """

    key: str
    width: int
    height: int
    anchor_px: Array


@dataclass(frozen=True)
class PlacedLabel:
    """Box of a label: upper left (x, y), size in px, on the left or right of the part, opacity 0–1."""

    key: str
    x: int
    y: int
    width: int
    height: int
    on_left: bool
    opacity: float


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

    def reset(self) -> None:
        """Forget all labels: the next ones appear at once at their places."""
        self._left, self._right, self._edges = [], [], None

    def place(
        self, requests: list[LabelRequest], part_px: tuple[float, float], cells: NDArray[np.float32]
    ) -> list[PlacedLabel]:
        """Boxes for one frame.

        Args:
            requests: labels wanted, the most urgent first.
            part_px: first and last column of the image that the part covers.
            cells: weighted covered area, px², of each cell of CELL_PX × CELL_PX of the image.

        Returns:
            Labels to draw, in any order; those for which there is no room are left out.
        """
        is_first = not (self._left or self._right)
        self._move_edges(part_px)
        self._update_slots(requests)
        integral = np.zeros((cells.shape[0] + 1, cells.shape[1] + 1), dtype=np.float64)
        np.cumsum(np.cumsum(cells, axis=0, dtype=np.float64), axis=1, out=integral[1:, 1:])
        for column in (self._left, self._right):
            self._solve(column, integral, is_first)
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
        return PlacedLabel(request.key, x, y, request.width, request.height, slot.on_left, slot.opacity)

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
        place = sum(other.anchor_y < slot.anchor_y for other in column)
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

    def _solve(self, column: list[_Slot], integral: Array, is_first: bool) -> None:
        """Set the row of every label of a column."""
        self._drop_overflow(column)
        if not column:
            return
        heights = np.array([slot.request.height + self._gap for slot in column], dtype=np.float64)
        x0 = np.array([self._x(slot.request, slot.on_left) for slot in column])
        widths = np.array([slot.request.width for slot in column], dtype=np.float64)
        anchors = np.array([slot.anchor_y for slot in column]) - 0.5 * (heights - self._gap)
        previous = np.array([slot.y for slot in column])
        goals = _best_rows(
            self._rows, heights, self._gap, self._bottom, x0, widths, anchors, previous, integral, _COVER_COST
        )
        for slot, goal in zip(column, goals, strict=True):
            if is_first or slot.opacity == 0:
                slot.y = float(goal)
            elif abs(goal - slot.y) > _ROW_PX:
                slot.y = self._glide(slot.y, float(goal))
        self._part([slot for slot in column if slot.opacity > 0])
        for place, slot in enumerate(column):
            if slot.opacity > 0 or slot.is_leaving:
                continue
            above = all(self._is_above(other, slot) for other in column[:place] if other.opacity > 0)
            if above and all(self._is_above(slot, other) for other in column[place + 1 :] if other.opacity > 0):
                slot.opacity = 1.0 if is_first else 1.0 / _FADE_FRAMES

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
def _best_rows(
    rows: NDArray[np.float64], heights: NDArray[np.float64], gap: int, bottom: int, x0: NDArray[np.float64],
    widths: NDArray[np.float64], anchors: NDArray[np.float64], previous: NDArray[np.float64],
    integral: NDArray[np.float64], cover_cost: float
) -> NDArray[np.float64]:  # fmt: skip
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
