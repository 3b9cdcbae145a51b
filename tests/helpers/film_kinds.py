"""Makers of films of unusual kinds: anamorphic, interlaced, of changing size, with odd clocks and colour tags."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import av
import numpy as np

STEP_PX = 8
"""Shift of the bar of `write_interlaced` from frame to frame; its second field is half of it further."""


def write_film(
    path: Path,
    images: Sequence[np.ndarray],
    *,
    fps: int = 30,
    first_s: float = 0.0,
    pixel_aspect: Fraction | None = None,
    codec: str = "libx264",
    parameters: str = "",
) -> Path:
    """Film of RGB images whose clock starts at ``first_s``; size, codec and format follow from the arguments."""
    height, width = images[0].shape[:2]
    options = {"crf": "8", "preset": "veryfast", "x264-params": f"log-level=none:{parameters}".rstrip(":")}
    # Without an offset, the muxer of MPEG-TS adds 1.4 s of its own.
    with av.open(str(path), "w", options={"muxdelay": "0", "muxpreload": "0"}) as container:
        video = container.add_stream(codec, rate=fps, options=options if codec == "libx264" else {"qscale": "2"})
        video.width, video.height, video.pix_fmt = width, height, "yuv420p"
        if pixel_aspect is not None:
            video.codec_context.sample_aspect_ratio = pixel_aspect
        for k, image in enumerate(images):
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
            frame.pts, frame.time_base = round(first_s * fps) + k, Fraction(1, fps)
            container.mux(video.encode(frame))
        container.mux(video.encode(None))
    return path


def write_interlaced(path: Path, count: int) -> Path:
    """Film at 25 fps of a light bar whose left end is at 20 + STEP_PX × frame in the first field, the bottom one."""
    images = []
    for k in range(count):
        image = np.full((240, 320, 3), 40, np.uint8)
        for row in range(240):
            left = 20 + STEP_PX * k + (0 if row % 2 else STEP_PX // 2)
            image[row, left : left + 60] = 220
        images.append(image)
    return write_film(path, images, fps=25, parameters="bff=1")


def left_ends(image: np.ndarray) -> np.ndarray:
    """(H,) column at which the bar of `write_interlaced` begins in each row."""
    return np.argmax(image[:, :, 0] > 130, axis=1)


def write_tagged(path: Path, size: tuple[int, int], code: tuple[int, int, int], matrix: int, color_range: int) -> Path:
    """Lossless film of one frame of one YUV code, tagged with FFmpeg's numbers of colour matrix and range."""
    with av.open(str(path), "w") as container:
        video = container.add_stream("libx264", rate=30, options={"qp": "0", "x264-params": "log-level=none"})
        video.width, video.height = size
        video.pix_fmt = "yuv420p"
        video.codec_context.colorspace, video.codec_context.color_range = matrix, color_range
        frame = av.VideoFrame(*size, "yuv420p")
        frame.pts, frame.time_base = 0, Fraction(1, 30)
        frame.colorspace, frame.color_range = matrix, color_range
        for plane, value in zip(frame.planes, code, strict=True):
            plane.update(np.full(plane.buffer_size, value, np.uint8).tobytes())
        container.mux(video.encode(frame))
        container.mux(video.encode(None))
    return path


def rgb_of_code(code: tuple[int, int, int], matrix: int, color_range: int) -> np.ndarray:
    """(3,) RGB 0–255 of a YUV code by the definition of its matrix (ITU-R BT.601, BT.709, BT.2020) and range."""
    kr, kb = {1: (0.2126, 0.0722), 6: (0.299, 0.114), 9: (0.2627, 0.0593)}[matrix]
    is_full = color_range == 2
    luma = code[0] / 255.0 if is_full else (code[0] - 16) / 219.0
    blue, red = ((value - 128) / (255.0 if is_full else 224.0) for value in code[1:])
    r, b = luma + 2.0 * (1.0 - kr) * red, luma + 2.0 * (1.0 - kb) * blue
    g = (luma - kr * r - kb * b) / (1.0 - kr - kb)
    return 255.0 * np.clip([r, g, b], 0.0, 1.0)
