"""Text and appearance of labels. Everything on them is from the inspection, never from a pose."""

from __future__ import annotations

import math

import numpy as np

from arview.inspection import ComponentDeviation, Finding, Inspection, Verdict
from arview.overlay import paint
from arview.overlay.options import VERDICT_RGB, VERDICT_WORD, OverlayOptions

_MM_PER_UNIT = {"mm": 1.0, "inch": 25.4}
_UNIT_SUFFIX = {"mm": " mm", "inch": " in"}
_WHITE = (246, 248, 250)
_MUTED = (176, 186, 200)
_RANK = {Verdict.FAIL: 0, Verdict.UNDECIDED: 1, Verdict.NOT_MEASURED: 3, Verdict.PASS: 2}
_ARROW_SCALES = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)
_ARROW_FRACTION = 0.14
"""Length of the longest arrow, at most, in diameters of the part."""


def _number(value_mm: float, options: OverlayOptions, signed: bool = False) -> str:
    """A length in the unit of the labels, with a typographic minus sign."""
    value = value_mm / _MM_PER_UNIT[options.unit]
    sign = "+" if signed else ""
    return f"{value:{sign}.{options.decimals}f}".replace("-", "−")


def by_urgency(inspection: Inspection) -> list[ComponentDeviation]:
    """Components by urgency of their labels: failures first, in order of their excess over the tolerance."""

    def key(deviation: ComponentDeviation) -> tuple[int, float, str]:
        if deviation.distance_mm is None or deviation.tolerance_mm is None:
            excess = math.inf if deviation.finding is Finding.MISSING else 0.0
        else:
            excess = deviation.distance_mm / deviation.tolerance_mm
        return _RANK[deviation.verdict], -excess, deviation.name

    return sorted(inspection.components, key=key)


def value_text(deviation: ComponentDeviation, options: OverlayOptions) -> str:
    """The distance with its unit, ``missing``, ``undetermined``, or an empty text if nothing was measured."""
    if deviation.finding is Finding.MISSING:
        return "missing"
    if deviation.distance_mm is None:
        return "" if deviation.verdict is Verdict.NOT_MEASURED else "undetermined"
    return _number(deviation.distance_mm, options) + _UNIT_SUFFIX[options.unit]


def detail_text(deviation: ComponentDeviation, options: OverlayOptions) -> str:
    """Displacement per axis, rotation and U; axes within U of zero are left out.

    Undetermined axes are shown with a question mark.
    """
    if deviation.distance_mm is None:
        return ""
    uncertainty_mm = deviation.uncertainty_mm or 0.0
    shown = []
    for axis, value in zip("xyz", deviation.displacement_mm, strict=True):
        if value is None:
            shown.append(f"d{axis} ?")
        elif abs(value) > uncertainty_mm:
            shown.append(f"d{axis} {_number(value, options, signed=True)}")
    parts = ["  ".join(shown)] if shown else []
    if deviation.tilt_deg is not None and deviation.tilt_deg >= 0.1:
        parts.append(f"tilt {deviation.tilt_deg:.1f}°")
    if deviation.twist_deg is not None and abs(deviation.twist_deg) >= 0.1:
        parts.append(f"twist {deviation.twist_deg:+.1f}°".replace("-", "−"))
    parts.append(f"U {_number(uncertainty_mm, options)}")
    return "   ".join(parts)


def arrow_scale(inspection: Inspection, diameter_mm: float, options: OverlayOptions) -> float:
    """Exaggeration of the arrows: from the options, or the largest round number that keeps the longest one short."""
    if options.arrow_scale is not None:
        return options.arrow_scale
    longest_mm = max((component.distance_mm or 0.0 for component in inspection.components), default=0.0)
    fitting = [s for s in _ARROW_SCALES if s * longest_mm <= _ARROW_FRACTION * diameter_mm]
    return float(fitting[-1] if fitting else _ARROW_SCALES[0])


def arrow_in_model(deviation: ComponentDeviation) -> tuple[float, float, float] | None:
    """Displacement (3,) mm that an arrow shows, with undetermined axes as 0; None if it is within U of zero."""
    if deviation.distance_mm is None or deviation.distance_mm <= (deviation.uncertainty_mm or 0.0):
        return None
    dx, dy, dz = (value or 0.0 for value in deviation.displacement_mm)
    return dx, dy, dz


def text_size_px(image_height: int) -> int:
    """Size of the label text: legible at 480 rows, and in proportion to the height above."""
    return max(11, round(4.5 + image_height / 72))


def label_sprite(
    deviation: ComponentDeviation, options: OverlayOptions, size_px: int, widest_px: int, note: str = ""
) -> paint.Sprite:
    """Sprite of a label: name, distance and verdict; below a note, or details unless the component passed."""
    color = VERDICT_RGB[deviation.verdict]
    small_px = max(10, round(0.86 * size_px))
    pad, bar = round(0.5 * size_px), max(3, round(0.28 * size_px))
    left = bar + pad
    value = paint.text_mask(value_text(deviation, options), size_px)
    word = paint.text_mask(VERDICT_WORD[deviation.verdict], small_px, True)
    gap = round(0.6 * size_px)
    chip_width = word.shape[1] + round(0.8 * small_px)
    has_value = bool(value_text(deviation, options))
    fixed = left + (value.shape[1] + gap if has_value else 0) + gap + chip_width + pad
    name = paint.text_mask(paint.shortened(deviation.name, size_px, widest_px - fixed, True), size_px, True)
    detail = None
    text = note or ("" if deviation.verdict is Verdict.PASS else detail_text(deviation, options))
    if text:
        detail = paint.text_mask(paint.shortened(text, small_px, widest_px - left - pad), small_px)

    width = fixed + name.shape[1]
    if detail is not None:
        width = max(width, left + detail.shape[1] + pad)
    top = round(0.22 * size_px)
    first_height = name.shape[0]
    height = 2 * top + first_height + (detail.shape[0] if detail is not None else 0)
    sprite = paint.panel(width, height, 0.36 * size_px, 0.8)
    inside = sprite.alpha > 0
    sprite.rgb[:, :bar][inside[:, :bar]] = color
    sprite.alpha[:, :bar] = np.minimum(255, sprite.alpha[:, :bar].astype(np.int32) * 5 // 4).astype(np.uint8)

    x = left
    paint.write(sprite, name, x, top, _WHITE)
    x += name.shape[1] + gap
    if has_value:
        paint.write(sprite, value, x, top, _WHITE)
    chip_height = round(1.3 * small_px)
    chip = paint.panel(chip_width, chip_height, 0.3 * small_px, 1.0, color)
    chip_x, chip_y = width - pad - chip_width, top + (first_height - chip_height) // 2
    paint.write(sprite, chip.alpha, chip_x, chip_y, color)
    word_x = chip_x + (chip_width - word.shape[1]) // 2
    paint.write(sprite, word, word_x, top + round(1.08 * size_px) - round(1.08 * small_px), (14, 16, 20))
    if detail is not None:
        paint.write(sprite, detail, left, top + first_height - 1, _MUTED)
    return sprite
