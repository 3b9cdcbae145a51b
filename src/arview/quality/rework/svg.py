"""Pieces of an SVG drawing in mm: lines, arrows, texts and scale bars, with attributes instead of styles.

The policy of the report forbids styles, and a drawing has to look the same on paper: no colour says anything alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

import numpy as np

from arview.geometry import Array

INK, MUTED, PALE = "#1c2430", "#5b6675", "#9aa5b1"
DESIGN, MEASURED, ZONE = "#1f5fa8", "#c22f2b", "#12805c"
FONT = "Inter, DejaVu Sans, Arial, sans-serif"


def path(lines: Sequence[Array], attributes: str) -> str:
    """Polylines (K,2) as one path; nothing without lines."""
    if not len(lines):
        return ""
    data = "".join(f"M{' '.join(f'{x:.3f},{y:.3f}' for x, y in line)}" for line in lines)
    return f'<path d="{data}" fill="none" stroke-linejoin="round" {attributes}/>'


def text(x: float, y: float, content: str, size: float = 2.8, attributes: str = "") -> str:
    """A text at its baseline."""
    return f'<text x="{x:.2f}" y="{y:.2f}" font-size="{size:g}" {attributes}>{escape(content)}</text>'


def haloed(x: float, y: float, content: str, size: float = 2.6, attributes: str = "") -> str:
    """A text on a white rim, which lines do not disturb."""
    rim = f'stroke="#fff" stroke-width="{0.28 * size:.2f}" stroke-linejoin="round"'
    return text(x, y, content, size, f"{attributes} {rim}") + text(x, y, content, size, attributes)


def wrapped(content: str, width: float, size: float) -> list[str]:
    """Lines of a text that fit a width, mm, at a size; long words are not cut."""
    longest = max(8, int(width / (0.57 * size)))
    lines = [""]
    for word in content.split():
        if lines[-1] and len(lines[-1]) + 1 + len(word) > longest:
            lines.append("")
        lines[-1] = f"{lines[-1]} {word}".strip()
    return lines


def arrow(start: Array, end: Array, width: float = 0.5, color: str = INK) -> str:
    """An arrow (2,) to (2,) with a filled head; shorter than its head, it is the head alone."""
    arm = end - start
    length = float(np.hypot(*arm))
    if length < 0.3:
        return ""
    along = arm / length
    across = np.array([-along[1], along[0]])
    head = min(2.6, max(1.2, 0.45 * length))
    base = end - along * head
    corners = " ".join(f"{x:.3f},{y:.3f}" for x, y in (end, base + across * 0.38 * head, base - across * 0.38 * head))
    shaft = path([np.stack([start, base])], f'stroke="{color}" stroke-width="{width:g}"') if length > head else ""
    return f'{shaft}<polygon points="{corners}" fill="{color}"/>'


def arc_arrow(center: Array, radius: float, is_clockwise: bool) -> str:
    """An arc with a head, clockwise or not as it is seen."""
    sign = 1.0 if is_clockwise else -1.0  # y runs down
    angles = np.deg2rad(-90.0 + sign * np.linspace(-38.0, 38.0, 24))
    points = center + radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    shaft = path([points[:-3]], f'stroke="{INK}" stroke-width="0.5"')
    return shaft + arrow(points[-4], points[-1] + 0.6 * (points[-1] - points[-4]))


def scale_bar(x: float, y: float, length_mm: float, magnification: float, size: float = 2.5) -> str:
    """A bar of a true length with its number; at a magnification of the drawing."""
    drawn = length_mm * magnification
    ticks = [np.array([[x, y - 1.0], [x, y], [x + drawn, y], [x + drawn, y - 1.0]])]
    label = f"{length_mm:g} mm"
    return path(ticks, f'stroke="{INK}" stroke-width="0.35"') + text(x + drawn + 1.2, y, label, size, f'fill="{INK}"')


def cross(center: Array, size: float, color: str) -> str:
    """A diagonal cross."""
    x, y = center
    lines = [
        np.array([[x - size, y - size], [x + size, y + size]]),
        np.array([[x - size, y + size], [x + size, y - size]]),
    ]
    return path(lines, f'stroke="{color}" stroke-width="0.45"')


def plus(center: Array, size: float, color: str) -> str:
    """An upright cross in a ring."""
    x, y = center
    lines = [np.array([[x - size, y], [x + size, y]]), np.array([[x, y - size], [x, y + size]])]
    ring = f'<circle cx="{x:.3f}" cy="{y:.3f}" r="{0.6 * size:.3f}" fill="none" stroke="{color}" stroke-width="0.3"/>'
    return path(lines, f'stroke="{color}" stroke-width="0.35"') + ring


def nice(value: float, steps: Sequence[float] = (1.0, 2.0, 5.0)) -> float:
    """The largest of 1, 2, 5, 10, 20, … (or of other steps in each decade) that does not exceed a positive value."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(max(step for step in steps if step <= value / power * (1.0 + 1e-9)) * power)
