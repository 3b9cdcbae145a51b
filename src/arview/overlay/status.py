"""The status line: state of the tracking, completeness, part and serial number, age of the inspection, arrows.

An item that does not fit whole is left out: only texts without numbers are shortened.
"""

from __future__ import annotations

from datetime import UTC, datetime

from arview.core.messages import sentence
from arview.inspection import Inspection, Verdict
from arview.overlay import paint
from arview.overlay.labels import MEASURING, age_text
from arview.overlay.options import VERDICT_RGB, VERDICT_WORD, Rgb
from arview.pose import Completeness, Pose, Presence, TrackingState

_STATE_RGB: dict[TrackingState, Rgb] = {
    TrackingState.TRACKED: VERDICT_RGB[Verdict.PASS],
    TrackingState.CRITICAL: VERDICT_RGB[Verdict.UNDECIDED],
    TrackingState.SEARCHING: (96, 165, 250),
    TrackingState.LOST: VERDICT_RGB[Verdict.FAIL],
}
_WHITE = (240, 244, 248)
_MUTED = (176, 186, 200)
MIN_REMARK = 6
"""Room, in letter heights, below which a remark of a tracked part is left out."""
_MIN_PART, _MIN_NOTE = 5, 4
"""Room, in letter heights, that the name of the part and the note of the inspection have at least."""
_COMPLETENESS_RGB: dict[Completeness, Rgb] = {
    Completeness.COMPLETE: VERDICT_RGB[Verdict.PASS],
    Completeness.INCOMPLETE: VERDICT_RGB[Verdict.FAIL],
    Completeness.NOT_YET_CHECKED: VERDICT_RGB[Verdict.UNDECIDED],
}
_COMPLETENESS_KEYS = {Completeness.COMPLETE: "yes", Completeness.INCOMPLETE: "no", Completeness.NOT_YET_CHECKED: "open"}
_COUNT_ORDER = (Verdict.FAIL, Verdict.UNDECIDED, Verdict.PASS, Verdict.MEASURED, Verdict.NOT_MEASURED)


def completeness_text(pose: Pose) -> str:
    """Whether all components are there, and how many are not: ``INCOMPLETE: 1 missing, 2 displaced``."""
    found = [one.presence for one in pose.components.values()]
    counts = {str(presence): found.count(presence) for presence in (Presence.MISSING, Presence.DISPLACED)}
    listed = {name: count for name, count in counts.items() if count}
    key = "both" if len(listed) == 2 else next(iter(listed), _COMPLETENESS_KEYS[pose.completeness])
    return sentence(f"complete.{key}", **listed)


class StatusLine:
    """A bar at the lower border of the image, of more rows if one is too short.

    Attributes:
        rows, height_px: its size.
        bottom_px: row of the image at which it ends; above the border where another bar is below it.
    """

    def __init__(
        self,
        width: int,
        height: int,
        size_px: int,
        inspection: Inspection | None,
        scale: float | None,
        with_completeness: bool = False,
        is_measuring: bool = False,
    ) -> None:
        """``with_completeness`` keeps room for the completeness of a part of several components; ``is_measuring`` says
        that values of the part are still to come.
        """
        self._width, self._size = width, size_px
        self.bottom_px = height
        self._inspection, self._scale, self._is_measuring = inspection, scale, is_measuring
        self._row_px = round(1.75 * size_px)
        self._pad = round(0.7 * size_px)
        self._fixed = self._inspection_items(None)
        # The number of rows is decided once for the longest text of the age, so that the height stays the same.
        self._with_completeness = with_completeness
        widest = [("INCOMPLETE: 00 missing, 00 displaced", _WHITE)] if with_completeness else []
        state = [("SEARCHING", _WHITE), ("quality 0.00", _WHITE), ("00 fps", _WHITE), *widest]
        about_part = [*self._fixed, ("inspected in the future", _MUTED)]
        self._is_one_row = self._length([*state, *about_part]) <= width - 3 * size_px
        self._tracking_rows = 1 if self._is_one_row else len(self._wrapped(state, self._indent()))
        part_rows = 0 if self._is_one_row else len(self._wrapped(about_part, self._pad))
        self.rows = self._tracking_rows + part_rows
        self.height_px = self.rows * self._row_px
        self._panel = paint.panel(width, self.height_px + 2, 0.0, 0.78)

    def draw(self, image: paint.Image, pose: Pose, fps: float | None, now: datetime | None) -> None:
        """Draw the bar on the image in place."""
        top = self.bottom_px - self.height_px
        paint.put_sprite(image, self._panel, 0, top)
        about_part = self._inspection_items(now or datetime.now(UTC), pose.is_label_withheld)
        # Of a tracked part the remark gives way to the inspection; else it says why the part is not tracked.
        gives_way = self._is_one_row and pose.state is TrackingState.TRACKED
        tracking = self._tracking_items(pose, fps, self._length(about_part) + self._gap() if gives_way else 0)
        if self._is_one_row and self._length([*tracking, *about_part]) > self._width - 3 * self._size:
            about_part = []
        y = top + round(0.16 * self._size)
        paint.dot(
            image,
            (self._pad + 0.3 * self._size, y + 0.72 * self._size),
            _STATE_RGB[pose.state],
            0.34 * self._size,
            False,
        )
        if self._is_one_row:
            self._row(image, tracking, self._indent(), y)
            if about_part:
                self._row(image, about_part, self._width - self._pad - self._length(about_part), y)
            return
        rows = self._wrapped(tracking, self._indent())[: self._tracking_rows]
        for number, row in enumerate(rows):
            self._row(image, row, self._indent(), y + number * self._row_px)
        for number, row in enumerate(self._wrapped(about_part, self._pad)[: self.rows - self._tracking_rows]):
            self._row(image, row, self._pad, y + (self._tracking_rows + number) * self._row_px)

    def _indent(self) -> int:
        """Column at which the state begins, after its dot."""
        return self._pad + round(1.1 * self._size)

    def _wrapped(self, items: list[tuple[str, Rgb]], x: int) -> list[list[tuple[str, Rgb]]]:
        """Items in rows that begin at column ``x``; one that is wider than the picture is left out."""
        room = self._width - x - self._pad
        rows: list[list[tuple[str, Rgb]]] = []
        for item in items:
            if self._length([item]) > room:
                continue
            if rows and self._length([*rows[-1], item]) <= room:
                rows[-1].append(item)
            else:
                rows.append([item])
        return rows

    def _tracking_items(self, pose: Pose, fps: float | None, taken_px: int) -> list[tuple[str, Rgb]]:
        """Specimen, state, quality, frame rate, and a remark if there is room beside ``taken_px``."""
        items = [(pose.instance, _WHITE)] if pose.instance else []
        items.append((pose.state.value.upper(), _STATE_RGB[pose.state]))
        if pose.cam_from_model is not None:
            items.append((f"quality {pose.quality:.2f}", _WHITE))
        if fps is not None:
            items.append((f"{fps:.0f} fps", _WHITE))
        if pose.steps is not None:
            items.append((pose.steps.text, _WHITE))
        elif self._with_completeness and pose.cam_from_model is not None:
            items.append((completeness_text(pose), _COMPLETENESS_RGB[pose.completeness]))
        if not pose.remark:
            return items
        last_row = items if self._is_one_row else (self._wrapped(items, self._indent()) or [[]])[-1]
        room = self._width - self._length(last_row) - 4 * self._size - taken_px
        if room > MIN_REMARK * self._size or (not taken_px and self._is_one_row):
            items.append((paint.shortened(pose.remark, self._size, room), _MUTED))
        elif not self._is_one_row:
            items.append((paint.shortened(pose.remark, self._size, self._width - self._indent() - self._pad), _MUTED))
        return items

    def _inspection_items(self, now: datetime | None, is_withheld: bool = False) -> list[tuple[str, Rgb]]:
        inspection = self._inspection
        if inspection is None:
            return [(MEASURING if self._is_measuring else "no inspection", _MUTED)]
        serial = f"  {inspection.serial}" if inspection.serial else ""
        room = round(0.3 * self._width) - paint.text_width(serial, self._size)
        title = paint.shortened(inspection.part, self._size, max(room, _MIN_PART * self._size))
        items: list[tuple[str, Rgb]] = [(title + serial, _WHITE)]
        if is_withheld:
            return [*items, ("labels withheld", VERDICT_RGB[Verdict.UNDECIDED])]
        verdicts = [component.verdict for component in inspection.components]
        verdicts += [one.verdict for one in inspection.characteristics]
        items += [
            (f"{verdicts.count(verdict)} {VERDICT_WORD[verdict]}", VERDICT_RGB[verdict])
            for verdict in _COUNT_ORDER
            if verdict in verdicts
        ]
        if self._is_measuring:
            items.append((MEASURING, _MUTED))
        if now is not None:
            items.append((f"inspected {age_text(inspection.age_s(now))}", _MUTED))
        if self._scale is not None:
            items.append((f"arrows ×{self._scale:g}", _MUTED))
        if inspection.provenance.note:
            limit = max(_MIN_NOTE * self._size, self._width - self._length(items) - 3 * self._size)
            note = paint.shortened(inspection.provenance.note, self._size, limit)
            items.append((note, VERDICT_RGB[Verdict.UNDECIDED]))
        return items

    def _gap(self) -> int:
        return round(1.1 * self._size)

    def _length(self, items: list[tuple[str, Rgb]]) -> int:
        widths = [paint.text_mask(text, self._size).shape[1] for text, _ in items]
        return int(sum(widths)) + self._gap() * max(0, len(widths) - 1)

    def _row(self, image: paint.Image, items: list[tuple[str, Rgb]], x: int, y: int) -> None:
        for text, color in items:
            mask = paint.text_mask(text, self._size)
            paint.put_text(image, mask, x, y, color)
            x += mask.shape[1] + self._gap()
