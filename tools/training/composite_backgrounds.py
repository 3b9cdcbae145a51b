"""Backgrounds to fit networks on that look like desks: cut-out pictures of things lie about on photos.

In few photos do many small things lie side by side, and that is what a shop floor looks like. Every thing has an
outline of its own, a shadow, and a light of its own; what it lies on is a part of a photo, soft and pale.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.core.atomic import replacing
from arview.errors import InputError
from arview.evaluation.semisynthetic import photos_in
from arview.evaluation.semisynthetic.backgrounds import read_photo
from arview.geometry import Array
from arview.live.stream.frames import to_jpeg
from arview.video import Image
from seeded_files import still_to_make

WIDTH, HEIGHT = 1280, 960
JPEG_QUALITY = 92
SMALLEST_THING_PX = 60
FEWEST_THINGS = 20
PART_SHARE, SOFT_PX, PALE = (0.15, 0.6), (0.5, 6.0), (0.3, 1.0)
"""Of the photo that things lie on: share of its width, blur, and share of its contrast that is left."""
THINGS, THING_PX = (8, 40), (90.0, 420.0)
"""How many lie on a desk, and their longer sides."""
TURNED_SHARE = 0.6
"""So many lie at any angle; the others are upright."""
LIGHT, SHADOW, DESK_LIGHT = (0.6, 1.25), (0.0, 0.6), (0.5, 1.1)
SHADOW_PX = 8
"""Its shift to the right and down, and its blur."""

Cutout = NDArray[np.uint8]
"""(H,W,4) RGB and opacity."""


def make_desks(seeds: range, photos: Sequence[Path], things: Path, folder: Path) -> None:
    """Write a desk for each seed to ``folder``, unless it is there.

    Args:
        seeds: each gives the same desk again.
        photos: what things lie on.
        things: folder of pictures with transparency, such as those of Debian's tuxpaint-stamps-default.

    Raises:
        InputError: fewer than `FEWEST_THINGS` cut-out pictures there.
    """
    cutouts = [cutout for path in photos_in(things) if (cutout := _read_cutout(path)) is not None]
    if len(cutouts) < FEWEST_THINGS:
        raise InputError(f"{things}: {len(cutouts)} pictures with transparency, {FEWEST_THINGS} are needed")
    for seed, path in still_to_make(seeds, folder, "desk_{:04d}.jpg", "desks"):
        rng = np.random.default_rng([seed, 6])
        picture = desk(read_photo(photos[rng.integers(len(photos))]), cutouts, rng)
        with replacing(path) as file:
            file.write(to_jpeg(picture, JPEG_QUALITY))


def desk(photo: Image, cutouts: Sequence[Cutout], rng: np.random.Generator) -> Image:
    """A picture (HEIGHT,WIDTH,3) of some things on a part of a photo."""
    picture = _lain_on(photo, rng)
    for _ in range(rng.integers(*THINGS)):
        thing, shadow = _placed(cutouts[rng.integers(len(cutouts))], rng)
        opacity = thing[..., 3:] / np.float32(255.0)
        picture *= 1.0 - shadow[..., None]
        picture += opacity * (thing[..., :3] - picture)
    return np.clip(np.round(picture * rng.uniform(*DESK_LIGHT)), 0, 255).astype(np.uint8)


def _lain_on(photo: Image, rng: np.random.Generator) -> NDArray[np.float32]:
    rows, columns = photo.shape[:2]
    width = int(min(columns * rng.uniform(*PART_SHARE), rows * WIDTH / HEIGHT))
    height = width * HEIGHT // WIDTH
    left, top = rng.integers(0, columns - width + 1), rng.integers(0, rows - height + 1)
    part = photo[top : top + height, left : left + width].astype(np.float32)
    part = cv2.GaussianBlur(cv2.resize(part, (WIDTH, HEIGHT)), (0, 0), rng.uniform(*SOFT_PX))
    mean = part.mean(axis=(0, 1))
    return np.asarray(mean + rng.uniform(*PALE) * (part - mean), dtype=np.float32)


def _placed(cutout: Cutout, rng: np.random.Generator) -> tuple[Array, NDArray[np.float32]]:
    """A thing (HEIGHT,WIDTH,4) float32 somewhere on the desk, and how dark its shadow is there (HEIGHT,WIDTH)."""
    zoom = rng.uniform(*THING_PX) / max(cutout.shape[:2])
    if zoom < 1.0:
        cutout, zoom = np.asarray(cv2.resize(cutout, None, fx=zoom, fy=zoom, interpolation=cv2.INTER_AREA)), 1.0
    height, width = cutout.shape[:2]
    angle_deg = rng.uniform(0.0, 360.0) if rng.random() < TURNED_SHARE else 0.0
    way = cv2.getRotationMatrix2D((0.5 * width, 0.5 * height), angle_deg, zoom)
    way[:, 2] += rng.uniform((0.0, 0.0), (WIDTH, HEIGHT)) - (0.5 * width, 0.5 * height)
    thing = cv2.warpAffine(cutout, way, (WIDTH, HEIGHT), flags=cv2.INTER_LINEAR).astype(np.float32)
    thing[..., :3] = np.minimum(thing[..., :3] * rng.uniform(*LIGHT), 255.0)
    shift = np.array([[1.0, 0.0, SHADOW_PX], [0.0, 1.0, SHADOW_PX]])
    shadow = cv2.warpAffine(np.ascontiguousarray(thing[..., 3]), shift, (WIDTH, HEIGHT))
    return thing, cv2.GaussianBlur(shadow, (0, 0), SHADOW_PX) * np.float32(rng.uniform(*SHADOW) / 255.0)


def _read_cutout(path: Path) -> Cutout | None:
    """A picture with transparency, or none where it has none or is small."""
    data = np.fromfile(path, dtype=np.uint8)
    read = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if data.size else None
    if read is None or read.ndim != 3 or read.shape[2] != 4 or min(read.shape[:2]) < SMALLEST_THING_PX:
        return None
    return np.asarray(cv2.cvtColor(read, cv2.COLOR_BGRA2RGBA), dtype=np.uint8)
