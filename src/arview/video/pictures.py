"""Sources on disk: pictures of a folder, a glob or a numbered pattern."""

from __future__ import annotations

import io
import re
import struct
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.camera import PHOTO_SUFFIXES, check_jpeg_scans, open_picture, read_exif
from arview.core.extras import load
from arview.errors import InputError, MissingDependencyError
from arview.video.frame import Frame, Image
from arview.video.source import FrameRange, FrameSource, read_ahead
from arview.video.tiff import SUFFIXES as TIFF_SUFFIXES
from arview.video.tiff import tiff_pages

RAW_SUFFIXES = frozenset({".dng"})
SUFFIXES = PHOTO_SUFFIXES | RAW_SUFFIXES
MAX_NUMBER = 99_999_999
"""Largest number in a file name that is taken for that of a frame; longer ones are dates or clocks."""
PROBED_PICTURES = 5
"""Pictures, spread over the sequence, whose largest values tell how many bits of 16 are used."""
MAX_DEFLATE_RATIO = 1032
"""Bytes that a byte of compressed data can stand for (RFC 1951): a PNG that claims more is damaged or hostile."""
MIN_ASPECT_DIFFERENCE = 0.01
"""Relative difference of the sides of a pixel from which it is not square."""
USED_BITS = (8, 10, 12, 14, 16)
_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_PNG_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}
_TIFF_SIGNATURES = (b"II", b"MM")
_PRINTF = re.compile(r"%(0?)([0-9]*)d")


class PictureSource(FrameSource):
    """Frames from picture files in the given order; the EXIF orientation is applied.

    Where the names differ in one number only, that number is the index of the frame, so that gaps stay gaps in index
    and time; else the index is the position. Each page of a TIFF is a picture. Times are those of ``fps`` frames per
    second from the first picture on. Pictures that cannot be read or differ in size from the first are skipped and
    counted. Pictures of 16 bits are reduced to 8 by the bits that are used: 12-bit values in 16 bits are not left dark.

    Attributes:
        first_path: the first picture that can be read.

    Raises:
        InputError: on construction, if no picture can be read.
        MissingDependencyError: a HEIC picture without pillow-heif, or a DNG without rawpy.
    """

    def __init__(self, name: str, paths: Sequence[Path], wanted: FrameRange, fps: float) -> None:
        self.name = name
        self.fps = self._pictures_per_s = fps
        pages = [(path, page) for path in paths for page in tiff_pages(path)]
        numbers = frame_numbers(paths) if len(pages) == len(paths) else None
        indices = list(range(len(pages))) if numbers is None else numbers
        self._first_index = indices[0]
        kept = [
            (i, page) for i, page in zip(indices, pages, strict=True) if i >= wanted.start and not wanted.is_past(i)
        ]
        # Every stride-th picture that is there, because numbers may have a stride of their own.
        self._pictures = kept[:: wanted.stride]
        self.frame_count = len(self._pictures)
        if not kept and numbers is not None:
            end = "" if wanted.end is None else f" and below {wanted.end}"
            raise InputError(
                f"{name}: no picture has a number from {wanted.start} on{end}; "
                f"the numbers of its {len(paths)} pictures go from {min(numbers)} to {max(numbers)}"
            )
        if not kept:
            raise InputError(f"{name}: start {wanted.start} is past the last of its {len(pages)} pictures")
        self._fault = "cannot be read"
        self._held = (Path(), b"")
        self._used_bits = self._probed_bits()
        for path, page in pages:
            first = self._read(path, page)
            if first is not None:
                break
        else:
            which = (
                f"the picture {self._fault}" if len(paths) == 1 else f"none of the {len(paths)} pictures can be read"
            )
            raise InputError(f"{name}: {which}; save {'it' if len(paths) == 1 else 'them'} as JPEG or PNG")
        self.first_path = path
        self._aspect_note = _aspect_note(path)
        self.height, self.width = first.shape[:2]
        self.quarter_turns_clockwise = _turns_of_picture(path)

    def __iter__(self) -> Iterator[Frame]:
        return read_ahead(self._frames)

    def _frames(self) -> Iterator[Frame]:
        self.skipped, self.notes = 0, (self._aspect_note,) if self._aspect_note else ()
        has_told_size = False
        for index, (path, page) in self._pictures:
            image = self._read(path, page)
            if image is None or image.shape != (self.height, self.width, 3):
                self.skipped += 1
                if image is not None and not has_told_size:
                    has_told_size = True
                    self.notes = (
                        *self.notes,
                        f"{path.name} is {image.shape[1]}×{image.shape[0]} px, not {self.width}×{self.height} as the "
                        "first picture: pictures of another size are left out",
                    )
                continue
            yield Frame(image, index, (index - self._first_index) / self._pictures_per_s, path.name)

    def _probed_bits(self) -> int:
        """Bits that 16-bit pictures of the sequence use; 8 if it has none."""
        deep = [picture for _, picture in self._pictures if picture[0].suffix.lower() in {".png", *TIFF_SUFFIXES}]
        used = USED_BITS[0]
        for path, page in deep[:: max(len(deep) // PROBED_PICTURES, 1)][:PROBED_PICTURES]:
            data = self._checked_bytes(path)
            if data is None or (data.startswith(_PNG_SIGNATURE) and data[24:25] != b"\x10"):
                continue
            pixels = _decoded(data, page)
            if pixels is not None and pixels.dtype == np.uint16:
                used = max(used, used_bits(pixels, significant_bits(data)))
        return used

    def _checked_bytes(self, path: Path) -> bytes | None:
        """The content of a file that `check_picture` lets pass; else None, and why is kept."""
        if self._held[0] == path:  # another page of the same file
            return self._held[1]
        try:
            data = path.read_bytes()
            check_picture(data)
        except OSError as error:
            self._fault = f"cannot be read ({error.strerror or error})"
        except InputError as error:
            self._fault = str(error).partition(";")[0]
        else:
            self._held = (path, data) if path.suffix.lower() in TIFF_SUFFIXES else self._held
            return data
        return None

    def _read(self, path: Path, page: int) -> Image | None:
        """(H,W,3) uint8 RGB, upright; None if the file is not a readable picture."""
        data = self._checked_bytes(path)
        if data is None:
            return None
        if data[4:8] == b"ftyp":
            return _read_heif(data)
        if path.suffix.lower() in RAW_SUFFIXES:
            return _read_raw(data)
        pixels = _decoded(data, page)
        if pixels is None:
            return None
        if pixels.dtype == np.uint16:
            # A picture brighter than those that were probed is not cut off.
            self._used_bits = max(self._used_bits, used_bits(pixels, significant_bits(data)))
            pixels = cv2.convertScaleAbs(pixels, alpha=255.0 / (2**self._used_bits - 1))
        elif pixels.dtype != np.uint8:
            pixels = _from_float(pixels)
        return cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB)


def check_picture(data: bytes) -> None:
    """Check from the header of a picture that decoding it takes neither minutes nor gigabytes.

    TIFF files that Pillow does not know, as those of 16-bit colours, are left to the limits of OpenCV.

    Raises:
        InputError: it has too many scans or pixels, more pixels than its data can hold, or no readable header.
    """
    from PIL.Image import DecompressionBombError

    check_jpeg_scans(data)
    if data.startswith(_PNG_SIGNATURE):
        _check_png(data)
    try:
        open_picture(data).close()
    except MissingDependencyError:
        return
    except InputError as error:
        if isinstance(error.__cause__, DecompressionBombError) or not data.startswith(_TIFF_SIGNATURES):
            raise


def _check_png(data: bytes) -> None:
    """Check that the chunks of a PNG end within it, and that its data can hold as many pixels as its header says.

    Raises:
        InputError: they do not, as in a file that was cut short or made to occupy memory.
    """
    start = len(_PNG_SIGNATURE)
    while start + 12 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, start)
        if start + 12 + length > len(data):
            raise InputError("is a damaged PNG, or one that was cut short; copy it again")
        if kind == b"IHDR" and length >= 10:
            width, height, bits, color = struct.unpack_from(">IIBB", data, start + 8)
            if width * height * bits * _PNG_CHANNELS.get(color, 1) > 8 * MAX_DEFLATE_RATIO * len(data):
                raise InputError(f"is a damaged PNG: {len(data)} bytes cannot hold {width}×{height} px")
        start += 12 + length


def picture_paths(folder: Path) -> list[Path]:
    """Picture files of a folder in natural order (2 before 10), see `pictures_among`."""
    return pictures_among(folder.iterdir())


def pictures_among(paths: Iterable[Path]) -> list[Path]:
    """Picture files among some paths in natural order; a raw is left out if its developed picture is there, too."""
    pictures = [path for path in paths if is_picture(path)]
    developed = {path.with_suffix("") for path in pictures if path.suffix.lower() not in RAW_SUFFIXES}
    return sorted_naturally(
        path for path in pictures if path.suffix.lower() not in RAW_SUFFIXES or path.with_suffix("") not in developed
    )


def is_film(path: Path) -> bool:
    """Whether a picture is an animated PNG, which FFmpeg reads."""
    with path.open("rb") as file:
        return path.suffix.lower() == ".png" and b"acTL" in file.read(1 << 16).partition(b"IDAT")[0]


def is_picture(path: Path) -> bool:
    """Whether a name ends as one of a picture; hidden files, such as ``._a.jpg`` of macOS, do not count."""
    return path.suffix.lower() in SUFFIXES and not path.name.startswith(".")


def sorted_naturally(paths: Iterable[Path]) -> list[Path]:
    """Paths in an order that takes runs of digits as numbers."""

    def key(path: Path) -> list[tuple[int, str]]:
        parts = re.split(r"([0-9]+)", str(path).lower())
        return [(int(part), part) if part.isdecimal() and part.isascii() else (-1, part) for part in parts]

    return sorted(paths, key=key)


def frame_numbers(paths: Sequence[Path]) -> list[int] | None:
    """Numbers of the pictures of a numbered sequence; None if their names are not one.

    The names must be alike but for one run of digits, which must differ and increase from picture to picture.
    """
    split = [re.split(r"([0-9]+)", str(path)) for path in paths]
    if len(paths) < 2 or len({len(parts) for parts in split}) != 1:
        return None
    columns = list(zip(*split, strict=True))
    changing = [k for k, column in enumerate(columns) if len(set(column)) > 1]
    if len(changing) != 1 or changing[0] % 2 == 0:
        return None
    texts = columns[changing[0]]
    if max(len(text.lstrip("0")) for text in texts) > len(str(MAX_NUMBER)):
        return None
    numbers = [int(text) for text in texts]
    return numbers if all(a < b for a, b in pairwise(numbers)) else None


def is_printf_pattern(text: str) -> bool:
    """Whether a name is a pattern of numbered pictures, as ``frame_%04d.png``."""
    return len(_PRINTF.findall(Path(text).name)) == 1 and "%" not in _PRINTF.sub("", Path(text).name)


def paths_of_pattern(text: str) -> list[Path]:
    """Existing files of a pattern as ``shots/frame_%04d.png``, by their numbers.

    Raises:
        InputError: the folder cannot be read, or no file fits the pattern.
    """
    pattern = Path(text)
    found = _PRINTF.search(pattern.name)
    assert found is not None
    padded, width = found.group(1) == "0", int(found.group(2) or 1)
    digits = rf"([0-9]{{{width},9}})" if padded or width == 1 else r" *([0-9]{1,9})"
    name = re.compile(re.escape(pattern.name[: found.start()]) + digits + re.escape(pattern.name[found.end() :]))
    try:
        matches = [(match, path) for path in pattern.parent.iterdir() if (match := name.fullmatch(path.name))]
    except OSError as error:
        raise InputError(f"{text}: the folder {pattern.parent} cannot be read ({error.strerror or error})") from error
    if not matches:
        raise InputError(f"{text}: no file in {pattern.parent.resolve()} fits the pattern; check it")
    return [path for _, path in sorted(matches, key=lambda found: int(found[0].group(1)))]


def significant_bits(data: bytes) -> int | None:
    """Significant bits of a 16-bit PNG by its sBIT chunk, the most of any channel; None without it."""
    if not data.startswith(_PNG_SIGNATURE):
        return None
    start = len(_PNG_SIGNATURE)
    while start + 8 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, start)
        if kind == b"sBIT":
            return max(data[start + 8 : start + 8 + length], default=None)
        if kind == b"IDAT":
            break
        start += 12 + length
    return None


def used_bits(pixels: NDArray[Any], significant: int | None) -> int:
    """Bits in which the values of a 16-bit picture lie.

    The largest value tells it; significant bits that are declared are believed as long as no value exceeds them, since
    the PNG standard wants values scaled up to 16 bits, and many cameras leave them unscaled.
    """
    largest = int(pixels.max(initial=0))
    if significant is not None and 8 <= significant <= 16 and largest < 2**significant:
        return significant
    return next(bits for bits in USED_BITS if largest < 2**bits)


@contextmanager
def quiet_opencv() -> Iterator[None]:
    """Suppress OpenCV's own warnings: what arview raises or counts says the same in one line."""
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        cv2.utils.logging.setLogLevel(level)


def _decoded(data: bytes, page: int) -> NDArray[Any] | None:
    """(H,W,3) BGR as stored, of 8 or 16 bits or floating point, upright; None if it is not a picture."""
    content, flags = np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH
    try:
        with quiet_opencv():
            if page == 0:
                return cv2.imdecode(content, flags)
            return next(iter(cv2.imdecodemulti(content, flags, range=(page, page + 1))[1]), None)
    except cv2.error:
        return None


def _from_float(pixels: NDArray[Any]) -> Image:
    """(H,W,3) uint8 of values from 0 to 1, or else to the largest one."""
    values = np.nan_to_num(pixels.astype(np.float32), nan=0.0, posinf=0.0, neginf=0.0)
    largest = float(values.max(initial=0.0))
    return np.clip(values * (255.0 / max(largest, 1.0)), 0.0, 255.0).round().astype(np.uint8)


def _read_heif(data: bytes) -> Image | None:
    """(H,W,3) uint8 RGB of a HEIC picture; its reader applies the orientation."""
    try:
        with open_picture(data) as picture:
            return np.array(picture.convert("RGB"))
    except MissingDependencyError:
        raise
    except Exception:  # the reader raises whatever a damaged file makes it run into
        return None


def _read_raw(data: bytes) -> Image | None:
    """(H,W,3) uint8 RGB of a DNG, upright, with the white balance of the camera and one brightness for all pictures."""
    rawpy = load("reading DNG pictures", "rawpy")
    try:
        with rawpy.imread(io.BytesIO(data)) as raw:
            return np.ascontiguousarray(raw.postprocess(use_camera_wb=True, no_auto_bright=True, output_bps=8))
    except Exception:  # the reader raises whatever a damaged file makes it run into
        return None


def _aspect_note(path: Path) -> str:
    """What to know of pictures whose header says that their pixels are not square; empty if they are.

    Programs disagree on which way round JFIF and PNG state it, so that the pixels are left as they are stored.
    """
    try:
        with open_picture(path.read_bytes()) as picture:
            is_ratio = picture.info.get("jfif_unit") == 0
            ratio = picture.info.get("aspect") or (picture.info.get("jfif_density") if is_ratio else None)
    except (InputError, OSError):
        return ""
    if ratio is None or len(ratio) != 2 or min(ratio) <= 0 or abs(ratio[0] / ratio[1] - 1.0) < MIN_ASPECT_DIFFERENCE:
        return ""
    return (
        f"{path.name} says that its pixels are not square ({ratio[0]}:{ratio[1]}): the pictures are used as they are "
        "stored, which needs a camera calibrated from such pictures (fx and fy differ)"
    )


def _turns_of_picture(path: Path) -> int:
    try:
        return read_exif(path).quarter_turns_clockwise
    except InputError:
        return 0
