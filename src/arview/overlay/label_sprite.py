"""The picture of a label. Name, value and verdict stand in one row or, in narrow pictures, below each other.

Only the name is ever shortened. Values, verdicts and notes are broken into rows between words, and are drawn smaller
where even a single word is wider than the picture allows.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from arview.overlay import paint
from arview.overlay.evidence import CROSSES, PLAIN, STRIPES, DrawnEvidence
from arview.overlay.labels import LabelText
from arview.overlay.options import PANEL_RGB, Rgb

_WHITE: Rgb = (246, 248, 250)
_MUTED: Rgb = (176, 186, 200)
_DARK: Rgb = (14, 16, 20)
_MIN_SIZE_PX = 7
"""Size of text below which it is not made smaller to fit."""
_DETAILS = 18.0
"""Width allowed, in letter heights, below which a label leaves the details out: it would hide too much of the part."""
_MIN_NAME = 10.0
"""Room for the name, in letter heights, below which it gets a row of its own."""
_NARROW_NAME = 8.0
"""Width of a shortened name in a row of its own, in letter heights, unless other rows are wider."""


@dataclass(frozen=True)
class LabelSprite:
    """A drawn label.

    Attributes:
        text: the texts that were asked for.
        lines: the texts that were drawn, each as drawn; the name may be shortened.
        sprite: the picture.
    """

    text: LabelText
    lines: tuple[str, ...]
    sprite: paint.Sprite


@dataclass(frozen=True)
class _Item:
    """A piece of text that is not broken."""

    text: str
    kind: str  # name, value, word or note
    size_px: int
    width: int


def label_sprite(text: LabelText, size_px: int, widest_px: int) -> LabelSprite:
    """Sprite of a label, at most ``widest_px`` wide if its longest number or word allows."""
    for size in range(size_px, _MIN_SIZE_PX - 1, -1):
        rows = _rows(text, size, widest_px)
        if max(_row_width(row, size) for row in rows) + _left(size) + _pad(size) <= widest_px:
            break
    return _draw(text, rows, size)


def _pad(size: int) -> int:
    return round(0.5 * size)


def _left(size: int) -> int:
    return max(3, round(0.28 * size)) + _pad(size)


def _gap(item: _Item, size: int) -> int:
    return round((0.6 if item.kind != "note" else 0.8) * size)


def _row_width(row: list[_Item], size: int) -> int:
    return sum(item.width for item in row) + sum(_gap(item, size) for item in row[1:])


def _item(text: str, kind: str, size: int) -> _Item:
    small = max(_MIN_SIZE_PX, round(0.86 * size))
    font = size if kind in ("name", "value") else small
    width = paint.text_width(text, font, kind in ("name", "word"))
    return _Item(text, kind, font, width + (round(0.8 * small) if kind == "word" else 0))


def _rows(text: LabelText, size: int, widest_px: int) -> list[list[_Item]]:
    """Rows of a label; all but the name may be wider than allowed."""
    room = widest_px - _left(size) - _pad(size)
    verdict = [_item(text.value, "value", size)] if text.value else []
    verdict.append(_item(text.word, "word", size))
    name = _item(text.name, "name", size)
    beside = room - _row_width([name, *verdict], size) + name.width
    below_verdict = (*text.notes, *(text.details if widest_px >= _DETAILS * size else ()))
    notes = _wrapped([_item(note, "note", size) for note in below_verdict], room, size)
    if beside >= min(name.width, _MIN_NAME * size):
        return [[_item(paint.shortened(text.name, size, beside, True), "name", size), *verdict], *notes]
    below = [verdict] if _row_width(verdict, size) <= room else [[item] for item in verdict]
    wide = max(_row_width(row, size) for row in (*below, *notes))
    limit = min(room, max(wide, round(_NARROW_NAME * size)))
    return [[_item(paint.shortened(text.name, size, limit, True), "name", size)], *below, *notes]


def _wrapped(notes: list[_Item], room: int, size: int) -> list[list[_Item]]:
    """Notes in rows, broken between words where one is wider than the room."""
    rows: list[list[_Item]] = []
    for note in notes:
        pieces = [note]
        if note.width > room:
            pieces = []
            for word in note.text.split(" "):
                joined = _item(f"{pieces[-1].text} {word}", "note", size) if pieces else None
                if joined is not None and joined.width <= room:
                    pieces[-1] = joined
                else:
                    pieces.append(_item(word, "note", size))
        for piece in pieces:
            if rows and _row_width([*rows[-1], piece], size) <= room and len(pieces) == 1:
                rows[-1].append(piece)
            else:
                rows.append([piece])
    return rows


def _draw(text: LabelText, rows: list[list[_Item]], size: int) -> LabelSprite:
    left, pad, top = _left(size), _pad(size), round(0.22 * size)
    heights = [paint.text_mask("x", max(item.size_px for item in row)).shape[0] for row in rows]
    width = left + max(_row_width(row, size) for row in rows) + pad
    sprite = paint.panel(width, 2 * top + sum(heights), 0.36 * size, 0.8)
    _draw_bar(sprite, left - pad, text, size)
    y = top
    for row, height in zip(rows, heights, strict=True):
        x = left
        for item in row:
            if item.kind == "word":
                _draw_chip(sprite, item, width - pad - item.width, y, height, text)
            else:
                color = _MUTED if item.kind == "note" or (text.is_dimmed and item.kind == "value") else _WHITE
                paint.write(sprite, paint.text_mask(item.text, item.size_px, item.kind == "name"), x, y, color)
            x += item.width + _gap(item, size)
        y += height
    lines = tuple(item.text for row in rows for item in row)
    return LabelSprite(text, lines, sprite)


def _draw_bar(sprite: paint.Sprite, width: int, text: LabelText, size: int) -> None:
    """The coloured bar at the left: broken where the verdict is dimmed, hatched where the picture contradicts it."""
    v, u = np.mgrid[0 : sprite.height, 0:width]
    period = max(4, round(0.5 * size))
    on = np.ones(v.shape, dtype=np.bool_)
    pattern = {DrawnEvidence.MISSING: CROSSES, DrawnEvidence.DISPLACED: STRIPES}.get(text.evidence, PLAIN)
    if pattern != PLAIN:
        on = (u + v) % period < (period + 1) // 2
    elif text.is_dimmed:
        on = v % (2 * period) < period
    shown = on & (sprite.alpha[:, :width] > 0)
    sprite.rgb[:, :width][shown] = text.rgb
    sprite.alpha[:, :width] = np.minimum(255, sprite.alpha[:, :width].astype(np.int32) * 5 // 4).astype(np.uint8)


def _draw_chip(sprite: paint.Sprite, item: _Item, x: int, y: int, row_height: int, text: LabelText) -> None:
    """The verdict on a filled chip, or, where it is dimmed, in an outlined one."""
    height = round(1.3 * item.size_px)
    chip_y = y + (row_height - height) // 2
    chip = paint.panel(item.width, height, 0.3 * item.size_px, 1.0)
    paint.write(sprite, chip.alpha, x, chip_y, text.rgb)
    if text.is_dimmed:
        inner = paint.panel(item.width - 2, height - 2, 0.3 * item.size_px - 1.0, 1.0)
        paint.write(sprite, inner.alpha, x + 1, chip_y + 1, PANEL_RGB)
    mask = paint.text_mask(item.text, item.size_px, True)
    color = text.rgb if text.is_dimmed else _DARK
    baseline = chip_y + round(0.5 * height) + round(0.36 * item.size_px)
    paint.write(sprite, mask, x + (item.width - mask.shape[1]) // 2, baseline - round(1.08 * item.size_px), color)
