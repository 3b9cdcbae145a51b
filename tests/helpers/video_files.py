"""Makers of small video files with known content, sound, orientation and defects for the video tests."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import av
import numpy as np

COLORS = np.array([[200, 40, 60], [30, 180, 70], [40, 60, 210], [230, 220, 40]], dtype=np.uint8)


def quarters(width: int, height: int) -> np.ndarray:
    """(H,W,3) uint8 RGB picture with one of COLORS per quarter: top left, top right, bottom left, right."""
    image = np.empty((height, width, 3), dtype=np.uint8)
    for k, color in enumerate(COLORS):
        rows = slice(0, height // 2) if k < 2 else slice(height // 2, None)
        columns = slice(0, width // 2) if k % 2 == 0 else slice(width // 2, None)
        image[rows, columns] = color
    return image


def numbered(index: int, width: int = 160, height: int = 120) -> np.ndarray:
    """(H,W,3) uint8 RGB picture whose middle has the grey level 10 + 8 × index."""
    image = quarters(width, height)
    image[height // 4 : -height // 4, width // 4 : -width // 4] = 10 + 8 * index
    return image


def number_of(image: np.ndarray) -> int:
    """Index that ``numbered`` put into the picture."""
    height, width = image.shape[:2]
    middle = image[height // 2 - 5 : height // 2 + 5, width // 2 - 5 : width // 2 + 5]
    return round((float(middle.mean()) - 10) / 8)


def write_clip(
    path: Path,
    images: Sequence[np.ndarray],
    times_s: Sequence[float] | None = None,
    with_sound: bool = False,
    gop: int = 12,
    faststart: bool = False,
) -> Path:
    """H.264 clip of the images, at 30 fps or the given times; sound is a 440 Hz tone as AAC."""
    height, width = images[0].shape[:2]
    times_s = times_s or [k / 30 for k in range(len(images))]
    options = {"movflags": "+faststart"} if faststart else {}
    with av.open(str(path), "w", options=options) as container:
        video = container.add_stream("libx264", rate=30, options={"crf": "12", "preset": "ultrafast"})
        video.width, video.height, video.pix_fmt = width, height, "yuv420p"
        video.codec_context.time_base = Fraction(1, 90_000)
        video.codec_context.gop_size = gop
        audio = container.add_stream("aac", rate=48_000) if with_sound else None
        for image, time_s in zip(images, times_s, strict=True):
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
            frame.pts, frame.time_base = round(time_s * 90_000), Fraction(1, 90_000)
            container.mux(video.encode(frame))
        container.mux(video.encode(None))
        if audio is not None:
            for k in range(int((times_s[-1] + 1 / 30) * 48_000) // 1024):
                tone = np.sin(2 * np.pi * 440 / 48_000 * np.arange(k * 1024, (k + 1) * 1024))
                sound = av.AudioFrame.from_ndarray(0.3 * tone[None].astype(np.float32), "fltp", "mono")
                sound.pts, sound.sample_rate, sound.time_base = k * 1024, 48_000, Fraction(1, 48_000)
                container.mux(audio.encode(sound))
            container.mux(audio.encode(None))
    return path


def turn_by_metadata(path: Path, quarter_turns_clockwise: int) -> None:
    """Write a rotation into the display matrix of the first track's ``tkhd`` box (version 0) of an MP4."""
    cosine, sine = [(1, 0), (0, 1), (-1, 0), (0, -1)][quarter_turns_clockwise % 4]
    one = 1 << 16
    matrix = struct.pack(">9i", cosine * one, sine * one, 0, -sine * one, cosine * one, 0, 0, 0, 1 << 30)
    data = bytearray(path.read_bytes())
    start = data.index(b"tkhd") + 4 + 40
    data[start : start + 36] = matrix
    path.write_bytes(data)


def write_hdr_clip(path: Path, levels: Sequence[int], transfer: int) -> Path:
    """10-bit BT.2020 clip of one frame whose vertical bars are grey at the given limited-range luma codes."""
    with av.open(str(path), "w") as container:
        # With B-frames the decoding time of a clip this short is what memory held: the muxer refuses some.
        parameters = "log-level=none:lossless=1:bframes=0:pools=none:frame-threads=1"
        video = container.add_stream("libx265", rate=30, options={"x265-params": parameters})
        video.width, video.height, video.pix_fmt = 64 * len(levels), 64, "yuv420p10le"
        context = video.codec_context
        context.colorspace, context.color_primaries, context.color_range = 9, 9, 1
        context.color_trc = transfer
        frame = av.VideoFrame(64 * len(levels), 64, "yuv420p10le")
        frame.pts, frame.time_base = 0, Fraction(1, 30)
        luma = np.repeat(np.array(levels, dtype=np.uint16), 64)[None].repeat(64, 0)
        chroma = np.full((32, luma.shape[1] // 2), 512, np.uint16)
        for plane, values in zip(frame.planes, [luma, chroma, chroma], strict=True):
            rows = np.zeros((plane.height, plane.line_size // 2), np.uint16)
            rows[:, : values.shape[1]] = values
            plane.update(rows.tobytes())
        container.mux(video.encode(frame))
        container.mux(video.encode(None))
    return path
