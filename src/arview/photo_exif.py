"""The few EXIF entries of a photo that arview uses: its orientation and what tells the focal length."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from arview.errors import InputError

PHOTO_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp"})

_ORIENTATION, _MODEL, _EXIF_IFD = 0x0112, 0x0110, 0x8769
_FOCAL_LENGTH, _FOCAL_LENGTH_35MM = 0x920A, 0xA405
# Quarter turns clockwise that bring the stored picture upright, by EXIF orientation. The mirrored
# orientations (2, 4, 5, 7) are left out: no camera writes them.
_TURNS = {1: 0, 6: 1, 3: 2, 8: 3}


@dataclass(frozen=True)
class PhotoExif:
    """Size in px as stored, quarter turns clockwise to upright, focal lengths in mm or None."""

    width: int
    height: int
    quarter_turns_clockwise: int
    model: str
    focal_length_mm: float | None
    focal_length_35mm_mm: float | None


def read_exif(path: Path) -> PhotoExif:
    """EXIF data of a photo; entries that are absent or malformed are None.

    Raises InputError when the file is no picture.
    """
    from PIL import Image

    try:
        with Image.open(path) as image:
            width, height = image.size
            exif = image.getexif()
            details = exif.get_ifd(_EXIF_IFD)
    except (OSError, ValueError, SyntaxError) as error:
        raise InputError(f"{path}: is not a readable picture; save it again as JPEG or PNG") from error
    return PhotoExif(
        width=width,
        height=height,
        quarter_turns_clockwise=_TURNS.get(exif.get(_ORIENTATION, 1), 0),
        model=str(exif.get(_MODEL, "")).strip("\0 "),
        focal_length_mm=_positive(details.get(_FOCAL_LENGTH)),
        focal_length_35mm_mm=_positive(details.get(_FOCAL_LENGTH_35MM)),
    )


def _positive(value: Any) -> float | None:
    """The value as a float when it is a positive number, else None (0 means unknown in EXIF)."""
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if 0.0 < number < 1e5 else None
