"""What is printed, stuck or scratched on a surface: photographs, labels, logos, tags, tape and scratches.

A canvas is (H,W,5) uint8: red, green, blue, opacity, and the strength of highlights in units of 1/`GLOSS_UNIT`.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.video import Image

Canvas = NDArray[np.uint8]
GLOSS_UNIT = 64
"""Value of a canvas's last channel that leaves highlights as they are."""
CROPS_TRIED = 4
"""Crops of a photograph from which the one with most to see is printed."""
WORDS = ("SERIES", "MODEL", "LOT", "REV", "TYPE", "IP 54", "24 V DC", "CE", "MADE IN", "PART NO", "CHECKED", "FRAGILE")
INKS = ((20, 20, 24), (160, 24, 28), (24, 60, 150), (20, 110, 60), (235, 235, 230))
PAPERS = ((238, 238, 232), (244, 208, 40), (196, 200, 204), (236, 232, 214))
FONTS = (cv2.FONT_HERSHEY_SIMPLEX, cv2.FONT_HERSHEY_DUPLEX, cv2.FONT_HERSHEY_TRIPLEX, cv2.FONT_HERSHEY_PLAIN)


def empty_canvas(height: int, width: int) -> Canvas:
    """A canvas that changes nothing."""
    canvas = np.zeros((height, width, 5), np.uint8)
    canvas[..., 4] = GLOSS_UNIT
    return canvas


def print_photo(canvas: Canvas, photo: Image, rng: np.random.Generator) -> None:
    """Print a crop of a photograph over a canvas, with or without a margin: the richest of some random ones."""
    height, width = canvas.shape[:2]
    margin = int(rng.choice([0, 0, 1]) * rng.uniform(0.03, 0.10) * min(height, width))
    inner = canvas[margin : height - margin, margin : width - margin]
    rows, columns = inner.shape[:2]
    crops = [_random_crop(photo, rows / columns, rng) for _ in range(CROPS_TRIED)]
    crop = max(crops, key=_richness)
    method = cv2.INTER_AREA if crop.shape[1] > columns else cv2.INTER_CUBIC
    inner[..., :3] = cv2.resize(_stretched(crop), (columns, rows), interpolation=method)
    inner[..., 3] = int(rng.uniform(225, 255))
    inner[..., 4] = int(GLOSS_UNIT * rng.uniform(0.6, 1.6))


def _random_crop(photo: Image, aspect: float, rng: np.random.Generator) -> Image:
    """A crop with a ratio of height to width."""
    widest = min(photo.shape[1], photo.shape[0] / aspect)
    width = max(2, int(rng.uniform(0.5, 1.0) * widest))
    height = min(photo.shape[0], max(2, int(width * aspect)))
    top, left = (int(rng.integers(photo.shape[k] - n + 1)) for k, n in ((0, height), (1, width)))
    return photo[top : top + height, left : left + width]


def _richness(image: Image) -> float:
    """Mean difference of neighbouring pixels of a picture brought to one size."""
    small = cv2.resize(image, (64, 64), interpolation=cv2.INTER_AREA).astype(np.float32)
    return float(np.abs(np.diff(small, axis=0)).mean() + np.abs(np.diff(small, axis=1)).mean())


def _stretched(image: Image) -> Image:
    """A picture whose brightness fills the range of print from black to white."""
    low, high = np.percentile(image, (2, 98))
    return np.asarray(
        np.clip((image.astype(np.float32) - low) * (220.0 / max(high - low, 20.0)) + 15.0, 8, 245), np.uint8
    )


def label(texel_mm: float, rng: np.random.Generator) -> Canvas:
    """A paper or foil label with lines of text, and often a frame and a bar code."""
    height, width = (round(side / texel_mm) for side in (rng.uniform(18.0, 34.0), rng.uniform(34.0, 64.0)))
    sticker = empty_canvas(height, width)
    paper = PAPERS[int(rng.integers(len(PAPERS)))]
    sticker[..., :3], sticker[..., 3] = paper, 255
    sticker[..., 4] = int(GLOSS_UNIT * rng.uniform(0.4, 1.5))
    ink = INKS[0] if rng.random() < 0.7 else INKS[int(rng.integers(1, 4))]
    face = np.ascontiguousarray(sticker[..., :3])
    if rng.random() < 0.6:
        edge = max(1, round(0.6 / texel_mm))
        cv2.rectangle(face, (2 * edge, 2 * edge), (width - 1 - 2 * edge, height - 1 - 2 * edge), ink, edge)
    coded = rng.random() < 0.6
    text_bottom = int(height * (0.58 if coded else 0.92))
    count = int(rng.integers(2, 4 if coded else 5))
    for line in range(count):
        words = [WORDS[int(rng.integers(len(WORDS)))], str(int(rng.integers(10, 99999)))]
        room = 0.86 * text_bottom / count
        write(face, " ".join(words), (0.08 * width, 0.08 * height + (line + 0.9) * room), 0.75 * room, ink, rng)
    if coded:
        bars(face[int(0.64 * height) : int(0.90 * height), int(0.08 * width) : int(0.92 * width)], ink, rng)
    sticker[..., :3] = face
    return sticker


def logo(texel_mm: float, rng: np.random.Generator) -> Canvas:
    """A sign of simple coloured forms with a word, printed without paper."""
    height = round(rng.uniform(16.0, 36.0) / texel_mm)
    width = round(height * rng.uniform(1.6, 2.6))
    sticker = empty_canvas(height, width)
    mark = np.zeros((height, width), np.uint8)
    face = np.zeros((height, width, 3), np.uint8)
    first, second = (INKS[k] for k in rng.permutation(len(INKS))[:2])
    center, radius = (round(0.5 * height), round(0.5 * height)), round(0.42 * height)
    kind = int(rng.integers(3))
    if kind == 0:
        cv2.circle(mark, center, radius, 255, -1, cv2.LINE_AA)
        cv2.circle(face, center, radius, first, -1)
        cv2.circle(face, center, radius // 2, second, -1, cv2.LINE_AA)
    else:
        sides = 3 + 2 * kind
        angle = rng.uniform(0, 2 * np.pi) + 2 * np.pi * np.arange(sides) / sides
        corners = np.round(np.array(center) + radius * np.stack([np.cos(angle), np.sin(angle)], 1)).astype(np.int32)
        cv2.fillPoly(mark, [corners], 255, cv2.LINE_AA)
        face[:] = first
        cv2.circle(face, center, round(0.4 * radius), second, -1, cv2.LINE_AA)
    letters = np.zeros((height, width, 3), np.uint8)
    word = "".join(rng.choice(list("ABEFGHKLMNORSTUVXZ"), size=int(rng.integers(3, 6))))
    write(letters, word, (1.02 * height, 0.68 * height), 0.42 * height, (255, 255, 255), rng)
    face[letters[..., 0] > 0] = first
    sticker[..., :3], sticker[..., 3] = face, np.maximum(mark, letters[..., 0])
    return sticker


def tag(texel_mm: float, rng: np.random.Generator) -> Canvas:
    """A square black-and-white tag of random cells on white paper, like a fiducial marker of no known family."""
    cells = int(rng.integers(5, 8))
    inner = np.zeros((cells + 2, cells + 2), np.uint8)
    inner[1:-1, 1:-1] = 255 * rng.integers(0, 2, (cells, cells))
    code = np.pad(inner, 1, constant_values=245)
    side = round(rng.uniform(26.0, 48.0) / texel_mm)
    sticker = empty_canvas(side, side)
    sticker[..., :3] = cv2.resize(np.clip(code, 18, 245), (side, side), interpolation=cv2.INTER_NEAREST)[..., None]
    sticker[..., 3], sticker[..., 4] = 255, int(GLOSS_UNIT * rng.uniform(0.3, 1.0))
    return sticker


def tape(length_mm: float, texel_mm: float, rng: np.random.Generator) -> Canvas:
    """A piece of transparent tape: barely coloured, glossy, with brighter cut edges and a few bubbles."""
    height, width = round(rng.uniform(15.0, 24.0) / texel_mm), max(4, round(length_mm / texel_mm))
    sticker = empty_canvas(height, width)
    sticker[..., :3] = (232, 224, 198) if rng.random() < 0.5 else (226, 230, 234)
    sticker[..., 3] = int(rng.uniform(18, 42))
    sticker[..., 4] = int(GLOSS_UNIT * rng.uniform(2.0, 3.4))
    edge = max(1, round(0.4 / texel_mm))
    for side in (np.s_[:edge], np.s_[-edge:], np.s_[:, :edge], np.s_[:, -edge:]):
        sticker[side][..., 3] = 95
    opacity = np.ascontiguousarray(sticker[..., 3])
    for _ in range(int(rng.integers(0, 5))):
        center = (int(rng.integers(width)), int(rng.integers(height)))
        axes = tuple(round(r / texel_mm) for r in rng.uniform(0.6, 3.0, 2))
        cv2.ellipse(opacity, center, axes, float(rng.uniform(0, 180)), 0, 360, 75, -1, cv2.LINE_AA)
    sticker[..., 3] = opacity
    return sticker


def scratch(canvas: Canvas, count: int, texel_mm: float, rng: np.random.Generator) -> None:
    """Draw bright and dark scratches on a canvas: broken polygons of a few tenths of a millimetre's width."""
    height, width = canvas.shape[:2]
    opacity = np.zeros((height, width), np.uint8)
    for _ in range(count):
        start = rng.uniform(0, 1, 2) * (width, height)
        angle = rng.uniform(0, 2 * np.pi)
        length = rng.gamma(2.0, 9.0) / texel_mm
        steps = np.linspace(0.0, length, 6)
        bend = angle + np.cumsum(rng.normal(0.0, 0.07, 6))
        path = start + np.cumsum(np.diff(steps, prepend=0.0)[:, None] * np.stack([np.cos(bend), np.sin(bend)], 1), 0)
        thick = max(1, round(rng.uniform(0.15, 0.6) / texel_mm))
        strength = int(rng.uniform(60, 190))
        cv2.polylines(opacity, [np.round(8 * path).astype(np.int32)], False, strength, thick, cv2.LINE_AA, 3)
    tone = 215 if rng.random() < 0.65 else 30
    lines = np.dstack([np.full((height, width, 3), tone, np.uint8), opacity, np.full_like(opacity, 2 * GLOSS_UNIT)])
    lay_over(canvas, lines)


def place(canvas: Canvas, sticker: Canvas, rng: np.random.Generator) -> None:
    """Lay a sticker on a canvas at a random place and rotation; what reaches over the border is cut off."""
    height, width = canvas.shape[:2]
    angle = float(rng.choice([0.0, 90.0, 180.0, 270.0])) + rng.normal(0.0, 4.0)
    reach = 0.5 * max(sticker.shape[:2])
    x = rng.uniform(min(reach, 0.5 * width), max(width - reach, 0.5 * width))
    y = rng.uniform(min(reach, 0.5 * height), max(height - reach, 0.5 * height))
    center = (0.5 * (sticker.shape[1] - 1), 0.5 * (sticker.shape[0] - 1))
    turn = cv2.getRotationMatrix2D(center, angle, 1.0)
    turn[:, 2] += np.array([x, y]) - center
    opacity = cv2.warpAffine(np.ascontiguousarray(sticker[..., 3]), turn, (width, height), flags=cv2.INTER_LINEAR)
    others = np.ascontiguousarray(np.delete(sticker, 3, axis=2))
    laid = cv2.warpAffine(others, turn, (width, height), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    lay_over(canvas, np.dstack([laid[..., :3], opacity, laid[..., 3]]))


def lay_over(canvas: Canvas, sticker: Canvas) -> None:
    """Blend a sticker of the canvas's size over it; under a transparent one the gloss is still the sticker's."""
    over = sticker[..., 3:4].astype(np.float32) / 255.0
    under = canvas[..., 3:4].astype(np.float32) / 255.0
    opacity = over + under * (1.0 - over)
    color = over * sticker[..., :3] + under * (1.0 - over) * canvas[..., :3]
    covers = sticker[..., 3] > 4
    canvas[..., :3] = np.round(color / np.maximum(opacity, 1e-6))
    canvas[..., 3] = np.round(255.0 * opacity[..., 0])
    canvas[..., 4][covers] = sticker[..., 4][covers]


def write(
    face: Image, text: str, origin: tuple[float, float], height: float, ink: tuple[int, int, int],
    rng: np.random.Generator,
) -> None:  # fmt: skip
    """Write a line of text with its baseline at an origin (x, y), at most as wide as there is room."""
    font = FONTS[int(rng.integers(len(FONTS)))]
    (wide, high), _ = cv2.getTextSize(text, font, 1.0, 1)
    scale = min(height / max(high, 1), 0.97 * (face.shape[1] - origin[0]) / max(wide, 1))
    thick = max(1, round(1.6 * scale))
    cv2.putText(face, text, (round(origin[0]), round(origin[1])), font, scale, ink, thick, cv2.LINE_AA)


def bars(face: Image, ink: tuple[int, int, int], rng: np.random.Generator) -> None:
    """Fill a part of a label with the bars of a code."""
    unit = max(1, face.shape[1] // 70)
    ends = np.cumsum(rng.integers(1, 4, size=80)) * unit
    for start, end in zip(ends[:-1:2], ends[1::2], strict=False):
        face[:, start:end] = ink
