"""Pictures of one size from decoded frames: upright, with square pixels."""

from __future__ import annotations

from fractions import Fraction

import cv2
from av.video.frame import VideoFrame

from arview.video.color import deep_gray_or_rgb, rgb_from_video_frame
from arview.video.frame import Image
from arview.video.pictures import USED_BITS, used_bits

MAX_PIXEL_ASPECT = 4.0
"""Widest, and by its inverse narrowest, pixel that is believed; professional formats lie between 0.9 and 2.2."""
MAX_ASPECT_CHANGE = 0.01
"""Relative difference of aspect ratios that counts as rounding, when the size of the frames changes."""
_CV2_ROTATIONS = {1: cv2.ROTATE_90_CLOCKWISE, 2: cv2.ROTATE_180, 3: cv2.ROTATE_90_COUNTERCLOCKWISE}


def turns_of(frame: VideoFrame) -> int:
    """Quarter turns clockwise, 0–3, that the frame's display matrix declares."""
    return round(-frame.rotation / 90.0) % 4


class UprightPictures:
    """Converts the frames of a stream to pictures that are all like the first one.

    Values of 16 bits are reduced to 8 by the bits that are used, as those of pictures are. Pixels that are not square
    are made so by enlarging the shorter side. Where the size of the frames changes, they are scaled to the first size
    if they show the same aspect ratio.

    Args:
        first: first frame.
        pixel_aspect: width of a stored pixel divided by its height; None, or a value that no camera has, means square.

    Attributes:
        width, height: size of the pictures, px.
        quarter_turns_clockwise: rotation applied.
        stored_size: width and height in px of the upright first frame before its pixels were made square.
        note: in one sentence, what became of frames of another size; empty if there were none.
    """

    def __init__(self, first: VideoFrame, pixel_aspect: Fraction | None) -> None:
        self.note = ""
        self._used_bits = USED_BITS[0]
        self.quarter_turns_clockwise = turns_of(first)
        self._decoded_size = (first.width, first.height)
        aspect = float(pixel_aspect) if pixel_aspect else 1.0
        if not 1.0 / MAX_PIXEL_ASPECT <= aspect <= MAX_PIXEL_ASPECT:
            aspect = 1.0
        self._display_ratio = aspect * first.width / first.height
        square = (round(first.width * max(aspect, 1.0)), round(first.height / min(aspect, 1.0)))
        self.width, self.height = self._turned(square)
        self.stored_size = self._turned(self._decoded_size)

    @property
    def is_square(self) -> bool:
        """Whether the stored pixels were square."""
        return self.stored_size == (self.width, self.height)

    def image_of(self, frame: VideoFrame, index: int) -> Image | None:
        """(H,W,3) uint8 RGB of the frame of an index; None if its aspect ratio is not that of the first one."""
        size = (frame.width, frame.height)
        if size != self._decoded_size:
            ratios = (self._display_ratio, self._decoded_size[0] / self._decoded_size[1])
            is_alike = any(abs(size[0] / size[1] / ratio - 1.0) <= MAX_ASPECT_CHANGE for ratio in ratios)
            self._note_change(size, index, is_alike)
            if not is_alike:
                return None
        deep = deep_gray_or_rgb(frame)
        if deep is None:
            image = rgb_from_video_frame(frame)
        else:
            self._used_bits = max(self._used_bits, used_bits(deep, None))
            image = cv2.convertScaleAbs(deep, alpha=255.0 / (2**self._used_bits - 1))
            image = cv2.cvtColor(image, cv2.COLOR_GRAY2RGB) if image.ndim == 2 else image
        if self.quarter_turns_clockwise:
            image = cv2.rotate(image, _CV2_ROTATIONS[self.quarter_turns_clockwise])
        if image.shape[:2] == (self.height, self.width):
            return image
        is_smaller = image.shape[0] * image.shape[1] > self.width * self.height
        return cv2.resize(
            image, (self.width, self.height), interpolation=cv2.INTER_AREA if is_smaller else cv2.INTER_LINEAR
        )

    def _turned(self, size: tuple[int, int]) -> tuple[int, int]:
        """Width and height after the rotation."""
        return (size[1], size[0]) if self.quarter_turns_clockwise % 2 else size

    def _note_change(self, size: tuple[int, int], index: int, is_alike: bool) -> None:
        if not self.note:
            old, new = (f"{width}×{height}" for width, height in (self._decoded_size, size))
            done = "frames of another size are scaled to it" if is_alike else "frames of another shape are left out"
            self.note = f"the size changes from {old} to {new} px at frame {index}: {done}"
