"""Panel: a rectangle of a drawing's sheet that shows a window of the drawing plane."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from arview.geometry import Array
from arview.quality.rework.outline import Window


@dataclass(frozen=True)
class Panel:
    """A rectangle of the sheet that shows a window of the drawing plane.

    Attributes:
        x, y, width, height: on the sheet, mm, from its upper left corner.
        center: (2,) of the window in the drawing plane, mm.
        scale: mm on the sheet for each mm of the part.
        text: factor of the letters.
    """

    x: float
    y: float
    width: float
    height: float
    center: Array
    scale: float
    text: float = 1.0

    @property
    def window(self) -> Window:
        """What it shows of the drawing plane, mm."""
        half = 0.5 / self.scale * np.array([self.width, self.height])
        (left, low), (right, high) = self.center - half, self.center + half
        return float(left), float(low), float(right), float(high)

    def at(self, points: Array) -> Array:
        """Points (...,2+) of the drawing plane on the sheet."""
        middle = np.array([self.x + 0.5 * self.width, self.y + 0.5 * self.height])
        return np.asarray((np.asarray(points)[..., :2] - self.center) * (self.scale, -self.scale) + middle)

    def holds(self, place: Array, margin: float = 0.0) -> bool:
        """Whether a place (2,) on the sheet is inside."""
        inside = (place >= (self.x + margin, self.y + margin)) & (
            place <= (self.x + self.width - margin, self.y + self.height - margin)
        )
        return bool(inside.all())
