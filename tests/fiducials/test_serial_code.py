"""Serial codes: those on the part count, by their text; all others are ignored."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import zxingcpp
from numpy.typing import NDArray

from arview.errors import InputError
from arview.fiducials.serial_code import SerialCodeReader, SerialNumbers
from arview.geometry import Array

HULL = np.array([[100, 80], [500, 100], [480, 400], [120, 380]], dtype=np.float32)


def drawn(code: NDArray[np.uint8], side_px: float, center: tuple[float, float], tilt: float = 0.0) -> NDArray[np.uint8]:
    """A cluttered picture (480,640,3) with a code on a light label, turned by 12° and foreshortened by ``tilt``."""
    rng = np.random.default_rng(3)
    image = cv2.GaussianBlur(rng.integers(40, 200, (480, 640, 3)).astype(np.uint8), (0, 0), 6)
    label = cv2.copyMakeBorder(code, 20, 20, 20, 20, cv2.BORDER_CONSTANT, value=255)
    size = label.shape[0]
    half = 0.5 * side_px * size / code.shape[0]
    angle = np.deg2rad(12.0)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    corners = np.array([[-half, -half], [half, -half], [half, half], [-half, half]]) * [1.0 - tilt, 1.0]
    target = (corners @ turn.T + center).astype(np.float32)
    source = np.array([[0, 0], [size, 0], [size, size], [0, size]], dtype=np.float32)
    homography = cv2.getPerspectiveTransform(source, target)
    rgb = cv2.cvtColor(label, cv2.COLOR_GRAY2RGB)
    warped = cv2.warpPerspective(rgb, homography, (640, 480), flags=cv2.INTER_AREA)
    mask = cv2.warpPerspective(np.full(label.shape, 255, np.uint8), homography, (640, 480))
    image[mask > 128] = warped[mask > 128]
    return image


def worn(
    image: NDArray[np.uint8], blur_px: float = 0.8, noise: float = 6.0, contrast: float = 0.6
) -> NDArray[np.uint8]:
    """A picture with blur, noise and less contrast."""
    soft = cv2.GaussianBlur(image, (0, 0), blur_px).astype(np.float32)
    soft = 128 + contrast * (soft - 128) + np.random.default_rng(5).normal(0.0, noise, soft.shape)
    return np.asarray(np.clip(np.round(soft), 0, 255), dtype=np.uint8)


def code(kind: str, text: str) -> NDArray[np.uint8]:
    """Picture of a code, 10 px a module."""
    if kind.startswith("tag"):
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_APRILTAG_{kind[3:]}"))
        return np.asarray(cv2.aruco.generateImageMarker(dictionary, int(text), 100))
    made = zxingcpp.create_barcode(text, zxingcpp.BarcodeFormat[kind])
    small = np.asarray(made.to_image(scale=10, add_quiet_zones=False))
    return np.ascontiguousarray(small[..., 0] if small.ndim == 3 else small)


def read(image: NDArray[np.uint8], numbers: SerialNumbers, hull: NDArray[np.float32] = HULL) -> str:
    return SerialCodeReader(numbers).read(image, hull)


@pytest.mark.parametrize("kind", ["DataMatrix", "QRCode"])
@pytest.mark.parametrize("text", ["BP-0042", "BP-0043"])
def test_a_code_on_the_part_is_read_through_blur_and_noise(kind: str, text: str) -> None:
    image = worn(drawn(code(kind, text), 90.0, (300.0, 240.0), tilt=0.25))
    assert read(image, SerialNumbers("BP-0042")) == text


def test_small_modules_are_read_in_an_enlarged_picture() -> None:
    image = worn(drawn(code("DataMatrix", "BP-0042"), 44.0, (300.0, 240.0)), blur_px=0.5, noise=2.0, contrast=0.9)
    assert read(image, SerialNumbers("BP-0042")) == "BP-0042"


def test_a_tag_counts_only_where_its_family_is_named() -> None:
    image = worn(drawn(code("tag36h11", "42"), 90.0, (300.0, 240.0)))
    assert read(image, SerialNumbers("tag36h11-42")) == "tag36h11-42"
    assert read(image, SerialNumbers("tag36h11-7")) == "tag36h11-42"
    assert read(image, SerialNumbers("42")) == ""
    assert read(image, SerialNumbers("A", r"tag36h11-\d+")) == "tag36h11-42"


def test_codes_that_name_no_serial_number_are_ignored() -> None:
    for text in ("PALLET 17", "org/BP-0042", "BP-42", "XP-0042"):
        image = drawn(code("QRCode", text), 110.0, (300.0, 240.0))
        assert read(image, SerialNumbers("", ".*")) == text, "the code itself can be read"
        assert read(image, SerialNumbers("BP-0042")) == ""
    assert read(drawn(code("DataMatrix", "0043"), 110.0, (300.0, 240.0)), SerialNumbers("0042")) == ""


def test_a_code_beside_the_part_is_ignored() -> None:
    image = drawn(code("DataMatrix", "BP-0042"), 70.0, (570.0, 420.0))
    around = np.array([[520, 370], [620, 370], [620, 470], [520, 470]], dtype=np.float32)
    assert read(image, SerialNumbers("BP-0042"), around) == "BP-0042"
    assert read(image, SerialNumbers("BP-0042")) == ""
    # One in the box of the outline but outside the outline is not on the part either.
    corner = drawn(code("DataMatrix", "BP-0042"), 50.0, (130.0, 110.0))
    triangle = np.array([[480, 90], [480, 400], [100, 400]], dtype=np.float32)
    assert read(corner, SerialNumbers("BP-0042"), triangle) == ""


def test_two_different_serial_numbers_say_nothing() -> None:
    image = drawn(code("DataMatrix", "BP-0042"), 90.0, (230.0, 240.0))
    other = drawn(code("QRCode", "BP-0043"), 90.0, (380.0, 240.0))
    image[:, 310:] = other[:, 310:]
    found = SerialCodeReader(SerialNumbers("BP-0042")).find(image, HULL)
    assert sorted(one.text for one in found) == ["BP-0042", "BP-0043"]
    centers: dict[str, Array] = {one.text: one.center_px for one in found}
    assert np.linalg.norm(centers["BP-0042"] - [230.0, 240.0]) < 4.0
    assert read(image, SerialNumbers("BP-0042")) == ""


def test_no_code_and_no_outline_give_nothing() -> None:
    rng = np.random.default_rng(8)
    clutter = rng.integers(0, 255, (480, 640, 3)).astype(np.uint8)
    assert read(clutter, SerialNumbers("BP-0042")) == ""
    assert read(clutter, SerialNumbers("BP-0042"), np.zeros((0, 2), np.float32)) == ""
    assert read(clutter, SerialNumbers("BP-0042"), HULL + 2000) == ""


def test_a_pattern_that_is_none_is_refused() -> None:
    with pytest.raises(InputError, match=r"serial_pattern = '\(': not a regular expression"):
        SerialNumbers("A", "(")
    assert SerialNumbers("A", r"[AB]\d").is_serial("B7")
    assert not SerialNumbers("A", r"[AB]\d").is_serial("B77")


def test_codes_are_read_rarely() -> None:
    reader = SerialCodeReader(SerialNumbers("A"))
    assert sum(reader.is_due(frame, has_read=False) for frame in range(1, 121)) == 8
    assert sum(reader.is_due(frame, has_read=True) for frame in range(1, 121)) == 2
