"""Recordings of what is shown: a thread draws the newest frames of a feed and writes them to a video."""

from __future__ import annotations

import logging
import re
import shutil
import threading
import time
from datetime import datetime
from pathlib import Path

import cv2
import numpy as np

from arview.errors import ArviewError
from arview.live.stream.drawing import Drawing
from arview.live.stream.feed import Feed, Tracked
from arview.live.stream.newest import NewestSlot
from arview.live.stream.notices import Notice
from arview.video import Image, VideoSink

logger = logging.getLogger("arview.live")

FREE_BYTES = 500_000_000
"""A recording ends before the disk is full: other programs need it too."""
LONGEST_S = 3600.0
_LOOK_EVERY_S = 5.0


class Recorder:
    """Records one feed until `stop`; frames that come while one is being drawn are left out.

    The first frame decides the size; later ones of another size (a phone that was turned) are fitted in with bars.

    Raises:
        OutputError: the file cannot be written.
    """

    def __init__(self, feed: Feed, drawing: Drawing, path: Path) -> None:
        self.path, self.trouble = path, ""
        self._feed, self._drawing = feed, drawing
        self._slot: NewestSlot[Tracked] = NewestSlot()
        self._sink: VideoSink | None = None
        self._began_s = time.monotonic()
        self._free_looked_s = 0.0
        self._thread = threading.Thread(target=self._run, name="arview-recorder", daemon=True)
        feed.listen(self._slot.put)
        self._thread.start()

    @property
    def seconds(self) -> float:
        """Since it began."""
        return time.monotonic() - self._began_s

    @property
    def is_running(self) -> bool:
        """Whether frames are still taken."""
        return self._thread.is_alive() and not self._slot.is_closed

    def stop(self) -> bool:
        """End and finish the file; whether there is one. Waits for the encoder, so never call it in the event loop."""
        self._feed.unlisten(self._slot.put)
        self._slot.close()
        self._thread.join()
        return self._sink is not None and not self.trouble

    def _run(self) -> None:
        try:
            while (tracked := self._slot.take()) is not None and self._may_go_on():
                self._write(tracked)
            if self._sink is not None:
                self._sink.close()
        except Exception as error:
            if not isinstance(error, ArviewError):
                logger.exception("recording failed")
            self.trouble = str(error) or type(error).__name__
            if self._sink is not None:
                self._sink.abort()
        self._feed.unlisten(self._slot.put)
        self._slot.close()

    def _write(self, tracked: Tracked) -> None:
        image = self._drawing.draw_record(tracked).image
        if self._sink is None:
            height, width = image.shape[:2]
            self._size = width, height
            self._sink = VideoSink(self.path, width, height)
        self._sink.write(_fitted(image, *self._size), tracked.arrived_s)

    def _may_go_on(self) -> bool:
        if time.monotonic() - self._free_looked_s < _LOOK_EVERY_S:
            return True
        self._free_looked_s = time.monotonic()
        return self.seconds < LONGEST_S and shutil.disk_usage(self.path.parent).free > FREE_BYTES


class Recordings:
    """The recordings of one run: running ones by feed, finished ones by number.

    Args:
        folder: where those are put that a page asks for.
        part_name: for their names.
    """

    def __init__(self, folder: Path, part_name: str) -> None:
        self._folder, self._part_name = folder, part_name
        self._running: dict[Feed, Recorder] = {}
        self._finished: list[Path] = []
        self._trouble: dict[Feed, str] = {}

    def of(self, feed: Feed) -> Recorder | None:
        """The running recorder of a feed."""
        recorder = self._running.get(feed)
        return recorder if recorder is not None and recorder.is_running else None

    def start(self, feed: Feed, drawing: Drawing, path: Path | None = None) -> None:
        """Begin to record a feed, if it is not recorded yet; without a path under a name of its own."""
        if self.of(feed) is None:
            self.stop(feed)
            self._trouble.pop(feed, None)
            self._running[feed] = Recorder(feed, drawing, path or self._new_path())

    def stop(self, feed: Feed) -> None:
        """End the recording of a feed, if there is one; waits for the file."""
        recorder = self._running.pop(feed, None)
        if recorder is None:
            return
        if recorder.stop():
            self._finished.append(recorder.path)
            logger.info("recorded %s", recorder.path)
        elif recorder.trouble:
            self._trouble[feed] = recorder.trouble
            logger.warning("%s", recorder.trouble)
        else:
            logger.warning("%s is not written: no picture came", recorder.path)

    def forget(self, feed: Feed) -> None:
        """End the recording of a feed that has gone."""
        self.stop(feed)
        self._trouble.pop(feed, None)

    def stop_all(self) -> None:
        """Finish all files."""
        for feed in list(self._running):
            self.stop(feed)

    @property
    def finished(self) -> list[int]:
        """Numbers of the finished recordings."""
        return list(range(len(self._finished)))

    def path(self, number: int) -> Path | None:
        """File of a finished recording."""
        return self._finished[number] if 0 <= number < len(self._finished) else None

    def notices(self, feed: Feed) -> list[Notice]:
        """What went wrong with the recording of a feed."""
        running = self._running.get(feed)
        trouble = running.trouble if running is not None else self._trouble.get(feed, "")
        return [Notice("recording_failed", "error", trouble.replace(f"{self._folder}/", ""))] if trouble else []

    def _new_path(self) -> Path:
        name = re.sub(r"[^\w.-]+", "_", self._part_name).strip("._") or "part"
        stem = f"live_{name}_{datetime.now():%Y%m%d-%H%M%S}"
        for count in range(1, 1000):
            path = self._folder / (f"{stem}.mp4" if count == 1 else f"{stem}-{count}.mp4")
            if not path.exists() and all(path != recorder.path for recorder in self._running.values()):
                return path
        return self._folder / f"{stem}-{time.monotonic_ns()}.mp4"


def _fitted(image: Image, width: int, height: int) -> Image:
    """The picture at this size, with black bars where its shape differs."""
    own_height, own_width = image.shape[:2]
    if (own_width, own_height) == (width, height):
        return image
    scale = min(width / own_width, height / own_height)
    small = cv2.resize(image, (round(own_width * scale), round(own_height * scale)), interpolation=cv2.INTER_AREA)
    canvas = np.zeros((height, width, 3), dtype=np.uint8)
    top, left = (height - small.shape[0]) // 2, (width - small.shape[1]) // 2
    canvas[top : top + small.shape[0], left : left + small.shape[1]] = small
    return canvas
