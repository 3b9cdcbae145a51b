"""Drawing of anti-aliased text, panels and lines on RGB images."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.core.kernel import kernel
from arview.geometry import Array
from arview.overlay.options import PANEL_RGB, Rgb

Image = NDArray[np.uint8]

_SHIFT = 4
"""Fractional bits of coordinates in OpenCV's drawing functions: sixteenths of a pixel."""
_OUTLINE_RGB: Rgb = (12, 14, 18)
_HERSHEY_ASCII = str.maketrans({"−": "-", "±": "~", "≈": "~", "×": "x", "·": "|", "…": "~", "°": "*"})


@dataclass(frozen=True)
class Sprite:
    """A small picture with transparency: rgb (h,w,3) uint8 and alpha (h,w) uint8."""

    rgb: Image
    alpha: NDArray[np.uint8]

    @property
    def width(self) -> int:
        """Width in px."""
        return int(self.alpha.shape[1])

    @property
    def height(self) -> int:
        """Height in px."""
        return int(self.alpha.shape[0])


@lru_cache(maxsize=512)
def text_mask(text: str, size_px: int, bold: bool = False) -> NDArray[np.uint8]:
    """Coverage (h,w) uint8 of a line of text; h depends only on the size, so that baselines agree.

    OpenCV 5 draws its built-in TrueType font; OpenCV 4 has only the Hershey fonts of ASCII. Characters that the font
    lacks are drawn as their code points, see `legible`.
    """
    baseline, height = round(1.08 * size_px), round(1.42 * size_px)
    text = legible(text)
    canvas = np.zeros((height, (size_px + 4) * (len(text) + 1), 3), dtype=np.uint8)
    white = (255, 255, 255)
    font = _font()
    if font is not None:
        end, _ = cv2.putText(canvas, text, (0, baseline), white, font, size_px, 620 if bold else 420)
        width = int(end[0])
    else:
        text, scale, thickness = text.translate(_HERSHEY_ASCII), size_px / 26.0, 2 if bold else 1
        cv2.putText(canvas, text, (0, baseline), cv2.FONT_HERSHEY_SIMPLEX, scale, white, thickness, cv2.LINE_AA)
        width = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, scale, thickness)[0][0]
    return np.ascontiguousarray(canvas[:, : max(1, width), 0])


@lru_cache(maxsize=1)
def _font() -> Any:
    return cv2.FontFace("sans") if hasattr(cv2, "FontFace") else None


def legible(text: str) -> str:
    """The text with each character that the font lacks replaced by its code point, so that names stay distinct."""
    if text.isascii() and text.isprintable():
        return text
    has_font = _font() is not None
    return "".join(char if _has_glyph(char, has_font) else _replacement(char) for char in text)


def _replacement(char: str) -> str:
    return " " if char.isspace() else f"<{ord(char):X}>"


@lru_cache(maxsize=4096)
def _has_glyph(char: str, has_font: bool) -> bool:
    if char.isascii():
        return char.isprintable()
    if not has_font:
        return ord(char) in _HERSHEY_ASCII
    drawn, lacking = (_glyph(one) for one in (char, "?"))
    return drawn.shape != lacking.shape or not np.array_equal(drawn, lacking)


def _glyph(char: str) -> NDArray[np.uint8]:
    canvas = np.zeros((40, 60, 3), dtype=np.uint8)
    end, _ = cv2.putText(canvas, char, (4, 28), (255, 255, 255), _font(), 24, 420)
    return np.ascontiguousarray(canvas[:, : max(1, int(end[0])), 0])


def text_width(text: str, size_px: int, bold: bool = False) -> int:
    """Width of a line of text, px."""
    return int(text_mask(text, size_px, bold).shape[1])


def shortened(text: str, size_px: int, width_px: int, bold: bool = False) -> str:
    """The text, shortened in its middle by an ellipsis if it is wider than ``width_px``."""
    text = legible(text)
    if text_width(text, size_px, bold) <= width_px:
        return text
    fitting, too_many = 0, len(text)
    short = "…"
    while too_many - fitting > 1:
        kept = (fitting + too_many) // 2
        tried = text[: (kept + 1) // 2] + "…" + text[len(text) - kept // 2 :]
        if text_width(tried, size_px, bold) <= width_px:
            fitting, short = kept, tried
        else:
            too_many = kept
    return short


def panel(width: int, height: int, radius_px: float, opacity: float, rgb: Rgb = PANEL_RGB) -> Sprite:
    """A rectangle with rounded corners."""
    v, u = np.mgrid[0:height, 0:width].astype(np.float64)
    across = np.abs(u - 0.5 * (width - 1)) - (0.5 * width - radius_px)
    down = np.abs(v - 0.5 * (height - 1)) - (0.5 * height - radius_px)
    outside = np.hypot(np.maximum(across, 0), np.maximum(down, 0))
    distance = outside + np.minimum(np.maximum(across, down), 0) - radius_px
    cover = np.clip(0.5 - distance, 0.0, 1.0)
    alpha = np.round(255.0 * opacity * cover).astype(np.uint8)
    return Sprite(np.full((height, width, 3), rgb, dtype=np.uint8), alpha)


def write(sprite: Sprite, mask: NDArray[np.uint8], x: int, y: int, rgb: Rgb) -> None:
    """Draw a text mask on a sprite in place, opaque where the text covers it."""
    height = min(mask.shape[0], sprite.height - y)
    width = min(mask.shape[1], sprite.width - x)
    part = (slice(y, y + height), slice(x, x + width))
    cover = mask[:height, :width].astype(np.float32)[..., None] / 255.0
    color = np.asarray(rgb, dtype=np.float32)
    sprite.rgb[part] = np.round(sprite.rgb[part] + cover * (color - sprite.rgb[part])).astype(np.uint8)
    sprite.alpha[part] = np.maximum(sprite.alpha[part], mask[:height, :width])


def put_text(image: Image, mask: NDArray[np.uint8], x: int, y: int, rgb: Rgb) -> None:
    """Blend a text mask over the image in place, with its upper left corner at (x, y)."""
    _blend_mask(image, mask, x, y, rgb[0], rgb[1], rgb[2])


def put_sprite(image: Image, sprite: Sprite, x: int, y: int, opacity: float = 1.0) -> None:
    """Blend a sprite over the image in place, with its upper left corner at (x, y)."""
    _blend_sprite(image, sprite.rgb, sprite.alpha, x, y, np.float32(opacity))


def line(image: Image, points_px: Array, rgb: Rgb, width_px: int) -> None:
    """An outlined polyline through points (N,2)."""
    fixed = np.round(points_px * 2**_SHIFT).astype(np.int32).reshape(-1, 1, 2)
    cv2.polylines(image, [fixed], False, _OUTLINE_RGB, width_px + 1, cv2.LINE_AA, _SHIFT)
    cv2.polylines(image, [fixed], False, rgb, width_px, cv2.LINE_AA, _SHIFT)


def dot(image: Image, point_px: Array | tuple[float, float], rgb: Rgb, radius_px: float, hollow: bool) -> None:
    """An outlined disc, or a ring."""
    centre = (round(float(point_px[0]) * 2**_SHIFT), round(float(point_px[1]) * 2**_SHIFT))
    radius = round(radius_px * 2**_SHIFT)
    rim = round(1.2 * 2**_SHIFT)
    cv2.circle(image, centre, radius + rim, _OUTLINE_RGB, 3 if hollow else cv2.FILLED, cv2.LINE_AA, _SHIFT)
    cv2.circle(image, centre, radius, rgb, 1 if hollow else cv2.FILLED, cv2.LINE_AA, _SHIFT)


def arrow(image: Image, tail_px: Array, tip_px: Array, rgb: Rgb, width_px: float) -> None:
    """An outlined arrow as one polygon, from tail to tip."""
    along = tip_px - tail_px
    length = float(np.linalg.norm(along))
    if length < 1e-6:
        return
    along = along / length
    across = np.array([-along[1], along[0]])
    head = min(4.2 * width_px, 0.6 * length)
    neck = tip_px - head * along
    half, wing = 0.5 * width_px, 0.48 * head
    outline = np.stack(
        [
            tail_px - half * across,
            neck - half * across,
            neck - wing * across,
            tip_px,
            neck + wing * across,
            neck + half * across,
            tail_px + half * across,
        ]
    )
    fixed = np.round(outline * 2**_SHIFT).astype(np.int32).reshape(-1, 1, 2)
    cv2.polylines(image, [fixed], True, _OUTLINE_RGB, 3, cv2.LINE_AA, _SHIFT)
    cv2.fillPoly(image, [fixed], rgb, cv2.LINE_AA, _SHIFT)


@kernel(fastmath=True)
def _blend_mask(image: NDArray[np.uint8], mask: NDArray[np.uint8], x: int, y: int, r: int, g: int, b: int) -> None:
    height, width = image.shape[0], image.shape[1]
    for i in range(max(0, -y), min(mask.shape[0], height - y)):
        for j in range(max(0, -x), min(mask.shape[1], width - x)):
            cover = mask[i, j]
            if cover > 0:
                alpha = np.float32(cover) * np.float32(1.0 / 255.0)
                for k in range(3):
                    color = r if k == 0 else (g if k == 1 else b)
                    old = np.float32(image[y + i, x + j, k])
                    image[y + i, x + j, k] = np.uint8(old + alpha * (color - old) + np.float32(0.5))


@kernel(fastmath=True)
def _blend_sprite(
    image: NDArray[np.uint8],
    rgb: NDArray[np.uint8],
    alpha: NDArray[np.uint8],
    x: int,
    y: int,
    opacity: float | np.float32,
) -> None:
    height, width = image.shape[0], image.shape[1]
    for i in range(max(0, -y), min(alpha.shape[0], height - y)):
        for j in range(max(0, -x), min(alpha.shape[1], width - x)):
            if alpha[i, j] > 0:
                a = opacity * np.float32(alpha[i, j]) * np.float32(1.0 / 255.0)
                for k in range(3):
                    old = np.float32(image[y + i, x + j, k])
                    new = old + a * (np.float32(rgb[i, j, k]) - old)
                    image[y + i, x + j, k] = np.uint8(new + np.float32(0.5))
