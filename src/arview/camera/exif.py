"""Opening photos, and the EXIF entries that arview uses: the orientation, and those that identify the lens."""

from __future__ import annotations

import io
import math
from dataclasses import dataclass
from functools import cache
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

from arview.core.extras import load
from arview.errors import InputError

if TYPE_CHECKING:
    from PIL.Image import Image

PHOTO_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".heic", ".heif", ".hif"})

MAX_JPEG_SCANS = 100
"""Most scans of a JPEG that is decoded: progressive ones have about ten, and each takes as long as a picture."""

_HEIF_BRANDS = frozenset({b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1"})
_ORIENTATION, _MAKE, _MODEL, _DATE, _EXIF_IFD = 0x0112, 0x010F, 0x0110, 0x0132, 0x8769
_FOCAL_LENGTH, _FOCAL_LENGTH_35MM, _DIGITAL_ZOOM, _TAKEN, _SERIAL = 0x920A, 0xA405, 0xA404, 0x9003, 0xA431
# Quarter turns clockwise from the sensor's picture to the upright one, by EXIF orientation. The orientations that
# mirror as well (2, 4, 5, 7) are written by editing programs only.
_TURNS = {1: 0, 2: 0, 3: 2, 4: 2, 5: 1, 6: 1, 7: 3, 8: 3}


@dataclass(frozen=True)
class PhotoExif:
    """EXIF data of a photo.

    Attributes:
        width, height: size as stored, px.
        quarter_turns_clockwise: turn from the sensor's picture to the upright one.
        model, make: of the camera; empty when unknown.
        focal_length_mm, focal_length_35mm_mm: focal length and its equivalent on 36 × 24 mm film, or None.
        orientation: EXIF orientation 1–8 still to be applied to the stored pixels (1 for HEIC: its reader applies it).
        digital_zoom: 1 when unknown or not used.
        taken: date and time as the camera wrote it ("2026:11:21 18:15:00"); empty when unknown.
        serial: serial number of the camera body; empty when unknown.
    """

    width: int
    height: int
    quarter_turns_clockwise: int = 0
    model: str = ""
    focal_length_mm: float | None = None
    focal_length_35mm_mm: float | None = None
    make: str = ""
    orientation: int = 1
    digital_zoom: float = 1.0
    taken: str = ""
    serial: str = ""

    @property
    def upright_size(self) -> tuple[int, int]:
        """Width and height in px once the orientation is applied."""
        return (self.height, self.width) if self.orientation >= 5 else (self.width, self.height)


def check_jpeg_scans(data: bytes) -> None:
    """Check that a JPEG, if the data are one, does not consist of so many scans that decoding takes minutes.

    Raises:
        InputError: it does.
    """
    scans = data.count(b"\xff\xda") if data.startswith(b"\xff\xd8") else 0
    if scans > MAX_JPEG_SCANS:
        raise InputError(f"is a JPEG of {scans} scans, more than any camera writes; save it again")


def open_picture(data: bytes) -> Image:
    """Open a picture with Pillow, which reads the header and decodes the pixels when they are first used.

    Args:
        data: content of the file.

    Raises:
        InputError: the data are not a readable picture, or one of far too many pixels.
        MissingDependencyError: a HEIC photo, without pillow-heif.
    """
    from PIL import Image, ImageFile

    # Importing WeasyPrint, for a report in the same process, turns this on: half a photo would pass as a whole one.
    ImageFile.LOAD_TRUNCATED_IMAGES = False
    if not data:
        raise InputError("is empty (0 bytes); copy it again from the camera")
    if data[4:8] == b"ftyp" and data[8:12] in _HEIF_BRANDS:
        _add_heif_to_pillow()
    check_jpeg_scans(data)
    try:
        return Image.open(io.BytesIO(data))
    except Image.DecompressionBombError as error:
        raise InputError("has far too many pixels for a photo; export it with fewer") from error
    except (OSError, ValueError, SyntaxError) as error:
        raise InputError("is not a readable picture; copy it again or save it as JPEG or PNG") from error


def exif_of(picture: Image) -> PhotoExif:
    """EXIF data of an opened picture; absent and malformed entries keep their defaults."""
    try:
        exif = picture.getexif()
        details = exif.get_ifd(_EXIF_IFD)
    except Exception:  # Pillow raises whatever its parser of a malformed block runs into
        return PhotoExif(*picture.size)
    orientation = _orientation(exif.get(_ORIENTATION))
    return PhotoExif(
        width=picture.width,
        height=picture.height,
        quarter_turns_clockwise=_TURNS[_orientation(picture.info.get("original_orientation") or orientation)],
        model=_text(exif.get(_MODEL)),
        focal_length_mm=_positive(details.get(_FOCAL_LENGTH)),
        focal_length_35mm_mm=_positive(details.get(_FOCAL_LENGTH_35MM)),
        make=_text(exif.get(_MAKE)),
        orientation=orientation,
        digital_zoom=_positive(details.get(_DIGITAL_ZOOM)) or 1.0,
        taken=_text(details.get(_TAKEN) or exif.get(_DATE)),
        serial=_text(details.get(_SERIAL)),
    )


def photos_of(source: Path) -> list[Path]:
    """The photos of a file, a folder or a glob pattern, by the suffixes of their names."""
    candidates = [source]
    if source.is_dir():
        candidates = sorted(source.iterdir())
    elif not source.is_file():
        candidates = sorted(source.parent.glob(source.name)) if source.parent.is_dir() else []
    return [path for path in candidates if path.suffix.lower() in PHOTO_SUFFIXES]


def read_exif(path: Path) -> PhotoExif:
    """EXIF data of a photo; absent and malformed entries keep their defaults.

    Raises:
        InputError: the file cannot be read or is not a picture.
    """
    try:
        with open_picture(path.read_bytes()) as picture:
            return exif_of(picture)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def focal_length_px(exif: PhotoExif, width: int, height: int) -> float | None:
    """Focal length in px by the EXIF data, for an uncropped picture of width × height px; None when unknown.

    The 35 mm equivalent compares diagonals (CIPA DCG-001): 43.27 mm for 36 × 24 mm film. Without it the focal length is
    used where the width of the sensor is known. Values outside the range of lenses (a field of view above 150° or below
    1°) are rejected.
    """
    if exif.focal_length_35mm_mm:
        focal_px = exif.focal_length_35mm_mm * math.hypot(width, height) / math.hypot(36.0, 24.0)
    else:
        sensor_mm = sensor_width_mm(exif.model)
        if not exif.focal_length_mm or not sensor_mm:
            return None
        focal_px = exif.focal_length_mm * exif.digital_zoom / sensor_mm * max(width, height)
    return focal_px if 0.13 < focal_px / max(width, height) < 60.0 else None


def sensor_width_mm(model: str) -> float | None:
    """Width of the sensor of a camera model, from ``sensor_widths.txt``; None when the model is not listed."""
    names = [name for name in _sensor_widths_mm() if name.lower() in model.lower()]
    return _sensor_widths_mm()[max(names, key=len)] if names else None


@cache
def _sensor_widths_mm() -> dict[str, float]:
    text = (resources.files("arview.camera") / "sensor_widths.txt").read_text(encoding="utf-8")
    rows = (line.split(maxsplit=1) for line in text.splitlines() if line and not line.startswith("#"))
    return {name: float(width_mm) for width_mm, name in rows}


@cache
def _add_heif_to_pillow() -> None:
    load("reading HEIC photos", "pillow_heif").register_heif_opener()


def _orientation(value: Any) -> int:
    return value if isinstance(value, int) and value in _TURNS else 1


def _text(value: Any) -> str:
    return str(value or "").strip("\0 ")


def _positive(value: Any) -> float | None:
    """The value as a float when it is a positive number, else None (0 means unknown in EXIF)."""
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if 0.0 < number < 1e5 else None
