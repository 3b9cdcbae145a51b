"""Frames as the server receives them, and their decoding to pictures of the size in which they were taken."""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from av.video.frame import VideoFrame

from arview.camera import check_jpeg_scans
from arview.errors import InputError
from arview.station.live.stream.stamp import read_stamp
from arview.video import Image, rgb_from_video_frame

MIN_SIDE_PX, MAX_SIDE_PX = 64, 2560
"""Range of the sides of the pictures that are accepted."""


@dataclass(frozen=True)
class DecodedFrame:
    """A frame that is ready to be tracked.

    Attributes:
        frame_id: 0 to 2^20 - 1, assigned by the page for a phone and by the server for a station camera.
        image: (H,W,3) uint8 RGB in the size in which it was taken.
        quarter_turns_clockwise: rotation that the browser, or the reader, applied to the picture of the sensor.
        scale: received size over the size in which it was taken; 1 when the frame was not scaled in transit.
        unsquared_size: width and height in px before pixels were made square; None where they were square.
        original: the picture of a wide lens before it was undistorted; None where it was not.
    """

    frame_id: int
    image: Image
    quarter_turns_clockwise: int = 0
    scale: float = 1.0
    unsquared_size: tuple[int, int] | None = None
    original: Image | None = None


@dataclass(frozen=True)
class IncomingFrame:
    """A received frame before decoding.

    Attributes:
        decode: decodes the frame, in the thread of the tracker; returns None when it cannot be read.
        arrived_s: monotonic time of its arrival.
    """

    decode: Callable[[], DecodedFrame | None]
    arrived_s: float


def from_stamped(frame: VideoFrame) -> DecodedFrame | None:
    """A WebRTC frame without the strip of its stamp; None when the stamp cannot be read.

    A frame that was scaled in transit is scaled back, so that the intrinsics and the tracker can stay as they are. The
    scaling agrees with `Camera.scaled` (pixel centres).
    """
    if frame.format.name not in ("yuv420p", "yuvj420p", "nv12"):
        frame = frame.reformat(format="yuv420p")
    plane = frame.planes[0]
    brightness = np.frombuffer(memoryview(plane), dtype=np.uint8)
    gray = brightness.reshape(-1, plane.line_size)[: frame.height, : frame.width]
    stamp = read_stamp(gray)
    if stamp is None or max(stamp.width, stamp.height) > MAX_SIDE_PX or stamp.height < MIN_SIDE_PX:
        return None
    scale = frame.width / stamp.width
    image = rgb_from_video_frame(frame)[: min(frame.height, round(stamp.height * scale))]
    if image.shape[:2] != (stamp.height, stamp.width):
        image = np.asarray(cv2.resize(image, (stamp.width, stamp.height), interpolation=cv2.INTER_LINEAR), np.uint8)
    return DecodedFrame(stamp.frame_id, image, stamp.quarter_turns_clockwise, scale)


def from_jpeg(content: bytes) -> Image:
    """(H,W,3) uint8 RGB of a JPEG. Its size is checked before it is decoded.

    Raises:
        InputError: the content is no JPEG, is damaged, or has a size outside `MIN_SIDE_PX` to `MAX_SIDE_PX`.
    """
    from PIL import Image as Pillow

    try:
        with Pillow.open(io.BytesIO(content), formats=["JPEG"]) as header:
            width, height = header.size
    except (OSError, ValueError, SyntaxError, Pillow.DecompressionBombError) as error:
        raise InputError("the body is not a JPEG picture") from error
    if min(width, height) < MIN_SIDE_PX or max(width, height) > MAX_SIDE_PX:
        raise InputError(f"the picture is {width}×{height} px, expected sides of {MIN_SIDE_PX} to {MAX_SIDE_PX} px")
    check_jpeg_scans(content)
    buffer = np.frombuffer(content, dtype=np.uint8)
    try:
        bgr = cv2.imdecode(buffer, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error:
        bgr = None
    if bgr is None or bgr.shape[:2] != (height, width):
        raise InputError("the JPEG picture is damaged")
    return np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), dtype=np.uint8)


def to_jpeg(image: Image, quality: int = 85) -> bytes:
    """JPEG of an (H,W,3) uint8 RGB picture."""
    _, content = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality])
    return bytes(content)
