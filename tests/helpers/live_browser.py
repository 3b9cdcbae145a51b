"""Chromium with the sample clip as its camera: the frames, which of them a screenshot shows, the browser itself."""

from __future__ import annotations

import io
import json
import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image as PilImage

from arview.cad import load_part
from arview.camera import Camera
from arview.camera.read import load_camera
from arview.geometry import Array
from arview.rendering.renderers import open_renderer
from arview.video import Image, open_source
from helpers.live_sample import CLIP, PART, SAMPLE

CHROMIUM = os.environ.get("ARVIEW_CHROMIUM") or shutil.which("chromium") or shutil.which("chromium-browser")
START, STRIDE, COUNT = 21, 3, 14
"""Frames of the clip in which the part is in full view, every third: it moves 3 to 5 px from one to the next."""
CLIP_SIZE = 1280, 720
BITS, CELL_PX, EDGE_PX = 8, 12, 4
"""The counter in the upper left corner: the number of the frame and, below, the same inverted."""
SPECK_PX = 60
"""Smaller differences of two pictures are a video encoder's; the smallest component shown has several times as many."""


@cache
def frames(width: int, height: int) -> list[Image]:
    """(H,W,3) frames of the clip with their number drawn into the corner."""
    return numbered(plain_frames(width, height, STRIDE, COUNT))


def plain_frames(width: int, height: int, stride: int, count: int) -> list[Image]:
    """(H,W,3) frames of the clip; their middle, if the shape is another."""
    left, shown = _crop(width, height)
    source = open_source(CLIP, start=START, end=START + stride * count, stride=stride)
    return [
        cv2.resize(frame.image[:, left : left + shown], (width, height), interpolation=cv2.INTER_AREA)
        for frame in source
    ]


def numbered(images: Sequence[Image]) -> list[Image]:
    """Copies of images with their number, from 0, drawn into the corner."""
    copies = [image.copy() for image in images]
    for number, image in enumerate(copies):
        image[: 2 * (CELL_PX + EDGE_PX), : BITS * CELL_PX + 2 * EDGE_PX] = 128
        for bit in range(BITS):
            is_set = number >> (BITS - 1 - bit) & 1
            columns = slice(EDGE_PX + bit * CELL_PX, EDGE_PX + (bit + 1) * CELL_PX)
            image[EDGE_PX : EDGE_PX + CELL_PX, columns] = 255 * is_set
            image[EDGE_PX + CELL_PX : EDGE_PX + 2 * CELL_PX, columns] = 255 * (1 - is_set)
    return copies


def camera(width: int, height: int) -> Camera:
    """Intrinsics of the frames."""
    whole = load_camera(str(SAMPLE / "camera.json"), *CLIP_SIZE)
    left, shown = _crop(width, height)
    return replace(whole, width=shown, cx=whole.cx - left).scaled(width, height)


def _crop(width: int, height: int) -> tuple[int, int]:
    """First column, and number of columns, of the clip's frames that are shown in this shape."""
    shown = min(CLIP_SIZE[0], round(CLIP_SIZE[1] * width / height))
    return (CLIP_SIZE[0] - shown) // 2, shown


def number_in(picture: Image, scale: float = 1.0) -> int | None:
    """The number of the frame that a picture shows, ``scale`` times its size; None when it cannot be read for sure."""
    number = 0
    for bit in range(BITS):
        u = round(scale * (EDGE_PX + (bit + 0.5) * CELL_PX))
        upper, lower = (
            picture[round(scale * v) - 1 : round(scale * v) + 2, u - 1 : u + 2].mean()
            for v in (EDGE_PX + 0.5 * CELL_PX, EDGE_PX + 1.5 * CELL_PX)
        )
        if abs(upper - lower) < 80:
            return None
        number = 2 * number + int(upper > lower)
    return number if number < COUNT else None


@cache
def truth() -> list[Array]:
    """``cam_from_model`` (4,4) mm of each frame."""
    described = json.loads((SAMPLE / "truth.json").read_text())["frames"]
    return [np.array(described[START + STRIDE * k]["cam_from_model"]) for k in range(COUNT)]


def there_and_back(count: int = COUNT) -> list[int]:
    """Order in which the frames are played over and over, without a jump."""
    return [*range(count), *range(count - 2, 0, -1)]


def write_y4m(path: Path, images: Sequence[Image], fps: int) -> None:
    """A film for ``--use-file-for-fake-video-capture``, which plays it over and over at its own rate."""
    height, width = images[0].shape[:2]
    with path.open("wb") as file:
        file.write(f"YUV4MPEG2 W{width} H{height} F{fps}:1 Ip A1:1 C420jpeg\n".encode())
        for image in images:
            yuv = av.VideoFrame.from_ndarray(image, format="rgb24").reformat(format="yuv420p").to_ndarray()
            file.write(b"FRAME\n" + np.ascontiguousarray(yuv).tobytes())


@contextmanager
def browser(film: Path | None, *more: str) -> Iterator[Any]:
    """A headless Chromium; skips the test when there is none."""
    playwright = pytest.importorskip(
        "playwright.sync_api", reason="Playwright is not installed: pip install playwright"
    )
    if CHROMIUM is None:
        pytest.skip("Chromium is not installed: apt-get install chromium")
    arguments = [
        "--no-sandbox", "--disable-dev-shm-usage", "--allow-loopback-in-peer-connection",
        # The processor stands in for a graphics card; it puts the page together faster by itself than through WebGL.
        "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-gpu-compositing",
        "--force-color-profile=srgb",
        "--use-fake-ui-for-media-stream", "--autoplay-policy=no-user-gesture-required", *more,
    ]  # fmt: skip
    if film is not None:
        arguments += ["--use-fake-device-for-media-stream", f"--use-file-for-fake-video-capture={film}"]
    with playwright.sync_playwright() as driver:
        running = driver.chromium.launch(executable_path=CHROMIUM, args=arguments)
        try:
            yield running
        finally:
            running.close()


def screenshot(page: Any) -> Image:
    """(H,W,3) what the screen shows where the page has its picture."""
    over = "document.getElementById('zoom').style.visibility"
    page.evaluate(f"{over} = 'hidden'")  # its buttons lie over the picture
    picture = page.locator("#picture").screenshot()
    page.evaluate(f"{over} = ''")
    return np.array(PilImage.open(io.BytesIO(picture)).convert("RGB"))


def true_mask(shape: tuple[int, int], number: int) -> NDArray[np.uint8]:
    """(H,W) 0 or 1: the inspected components at the true pose, as the lens shows them in a picture of this size.

    The lens is OpenCV's here, so that it is not arview's own formula that arview is compared with.
    """
    height, width = shape
    lens = camera(width, height)
    model = load_part(str(PART)).model
    ids = open_renderer(model, lens.without_distortion(), "zbuffer").render(truth()[number]).component_ids
    names = [component.name for component in model.components]
    mask = ((ids >= 0) & (ids != names.index("base_plate"))).astype(np.uint8)
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).reshape(-1, 1, 2).astype(np.float64)
    ideal = cv2.undistortPoints(pixels, lens.matrix, lens.dist, P=lens.matrix).reshape(height, width, 2)
    columns, rows = ideal.astype(np.float32).transpose(2, 0, 1)
    return np.asarray(cv2.remap(mask, columns, rows, cv2.INTER_NEAREST))


def outline_errors_px(found: NDArray[np.uint8], true: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Distances between the outlines of two masks, from each pixel of either to the nearest of the other."""
    outlines = [mask - cv2.erode(mask, np.ones((3, 3), np.uint8)) for mask in (found, true)]
    distances = [cv2.distanceTransform(1 - outline, cv2.DIST_L2, 5) for outline in outlines]
    return np.concatenate([distances[1][outlines[0] > 0], distances[0][outlines[1] > 0]]).astype(np.float64)


def difference_mask(one: Image, other: Image, least: float, blur_px: int = 1) -> NDArray[np.uint8]:
    """(H,W) 0 or 1: where two pictures differ by so many grey levels; specks and pin holes are cleaned away."""
    difference = cv2.GaussianBlur(cv2.absdiff(one, other), (blur_px, blur_px), 0).max(axis=2)
    mask = (difference > least).astype(np.uint8)
    mask = np.asarray(cv2.morphologyEx(closed(mask, 5), cv2.MORPH_OPEN, _disc(5)))
    _, labels, sizes, _ = cv2.connectedComponentsWithStats(mask)
    mask[sizes[labels, cv2.CC_STAT_AREA] < SPECK_PX] = 0
    return mask


def closed(mask: NDArray[np.uint8], gap_px: int) -> NDArray[np.uint8]:
    """A mask (H,W) of 0 and 1 without the holes and gaps that are narrower."""
    return np.asarray(cv2.morphologyEx(mask, cv2.MORPH_CLOSE, _disc(gap_px)))


def _disc(diameter_px: int) -> NDArray[np.uint8]:
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (diameter_px, diameter_px)))
