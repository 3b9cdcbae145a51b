"""Serial codes: DataMatrix and QR codes and AprilTags on a part that name its serial number.

A picture may show many codes, of pallets, boards and labels. Only a text that is the serial number, or has the form of
one, counts; all others are ignored. DataMatrix (ISO/IEC 16022) and QR codes (ISO/IEC 18004) are read with zxing-cpp,
AprilTags (Olson 2011) with OpenCV.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import cv2
import numpy as np
import zxingcpp
from numpy.typing import NDArray

from arview.errors import InputError
from arview.geometry import Array

TAG_FAMILIES = {
    "tag16h5": cv2.aruco.DICT_APRILTAG_16h5,
    "tag25h9": cv2.aruco.DICT_APRILTAG_25h9,
    "tag36h10": cv2.aruco.DICT_APRILTAG_36h10,
    "tag36h11": cv2.aruco.DICT_APRILTAG_36h11,
}
"""AprilTag families by name. The text of a tag is its family and number, as in ``tag36h11-42``."""


@dataclass(frozen=True)
class SerialNumbers:
    """The serial number of the part, and which texts are serial numbers.

    Attributes:
        serial: of the specimen to which the labels belong; may be empty.
        pattern: regular expression that a whole text must match to be a serial number. If it is empty, a text of the
            form of ``serial`` is one: the same but for its digits, so that ``BP-0043`` is a serial number where
            ``BP-0042`` is the part's. A serial number of digits only has no form of its own.

    Raises:
        InputError: the pattern is not a regular expression.
    """

    serial: str = ""
    pattern: str = ""

    def __post_init__(self) -> None:
        try:
            re.compile(self.pattern)
        except re.error as error:
            raise InputError(f"serial_pattern = {self.pattern!r}: not a regular expression: {error}") from error

    @classmethod
    def expected(cls, inspected: str | None, declared: str | None, pattern: str) -> SerialNumbers | None:
        """What codes are read for; None where nothing names a serial number.

        Args:
            inspected: serial number of the inspection, which comes first.
            declared: serial number of the part file.
            pattern: see the class.
        """
        serial = inspected or declared or ""
        return cls(serial, pattern) if serial or pattern else None

    @cached_property
    def form(self) -> re.Pattern[str] | None:
        """What a serial number looks like; None if any text that is not the part's own number is ignored."""
        if self.pattern:
            return re.compile(self.pattern)
        if re.search(r"\d", self.serial) is None or self.serial.isdecimal():
            return None
        family, _, number = self.serial.rpartition("-")
        if family in TAG_FAMILIES and number.isdecimal():
            return re.compile(rf"{family}-\d+")
        runs = re.split(r"(\d+)", self.serial)
        return re.compile("".join(f"[0-9]{{{len(run)}}}" if run.isdecimal() else re.escape(run) for run in runs))

    def is_serial(self, text: str) -> bool:
        """Whether a text is a serial number of this kind of part."""
        if self.serial and text == self.serial:
            return True
        return bool(text) and self.form is not None and self.form.fullmatch(text) is not None

    @cached_property
    def tag_families(self) -> tuple[str, ...]:
        """AprilTag families that may name a serial number: those that the serial number or the pattern mentions."""
        return tuple(name for name in TAG_FAMILIES if name in self.serial or name in self.pattern)


EVERY = 15
"""Frames between two attempts until a code has been read."""
AGAIN_EVERY = 60
"""Frames between two attempts afterwards."""
MAX_SIDE_PX = 900
"""Longer side of the cut-out of the part beyond which it is reduced; it bounds the time."""
MIN_SIDE_PX = 600
"""Longer side below which it is enlarged, because modules of few pixels are not read."""
MAX_ENLARGEMENT = 3.0
"""Factor by which it is enlarged at most."""
MARGIN = 0.02
"""Border around the part's outline in which a code still belongs to it, in widths of its box."""


class SerialCode(NamedTuple):
    """A code that names a serial number.

    Attributes:
        text: the serial number.
        center_px: (2,) its centre in the frame.
    """

    text: str
    center_px: Array


class SerialCodeReader:
    """Reads the serial number on a part.

    Args:
        numbers: which texts are serial numbers.
    """

    def __init__(self, numbers: SerialNumbers) -> None:
        self.numbers = numbers
        self._detectors = {
            name: cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(TAG_FAMILIES[name]))
            for name in numbers.tag_families
        }

    def is_due(self, frame: int, has_read: bool) -> bool:
        """Whether the code should be read in a frame, counted from 1."""
        return frame % (AGAIN_EVERY if has_read else EVERY) == 1

    def read(self, image: NDArray[np.uint8], hull_px: NDArray[np.float32]) -> str:
        """The serial number within the outline of a part, or empty if there is none or there are different ones.

        Args:
            image: (H,W,3) uint8 RGB.
            hull_px: (N,2) convex hull of the part's outline.
        """
        codes = self.find(image, hull_px)
        texts = {code.text for code in codes}
        return texts.pop() if len(texts) == 1 else ""

    def find(self, image: NDArray[np.uint8], hull_px: NDArray[np.float32]) -> list[SerialCode]:
        """All codes within the outline of a part that name a serial number."""
        if len(hull_px) < 3:
            return []
        height, width = image.shape[:2]
        border_px = MARGIN * float(np.ptp(hull_px, axis=0).max())
        low = np.floor(np.maximum(hull_px.min(axis=0) - border_px, 0.0)).astype(int)
        high = np.ceil(np.minimum(hull_px.max(axis=0) + border_px + 1.0, [width, height])).astype(int)
        if (high - low).min() < 8:
            return []
        gray = cv2.cvtColor(np.ascontiguousarray(image[low[1] : high[1], low[0] : high[0]]), cv2.COLOR_RGB2GRAY)
        codes = []
        for scale in self._scales(max(gray.shape)):
            way = cv2.INTER_AREA if scale < 1.0 else cv2.INTER_CUBIC
            scaled = gray if scale == 1.0 else cv2.resize(gray, None, fx=scale, fy=scale, interpolation=way)
            for text, corners in self._texts(np.ascontiguousarray(scaled)):
                center = (corners.mean(axis=0) + 0.5) / scale - 0.5 + low
                inside_px = cv2.pointPolygonTest(hull_px, (float(center[0]), float(center[1])), True)
                if inside_px >= -border_px and self.numbers.is_serial(text):
                    codes.append(SerialCode(text, center))
            if codes:
                break
        return codes

    def _scales(self, side_px: int) -> list[float]:
        """Scales at which a cut-out with a longer side is read, one after another until a serial number is found."""
        first = min(1.0, MAX_SIDE_PX / side_px)
        if side_px >= MIN_SIDE_PX:
            return [first]
        return [first, min(MAX_ENLARGEMENT, MAX_SIDE_PX / side_px)]

    def _texts(self, gray: NDArray[np.uint8]) -> list[tuple[str, Array]]:
        """Texts and corners (4,2) of all codes in a grey picture."""
        formats = (zxingcpp.BarcodeFormat.DataMatrix, zxingcpp.BarcodeFormat.QRCode, zxingcpp.BarcodeFormat.MicroQRCode)
        found = []
        for code in zxingcpp.read_barcodes(gray, formats=formats):
            p = code.position
            corners = [p.top_left, p.top_right, p.bottom_right, p.bottom_left]
            found.append((code.text.strip(), np.array([[corner.x, corner.y] for corner in corners], dtype=np.float64)))
        for name, detector in self._detectors.items():
            quads, ids, _ = detector.detectMarkers(gray)
            for quad, number in zip(quads, () if ids is None else np.ravel(ids), strict=True):
                found.append((f"{name}-{number}", np.asarray(quad, dtype=np.float64).reshape(4, 2)))
        return found
