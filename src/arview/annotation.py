"""annotate: source → session → overlay → sink, overlapped by threads with short queues between them.

Decoding runs in the source's thread, tracking in the caller's, drawing in one worker, encoding in the sink's.
"""

from __future__ import annotations

import json
import os
import queue
import re
import threading
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from arview.errors import OutputError
from arview.pose import Pose
from arview.video import Frame, FrameSource, Image

QUEUED_FRAMES = 3  # between tracking and drawing; 19 MB at 1080p
MOST_REASONS = 4
_NUMBER = re.compile(r"-?\d+(?:\.\d+)?")
FPS_WINDOW_S = 1.0  # the rate on the picture is that of the last second


class Session(Protocol):
    """What tracks: `arview.tracking.TrackingSession`."""

    def process(self, image: Image, index: int, time_s: float) -> Pose:
        """Pose of the next frame."""
        ...


class Overlay(Protocol):
    """What draws: `arview.overlay.OverlayRenderer`."""

    def draw(self, image: Image, pose: Pose, fps: float | None = None) -> Image:
        """The annotated frame."""
        ...


class Sink(Protocol):
    """What takes the pictures: `arview.video.VideoSink`."""

    frames_written: int

    def write(self, image: Image, time_s: float) -> None:
        """Add a frame."""
        ...

    def close(self) -> None:
        """Finish the file."""
        ...

    def abort(self) -> None:
        """Remove what was written."""
        ...


@dataclass(frozen=True)
class AnnotateSummary:
    """What a run did.

    Attributes:
        frames: processed.
        skipped: broken frames that the source left out.
        seconds: from the first frame asked for to the finished files.
        states: frames by tracking state.
        reasons: frames by state and reason, of the frames that have one.
        never_seen: components that no frame has shown surely, see `Pose.unverified`; none without a pose.
        ms: (F,) time of detection and tracking of each frame.
        ended_reason: why the source ended before its time, or empty.
        is_interrupted: stopped by Ctrl-C; the files hold what was done until then.
    """

    frames: int
    skipped: int
    seconds: float
    states: dict[str, int]
    reasons: dict[str, dict[str, int]]
    never_seen: tuple[str, ...]
    ms: tuple[float, ...]
    ended_reason: str
    is_interrupted: bool

    @property
    def fps(self) -> float:
        """Frames per second, end to end."""
        return self.frames / self.seconds if self.seconds > 0 else 0.0


def annotate(
    source: FrameSource,
    session: Session,
    overlay: Overlay | None = None,
    sink: Sink | None = None,
    poses_path: str | Path | None = None,
    progress: Callable[[int, Pose], None] | None = None,
    start_s: float | None = None,
    end_s: float | None = None,
) -> AnnotateSummary:
    """Track the part through a source, and write the annotated video and the poses.

    Ctrl-C ends the run in good order: what was tracked is drawn and both files are finished. Any other
    exception removes the unfinished files and goes on to the caller. Memory is bounded by the queues.

    Args:
        source: frames.
        session: tracks.
        overlay: draws; needed with a sink.
        sink: gets the annotated frames; it is closed (or aborted) here.
        poses_path: file for one JSON line a frame, see `PoseWriter`.
        progress: called after each frame with (frames done, pose).
        start_s: time stamp in the source before which frames are passed over.
        end_s: time stamp at which to stop.

    Raises:
        OutputError: a file cannot be written, or no frame was in the wanted range.
    """
    if sink is not None and overlay is None:
        raise ValueError("annotate: a sink needs an overlay")
    poses: PoseWriter | None = None
    drawer: _Drawer | None = None
    states: Counter[str] = Counter()
    reasons: dict[str, Counter[str]] = {}
    ms: list[float] = []
    never_seen: tuple[str, ...] | None = None
    is_interrupted = False
    began = time.perf_counter()
    try:
        poses = PoseWriter(poses_path) if poses_path is not None else None
        drawer = _Drawer(overlay, sink) if sink is not None and overlay is not None else None
        try:
            for frame in source:
                if start_s is not None and frame.time_s < start_s:
                    continue
                if end_s is not None and frame.time_s >= end_s:
                    break
                pose = session.process(frame.image, frame.index, frame.time_s)
                if drawer is not None:
                    drawer.put(frame, pose)
                if poses is not None:
                    poses.write(pose)
                states[str(pose.state)] += 1
                if pose.reason:
                    reasons.setdefault(str(pose.state), Counter())[pose.reason] += 1
                if pose.cam_from_model is not None:
                    never_seen = tuple(name for name in pose.unverified if never_seen is None or name in never_seen)
                ms.append(pose.ms)
                if progress:
                    progress(len(ms), pose)
        except KeyboardInterrupt:
            is_interrupted = True
        if drawer is not None:
            drawer.finish()
        if not ms and not is_interrupted:
            raise OutputError(f"{source.name}: no frame in the wanted range; nothing is written")
        if sink is not None:
            if sink.frames_written:
                sink.close()
            else:
                sink.abort()
        if poses is not None:
            poses.close()
    except BaseException:
        if drawer is not None:
            drawer.stop()
        if sink is not None:
            sink.abort()
        if poses is not None:
            poses.abort()
        raise
    return AnnotateSummary(
        frames=len(ms),
        skipped=source.skipped,
        seconds=time.perf_counter() - began,
        states=dict(states),
        reasons={state: dict(counts) for state, counts in reasons.items()},
        never_seen=never_seen or (),
        ms=tuple(ms),
        ended_reason=source.ended_reason,
        is_interrupted=is_interrupted,
    )


def reasons_text(reasons: dict[str, int]) -> str:
    """The commonest reasons with their frames, e.g. ``too dark (80), only 8 to 12 % of the outline found (40)``.

    Reasons that differ only in their numbers are one, with the span of those numbers.
    """
    counts: Counter[str] = Counter()
    numbers: dict[str, list[list[str]]] = {}
    for reason, count in reasons.items():
        kind = _NUMBER.sub("\0", reason)
        counts[kind] += count
        numbers.setdefault(kind, []).append(_NUMBER.findall(reason))
    texts = []
    for kind, count in counts.most_common(MOST_REASONS):
        for column in zip(*numbers[kind], strict=True):
            low, high = min(column, key=float), max(column, key=float)
            kind = kind.replace("\0", low if low == high else f"{low} to {high}", 1)
        texts.append(f"{kind} ({count})")
    others = counts.total() - sum(count for _, count in counts.most_common(MOST_REASONS))
    return ", ".join([*texts, f"other ({others})"] if others else texts)


class _Drawer:
    """A thread that draws frames in order and hands them to the sink."""

    def __init__(self, overlay: Overlay, sink: Sink) -> None:
        self._overlay, self._sink = overlay, sink
        self._waiting: queue.Queue[tuple[Frame, Pose] | None] = queue.Queue(QUEUED_FRAMES)
        self._error: BaseException | None = None
        self._is_stopped = False
        self._thread = threading.Thread(target=self._run, name="arview-overlay", daemon=True)
        self._thread.start()

    def put(self, frame: Frame, pose: Pose) -> None:
        """Queue a frame; raises what drawing or writing an earlier one raised."""
        if self._error is not None:
            raise self._error
        self._waiting.put((frame, pose))

    def finish(self) -> None:
        """Wait until all queued frames are written; raises what drawing or writing raised."""
        self._waiting.put(None)
        self._thread.join()
        if self._error is not None:
            raise self._error

    def stop(self) -> None:
        """Throw away what is queued and end the thread."""
        self._is_stopped = True
        if self._thread.is_alive():
            self._waiting.put(None)
            self._thread.join()

    def _run(self) -> None:
        rate = _Rate()
        for frame, pose in iter(self._waiting.get, None):
            # After an error the queue is emptied, so that nobody waits for a place in it.
            if self._error is not None or self._is_stopped:
                continue
            try:
                self._sink.write(self._overlay.draw(frame.image, pose, fps=rate.tick()), frame.time_s)
            except BaseException as error:
                self._error = error


class _Rate:
    """Frames per second over the last window, renewed once a window so that the figure can be read."""

    def __init__(self) -> None:
        self._since_s = time.perf_counter()
        self._count = 0
        self._fps: float | None = None

    def tick(self) -> float | None:
        """Count a frame; the rate, or None in the first window."""
        self._count += 1
        passed_s = time.perf_counter() - self._since_s
        if passed_s >= FPS_WINDOW_S:
            self._fps = self._count / passed_s
            self._since_s, self._count = self._since_s + passed_s, 0
        return self._fps


class PoseWriter:
    """Writes poses as JSON lines under a temporary name; `close` gives the file its name.

    A line holds ``index``, ``time_s``, ``state``, ``quality``, ``cam_from_model`` (4×4 row-major, mm, or
    null), ``covariance`` (6×6 or null), ``ms``, ``reason`` (why not ``tracked``, or empty), ``mismatches`` (list),
    ``unverified`` (components not seen yet) and ``alternatives`` (list of 4×4 poses that fit as well).

    Raises:
        OutputError: the file cannot be written.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._part = self.path.with_name(f".{self.path.name}.{os.getpid()}.part")
        if self.path.is_dir():
            raise OutputError(f"{path}: is a folder; give the name of a file")
        try:
            self._file = self._part.open("w", encoding="utf-8")
        except OSError as error:
            raise self._explained(error) from error

    def write(self, pose: Pose) -> None:
        """Add a line."""
        try:
            self._file.write(pose_line(pose) + "\n")
        except OSError as error:
            raise self._explained(error) from error

    def close(self) -> None:
        """Complete the file."""
        try:
            self._file.close()
            self._part.replace(self.path)
        except OSError as error:
            raise self._explained(error) from error

    def abort(self) -> None:
        """Remove what was written; an older file of the same name stays."""
        with suppress(OSError):
            self._file.close()
        with suppress(OSError):
            self._part.unlink(missing_ok=True)

    def _explained(self, error: OSError) -> OutputError:
        return OutputError(f"{self.path}: cannot write the poses: {error.strerror or error}")


def pose_line(pose: Pose) -> str:
    """One line of ``poses.jsonl``; a covariance that is not finite becomes null."""
    covariance = pose.covariance
    is_known = covariance is not None and bool(np.all(np.isfinite(covariance)))
    return json.dumps(
        {
            "index": pose.index,
            "time_s": pose.time_s,
            "state": str(pose.state),
            "quality": pose.quality,
            "cam_from_model": None if pose.cam_from_model is None else pose.cam_from_model.tolist(),
            "covariance": covariance.tolist() if covariance is not None and is_known else None,
            "ms": round(pose.ms, 4),
            "reason": pose.reason,
            "mismatches": list(pose.mismatches),
            "unverified": list(pose.unverified),
            "alternatives": [alternative.tolist() for alternative in pose.alternatives],
        },
        allow_nan=False,
    )
