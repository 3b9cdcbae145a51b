"""The station camera: a camera, stream or file that is read continuously and reopened after failures."""

from __future__ import annotations

import logging
import threading
import time

import numpy as np

from arview.core.messages import sentence
from arview.errors import ArviewError, without_credentials
from arview.station.live.protocol import FRAME_IDS
from arview.station.live.stream.feed import Feed
from arview.station.live.stream.frames import DecodedFrame, IncomingFrame
from arview.station.live.stream.notices import Notice, without_folder
from arview.video import Frame, FrameSource, Image, open_source

FIRST_PAUSE_S = 0.5
"""Pause before the first reconnection; it doubles with each further one."""
MAX_PAUSE_S = 8.0
"""Longest pause between two reconnections."""
OPEN_TIMEOUT_S = 10.0
"""Time in which a network camera must be opened."""
READ_TIMEOUT_S = 3.0
"""Time in which a network camera must deliver a frame."""
STUCK_S = 30.0
"""A reader that neither delivers nor fails for so long is given up with its thread."""
MAX_LOST = 8
"""Readers given up; then the camera counts as broken."""
FROZEN_S = 2.0
"""Pictures that stay equal, pixel for pixel, for so long are those of a frozen camera: sensors have noise."""
SAMPLE_STEP_PX = 7
"""Distance of the pixels that are compared."""

logger = logging.getLogger("arview.station.live")


class StationCamera:
    """Reads a source in a thread and puts its frames into a feed.

    A file or folder is played in a loop at its own frame rate. A camera or stream that ends or breaks is reopened after
    a pause, which doubles with each failure.

    Args:
        spec: the source, see `arview.video.open_source`.
        feed: receives the frames.
    """

    def __init__(self, spec: str, feed: Feed) -> None:
        self._spec, self._feed = spec, feed
        self._ended = threading.Event()
        self._fault = ""
        self._count = 0
        self._sample: Image | None = None
        self._same_since_s: float | None = None
        self._is_live = False
        self._lost = 0
        self._alive_s = time.monotonic()
        self._thread = threading.Thread(target=self._run, name="arview-station", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop reading and release the source."""
        self._ended.set()
        self._thread.join(timeout=2.0)

    def replace_if_stuck(self) -> None:
        """Give the camera another thread when opening or reading it does not come back."""
        if self._count and not self._is_live:
            return  # a file, whose frames may be far apart
        if time.monotonic() - self._alive_s < STUCK_S or self._ended.is_set() or self._lost >= MAX_LOST:
            return
        self._lost += 1
        self._fault = f"the camera does not answer, for {STUCK_S:.0f} s"
        logger.warning("%s; it is opened anew", self._fault)
        self._alive_s = time.monotonic()
        self._thread = threading.Thread(target=self._run, name="arview-station", daemon=True)
        self._thread.start()

    @property
    def _is_over(self) -> bool:
        """Whether the calling thread has to end: the camera was closed, or another thread reads it."""
        return self._ended.is_set() or threading.current_thread() is not self._thread

    @property
    def state(self) -> tuple[str, str]:
        """State of the stream and its description for the page."""
        if self._fault:
            return "reconnecting", self._fault
        if self.is_frozen:
            return "frozen", sentence("told.same_picture")
        return self._feed.state

    @property
    def is_frozen(self) -> bool:
        """Whether the pictures have been identical for longer than the options allow."""
        since_s = self._same_since_s
        return self._is_live and since_s is not None and time.monotonic() - since_s > FROZEN_S

    def notices(self) -> list[Notice]:
        """Conditions of the camera that viewers have to know of."""
        if self._fault:
            return [Notice("source_reconnecting", "error", f"{self._fault}; reconnecting")]
        if self.is_frozen:
            return [Notice("source_frozen", "error", sentence("told.same_picture"))]
        age_ms = self._feed.age_ms
        if age_ms is not None and self._feed.state[0] == "waiting" and self._feed.newest is not None:
            return [Notice("source_frozen", "error", sentence("told.camera_silent", seconds=f"{age_ms / 1e3:.0f}"))]
        return []

    def _run(self) -> None:
        pause_s = FIRST_PAUSE_S
        while not self._is_over:
            self._alive_s = time.monotonic()
            count = self._count
            try:
                with open_source(self._spec, open_timeout_s=OPEN_TIMEOUT_S, read_timeout_s=READ_TIMEOUT_S) as source:
                    self._play(source)
                    fault = source.ended_reason or ("the camera delivers no more pictures" if source.is_live else "")
            except ArviewError as error:
                fault = str(error)
            except Exception as error:  # drivers and decoders can raise anything, and the station must go on
                logger.exception("reading %s failed", without_credentials(self._spec))
                fault = f"reading failed ({type(error).__name__})"
            if self._is_over:
                return
            self._fault = without_folder(without_credentials(fault), self._spec)
            if self._count > count:
                pause_s = FIRST_PAUSE_S
            if fault:
                logger.warning("%s; trying again in %.1f s", fault, pause_s)
                self._ended.wait(pause_s)
                pause_s = min(2.0 * pause_s, MAX_PAUSE_S)

    def _play(self, source: FrameSource) -> None:
        self._is_live = source.is_live
        began_s = time.monotonic()
        first_s: float | None = None
        for frame in source:
            if first_s is None:
                first_s = frame.time_s
            if not source.is_live and self._ended.wait(max(0.0, began_s + frame.time_s - first_s - time.monotonic())):
                return
            if self._is_over:
                return
            self._put(frame, source)
        if not source.is_live and source.fps:
            self._ended.wait(1.0 / source.fps)

    def _put(self, frame: Frame, source: FrameSource) -> None:
        now_s = self._alive_s = time.monotonic()
        self._fault = ""
        step = SAMPLE_STEP_PX
        sample = frame.image[::step, ::step].copy()
        if self._sample is None or not np.array_equal(sample, self._sample):
            self._sample, self._same_since_s = sample, now_s
        turns, unsquared = source.quarter_turns_clockwise, source.unsquared_size
        decoded = DecodedFrame(self._count % FRAME_IDS, frame.image, turns, unsquared_size=unsquared)
        self._count += 1
        self._feed.put(IncomingFrame(lambda: decoded, now_s))
