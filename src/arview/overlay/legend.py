"""The legend of the kinds of evidence in the picture, and the banner of a part whose labels are withheld."""

from __future__ import annotations

from collections.abc import Iterable
from functools import lru_cache

import numpy as np

from arview.core.messages import sentence
from arview.overlay import paint
from arview.overlay.evidence import DIMMED_RGB, DISPLACED_RGB, MISSING_RGB, NEXT_RGB, DrawnEvidence
from arview.overlay.options import CONTEXT_RGB, Rgb
from arview.pose import Pose

_WHITE: Rgb = (240, 244, 248)
_AMBER: Rgb = (255, 176, 32)
_ENTRIES: dict[DrawnEvidence, str] = {
    DrawnEvidence.MISSING: sentence("legend.missing"),
    DrawnEvidence.DISPLACED: sentence("legend.displaced"),
    DrawnEvidence.WRONG: sentence("legend.wrong"),
    DrawnEvidence.NEXT: sentence("legend.next"),
    DrawnEvidence.UNVERIFIED: sentence("label.not_verified"),
    DrawnEvidence.UNCERTAIN: sentence("label.not_verified"),
    DrawnEvidence.WITHHELD: sentence("legend.withheld"),
}


def legend_entries(evidence: Iterable[DrawnEvidence]) -> tuple[tuple[DrawnEvidence, str], ...]:
    """Kinds of evidence that need an explanation, each with its text; none where all is as measured."""
    present = set(evidence)
    if DrawnEvidence.UNVERIFIED in present:
        present.discard(DrawnEvidence.UNCERTAIN)
    return tuple((kind, text) for kind, text in _ENTRIES.items() if kind in present)


def withheld_title(pose: Pose) -> str:
    """Title of the banner of a part whose labels are withheld."""
    return sentence("identity.withheld_of", serial=pose.serial) if pose.serial else sentence("identity.withheld")


@lru_cache(maxsize=32)
def legend_sprite(entries: tuple[tuple[DrawnEvidence, str], ...], size_px: int, width_px: int) -> paint.Sprite:
    """Panel with a swatch and a text for each entry, in as many rows as the width requires."""
    small = max(9, round(0.86 * size_px))
    pad, gap, swatch = round(0.6 * small), round(0.5 * small), round(1.9 * small)
    masks = [
        paint.text_mask(paint.shortened(text, small, width_px - 2 * pad - swatch - gap), small) for _, text in entries
    ]
    rows: list[list[int]] = [[]]
    used = 0
    for index, mask in enumerate(masks):
        need = swatch + gap + mask.shape[1] + (3 * gap if rows[-1] else 0)
        if rows[-1] and used + need > width_px - 2 * pad:
            rows.append([])
            used = 0
            need -= 3 * gap
        rows[-1].append(index)
        used += need
    row_px = round(1.55 * small)
    widths = [sum(swatch + gap + masks[i].shape[1] for i in row) + 3 * gap * (len(row) - 1) for row in rows]
    sprite = paint.panel(max(widths) + 2 * pad, len(rows) * row_px + gap, 0.3 * small, 0.72)
    for line, row in enumerate(rows):
        x, y = pad, line * row_px + gap // 2
        for index in row:
            _draw_swatch(sprite, entries[index][0], x, y + round(0.25 * small), swatch, round(1.05 * small))
            paint.write(sprite, masks[index], x + swatch + gap, y, _WHITE)
            x += swatch + gap + masks[index].shape[1] + 3 * gap
    return sprite


def _draw_swatch(sprite: paint.Sprite, kind: DrawnEvidence, x: int, y: int, width: int, height: int) -> None:
    """A small picture of how a kind of evidence is drawn."""
    v, u = np.mgrid[0:height, 0:width]
    period = max(4, height // 2)
    rim = np.zeros((height, width), dtype=np.bool_)
    rim[[0, -1], :] = rim[:, [0, -1]] = True
    dash = (u + v) % (2 * max(2, period // 2)) < max(2, period // 2)
    color: Rgb = DIMMED_RGB
    if kind is DrawnEvidence.MISSING:
        color, on = MISSING_RGB, rim | ((u + v) % period < 1) | ((u - v) % period < 1)
    elif kind is DrawnEvidence.DISPLACED:
        # The nominal place hatched, the other one plain, with a link between them.
        color, third = DISPLACED_RGB, width // 3
        left = (u < third) & (((u + v) % period < (period + 1) // 2) | rim)
        on = left | (u >= width - third) | ((v == height // 2) & (u >= third))
    elif kind is DrawnEvidence.WITHHELD:
        color, on = CONTEXT_RGB, rim
    elif kind is DrawnEvidence.WRONG:
        color, on = MISSING_RGB, ((u + v) % period < (period + 1) // 2) | rim
    elif kind is DrawnEvidence.NEXT:
        color, on = NEXT_RGB, rim | (v > 0)
    else:
        on = rim & dash
    mask = np.where(on, 255, 0).astype(np.uint8)
    paint.write(sprite, mask, x, y, color)


@lru_cache(maxsize=16)
def banner_sprite(title: str, text: str, size_px: int, width_px: int) -> paint.Sprite:
    """Panel with a title, if any, and a text below it, broken between words; no word is left out."""
    pad = round(0.7 * size_px)
    room = width_px - 2 * pad
    rows = [(paint.shortened(title, size_px, room, True), True)] if title else []
    line = ""
    for word in text.split():
        joined = f"{line} {word}".strip()
        if line and paint.text_width(joined, size_px) > room:
            rows.append((line, False))
            joined = word
        line = paint.shortened(joined, size_px, room) if joined == word else joined
    if line:
        rows.append((line, False))
    masks = [paint.text_mask(row, size_px, is_bold) for row, is_bold in rows]
    height = masks[0].shape[0]
    sprite = paint.panel(max(mask.shape[1] for mask in masks) + 2 * pad, len(masks) * height + pad, 0.4 * size_px, 0.85)
    if title:
        sprite.rgb[:, : max(3, pad // 3)] = _AMBER
    for index, mask in enumerate(masks):
        paint.write(sprite, mask, pad, pad // 2 + index * height, _AMBER if rows[index][1] else _WHITE)
    return sprite
