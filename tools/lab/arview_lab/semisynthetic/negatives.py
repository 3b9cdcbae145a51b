"""Pictures that do not show a part, in which a detector must find nothing."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import chain, cycle, islice
from pathlib import Path

import cv2
import numpy as np

from arview.video import Image
from arview_lab.evaluation.bop import Scene
from arview_lab.semisynthetic.backgrounds import read_photo
from arview_lab.semisynthetic.sequence import generator

_MIN_CROP = 0.45
"""Smallest crop, as a share of the largest that fits."""


def frames_without_part(
    photos: Sequence[Path], scenes: Sequence[Scene], width: int, height: int, count: int, seed: int = 0
) -> Iterator[tuple[str, Image]]:
    """Pictures (height,width,3) of other things, each with its origin as text.

    A third are whole photos, a third frames of other parts' scenes, and the rest random crops of photos, half of them
    mirrored; where there are too few photos or scenes, crops replace them. No whole picture is used twice.

    Args:
        photos: none of which shows the part.
        scenes: none of which shows the part.
        width, height: of the pictures, px.
        count: how many.
        seed: of the order and the crops.
    """
    rng = generator(seed, "without")
    whole = [photos[k] for k in rng.permutation(len(photos))]
    shown = [(scene, frame) for scene in scenes for frame in scene.frames]
    shown = [shown[k] for k in rng.permutation(len(shown))]
    third = -(-count // 3)
    pictures = chain(
        ((path.as_posix(), _fitted(read_photo(path), width, height)) for path in whole[:third]),
        ((f"{s.name} {f.index}", _fitted(s.image(f), width, height)) for s, f in shown[:third]),
        ((f"{path.as_posix()} (part)", _random_crop(read_photo(path), width, height, rng)) for path in cycle(whole)),
    )
    return islice(pictures, count)


def _fitted(image: Image, width: int, height: int) -> Image:
    """The largest central crop of a picture with the wanted aspect ratio, at the wanted size."""
    rows, columns = image.shape[:2]
    scale = min(columns / width, rows / height)
    w, h = min(columns, round(scale * width)), min(rows, round(scale * height))
    top, left = (rows - h) // 2, (columns - w) // 2
    return _resized(image[top : top + h, left : left + w], width, height)


def _random_crop(image: Image, width: int, height: int, rng: np.random.Generator) -> Image:
    rows, columns = image.shape[:2]
    scale = min(columns / width, rows / height) * rng.uniform(_MIN_CROP, 1.0)
    w, h = int(scale * width), int(scale * height)
    top, left = int(rng.integers(rows - h + 1)), int(rng.integers(columns - w + 1))
    crop = image[top : top + h, left : left + w]
    return _resized(crop[:, ::-1] if rng.random() < 0.5 else crop, width, height)


def _resized(image: Image, width: int, height: int) -> Image:
    if image.shape[:2] == (height, width):
        return np.ascontiguousarray(image)
    shrinks = image.shape[1] > width
    method = cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC
    return np.asarray(cv2.resize(np.ascontiguousarray(image), (width, height), interpolation=method))
