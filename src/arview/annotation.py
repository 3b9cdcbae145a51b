"""annotate: track a part, or several, through a video, and write the annotated video and the poses.

Source, tracking, drawing and encoding overlap in threads with short queues between them: frames are decoded in the
source's thread, tracked in the caller's, drawn in one worker and encoded in the sink's.
"""

from __future__ import annotations

import queue
import re
import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from arview.camera import Camera
from arview.core.checks import check_type
from arview.errors import OutputError
from arview.pose import Completeness, Pose, Presence
from arview.pose_file import PoseWriter
from arview.tracking import FocalEstimate, TrackingSession
from arview.video import Frame, FrameSource, Image

MAX_FIRST_PASS = 900
"""Frames of the first pass over a film at most."""
MAX_IDLE_FRAMES = 240
"""Frames without a new view after which the first pass ends."""

QUEUED_FRAMES = 3
"""Frames that may wait between tracking and drawing; 19 MB at 1080p."""
MAX_REASONS = 4
"""Reasons that `reasons_text` lists; it counts the others."""
FPS_WINDOW_S = 1.0
"""The frame rate drawn on the picture is that of the last window."""
_NUMBER = re.compile(r"-?\d+(?:\.\d+)?")


class Session(Protocol):
    """What tracks: `arview.tracking.TrackingSession`."""

    def process(self, image: Image, index: int, time_s: float) -> tuple[Pose, ...]:
        """Pose of each specimen in the next frame."""
        ...


class Overlay(Protocol):
    """What draws: `arview.overlay.OverlayRenderer`, or `FollowingOverlay`."""

    def draw(self, image: Image, poses: tuple[Pose, ...], /, fps: float | None = None) -> Image:
        """The annotated frame."""
        ...


class Sink(Protocol):
    """What writes the annotated frames: `arview.video.VideoSink`."""

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
class SpecimenSummary:
    """What a run found of one specimen.

    Attributes:
        states: frames by tracking state.
        completeness: by the last frame with a pose; None if there is none.
        presence: of each component by that frame.
        serial: read from a code on the specimen, or empty.
        steps: how far its assembly is, and what was wrong, in sentences.
    """

    states: Mapping[str, int]
    completeness: Completeness | None
    presence: Mapping[str, Presence]
    serial: str
    steps: tuple[str, ...] = ()


@dataclass(frozen=True)
class AnnotateSummary:
    """Counts of one run.

    Attributes:
        frames: frames tracked.
        skipped: broken frames that the source left out.
        seconds: from the start of the run to the finished files.
        states: frames by tracking state.
        reasons: frames by state and reason, of the frames that have a reason.
        withheld_reasons: frames whose labels were withheld, by the reason, see `Pose.identity_reason`.
        never_verified: components that no frame has verified or refuted; empty if no frame has a pose.
        ms: (F,) time of detection and tracking of each frame, milliseconds.
        ended_reason: why the source ended early, or empty.
        is_interrupted: stopped by Ctrl-C; the files hold what was done until then.
        specimens: what is known of each specimen at the end, by `Pose.instance`; one without a name if there is one.
    """

    frames: int
    skipped: int
    seconds: float
    states: dict[str, int]
    reasons: dict[str, dict[str, int]]
    never_verified: tuple[str, ...]
    ms: tuple[float, ...]
    ended_reason: str
    is_interrupted: bool
    withheld_reasons: Mapping[str, int] = field(default_factory=dict)
    specimens: Mapping[str, SpecimenSummary] = field(default_factory=dict)

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
    *,
    progress: Callable[[int, Pose], None] | None = None,
    start_s: float | None = None,
    end_s: float | None = None,
    camera_of: Callable[[int], Camera] | None = None,
) -> AnnotateSummary:
    """Track the part through a source, and write the annotated video and the poses.

    Ctrl-C ends the run in good order: the frames tracked so far are drawn and both files are finished. Any other
    exception removes the unfinished files and is raised again. Memory is bounded by the queues.

    Args:
        source: of the frames.
        session: tracks the specimens.
        overlay: draws them; required with a sink.
        sink: writes the annotated frames; it is closed (or aborted) here.
        poses_path: file for one JSON line per frame and specimen, see `PoseWriter`.
        progress: called after each frame with (frames done, pose of the first specimen).
        start_s: time stamp of the source from which on frames are tracked.
        end_s: time stamp of the source at which to stop.
        camera_of: camera of the frame of an index, to be written beside its pose; None leaves it out.

    Raises:
        OutputError: a file cannot be written, or no frame is in the range.
        ValueError: a sink without an overlay.
    """
    check_type(source, FrameSource, "annotate: source")
    if sink is not None and overlay is None:
        raise ValueError("annotate: a sink needs an overlay")
    counts = _Counts()
    outputs = _OutputFiles(sink)
    began = time.perf_counter()
    try:
        outputs.open(overlay, poses_path, camera_of)
        try:
            for frame in source:
                if start_s is not None and frame.time_s < start_s:
                    continue
                if end_s is not None and frame.time_s >= end_s:
                    break
                poses = session.process(frame.image, frame.index, frame.time_s)
                outputs.write(frame, poses)
                counts.add(poses)
                if progress:
                    progress(len(counts.ms), poses[0])
        except KeyboardInterrupt:
            counts.is_interrupted = True
        outputs.finish_drawing()
        if not counts.ms and not counts.is_interrupted:
            raise OutputError(f"{source.name}: no frame in the wanted range; nothing is written")
        outputs.close()
    except BaseException:
        outputs.abort()
        raise
    return counts.summary(source, time.perf_counter() - began)


def estimate_camera(
    source: FrameSource, session: TrackingSession, progress: Callable[[int], None] | None = None
) -> FocalEstimate:
    """The focal length from a first pass over a film, which ends as soon as it is known well.

    Args:
        source: of the frames; it must start again with each iteration.
        session: a new one whose camera is a guess; it is finished here.
        progress: called with the number of frames done.

    Raises:
        ValueError: the camera of the session is no guess.
    """
    estimate = session.camera_estimate
    if estimate is None:
        raise ValueError("estimate_camera: the camera of the session is no guess")
    kept = idle = 0
    for done, frame in enumerate(source, 1):
        session.process(frame.image, frame.index, frame.time_s)
        # A film gives the same result each time; a stream does not wait.
        estimate.wait()
        if progress:
            progress(done)
        idle = 0 if estimate.frames > kept else idle + 1
        kept = estimate.frames
        if estimate.is_done or done >= MAX_FIRST_PASS or idle >= MAX_IDLE_FRAMES:
            break
    return estimate.finish()


class _Counts:
    """Counts of the frames tracked so far."""

    def __init__(self) -> None:
        self.ms: list[float] = []
        self.is_interrupted = False
        self._states: Counter[str] = Counter()
        self._reasons: dict[str, Counter[str]] = {}
        self._withheld_reasons: Counter[str] = Counter()
        self._never_verified: tuple[str, ...] | None = None
        self._specimens: dict[str, _SpecimenCounts] = {}

    def add(self, poses: tuple[Pose, ...]) -> None:
        """Count a frame."""
        self.ms.append(sum(pose.ms for pose in poses))
        for pose in poses:
            self._add(pose)
            self._specimens.setdefault(pose.instance, _SpecimenCounts()).add(pose)

    def _add(self, pose: Pose) -> None:
        self._states[str(pose.state)] += 1
        if pose.reason:
            self._reasons.setdefault(str(pose.state), Counter())[pose.reason] += 1
        if pose.is_label_withheld:
            self._withheld_reasons[pose.identity_reason] += 1
        if pose.cam_from_model is not None:
            before = self._never_verified
            open_names = [name for name in pose.unverified if not is_refuted(pose, name)]
            self._never_verified = tuple(name for name in open_names if before is None or name in before)

    def summary(self, source: FrameSource, seconds: float) -> AnnotateSummary:
        """Summary of the run."""
        return AnnotateSummary(
            frames=len(self.ms),
            skipped=source.skipped,
            seconds=seconds,
            states=dict(self._states),
            reasons={state: dict(counts) for state, counts in self._reasons.items()},
            never_verified=self._never_verified or (),
            ms=tuple(self.ms),
            ended_reason=source.ended_reason,
            is_interrupted=self.is_interrupted,
            withheld_reasons=dict(self._withheld_reasons),
            specimens={name: counts.summary() for name, counts in self._specimens.items()},
        )


def is_refuted(pose: Pose, name: str) -> bool:
    """Whether a component was seen not to be in its place."""
    one = pose.components.get(name)
    return one is not None and one.presence in (Presence.MISSING, Presence.DISPLACED)


class _SpecimenCounts:
    """Counts of the frames of one specimen, and what was last known of it."""

    def __init__(self) -> None:
        self._states: Counter[str] = Counter()
        self._last: Pose | None = None
        self._serial = ""

    def add(self, pose: Pose) -> None:
        """Count a frame."""
        self._states[str(pose.state)] += 1
        self._serial = pose.serial or self._serial
        if pose.cam_from_model is not None:
            self._last = pose

    def summary(self) -> SpecimenSummary:
        """Summary of the specimen."""
        last = self._last
        presence = {} if last is None else {name: one.presence for name, one in last.components.items()}
        completeness = None if last is None else last.completeness
        return SpecimenSummary(
            dict(self._states),
            completeness,
            presence,
            self._serial,
            () if last is None or last.steps is None else (last.steps.text, *(one[0] for one in last.steps.history)),
        )


class _OutputFiles:
    """The files of one run: the annotated video and the poses, each or none."""

    def __init__(self, sink: Sink | None) -> None:
        self._sink = sink
        self._drawer: _Drawer | None = None
        self._poses: PoseWriter | None = None

    def open(
        self, overlay: Overlay | None, poses_path: str | Path | None, camera_of: Callable[[int], Camera] | None
    ) -> None:
        """Open the file of the poses and start drawing."""
        if poses_path is not None:
            self._poses = PoseWriter(poses_path, camera_of)
        if self._sink is not None and overlay is not None:
            self._drawer = _Drawer(overlay, self._sink)

    def write(self, frame: Frame, poses: tuple[Pose, ...]) -> None:
        """Add a frame to both files."""
        if self._drawer is not None:
            self._drawer.put(frame, poses)
        if self._poses is not None:
            for pose in poses:
                self._poses.write(pose, frame.file, frame.image)

    def finish_drawing(self) -> None:
        """Wait until all frames are drawn."""
        if self._drawer is not None:
            self._drawer.finish()

    def close(self) -> None:
        """Finish both files; a video without a frame is removed."""
        if self._sink is not None:
            if self._sink.frames_written:
                self._sink.close()
            else:
                self._sink.abort()
        if self._poses is not None:
            self._poses.close()

    def abort(self) -> None:
        """Remove both files."""
        if self._drawer is not None:
            self._drawer.stop()
        if self._sink is not None:
            self._sink.abort()
        if self._poses is not None:
            self._poses.abort()


def reasons_text(reasons: Mapping[str, int]) -> str:
    """The most frequent reasons and their frames, e.g. ``too dark (80), only 8 to 12 % of the outline found (40)``.

    Reasons that differ only in their numbers are counted together, with the range of those numbers.
    """
    counts: Counter[str] = Counter()
    numbers: dict[str, list[list[str]]] = {}
    for reason, count in reasons.items():
        kind = _NUMBER.sub("\0", reason)
        counts[kind] += count
        numbers.setdefault(kind, []).append(_NUMBER.findall(reason))
    texts = []
    for kind, count in counts.most_common(MAX_REASONS):
        for column in zip(*numbers[kind], strict=True):
            low, high = min(column, key=float), max(column, key=float)
            kind = kind.replace("\0", low if low == high else f"{low} to {high}", 1)
        texts.append(f"{kind} ({count})")
    others = counts.total() - sum(count for _, count in counts.most_common(MAX_REASONS))
    return ", ".join([*texts, f"other ({others})"] if others else texts)


def summary_lines(summary: AnnotateSummary) -> list[str]:
    """A run in words: speed, states with their reasons, specimens, and what was withheld or not verified."""
    states = _listed(summary.states)
    skipped = f", {summary.skipped} broken frames skipped" if summary.skipped else ""
    tracking_ms = sorted(summary.ms)[len(summary.ms) // 2]
    lines = [
        f"{summary.frames} frames in {summary.seconds:.1f} s ({summary.fps:.1f} fps end to end, tracking "
        f"{tracking_ms:.1f} ms a frame): {states}{skipped}"
    ]
    for state, reasons in sorted(summary.reasons.items()):
        lines.append(f"{state} {sum(reasons.values())} frames: {reasons_text(reasons)}")
    if summary.withheld_reasons:
        withheld = summary.withheld_reasons
        lines.append(f"labels withheld in {sum(withheld.values())} frames: {reasons_text(withheld)}")
    for name, specimen in summary.specimens.items():
        lines += _specimen_lines(name, specimen)
    if summary.never_verified:
        lines.append(f"not verified in any frame: {', '.join(summary.never_verified)}")
    return lines


def _specimen_lines(name: str, specimen: SpecimenSummary) -> list[str]:
    """What was found of one specimen: its states where it has a name, and its components where it has several."""
    title = f"{name}: " if name else ""
    lines = [title + _listed(specimen.states)] if name else []
    if not specimen.presence or specimen.completeness is None:
        return lines
    names: dict[Presence, list[str]] = {}
    for component, presence in specimen.presence.items():
        names.setdefault(presence, []).append(component)
    named = (Presence.MISSING, Presence.DISPLACED)
    found = [f"{len(some)} {one}" + (f" ({', '.join(some)})" if one in named else "") for one, some in names.items()]
    lines += [f"{title}steps: {'; '.join(specimen.steps)}"] if specimen.steps else []
    return [*lines, f"{title}components {specimen.completeness}: {', '.join(found)}"]


def _listed(states: Mapping[str, int]) -> str:
    return ", ".join(f"{count} {state}" for state, count in sorted(states.items()))


class _Drawer:
    """A thread that draws frames in order and hands them to the sink."""

    def __init__(self, overlay: Overlay, sink: Sink) -> None:
        self._overlay = overlay
        self._sink = sink
        self._waiting: queue.Queue[tuple[Frame, tuple[Pose, ...]] | None] = queue.Queue(QUEUED_FRAMES)
        self._error: BaseException | None = None
        self._is_stopped = False
        self._thread = threading.Thread(target=self._run, name="arview-overlay", daemon=True)
        self._thread.start()

    def put(self, frame: Frame, poses: tuple[Pose, ...]) -> None:
        """Queue a frame; raises the exception of an earlier one, if drawing or writing it failed."""
        if self._error is not None:
            raise self._error
        self._waiting.put((frame, poses))

    def finish(self) -> None:
        """Wait until all queued frames are written; raises the exception of one that failed."""
        self._waiting.put(None)
        self._thread.join()
        if self._error is not None:
            raise self._error

    def stop(self) -> None:
        """Discard the queued frames and end the thread."""
        self._is_stopped = True
        if self._thread.is_alive():
            self._waiting.put(None)
            self._thread.join()

    def _run(self) -> None:
        rate = _Rate()
        for frame, poses in iter(self._waiting.get, None):
            # After an error the queue is still emptied, so that no caller waits for room in it.
            if self._error is not None or self._is_stopped:
                continue
            try:
                self._sink.write(self._overlay.draw(frame.image, poses, fps=rate.tick()), frame.time_s)
            except BaseException as error:
                self._error = error


class _Rate:
    """Frames per second over the last window, updated once per window so that the number can be read."""

    def __init__(self) -> None:
        self._since_s = time.perf_counter()
        self._count = 0
        self._fps: float | None = None

    def tick(self) -> float | None:
        """Count a frame; returns the rate, or None in the first window."""
        self._count += 1
        passed_s = time.perf_counter() - self._since_s
        if passed_s >= FPS_WINDOW_S:
            self._fps = self._count / passed_s
            self._since_s, self._count = self._since_s + passed_s, 0
        return self._fps


class FollowingOverlay:
    """Draws with the camera of each frame, where that is replaced while the frames are tracked.

    Args:
        make: makes the overlay of a camera.
        camera_of: camera of the frame of an index.
    """

    def __init__(self, make: Callable[[Camera], Overlay], camera_of: Callable[[int], Camera]) -> None:
        self._make = make
        self._camera_of = camera_of
        self._camera: Camera | None = None
        self._overlay: Overlay | None = None

    def draw(self, image: Image, poses: tuple[Pose, ...], /, fps: float | None = None) -> Image:
        """The annotated frame."""
        camera = self._camera_of(poses[0].index)
        if self._overlay is None or camera is not self._camera:
            self._camera, self._overlay = camera, self._make(camera)
        return self._overlay.draw(image, poses, fps=fps)
