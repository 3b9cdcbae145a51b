"""The status line: state of the tracking, part and serial number, age of the inspection, scale of the arrows."""

from __future__ import annotations

from datetime import UTC, datetime

from arview.inspection import Inspection, Verdict
from arview.overlay import paint
from arview.overlay.options import VERDICT_RGB, VERDICT_WORD, Rgb
from arview.pose import Pose, TrackingState

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
_COUNT_ORDER = (Verdict.FAIL, Verdict.UNDECIDED, Verdict.PASS, Verdict.NOT_MEASURED)


def age_text(age_s: float) -> str:
    """Age in the largest unit in which it is at least two (minutes: one), e.g. ``3 h ago``."""
    if age_s < 0:
        return "in the future"
    for unit, length_s in (("d", 86400.0), ("h", 3600.0), ("min", 60.0)):
        if age_s >= 2 * length_s or (unit == "min" and age_s >= length_s):
            return f"{age_s / length_s:.0f} {unit} ago"
    return "just now"


class StatusLine:
    """A bar at the lower border of the image, of two rows if one is too short."""

    def __init__(self, width: int, height: int, size_px: int, inspection: Inspection | None, scale: float | None):
        self._width, self._height, self._size = width, height, size_px
        self._inspection, self._scale = inspection, scale
        self._row_px = round(1.75 * size_px)
        self._pad = round(0.7 * size_px)
        self._fixed = self._inspection_items(None)
        # The number of rows is decided once for the longest text of the age, so that the height stays the same.
        sample = [("searching  q 0.00  00.0 fps", _WHITE), *self._fixed, ("inspected in the future", _MUTED)]
        self.rows = 1 if self._length(sample) <= width - 3 * size_px else 2
        self.height_px = self.rows * self._row_px
        self._panel = paint.panel(width, self.height_px + 2, 0.0, 0.78)

    def draw(self, image: paint.Image, pose: Pose, fps: float | None, now: datetime | None) -> None:
        """Draw the bar on the image in place."""
        top = self._height - self.height_px
        paint.put_sprite(image, self._panel, 0, top)
        about_part = self._inspection_items(now or datetime.now(UTC))
        # Of a tracked part the remark gives way to the inspection; else it says why the part is not tracked.
        gives_way = self.rows == 1 and pose.state is TrackingState.TRACKED
        tracking = self._tracking_items(pose, fps, self._length(about_part) + self._gap() if gives_way else 0)
        if self.rows == 1 and self._length([*tracking, *about_part]) > self._width - 3 * self._size:
            about_part = []
        y = top + round(0.16 * self._size)
        state_x = self._pad + round(1.1 * self._size)
        paint.dot(
            image, (self._pad + 0.3 * self._size, y + 0.72 * self._size), _STATE_RGB[pose.state],
            0.34 * self._size, False,
        )  # fmt: skip
        self._row(image, tracking, state_x, y)
        if not about_part:
            return
        if self.rows == 1:
            self._row(image, about_part, self._width - self._pad - self._length(about_part), y)
        else:
            self._row(image, about_part, self._pad, y + self._row_px)

    def _tracking_items(self, pose: Pose, fps: float | None, taken_px: int) -> list[tuple[str, Rgb]]:
        """State, quality, frame rate, and a remark if there is room beside ``taken_px``."""
        items = [(pose.state.value.upper(), _STATE_RGB[pose.state])]
        if pose.cam_from_model is not None:
            items.append((f"quality {pose.quality:.2f}", _WHITE))
        if fps is not None:
            items.append((f"{fps:.0f} fps", _WHITE))
        room = self._width - self._length(items) - 4 * self._size - taken_px
        if pose.remark and (not taken_px or room > MIN_REMARK * self._size):
            items.append((paint.shortened(pose.remark, self._size, room), _MUTED))
        return items

    def _inspection_items(self, now: datetime | None) -> list[tuple[str, Rgb]]:
        inspection = self._inspection
        if inspection is None:
            return [("no inspection", _MUTED)]
        serial = f"  {inspection.serial}" if inspection.serial else ""
        title = paint.shortened(inspection.part + serial, self._size, round(0.3 * self._width))
        items: list[tuple[str, Rgb]] = [(title, _WHITE)]
        verdicts = [component.verdict for component in inspection.components]
        items += [
            (f"{verdicts.count(verdict)} {VERDICT_WORD[verdict]}", VERDICT_RGB[verdict])
            for verdict in _COUNT_ORDER
            if verdict in verdicts
        ]
        if now is not None:
            items.append((f"inspected {age_text(inspection.age_s(now))}", _MUTED))
        if self._scale is not None:
            items.append((f"arrows ×{self._scale:g}", _MUTED))
        if inspection.provenance.note:
            items.append((inspection.provenance.note, VERDICT_RGB[Verdict.UNDECIDED]))
        widths = self._length(items[:-1]) if len(items) > 1 else 0
        limit = max(4 * self._size, self._width - widths - 3 * self._size)
        text, color = items[-1]
        return [*items[:-1], (paint.shortened(text, self._size, limit), color)]

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
