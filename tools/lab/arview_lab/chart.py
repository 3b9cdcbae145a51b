"""Charts drawn with OpenCV: lines, points and bars on linear or logarithmic axes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from arview.core.atomic import write_file
from arview.geometry import Array

Picture = NDArray[np.uint8]
COLORS = ((31, 119, 180), (214, 84, 38), (44, 140, 60), (130, 90, 170), (120, 120, 120), (200, 160, 20))
"""RGB colours of the series, in order."""
_FONT = cv2.FONT_HERSHEY_SIMPLEX
_INK, _GRID = (40, 40, 40), (225, 225, 225)


@dataclass
class Chart:
    """A chart to which series are added before it is drawn.

    Attributes:
        title, x_label, y_label: ASCII only.
        is_log_x, is_log_y: logarithmic axes; values that are not positive are left out.
    """

    title: str
    x_label: str
    y_label: str
    is_log_x: bool = False
    is_log_y: bool = False
    _series: list[tuple[Array, Array, str, str]] = field(default_factory=list)

    def add(
        self, x: ArrayLike, y: ArrayLike, label: str = "", kind: Literal["line", "points", "bars"] = "line"
    ) -> None:
        """Add a series of values ``y`` (N,) at ``x`` (N,); series take the colours of COLORS in turn."""
        self._series.append((np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64), label, kind))

    def draw(self, width: int = 960, height: int = 600) -> Picture:
        """The chart as (H,W,3) uint8 RGB."""
        image = np.full((height, width, 3), 255, dtype=np.uint8)
        (left, right), (top, bottom) = (95, width - 25), (50, height - 65)
        x_range, y_range = self._range(0, self.is_log_x), self._range(1, self.is_log_y)

        def at(values: Array, axis: int) -> Array:
            low, high, is_log = (*x_range, self.is_log_x) if axis == 0 else (*y_range, self.is_log_y)
            with np.errstate(divide="ignore", invalid="ignore"):
                share = ((np.log10(values) if is_log else values) - low) / (high - low)
            return left + share * (right - left) if axis == 0 else bottom - share * (bottom - top)

        for value, text in _ticks(*x_range, self.is_log_x):
            u = round(float(at(np.array(value), 0)))
            cv2.line(image, (u, top), (u, bottom), _GRID, 1)
            _text(image, text, (u, bottom + 20), 0.45, "middle")
        for value, text in _ticks(*y_range, self.is_log_y):
            v = round(float(at(np.array(value), 1)))
            cv2.line(image, (left, v), (right, v), _GRID, 1)
            _text(image, text, (left - 8, v + 5), 0.45, "end")
        cv2.rectangle(image, (left, top), (right, bottom), _INK, 1)
        for index, (x, y, label, kind) in enumerate(self._series):
            color = COLORS[index % len(COLORS)]
            known = np.isfinite(at(x, 0)) & np.isfinite(at(y, 1))
            us, vs = np.clip(at(x[known], 0), left, right), np.clip(at(y[known], 1), top, bottom)
            if kind == "bars":
                half = 0.45 * float(np.min(np.diff(us))) if len(us) > 1 else 10.0
                for a, b in zip(us, vs, strict=True):
                    cv2.rectangle(image, (round(a - half), round(b)), (round(a + half), bottom), color, -1)
            elif kind == "line":
                path = np.round(np.stack([us, vs], axis=1)).astype(np.int32)
                cv2.polylines(image, [path.reshape(-1, 1, 2)], False, color, 2, cv2.LINE_AA)
            if kind == "points" or (kind == "line" and len(us) <= 30):
                for a, b in zip(us, vs, strict=True):
                    cv2.circle(image, (round(a), round(b)), 4, color, -1, cv2.LINE_AA)
            if label:
                row = top + 22 + 20 * index
                cv2.line(image, (right - 250, row - 4), (right - 225, row - 4), color, 3)
                _text(image, label, (right - 218, row), 0.45, "start")
        _text(image, self.title, (width // 2, 30), 0.65, "middle")
        _text(image, self.x_label, ((left + right) // 2, height - 18), 0.5, "middle")
        turned = np.full((24, height, 3), 255, dtype=np.uint8)
        _text(turned, self.y_label, (height // 2, 17), 0.5, "middle")
        image[:, 4:28] = np.rot90(turned)
        return image

    def _range(self, axis: int, is_log: bool) -> tuple[float, float]:
        """Lower and upper limit of an axis; logarithms on a logarithmic axis."""
        parts = [np.asarray(series[axis], dtype=np.float64) for series in self._series]
        if axis == 1 and any(series[3] == "bars" for series in self._series):
            parts.append(np.zeros(1))
        values = np.concatenate(parts) if parts else np.zeros(1)
        values = values[np.isfinite(values) & ((values > 0) | (not is_log))]
        if len(values) == 0:
            return 0.0, 1.0
        if is_log:
            values = np.log10(values)
        low, high = float(values.min()), float(values.max())
        space = 0.05 * (high - low) or 0.5
        return (low if axis == 1 and low == 0.0 and not is_log else low - space), high + space


def save_picture(image: Picture, path: Path) -> None:
    """Write a picture (H,W,3) uint8 RGB as PNG. Raises OutputError."""
    done, data = cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    write_file(path, data.tobytes() if done else b"")


def stack(pictures: Sequence[Picture]) -> Picture:
    """Pictures of equal width, one below another."""
    return np.concatenate(list(pictures), axis=0)


def _ticks(low: float, high: float, is_log: bool) -> list[tuple[float, str]]:
    """Values and labels of grid lines; limits are logarithms on a logarithmic axis."""
    if is_log:
        step = max(1, int(np.ceil((high - low) / 8)))
        return [(10.0**k, f"1e{k}") for k in range(int(np.ceil(low)), int(np.floor(high)) + 1, step)]
    raw = (high - low) / 6.0
    power = 10.0 ** np.floor(np.log10(raw))
    step_size = power * min((1.0, 2.0, 5.0, 10.0), key=lambda k: abs(k * power - raw))
    first = np.ceil(low / step_size - 1e-9)
    return [
        (float(k * step_size), f"{0.0 if abs(k) < 1e-9 else k * step_size:.4g}")
        for k in np.arange(first, np.floor(high / step_size + 1e-9) + 1)
    ]


def _text(image: Picture, text: str, at: tuple[int, int], size: float, anchor: str) -> None:
    width = cv2.getTextSize(text, _FONT, size, 1)[0][0]
    x = at[0] - {"start": 0, "middle": width // 2, "end": width}[anchor]
    cv2.putText(image, text, (x, at[1]), _FONT, size, _INK, 1, cv2.LINE_AA)
