"""StationCamera: a camera, stream or file of the station, read for ever; what breaks is opened again."""

from __future__ import annotations

import logging
import threading
import time

import numpy as np

from arview.errors import ArviewError
from arview.live.protocol import FRAME_IDS
from arview.live.stream.feed import Feed
from arview.live.stream.frames import Incoming, Picture
from arview.live.stream.notices import Notice, without_folder
from arview.video import Frame, FrameSource, Image, open_source

logger = logging.getLogger("arview.live")

FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.5, 8.0
OPEN_TIMEOUT_S, READ_TIMEOUT_S = 10.0, 3.0
FROZEN_S = 2.0
"""A camera whose pictures are equal, pixel for pixel, for so long is frozen: sensors have noise."""
_SAMPLED_PX = 7
"""Every so many pixels are compared."""


class StationCamera:
    """Reads a source in a thread and puts its frames into a feed.

    A file or folder is played at its own rate, over and over; a camera or stream that ends or breaks is opened again
    after a pause that doubles from half a second to eight.
    """

    def __init__(self, spec: str, feed: Feed) -> None:
        self._spec, self._feed = spec, feed
        self._ended = threading.Event()
        self._trouble = ""
        self._count = 0
        self._sample: Image | None = None
        self._same_since_s: float | None = None
        self._is_live = False
        self._thread = threading.Thread(target=self._run, name="arview-station", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Let go of the source."""
        self._ended.set()
        self._thread.join(timeout=2.0)

    @property
    def state(self) -> tuple[str, str]:
        """State of the stream and what to say of it."""
        if self._trouble:
            return "reconnecting", self._trouble
        if self.is_frozen:
            return "frozen", "the camera gives the same picture again and again"
        return self._feed.state

    @property
    def is_frozen(self) -> bool:
        """Whether the pictures have been equal for a while."""
        since_s = self._same_since_s
        return self._is_live and since_s is not None and time.monotonic() - since_s > FROZEN_S

    def notices(self) -> list[Notice]:
        """What whoever looks at the picture has to know."""
        if self._trouble:
            return [Notice("source_reconnecting", "error", f"{self._trouble}; it is tried again")]
        if self.is_frozen:
            return [Notice("source_frozen", "error", "the camera gives the same picture again and again")]
        state, text = self._feed.state
        if state == "waiting" and self._feed.newest is not None:
            return [Notice("source_frozen", "error", f"the camera gives {text}")]
        return []

    def _run(self) -> None:
        pause_s = FIRST_PAUSE_S
        while not self._ended.is_set():
            count = self._count
            try:
                with open_source(self._spec, open_timeout_s=OPEN_TIMEOUT_S, read_timeout_s=READ_TIMEOUT_S) as source:
                    self._play(source)
                    trouble = source.ended_reason or ("the camera gives no more pictures" if source.is_live else "")
            except ArviewError as error:
                trouble = str(error)
            except Exception as error:  # a driver or decoder can raise anything; the station must not go dark for it
                logger.exception("reading %s failed", self._spec)
                trouble = f"reading failed ({type(error).__name__})"
            if self._ended.is_set():
                return
            self._trouble = without_folder(trouble, self._spec)
            if self._count > count:
                pause_s = FIRST_PAUSE_S
            if trouble:
                logger.warning("%s; trying again in %.1f s", trouble, pause_s)
                self._ended.wait(pause_s)
                pause_s = min(2.0 * pause_s, LONGEST_PAUSE_S)

    def _play(self, source: FrameSource) -> None:
        self._is_live = source.is_live
        began_s = time.monotonic()
        first_s: float | None = None
        for frame in source:
            if first_s is None:
                first_s = frame.time_s
            if not source.is_live and self._ended.wait(max(0.0, began_s + frame.time_s - first_s - time.monotonic())):
                return
            if self._ended.is_set():
                return
            self._put(frame)
        if not source.is_live and source.fps:
            self._ended.wait(1.0 / source.fps)

    def _put(self, frame: Frame) -> None:
        now_s = time.monotonic()
        self._trouble = ""
        sample = frame.image[::_SAMPLED_PX, ::_SAMPLED_PX].copy()
        if self._sample is None or not np.array_equal(sample, self._sample):
            self._sample, self._same_since_s = sample, now_s
        picture = Picture(self._count % FRAME_IDS, frame.image)
        self._count += 1
        self._feed.put(Incoming(lambda: picture, now_s))
