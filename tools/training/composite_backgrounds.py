"""Composite backgrounds for training: cut-out pictures of things, scattered on photos.

Few photos show many small things side by side, as a workbench does. Each thing has an outline, a shadow and a
brightness of its own; the ground is a blurred part of a photo with reduced contrast.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.core.atomic import replacing
from arview.errors import InputError
from arview.geometry import Array
from arview.station.live.stream.frames import to_jpeg
from arview.video import Image
from arview_lab.semisynthetic import photos_in
from arview_lab.semisynthetic.backgrounds import read_photo
from seeded_files import missing_files

WIDTH, HEIGHT = 1280, 960
JPEG_QUALITY = 92
MIN_THING_PX = 60
MIN_CUTOUTS = 20
PART_SHARE, BLUR_PX, CONTRAST_LEFT = (0.15, 0.6), (0.5, 6.0), (0.3, 1.0)
"""Ranges for the ground: share of the photo's width, blur, and share of its contrast that is kept."""
THINGS, THING_PX = (8, 40), (90.0, 420.0)
"""Ranges of the number of things and of their longer sides."""
TURNED_SHARE = 0.6
"""Share of the things at any angle; the others are upright."""
LIGHT, SHADOW, COMPOSITE_LIGHT = (0.6, 1.25), (0.0, 0.6), (0.5, 1.1)
"""Ranges of the brightness of a thing, of the darkness of its shadow, and of the brightness of the whole picture."""
SHADOW_PX = 8
"""Shift of a shadow to the right and down, and its blur."""

Cutout = NDArray[np.uint8]
"""(H,W,4) RGB and opacity."""


def make_composites(seeds: range, photos: Sequence[Path], things: Path, folder: Path) -> None:
    """Write a composite background for each seed, unless its file exists.

    Args:
        seeds: each always gives the same picture.
        photos: for the ground.
        things: folder of pictures with transparency, such as those of Debian's tuxpaint-stamps-default.
        folder: for the pictures.

    Raises:
        InputError: fewer than `MIN_CUTOUTS` pictures with transparency.
    """
    cutouts = [cutout for path in photos_in(things) if (cutout := _read_cutout(path)) is not None]
    if len(cutouts) < MIN_CUTOUTS:
        raise InputError(f"{things}: {len(cutouts)} pictures with transparency, {MIN_CUTOUTS} are needed")
    for seed, path in missing_files(seeds, folder, "composite_{:04d}.jpg", "composite backgrounds"):
        rng = np.random.default_rng([seed, 6])
        picture = composite(read_photo(photos[int(rng.integers(len(photos)))]), cutouts, rng)
        with replacing(path) as file:
            file.write(to_jpeg(picture, JPEG_QUALITY))


def composite(photo: Image, cutouts: Sequence[Cutout], rng: np.random.Generator) -> Image:
    """A picture (HEIGHT,WIDTH,3) of some things on a part of a photo."""
    picture = _ground(photo, rng)
    for _ in range(rng.integers(*THINGS)):
        thing, shadow = _placed(cutouts[int(rng.integers(len(cutouts)))], rng)
        opacity = thing[..., 3:] / np.float32(255.0)
        picture *= 1.0 - shadow[..., None]
        picture += opacity * (thing[..., :3] - picture)
    return np.clip(np.round(picture * rng.uniform(*COMPOSITE_LIGHT)), 0, 255).astype(np.uint8)


def _ground(photo: Image, rng: np.random.Generator) -> NDArray[np.float32]:
    """A blurred part (HEIGHT,WIDTH,3) of a photo with reduced contrast."""
    rows, columns = photo.shape[:2]
    width = int(min(columns * rng.uniform(*PART_SHARE), rows * WIDTH / HEIGHT))
    height = width * HEIGHT // WIDTH
    left, top = rng.integers(0, columns - width + 1), rng.integers(0, rows - height + 1)
    part = photo[top : top + height, left : left + width].astype(np.float32)
    part = cv2.GaussianBlur(cv2.resize(part, (WIDTH, HEIGHT)), (0, 0), rng.uniform(*BLUR_PX))
    mean = part.mean(axis=(0, 1))
    return np.asarray(mean + rng.uniform(*CONTRAST_LEFT) * (part - mean), dtype=np.float32)


def _placed(cutout: Cutout, rng: np.random.Generator) -> tuple[Array, NDArray[np.float32]]:
    """A thing (HEIGHT,WIDTH,4) float32 at a random place, and the darkness of its shadow (HEIGHT,WIDTH)."""
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
    """A picture with transparency; None where it has none, or is too small."""
    data = np.fromfile(path, dtype=np.uint8)
    read = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if data.size else None
    if read is None or read.ndim != 3 or read.shape[2] != 4 or min(read.shape[:2]) < MIN_THING_PX:
        return None
    return np.asarray(cv2.cvtColor(read, cv2.COLOR_BGRA2RGBA), dtype=np.uint8)
