"""Conversion of decoded video frames to 8-bit RGB, including high dynamic range (HLG, PQ).

HDR is converted to BT.709 in three steps per pixel: the transfer curve is inverted to linear light in which diffuse
white (HLG 75 %, PQ 203 cd/m², ITU-R BT.2408) is 1; BT.2020 primaries become BT.709; highlights are rolled off above
0.8 and encoded in 8 bits, with the curve of BT.709 for HLG, since both describe the scene (no display gamma is needed
between them), and with that of sRGB for PQ, since both describe the display.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from av.video.frame import VideoFrame
from av.video.reformatter import Colorspace, ColorTrc
from numpy.typing import NDArray

from arview.video.frame import Image

UNSPECIFIED_COLORSPACE = 2
"""FFmpeg's AVCOL_SPC_UNSPECIFIED."""
LINEAR_LEVELS = 4096
"""Entries of the table from signal to light: 12 bits."""
ENCODED_LEVELS = 65536
"""Entries of the table from light to 8 bits: steps of less than half a code value near black."""
PEAK_LIGHT = 8.0
"""Light at which the tables end, in units of diffuse white."""
KNEE = 0.8
"""Light above which highlights are rolled off."""
RGB709_FROM_RGB2020 = np.array(
    [[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]], dtype=np.float32
)
"""Linear BT.2020 to linear BT.709 (ITU-R BT.2087)."""


def rgb_from_video_frame(frame: VideoFrame) -> Image:
    """(H,W,3) uint8 RGB of a decoded frame of any pixel format; HLG and PQ are tone-mapped.

    Frames without a declared colour matrix are taken as BT.709 from 720 lines on, else as BT.601, as players do.
    """
    if frame.color_trc in (ColorTrc.ARIB_STD_B67, ColorTrc.SMPTE2084):
        signal = frame.to_ndarray(format="rgb48le", src_colorspace=Colorspace.BT2020, threads=1)
        return tone_map(signal.astype(np.uint16, copy=False), is_pq=frame.color_trc == ColorTrc.SMPTE2084)
    options: dict[str, Any] = {}
    if frame.colorspace == UNSPECIFIED_COLORSPACE and frame.height >= 720:
        options["src_colorspace"] = Colorspace.ITU709
    # One conversion thread, because at video sizes starting more takes longer than the conversion.
    return np.ascontiguousarray(frame.to_ndarray(format="rgb24", threads=1, **options))


def deep_gray_or_rgb(frame: VideoFrame) -> NDArray[np.uint16] | None:
    """(H,W) or (H,W,3) values of a frame of 16 bits, grey or RGB, as they are stored; None of another frame."""
    is_hdr = frame.color_trc in (ColorTrc.ARIB_STD_B67, ColorTrc.SMPTE2084)
    is_gray = frame.format.name.startswith(("gray16", "ya16"))
    if is_hdr or not (is_gray or (frame.format.is_rgb and frame.format.components[0].bits == 16)):
        return None
    return frame.to_ndarray(format="gray16le" if is_gray else "rgb48le", threads=1).astype(np.uint16, copy=False)


def tone_map(signal: NDArray[np.uint16], is_pq: bool) -> Image:
    """(H,W,3) uint8 BT.709 RGB of (H,W,3) uint16 full-range BT.2020 RGB in HLG or PQ."""
    from arview.video._tone_map import apply_tables

    light_of_signal, code_of_light = tables(is_pq)
    image = np.empty(signal.shape, dtype=np.uint8)
    scale = np.float32((ENCODED_LEVELS - 1) / PEAK_LIGHT)
    apply_tables(signal, light_of_signal, RGB709_FROM_RGB2020 * scale, code_of_light, image)
    return image


@cache
def tables(is_pq: bool) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Light of a signal (LINEAR_LEVELS,) and 8-bit code of light 0 … PEAK_LIGHT (ENCODED_LEVELS,)."""
    signal = np.linspace(0.0, 1.0, LINEAR_LEVELS)
    light = np.linspace(0.0, PEAK_LIGHT, ENCODED_LEVELS)
    rolled = np.where(light <= KNEE, light, 1.0 - (1.0 - KNEE) * np.exp(-(light - KNEE) / (1.0 - KNEE)))
    if is_pq:
        light_of_signal = np.minimum(light_of_pq(signal), PEAK_LIGHT)
        code = np.where(rolled < 0.0031308, 12.92 * rolled, 1.055 * rolled ** (1.0 / 2.4) - 0.055)
    else:
        light_of_signal = light_of_hlg(signal)
        code = np.where(rolled < 0.018, 4.5 * rolled, 1.099 * rolled**0.45 - 0.099)
    return light_of_signal.astype(np.float32), np.round(255.0 * code).astype(np.uint8)


def light_of_hlg(signal: NDArray[np.float64]) -> NDArray[np.float64]:
    """Scene light of an HLG signal in 0–1 (ITU-R BT.2100), 1 at the 75 % signal of diffuse white."""
    a, b, c = 0.17883277, 0.28466892, 0.55991073

    def scene(value: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.where(value <= 0.5, value**2 / 3.0, (np.exp((value - c) / a) + b) / 12.0)

    return scene(signal) / scene(np.array(0.75))


def light_of_pq(signal: NDArray[np.float64]) -> NDArray[np.float64]:
    """Display light of a PQ signal in 0–1 (SMPTE ST 2084), 1 at 203 cd/m²."""
    m1, m2, c1, c2, c3 = 2610 / 16384, 2523 / 32, 3424 / 4096, 2413 / 128, 2392 / 128
    power = signal ** (1.0 / m2)
    return 10000.0 / 203.0 * (np.maximum(power - c1, 0.0) / (c2 - c3 * power)) ** (1.0 / m1)
