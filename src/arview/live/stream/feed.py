"""Feed: one stream of frames and its tracking, in a thread of its own that always takes the newest frame."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from arview.camera import Camera
from arview.camera.read import guess_camera
from arview.errors import ArviewError
from arview.live.stream.frames import Incoming, Picture, to_jpeg
from arview.live.stream.newest import NewestSlot
from arview.live.stream.notices import Notice, without_folder
from arview.live.stream.subject import Subject
from arview.pose import Pose, TrackingState
from arview.tracking import TrackingSession

logger = logging.getLogger("arview.live")

KEPT_FRAMES = 12
"""Tracked frames kept for a snapshot: what a page still shows after a slow network; 33 MB at 720p."""
RATE_WINDOW_S = 2.0
SILENT_S = 1.5
"""A feed without a frame for so long is waiting."""
UNREADABLE_IN_A_ROW = 15
"""So many frames without a readable stamp, half a second, are told."""
SCALED_BELOW = 0.95


@dataclass(frozen=True, eq=False)
class Tracked:
    """A frame with its pose.

    Attributes:
        picture: what was tracked.
        pose: of that frame.
        camera: of the picture.
        arrived_s, started_s, done_s: monotonic times.
        dropped: frames that the feed passed over so far.
        revision: of the part document.
        serial: counts the tracked frames of the feed; frame ids may wrap around or repeat.
    """

    picture: Picture
    pose: Pose
    camera: Camera
    arrived_s: float
    started_s: float
    done_s: float
    dropped: int
    revision: int
    serial: int

    @cached_property
    def jpeg(self) -> bytes:
        """The plain picture as JPEG."""
        return to_jpeg(self.picture.image)


@dataclass
class _Rate:
    """Events a second over the last window."""

    _times: deque[float] = field(default_factory=lambda: deque(maxlen=400))

    def tick(self) -> None:
        self._times.append(time.monotonic())

    def value(self) -> float:
        since = time.monotonic() - RATE_WINDOW_S
        return sum(moment > since for moment in tuple(self._times)) / RATE_WINDOW_S


class Feed:
    """Tracks the newest frame of one stream and tells its listeners.

    Attributes:
        kind: "phone" or "station".
        received: frames that came.
        unreadable: of these, without a readable stamp.
        failures: how often the tracking had to begin anew because of an error of its own.
        newest: last tracked frame.
    """

    def __init__(self, subject: Subject, kind: str) -> None:
        self.kind = kind
        self.received = self.unreadable = self.failures = 0
        self.newest: Tracked | None = None
        self.received_rate, self.tracked_rate = _Rate(), _Rate()
        self._subject = subject
        self._slot: NewestSlot[Incoming] = NewestSlot()
        self._listeners: list[Callable[[Tracked], None]] = []
        self._kept: deque[Tracked] = deque(maxlen=KEPT_FRAMES)
        self._arrived_s: float | None = None
        self._session: TrackingSession | None = None
        self._wants_reset = False
        self._refused: Notice | None = None
        self._shape: tuple[int, int, int] | None = None
        self._unreadable_in_a_row = 0
        self._serial = 0
        self._thread = threading.Thread(target=self._run, name=f"arview-{kind}", daemon=True)
        self._thread.start()

    def put(self, incoming: Incoming) -> None:
        """Offer a frame; one that still waits is dropped."""
        self.received += 1
        self._arrived_s = incoming.arrived_s
        self.received_rate.tick()
        self._slot.put(incoming)

    def listen(self, listener: Callable[[Tracked], None]) -> None:
        """Have a function called, in the tracker's thread, with every tracked frame; it must not wait."""
        self._listeners.append(listener)

    def unlisten(self, listener: Callable[[Tracked], None]) -> None:
        """Take a listener away."""
        if listener in self._listeners:
            self._listeners.remove(listener)

    def reset(self) -> None:
        """Search again, from the next frame on."""
        self._wants_reset = True

    def find(self, frame_id: int) -> Tracked | None:
        """A tracked frame that is still kept."""
        return next((one for one in reversed(tuple(self._kept)) if one.picture.frame_id == frame_id), None)

    def close(self) -> None:
        """End the tracking; a frame being tracked is finished first."""
        self._slot.close()
        self._thread.join(timeout=5.0)

    @property
    def dropped(self) -> int:
        """Frames passed over because a newer one had come."""
        return self._slot.dropped

    @property
    def age_ms(self) -> float | None:
        """Time since the newest frame came."""
        return None if self._arrived_s is None else 1e3 * (time.monotonic() - self._arrived_s)

    @property
    def state(self) -> tuple[str, str]:
        """State of the stream and what to say of it."""
        age_ms = self.age_ms
        if age_ms is None:
            return "waiting", "waiting for the first picture"
        if age_ms > 1e3 * SILENT_S:
            return "waiting", f"no picture for {age_ms / 1e3:.0f} s"
        return "live", ""

    def notices(self) -> list[Notice]:
        """What whoever looks at this feed has to know."""
        said = [self._refused] if self._refused else []
        newest = self.newest
        if newest is not None and newest.picture.scale < SCALED_BELOW:
            said.append(
                Notice("frames_scaled", "warning", f"pictures arrive at {newest.picture.scale:.0%} of their size")
            )
        if self._unreadable_in_a_row >= UNREADABLE_IN_A_ROW:
            said.append(Notice("stamp_unreadable", "error", "pictures arrive damaged: their counter cannot be read"))
        if self.failures:
            said.append(
                Notice("tracking_failed", "error", f"the tracking failed and began anew, {self.failures} times")
            )
        return said

    def _run(self) -> None:
        while (incoming := self._slot.take()) is not None:
            try:
                self._step(incoming)
            except Exception:  # a bug must not end the stream: begin anew with the next frame, and say so
                logger.exception("tracking failed; it begins anew")
                self.failures += 1
                self._shape = None
        # A connection that broke can live on in cycles of references for a while; the pictures must not.
        self._kept.clear()
        self._session = self.newest = None

    def _step(self, incoming: Incoming) -> None:
        started_s = time.monotonic()
        picture = incoming.open()
        if picture is None:
            self.unreadable += 1
            self._unreadable_in_a_row += 1
            return
        self._unreadable_in_a_row = 0
        tracked = self._track(picture, incoming.arrived_s, started_s)
        self.newest = tracked
        self._kept.append(tracked)
        self.tracked_rate.tick()
        for listener in tuple(self._listeners):
            listener(tracked)

    def _track(self, picture: Picture, arrived_s: float, started_s: float) -> Tracked:
        height, width = picture.image.shape[:2]
        shape = width, height, picture.quarter_turns_clockwise
        if shape != self._shape:
            self._begin(shape)
        if self._wants_reset and self._session is not None:
            self._wants_reset = False
            self._session.reset()
        self._serial += 1
        if self._session is None:
            reason = self._refused.text if self._refused else ""
            pose = Pose(None, None, 0.0, TrackingState.SEARCHING, arrived_s, picture.frame_id, 0.0, reason)
        else:
            pose = self._session.process(np.ascontiguousarray(picture.image), picture.frame_id, arrived_s)
        return Tracked(
            picture, pose, self._camera, arrived_s, started_s, time.monotonic(), self.dropped, self._subject.revision,
            self._serial,
        )  # fmt: skip

    def _begin(self, shape: tuple[int, int, int]) -> None:
        """Make a session for pictures of another size or turn, or say why there is none."""
        width, height, turns = shape
        self._shape, self._session, self._refused = shape, None, None
        try:
            self._camera = self._subject.camera(width, height, turns)
            self._session = self._subject.session(self._camera)
        except ArviewError as error:
            self._camera = guess_camera(width, height)
            self._refused = Notice(
                "size_refused", "error", without_folder(str(error), self._subject.options.camera or "")
            )
