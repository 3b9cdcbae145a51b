"""FrameSource: the interface of all sources of frames, and the thread that reads ahead of the consumer."""

from __future__ import annotations

import queue
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

from arview.errors import InputError
from arview.video.frame import Frame

READ_AHEAD_FRAMES = 4
"""Frames decoded ahead, enough to smooth over key frames; 25 MB at 1080p."""
_POLL_S = 0.1
"""Time after which a blocked reader notices that its consumer has stopped."""


@dataclass(frozen=True)
class FrameRange:
    """Wanted frames of a source: every stride-th from start on, start <= index < end.

    Raises:
        InputError: a negative index, an empty range or a stride under 1.
    """

    start: int = 0
    end: int | None = None
    stride: int = 1

    def __post_init__(self) -> None:
        if self.start < 0 or self.stride < 1:
            raise InputError(f"start {self.start}, stride {self.stride}: start must be >= 0 and stride >= 1")
        if self.end is not None and self.end <= self.start:
            raise InputError(f"end {self.end} is not after start {self.start}: no frame is left")

    def wants(self, index: int) -> bool:
        """Whether the frame of an index is wanted."""
        return index >= self.start and (index - self.start) % self.stride == 0 and not self.is_past(index)

    def is_past(self, index: int) -> bool:
        """Whether no frame from an index on is wanted."""
        return self.end is not None and index >= self.end

    def count(self, total: int) -> int:
        """Number of wanted frames of a source with ``total`` frames."""
        end = total if self.end is None else min(self.end, total)
        return len(range(self.start, end, self.stride))


class FrameSource(ABC):
    """A context manager that yields frames when iterated.

    Attributes:
        name: the source as the user gave it.
        width, height: size in px of the upright frames.
        fps: nominal frames per second, None if unknown; the time stamps of the frames are decisive.
        frame_count: largest number of frames that an iteration yields, None if unknown.
        quarter_turns_clockwise: rotation already applied to the frames; pass it to ``load_camera`` or
            ``Camera.rotated``.
        unsquared_size: width and height in px of the upright frames before their pixels were made square; None where
            they were square.
        skipped: frames so far that were left out because they are broken or of another size.
        notes: after the iteration, what was changed in the frames, or why some were left out, a sentence each.
        ended_reason: after the iteration, why it ended early, in one sentence; else empty.
        is_live: frames arrive in real time, and those that are not fetched are dropped.
        audio_path: file with the sound of the frames, or None.
        audio_start_s: time stamp in that file of the first frame, whose time is 0.
    """

    name: str
    width: int
    height: int
    fps: float | None = None
    frame_count: int | None = None
    quarter_turns_clockwise: int = 0
    unsquared_size: tuple[int, int] | None = None
    skipped: int = 0
    notes: tuple[str, ...] = ()
    ended_reason: str = ""
    is_live: bool = False
    audio_path: Path | None = None
    audio_start_s: float = 0.0

    @abstractmethod
    def __iter__(self) -> Iterator[Frame]:
        """Frames in order; files start again with each iteration."""

    def close(self) -> None:  # noqa: B027 - files have nothing to release
        """Release devices and connections."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def read_ahead(read: Callable[[], Iterator[Frame]], depth: int = READ_AHEAD_FRAMES) -> Iterator[Frame]:
    """Frames of ``read()``, which runs in a thread that keeps at most ``depth`` frames ready.

    An exception of the reader is raised here, after the frames before it. The thread ends when the iteration is left.
    """
    ready: queue.Queue[Frame | BaseException | None] = queue.Queue(maxsize=depth)
    left = threading.Event()

    def put(item: Frame | BaseException | None) -> bool:
        while not left.is_set():
            try:
                ready.put(item, timeout=_POLL_S)
                return True
            except queue.Full:
                continue
        return False

    def run() -> None:
        frames = read()
        try:
            for frame in frames:
                if not put(frame):
                    frames.close()  # type: ignore[attr-defined]
                    return
            put(None)
        except BaseException as error:
            put(error)

    reader = threading.Thread(target=run, name="arview-reader", daemon=True)
    reader.start()
    try:
        while (item := ready.get()) is not None:
            if isinstance(item, BaseException):
                raise item
            yield item
    finally:
        left.set()
        reader.join()
