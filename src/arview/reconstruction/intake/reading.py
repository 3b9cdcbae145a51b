"""Finding and reading photo files: JPEG, PNG, TIFF, BMP and HEIC, upright, with eight bits."""

from __future__ import annotations

import glob
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.camera import PHOTO_SUFFIXES, PhotoExif, exif_of, open_picture
from arview.errors import InputError
from arview.reconstruction.intake.kept import kept
from arview.video import sorted_naturally

if TYPE_CHECKING:
    from PIL.Image import Image

Pixels = NDArray[np.uint8]

SUFFIXES = PHOTO_SUFFIXES
RAW_SUFFIXES = frozenset({".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2"})
GLANCE_PX = 2000  # longest side at which photos are checked: about the size at which features are found

_UPRIGHT: dict[int, Callable[[Pixels], Pixels]] = {
    1: lambda a: a,
    2: lambda a: a[:, ::-1],
    3: lambda a: a[::-1, ::-1],
    4: lambda a: a[::-1],
    5: lambda a: a.swapaxes(0, 1),
    6: lambda a: a.swapaxes(0, 1)[:, ::-1],
    7: lambda a: a.swapaxes(0, 1)[::-1, ::-1],
    8: lambda a: a.swapaxes(0, 1)[::-1],
}


def read_photo(path: str | Path) -> Pixels:
    """(H,W,3) uint8 RGB of a photo, upright by its EXIF orientation; alpha is dropped, 16 bits are scaled to 8.

    Raises:
        InputError: the file is missing, empty, truncated or not a picture.
    """
    return kept("picture", Path(path), lambda: _read(Path(path)))


def _read(path: Path) -> Pixels:
    """See `read_photo`."""
    data = read_bytes(path)
    try:
        with open_picture(data) as picture:
            return _upright(_pixels(picture, "RGB"), exif_of(picture).orientation)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


@dataclass(frozen=True)
class Glance:
    """EXIF data of a photo, and its upright grey picture with a longest side of at most 2000 px."""

    exif: PhotoExif
    gray: Pixels


def glance(data: bytes) -> Glance:
    """Decode all of a photo's bytes, at half, quarter or eighth size where that is enough.

    Pillow detects truncated files, but decodes JPEGs with damaged data without an error. FFmpeg's decoder reports
    these, so JPEGs are decoded by it too.

    Raises:
        InputError: what is wrong, without the file's name.
    """
    with open_picture(data) as picture:
        width, height = picture.size
        factor = 1
        while max(width, height) > factor * GLANCE_PX:
            factor *= 2
        size = (max(1, width // factor), max(1, height // factor))
        picture.draft("L", size)
        gray = _pixels(picture, "L")
        # After decoding, because reading the EXIF data of a PNG decodes all of it.
        exif = replace(exif_of(picture), width=width, height=height)
        is_jpeg = picture.format in ("JPEG", "MPO")
    if is_jpeg and _is_damaged_jpeg(data):
        raise InputError("its data are damaged and part of the picture is lost; copy it again from the camera")
    if max(gray.shape) > GLANCE_PX:
        gray = cv2.resize(gray, size, interpolation=cv2.INTER_AREA)
    return Glance(exif, _upright(gray, exif.orientation))


def read_bytes(path: Path) -> bytes:
    """All bytes of a file. Raises InputError, which names the file, when it cannot be read."""
    try:
        return path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error


def photo_paths(source: str | Path | Sequence[str | Path]) -> tuple[list[Path], list[str]]:
    """Photo files of a folder, glob, file or list of these in natural order, with a unique name for each.

    Of a folder its own photos are taken, or if it has none those of its subfolders, so that results written below the
    photos are not taken for photos. Hidden files, and raw files beside a JPEG of the same name, are skipped. Names are
    paths below the folder.

    Raises:
        InputError: the folder does not exist, or there is no photo in it.
    """
    if not isinstance(source, str | Path):
        return _named(list(dict.fromkeys(Path(item) for item in source)))
    path, text = Path(source), str(source)
    if path.is_dir():
        found = _photos_among(path.iterdir()) or _photos_among(path.rglob("*"), path)
        if not found:
            kinds = ", ".join(sorted(suffix[1:] for suffix in SUFFIXES))
            raise InputError(f"{path}: the folder holds no photos ({kinds}); give the folder with the photos")
        return found, [photo.relative_to(path).as_posix() for photo in found]
    if path.exists():
        return [path], [path.name]
    if not glob.has_magic(text):
        raise InputError(f"{text}: no such folder; give a folder of photos or a video")
    found = _photos_among(Path(match) for match in glob.glob(text, recursive=True))  # noqa: PTH207 - absolute patterns
    if not found:
        raise InputError(f"{text}: no photo matches; check the pattern")
    return _named(found)


def _photos_among(paths: Iterable[Path], below: Path | None = None) -> list[Path]:
    """Photo files among some paths, in natural order."""
    photos = []
    for path in paths:
        parts = path.relative_to(below).parts if below else (path.name,)
        known = path.suffix.lower() in SUFFIXES | RAW_SUFFIXES
        if known and path.is_file() and not any(part.startswith((".", "__")) for part in parts):
            photos.append(path)
    developed = {path.with_suffix("") for path in photos if path.suffix.lower() in SUFFIXES}
    kept = (p for p in photos if p.suffix.lower() not in RAW_SUFFIXES or p.with_suffix("") not in developed)
    return sorted_naturally(kept)


def _named(paths: list[Path]) -> tuple[list[Path], list[str]]:
    """The paths with unique names: file names, or the paths themselves if two file names are equal."""
    names = [path.name for path in paths]
    return paths, names if len(set(names)) == len(names) else [path.as_posix() for path in paths]


def _pixels(picture: Image, mode: str) -> Pixels:
    """Decoded pixels, (H,W,3) for mode RGB and (H,W) for L. Raises InputError when the data are damaged."""
    try:
        picture.load()
        if picture.mode == "F":
            raise InputError("holds floating-point pixels; save it with 8 or 16 bits")
        if not picture.mode.startswith("I"):
            return np.asarray(picture.convert(mode))
        gray = np.clip(np.asarray(picture).astype(np.float32) / 257.0 + 0.5, 0, 255).astype(np.uint8)
        return gray if mode == "L" else np.repeat(gray[..., None], 3, axis=2)
    except InputError:
        raise
    except Exception as error:  # with damaged data, decoders may raise anything
        raise InputError("is truncated or damaged; copy it again from the camera") from error


def _upright(pixels: Pixels, orientation: int) -> Pixels:
    """The pixels rotated by an EXIF orientation."""
    return np.ascontiguousarray(_UPRIGHT[orientation](pixels))


def _is_damaged_jpeg(data: bytes) -> bool:
    """Whether FFmpeg's decoder finds the data of a JPEG damaged."""
    import av

    decoder = av.CodecContext.create("mjpeg", "r")
    decoder.options = {"err_detect": "explode+bitstream+buffer"}
    decoder.thread_count = 1
    try:
        decoder.decode(av.Packet(data))
        decoder.decode(None)
    except av.error.InvalidDataError:
        return True
    except av.error.FFmpegError:
        return False  # a kind of JPEG that only Pillow supports
    return False
