"""Portrait and landscape photos of one camera in one orientation relative to its sensor, where they share one lens."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from arview.camera import exif_of, open_picture
from arview.core.atomic import write_file
from arview.reconstruction.intake.lenses import Lens
from arview.reconstruction.intake.photos import Intake
from arview.reconstruction.intake.reading import read_bytes, read_photo
from arview.reconstruction.types import Photo

_MIRRORED = (2, 4, 5, 7)
"""EXIF orientations that cameras do not write; their photos are left alone."""


def share_lenses(intake: Intake, folder: Path) -> Intake:
    """The intake in which photos of one camera that was turned between them share their lens.

    Upright, a portrait photo has another camera than a landscape one: the principal point is turned and the sides are
    exchanged. In one orientation relative to the sensor both have the same. Where a lens that is not a calibration was
    used in several orientations, the photos of all but the most frequent one are turned into that one and copied, as
    PNG without an EXIF orientation.

    Args:
        intake: of the photos, upright.
        folder: where copies are written; made when there are any.

    Raises:
        OutputError: a copy cannot be written.
    """
    by_key = {lens.key: lens for lens in intake.lenses}
    turns = {photo.name: _quarter_turns(photo) for photo in intake.photos if not photo.is_calibrated}
    families: dict[tuple[object, ...], list[Photo]] = {}
    for photo in intake.photos:
        quarter_turns = turns.get(photo.name)
        if quarter_turns is not None and photo.mask is None:
            families.setdefault(_family(photo, by_key[photo.lens], quarter_turns), []).append(photo)
    changed: dict[str, Photo] = {}
    for members in families.values():
        usual = Counter(turns[photo.name] for photo in members).most_common(1)[0][0]
        like = next(photo for photo in members if turns[photo.name] == usual)
        for photo in members:
            further = ((usual or 0) - (turns[photo.name] or 0)) % 4
            if further:
                place = folder / f"{intake.photos.index(photo):04d}.png"
                changed[photo.name] = _turned(photo, further, like, place)
    if not changed:
        return intake
    photos = tuple(changed.get(photo.name, photo) for photo in intake.photos)
    lenses = _used(intake.lenses, photos)
    gone = [f"({lens.key})" for lens in intake.lenses if lens not in lenses]
    warnings = tuple(text for text in intake.warnings if not any(key in text for key in gone))
    return replace(intake, photos=photos, lenses=lenses, warnings=warnings)


def _quarter_turns(photo: Photo) -> int | None:
    """Quarter turns clockwise from the sensor's picture to the upright one; None for a mirrored picture."""
    with open_picture(read_bytes(photo.path)) as picture:
        exif = exif_of(picture)
    return None if exif.orientation in _MIRRORED else exif.quarter_turns_clockwise


def _family(photo: Photo, lens: Lens, quarter_turns: int) -> tuple[object, ...]:
    """What photos of one lens have in common, whatever the orientation: size on the sensor, focal length, name."""
    size = (photo.height, photo.width) if quarter_turns % 2 else (photo.width, photo.height)
    name = lens.key.replace(f"{photo.width}×{photo.height}", "")
    return (*size, round(lens.camera.fx, 3), name)


def _turned(photo: Photo, quarter_turns: int, like: Photo, path: Path) -> Photo:
    """The photo turned clockwise, with the lens of another one."""
    pixels = np.ascontiguousarray(np.rot90(read_photo(photo.path), -quarter_turns))
    _, png = cv2.imencode(".png", cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_PNG_COMPRESSION, 1])
    write_file(path, png.tobytes(), makes_folder=True)
    return replace(photo, path=path, width=like.width, height=like.height, lens=like.lens, camera=like.camera)


def _used(lenses: Sequence[Lens], photos: Sequence[Photo]) -> tuple[Lens, ...]:
    counts = {lens.key: sum(photo.lens == lens.key for photo in photos) for lens in lenses}
    return tuple(sorted((lens for lens in lenses if counts[lens.key]), key=lambda lens: -counts[lens.key]))
