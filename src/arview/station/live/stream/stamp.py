"""The stamp: a strip of black and white cells below a picture that encodes the frame's id and size.

WebRTC does not tell the receiver which camera frame a decoded frame is. The stamp does, and it survives encoding and
scaling. For a picture of width W:

- the strip is ``strip_px(W) = 2 * ceil(W / 64)`` rows below the picture, over the full width;
- it holds 2 rows of 32 cells: cell (r, c) spans columns ``c*W/32`` to ``(c+1)*W/32`` and, of the strip, rows
  ``r*S/2`` to ``(r+1)*S/2``; white (255) is 1, black (0) is 0;
- the 64 bits, row after row, most significant first, are 8 bytes: 20 bits frame id, 13 bits W, 13 bits H (the
  picture's size without strip), 2 bits quarter turns, 16 bits CRC-16/CCITT-FALSE (poly 0x1021, init 0xFFFF, no
  reflection, no final xor) of the first 6 bytes.

Quarter turns: how often the browser rotated the picture of the sensor clockwise to show it upright. They matter for
calibrated cameras only. For a phone (natural orientation portrait) they are
``(1 - screen.orientation.angle / 90) mod 4``, for other devices ``(-angle / 90) mod 4``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

CELLS, ROWS = 32, 2
MIN_WIDTH_PX, MAX_PX = 64, 4096
"""Smallest width of a picture, and bound on its sides (exclusive)."""
_MIN_CONTRAST = 50.0
"""Smallest difference between the means of the white and of the black cells, grey levels."""


@dataclass(frozen=True)
class Stamp:
    """The values that a strip encodes.

    Attributes:
        frame_id: 0 to 2^20 - 1.
        width, height: size of the picture without the strip when it was stamped, px.
        quarter_turns_clockwise: 0 to 3, rotation that the browser applied to the picture of the sensor.
    """

    frame_id: int
    width: int
    height: int
    quarter_turns_clockwise: int = 0


def strip_px(width: int) -> int:
    """Height of the strip below a picture of this width, rows."""
    return 2 * -(-width // 64)


def crc16(data: bytes) -> int:
    """CRC-16/CCITT-FALSE; its value for ``b"123456789"`` is 0x29B1."""
    crc = 0xFFFF
    for byte in data:
        crc ^= byte << 8
        for _ in range(8):
            crc = ((crc << 1) ^ 0x1021 if crc & 0x8000 else crc << 1) & 0xFFFF
    return crc


def stamp_strip(stamp: Stamp) -> NDArray[np.uint8]:
    """The strip of a stamp, (S,W) uint8 with the values 0 and 255."""
    payload = (
        (stamp.frame_id << 28) | (stamp.width << 15) | (stamp.height << 2) | stamp.quarter_turns_clockwise
    ).to_bytes(6, "big")
    coded = payload + crc16(payload).to_bytes(2, "big")
    cells = np.unpackbits(np.frombuffer(coded, dtype=np.uint8)).reshape(ROWS, CELLS)
    columns = np.arange(stamp.width) * CELLS // stamp.width
    rows = np.arange(strip_px(stamp.width)) * ROWS // strip_px(stamp.width)
    return np.asarray(255 * cells[rows][:, columns], dtype=np.uint8)


def stamped(image: NDArray[np.uint8], frame_id: int, quarter_turns_clockwise: int = 0) -> NDArray[np.uint8]:
    """The image with its strip below, (H+S,W,3) uint8 RGB."""
    height, width = image.shape[:2]
    below = stamp_strip(Stamp(frame_id, width, height, quarter_turns_clockwise))
    return np.concatenate([image, np.repeat(below[:, :, None], 3, axis=2)])


def read_stamp(gray: NDArray[np.uint8]) -> Stamp | None:
    """The stamp of a received frame, which may have been scaled; None when its checksum does not match.

    Args:
        gray: (H,W) uint8 brightness of the whole frame, strip included.
    """
    height, width = gray.shape
    rows_px = width / 32.0  # height of the strip, to within two rows of the unscaled frame
    if width < MIN_WIDTH_PX or height < 2 * rows_px:
        return None
    for strip_height_px in (float(strip_px(width)), rows_px, rows_px + 1.0):
        means = _cell_means(gray, strip_height_px)
        low, high = means.min(), means.max()
        if high - low < _MIN_CONTRAST:
            continue
        coded = np.packbits(means.ravel() > 0.5 * (low + high)).tobytes()
        if crc16(coded[:6]) == int.from_bytes(coded[6:], "big"):
            value = int.from_bytes(coded[:6], "big")
            stamp = Stamp(value >> 28, (value >> 15) & 0x1FFF, (value >> 2) & 0x1FFF, value & 3)
            return stamp if _fits(stamp, width, height) else None
    return None


def _cell_means(gray: NDArray[np.uint8], strip_height_px: float) -> NDArray[np.float64]:
    """Mean brightness of the inner half of each cell, (2,32)."""
    height, width = gray.shape
    means = np.zeros((ROWS, CELLS))
    cell_w, cell_h = width / CELLS, strip_height_px / ROWS
    for row in range(ROWS):
        top = height - strip_height_px + (row + 0.25) * cell_h
        v0 = int(top)
        v1 = max(v0 + 1, int(top + 0.5 * cell_h))
        for cell in range(CELLS):
            u0 = int((cell + 0.25) * cell_w)
            u1 = max(u0 + 1, int((cell + 0.75) * cell_w))
            means[row, cell] = gray[v0:v1, u0:u1].mean()
    return means


def _fits(stamp: Stamp, width: int, height: int) -> bool:
    """Whether a received frame of this size can be the stamped one, scaled uniformly."""
    if not (MIN_WIDTH_PX <= stamp.width < MAX_PX and 0 < stamp.height < MAX_PX):
        return False
    scale = width / stamp.width
    return abs(scale * (stamp.height + strip_px(stamp.width)) - height) <= max(2.0, 0.01 * height)
