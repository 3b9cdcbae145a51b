"""Recordings: a thread draws the overlay on the newest frames of a feed, and writes them and their poses to files."""

from __future__ import annotations

import logging
import re
import shutil
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

import cv2
import numpy as np

from arview.errors import ArviewError
from arview.pose_file import PoseWriter
from arview.station.live.options import RecordingOptions
from arview.station.live.stream.annotator import FrameAnnotator
from arview.station.live.stream.feed import Feed, TrackedFrame
from arview.station.live.stream.newest import NewestSlot
from arview.station.live.stream.notices import Notice
from arview.station.live.stream.recovery import RECOVERED, duration_s, recover_recordings
from arview.video import CONTAINERS, Image, VideoSink

MIN_FREE_BYTES = 500_000_000
"""Free disk space that is left to other programs."""
LOW_BYTES = 2_000_000_000
"""Free disk space or rest of the quota below which the page warns."""
STOP_TIMEOUT_S = 60.0
"""Time for the encoder to finish a file that a page stops."""
MAX_DURATION_S = 3600.0
"""Longest recording."""
CHECK_INTERVAL_S = 5.0
"""Time between two checks of the free disk space."""

logger = logging.getLogger("arview.station.live")


class Recorder:
    """Records one feed until `stop`; frames that arrive while another is being drawn are dropped.

    The first frame sets the size of the video. Later frames of another size (a phone that was rotated) are fitted in
    with black bars. The poses stand beside the video, in a file of the same name that ends in ``.jsonl``, a line for
    each part in each frame, see `PoseWriter`; their index is the number of the frame in the video.

    Args:
        feed: the feed to record.
        annotator: draws the overlay on its frames.
        path: the video.
        options: when the recording ends by itself.
        space: says how much may still be recorded; default: by disk and quota for this video alone.

    Attributes:
        fault: why the file could not be written; empty when it could.
        ended_by: why the recording ended by itself; empty when it did not.
    """

    def __init__(
        self,
        feed: Feed,
        annotator: FrameAnnotator,
        path: Path,
        options: RecordingOptions | None = None,
        space: Callable[[], Space] | None = None,
    ) -> None:
        self.path, self.fault, self.ended_by = path, "", ""
        self._space = space or (lambda: free_space(path.parent, self._options, [path]))
        self._options = options or RecordingOptions()
        self._feed, self._annotator = feed, annotator
        self._slot: NewestSlot[TrackedFrame] = NewestSlot()
        self._sink: VideoSink | None = None
        self._poses: PoseWriter | None = None
        self._frames, self._first_s = 0, 0.0
        self._began_s = time.monotonic()
        self._disk_checked_s = 0.0
        self._thread = threading.Thread(target=self._run, name="arview-recorder", daemon=True)
        feed.listen(self._slot.put)
        self._thread.start()

    @property
    def seconds(self) -> float:
        """Duration of the recording so far."""
        return time.monotonic() - self._began_s

    @property
    def is_running(self) -> bool:
        """Whether frames are still being recorded."""
        return self._thread.is_alive() and not self._slot.is_closed

    def stop(self) -> bool:
        """End the recording; returns whether there is a file.

        It waits for the encoder, so do not call it in the event loop.
        """
        self._feed.unlisten(self._slot.put)
        self._slot.close()
        self._thread.join(STOP_TIMEOUT_S)
        if self._thread.is_alive():
            self.fault = f"{self.path}: the encoder does not come back"
        return self._sink is not None and not self.fault

    def _run(self) -> None:
        try:
            while (tracked := self._slot.take()) is not None and self._may_continue():
                self._write(tracked)
            if self._sink is not None and self._poses is not None:
                self._sink.close()
                self._poses.close()
        except Exception as error:
            if not isinstance(error, ArviewError):
                logger.exception("recording failed")
            self.fault = str(error) or type(error).__name__
            if self._sink is not None:
                self._sink.abort()
            if self._poses is not None:
                self._poses.abort()
        self._feed.unlisten(self._slot.put)
        self._slot.close()

    def _write(self, tracked: TrackedFrame) -> None:
        image = self._annotator.draw_with_status(tracked).image
        if self._sink is None or self._poses is None:
            height, width = image.shape[:2]
            self._size, self._first_s = (width, height), tracked.arrived_s
            self._sink = VideoSink(self.path, width, height, is_recoverable=True)
            self._poses = PoseWriter(self.path.with_suffix(".jsonl"), lambda index: self._camera)
        self._sink.write(_fitted(image, *self._size), tracked.arrived_s)
        self._camera = tracked.camera
        for pose in tracked.poses:
            steps, time_s = pose.steps and pose.steps.since(self._first_s), tracked.arrived_s - self._first_s
            self._poses.write(replace(pose, index=self._frames, time_s=time_s, steps=steps), image=tracked.frame.image)
        self._frames += 1

    def _may_continue(self) -> bool:
        if time.monotonic() - self._disk_checked_s < CHECK_INTERVAL_S:
            return True
        self._disk_checked_s = time.monotonic()
        if self.seconds >= MAX_DURATION_S:
            self.ended_by = f"the recording has ended: it was {MAX_DURATION_S / 60:.0f} minutes long"
        else:
            self.ended_by = self._space().exhausted
        return not self.ended_by


@dataclass(frozen=True)
class Space:
    """Room for recordings.

    Attributes:
        free_bytes: bytes that may still be written.
        limit: what limits them, for a message.
        low_bytes: number below which users are warned.
    """

    free_bytes: int
    limit: str
    low_bytes: int

    @property
    def exhausted(self) -> str:
        """Why nothing more can be recorded; empty while something can."""
        return f"the recording has ended: {self.limit}" if self.free_bytes <= 0 else ""

    @property
    def refusal(self) -> str:
        """Why no recording can be started; empty while one can."""
        return f"nothing can be recorded: {self.limit}" if self.free_bytes <= 0 else ""

    @property
    def warning(self) -> str:
        """A warning before that; empty while there is enough room."""
        if 0 < self.free_bytes < self.low_bytes:
            return f"little room for recordings, {self.free_bytes / 1e9:.1f} GB: then {self.limit}"
        return ""


def free_space(folder: Path, options: RecordingOptions, paths: Sequence[Path] = ()) -> Space:
    """Room for recordings in a folder, by the free disk and by the quota.

    Args:
        folder: the folder.
        options: the limits.
        paths: further recordings, beside those in the folder that pages have asked for; unfinished ones count, too.
    """
    on_disk = shutil.disk_usage(folder).free - MIN_FREE_BYTES
    known = {*folder.glob("live_*"), *folder.glob(".live_*")}
    for path in paths:
        known |= {path, *path.parent.glob(f".{path.name}*"), *path.parent.glob(f"{path.name}*")}
    used = 0
    for path in known:
        with suppress(OSError):
            used += path.stat().st_size
    left = options.quota_bytes - used
    if left < on_disk:
        gb = options.quota_bytes / 1e9
        return Space(left, f"recordings fill their quota of {gb:g} GB; move some, or raise --quota", LOW_BYTES)
    return Space(on_disk, "the disk is almost full", LOW_BYTES)


@dataclass(frozen=True)
class RecordingFile:
    """A finished recording.

    Attributes:
        number: by which the page asks for it; it stays the same during a run.
        path: the video.
        bytes: its size.
        seconds: its duration; None where it cannot be read.
        created: time of its last change, UTC.
        is_recovered: whether it was cut off by a crash.
    """

    number: int
    path: Path
    bytes: int
    seconds: float | None
    created: datetime
    is_recovered: bool


class Recordings:
    """The recordings of a folder: running ones by feed, finished ones, those of earlier runs included, by number.

    Args:
        folder: folder of the recordings that pages ask for.
        part_name: name of the part, used in the file names.
        options: when recordings end by themselves.
        own_path: video that the program records from the start, if any.
    """

    def __init__(
        self, folder: Path, part_name: str, options: RecordingOptions | None = None, own_path: Path | None = None
    ) -> None:
        self._folder, self._part_name, self._options = folder, part_name, options or RecordingOptions()
        self._own_path = own_path
        self._running: dict[Feed, Recorder] = {}
        self._lock = threading.Lock()
        self._files: list[Path] = []
        self._finished: list[int] = []
        self._durations: dict[tuple[Path, int], float | None] = {}
        self._fault: dict[Feed, str] = {}
        self._ended_by: dict[Feed, str] = {}
        self._checked: tuple[float, Space | None] = (0.0, None)

    def adopt(self) -> None:
        """List the recordings of earlier runs, and recover those that a crash has cut off; this takes its time."""
        names = [] if self._own_path is None else [self._own_path.stem]
        folders = {self._folder} | ({self._own_path.parent} if self._own_path is not None else set())
        for folder in folders:
            recover_recordings(folder, names, [recorder.path for recorder in self._running.values()])
        found = [path for path in self._folder.glob("live_*") if path.suffix.lower() in CONTAINERS]
        for name in names:
            recovered = [path for folder in folders for path in folder.glob(f"{name}*{RECOVERED}*")]
            found += [path for path in recovered if path.suffix in CONTAINERS]
        for path in sorted(set(found), key=lambda one: (one.stat().st_mtime, one.name)):
            self._number(path)

    def listed(self) -> list[RecordingFile]:
        """The finished recordings; it opens each file once, so do not call it in the event loop."""
        files = []
        for number, path in enumerate(tuple(self._files)):
            with suppress(OSError):
                stat = path.stat()
                key = path, stat.st_mtime_ns
                if key not in self._durations:
                    self._durations[key] = duration_s(path)
                created = datetime.fromtimestamp(stat.st_mtime, UTC)
                is_recovered = RECOVERED in path.stem
                files.append(RecordingFile(number, path, stat.st_size, self._durations[key], created, is_recovered))
        return files

    def of(self, feed: Feed) -> Recorder | None:
        """The running recorder of a feed, or None."""
        recorder = self._running.get(feed)
        return recorder if recorder is not None and recorder.is_running else None

    def start(self, feed: Feed, annotator: FrameAnnotator, path: Path | None = None) -> None:
        """Start to record a feed unless it is being recorded; without a path, to a new file in the folder."""
        if self.of(feed) is None:
            self.stop(feed)
            self._fault.pop(feed, None)
            self._ended_by.pop(feed, None)
            if full := self.space().exhausted:
                self._ended_by[feed] = full
                logger.warning("%s", full)
                return
            self._running[feed] = Recorder(feed, annotator, path or self._new_path(), self._options, self.space)

    def stop(self, feed: Feed) -> None:
        """End the recording of a feed, if there is one, and wait for its file."""
        recorder = self._running.pop(feed, None)
        if recorder is None:
            return
        if recorder.ended_by:
            self._ended_by[feed] = recorder.ended_by
            logger.warning("%s", recorder.ended_by)
        if recorder.stop():
            self._finished.append(self._number(recorder.path))
            logger.info("recorded %s", recorder.path)
        elif recorder.fault:
            self._fault[feed] = recorder.fault
            logger.warning("%s", recorder.fault)
        else:
            logger.warning("%s is not written: no picture arrived", recorder.path)

    def forget(self, feed: Feed) -> None:
        """End the recording of a feed that was closed."""
        self.stop(feed)
        self._fault.pop(feed, None)
        self._ended_by.pop(feed, None)

    def stop_all(self) -> None:
        """End all recordings, together: each waits for its encoder."""
        threads = [threading.Thread(target=self.stop, args=(feed,), daemon=True) for feed in list(self._running)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()

    def space(self) -> Space:
        """Room for further recordings."""
        paths = [*self._files, *(recorder.path for recorder in self._running.values())]
        return free_space(self._folder, self._options, paths)

    @property
    def finished(self) -> list[int]:
        """Numbers of the recordings that were finished in this run."""
        return list(self._finished)

    def path(self, number: int) -> Path | None:
        """File of a finished recording, or None."""
        return self._files[number] if 0 <= number < len(self._files) else None

    def notices(self, feed: Feed) -> list[Notice]:
        """The notices about the recording of a feed: it failed, it ended by itself, or there is little room for it."""
        running = self._running.get(feed)
        fault = running.fault if running is not None else self._fault.get(feed, "")
        ended = running.ended_by if running is not None else self._ended_by.get(feed, "")
        notices = [Notice("recording_failed", "error", fault.replace(f"{self._folder}/", ""))] if fault else []
        if ended:
            notices.append(Notice("recording_ended", "warning", ended))
        else:
            space = self._recent_space()
            if low := space.warning or (space.refusal if running is None else ""):
                notices.append(Notice("disk_low", "warning", low))
        return notices

    def check_space(self) -> None:
        """Look up the room for recordings if that was some time ago, in a thread, before `notices` has to do it."""
        if time.monotonic() - self._checked[0] > 0.5 * CHECK_INTERVAL_S:
            self._checked = time.monotonic(), self.space()

    def _recent_space(self) -> Space:
        """As `space`, looked up once in a while only: notices are made several times a second."""
        checked_s, space = self._checked
        if space is None or time.monotonic() - checked_s > CHECK_INTERVAL_S:
            space = self.space()
            self._checked = time.monotonic(), space
        return space

    def _number(self, path: Path) -> int:
        """Number of a finished recording, a new one if it has none yet."""
        with self._lock:
            if path not in self._files:
                self._files.append(path)
            return self._files.index(path)

    def _new_path(self) -> Path:
        name = re.sub(r"[^\w.-]+", "_", self._part_name).strip("._") or "part"
        stem = f"live_{name}_{datetime.now():%Y%m%d-%H%M%S}"
        for count in range(1, 1000):
            path = self._folder / (f"{stem}.mp4" if count == 1 else f"{stem}-{count}.mp4")
            if not path.exists() and all(path != recorder.path for recorder in self._running.values()):
                return path
        return self._folder / f"{stem}-{time.monotonic_ns()}.mp4"


def _fitted(image: Image, width: int, height: int) -> Image:
    """The picture scaled to this size, with black bars where its aspect ratio differs."""
    own_height, own_width = image.shape[:2]
    if (own_width, own_height) == (width, height):
        return image
    scale = min(width / own_width, height / own_height)
    small = cv2.resize(image, (round(own_width * scale), round(own_height * scale)), interpolation=cv2.INTER_AREA)
    canvas = np.zeros((height, width, 3), dtype=np.uint8)
    top, left = (height - small.shape[0]) // 2, (width - small.shape[1]) // 2
    canvas[top : top + small.shape[0], left : left + small.shape[1]] = small
    return canvas
