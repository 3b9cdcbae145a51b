"""Feeds: a stream of frames and its tracking, in a thread that always takes the newest frame."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from arview import tracking
from arview.camera import Camera, FrameView, guess_camera, require_brown
from arview.core.messages import sentence
from arview.errors import ArviewError
from arview.pose import Pose, TrackingState
from arview.station.live.options import UNDISTORT
from arview.station.live.stream.frames import DecodedFrame, IncomingFrame, to_jpeg
from arview.station.live.stream.newest import NewestSlot
from arview.station.live.stream.notices import Notice, without_folder
from arview.station.live.stream.subjects import Subjects

STUCK_S = 90.0
"""A frame that is tracked for longer is given up with its thread; compiling takes a minute."""
MAX_LOST = 4
"""Threads given up; then the stream ends, with a notice."""
KEPT_FRAMES = 12
"""Tracked frames kept for snapshots while the network is slow; 33 MB at 720p."""
RATE_WINDOW_S = 2.0
"""Window over which frame rates are counted."""
SILENCE_S = 1.5
"""A feed without a frame for longer than this is waiting."""
MAX_UNREADABLE = 15
"""Consecutive frames without a readable stamp, half a second, that raise a notice."""
MIN_SCALE = 0.95
"""A frame received at less than this share of its size raises a notice."""

logger = logging.getLogger("arview.station.live")


@dataclass(frozen=True, eq=False)
class TrackedFrame:
    """A frame with its pose.

    Attributes:
        frame: the frame that was tracked.
        poses: pose of each part in that frame.
        camera: intrinsics of the frame.
        arrived_s, started_s, done_s: monotonic times of its arrival, and of the start and end of its tracking.
        dropped: number of frames that the feed had dropped by then.
        revision: revision of the part document.
        serial: number of the frame among the tracked frames of the feed; frame ids may wrap around or repeat.
        subjects: the parts that are tracked, from which labels get their texts.
    """

    frame: DecodedFrame
    poses: tuple[Pose, ...]
    camera: Camera
    arrived_s: float
    started_s: float
    done_s: float
    dropped: int
    revision: int
    serial: int
    subjects: Subjects | None = None

    @property
    def pose(self) -> Pose:
        """Pose of the first part."""
        return self.poses[0]

    @cached_property
    def jpeg(self) -> bytes:
        """The picture without overlay as JPEG."""
        return to_jpeg(self.frame.image)


@dataclass
class _EventRate:
    """Events per second over the last ``window_s`` seconds."""

    window_s: float
    _times: deque[float] = field(default_factory=lambda: deque(maxlen=400))

    def tick(self) -> None:
        self._times.append(time.monotonic())

    def value(self) -> float:
        since = time.monotonic() - self.window_s
        return sum(moment > since for moment in tuple(self._times)) / self.window_s


class Feed:
    """Tracks the newest frame of one stream and passes it to its listeners.

    Attributes:
        kind: "phone" or "station".
        received: number of frames received.
        unreadable: number of these without a readable stamp.
        failures: how often the tracking was restarted after an internal error.
        newest: the last tracked frame.
    """

    def __init__(self, subjects: Subjects, kind: str) -> None:
        self.kind = kind
        self.received = self.unreadable = self.failures = 0
        self.newest: TrackedFrame | None = None
        self.received_rate = _EventRate(RATE_WINDOW_S)
        self.tracked_rate = _EventRate(RATE_WINDOW_S)
        self._subjects = subjects
        self._slot: NewestSlot[IncomingFrame] = NewestSlot()
        self._listeners: list[Callable[[TrackedFrame], None]] = []
        self._kept: deque[TrackedFrame] = deque(maxlen=KEPT_FRAMES)
        self._arrived_s: float | None = None
        self._session: tracking.TrackingSession | None = None
        self._view: FrameView | None = None
        self._wanted: deque[tuple[str, int | None]] = deque()
        self._camera: Camera
        self._refused: Notice | None = None
        self._shape: tuple[int, int, int] | None = None
        self._unreadable_in_a_row = 0
        self._serial = 0
        self._lost = 0
        self._step_began_s: float | None = None
        self._start()

    def put(self, incoming: IncomingFrame) -> None:
        """Add a frame; one that still waits is dropped."""
        self.received += 1
        self._arrived_s = incoming.arrived_s
        self.received_rate.tick()
        self._slot.put(incoming)

    def listen(self, listener: Callable[[TrackedFrame], None]) -> None:
        """Call a function, in the thread of the tracker, with every tracked frame; it must not block."""
        self._listeners.append(listener)

    def unlisten(self, listener: Callable[[TrackedFrame], None]) -> None:
        """Remove a listener."""
        if listener in self._listeners:
            self._listeners.remove(listener)

    def reset(self, part: int | None = None) -> None:
        """Search for a part again, by its number, or for all of them, from the next frame on."""
        self._wanted.append(("reset", part))

    def confirm(self, part: int | None = None) -> None:
        """The user says that a part in view is the one to which its labels belong, from the next frame on."""
        self._wanted.append(("confirm", part))

    def show(self, subjects: Subjects) -> None:
        """Track the same parts as specimens with other serial numbers and inspections, from the next frame on."""
        self._subjects = subjects

    def find(self, frame_id: int) -> TrackedFrame | None:
        """The tracked frame with this id, if it is still kept."""
        return next((one for one in reversed(tuple(self._kept)) if one.frame.frame_id == frame_id), None)

    def close(self) -> None:
        """End the tracking, after the frame that is being tracked."""
        self._slot.close()
        self._thread.join(timeout=5.0)

    def replace_if_stuck(self) -> None:
        """Give the stream another thread when decoding or tracking of a frame does not come back."""
        began_s = self._step_began_s
        if began_s is None or time.monotonic() - began_s < STUCK_S or self._slot.is_closed:
            return
        self._step_began_s = None
        self._lost += 1
        self.failures += 1
        if self._lost > MAX_LOST:
            logger.error("the tracking did not come back %d times; the stream has ended", self._lost)
            self._slot.close()
            return
        logger.warning("the tracking of a frame did not come back within %.0f s and is replaced", STUCK_S)
        self._shape = self._session = None
        self._start()

    @property
    def dropped(self) -> int:
        """Number of frames dropped because a newer one had arrived."""
        return self._slot.dropped

    @property
    def age_ms(self) -> float | None:
        """Milliseconds since the newest frame arrived; None before the first."""
        return None if self._arrived_s is None else 1e3 * (time.monotonic() - self._arrived_s)

    @property
    def state(self) -> tuple[str, str]:
        """State of the stream and its description for the page."""
        age_ms = self.age_ms
        if age_ms is None:
            return "waiting", sentence("told.first_picture")
        if age_ms > 1e3 * SILENCE_S:
            return "waiting", sentence("told.no_picture", seconds=f"{age_ms / 1e3:.0f}")
        return "live", ""

    def notices(self) -> list[Notice]:
        """Conditions of this feed that its viewers have to know of."""
        notices = [self._refused] if self._refused else []
        estimate = None if self._session is None else self._session.estimate
        if estimate is not None and estimate.is_determined:
            notices.append(Notice("camera_estimated", "info", estimate.text))
        newest = self.newest
        if newest is not None and newest.frame.scale < MIN_SCALE:
            share = f"{newest.frame.scale:.0%}"
            notices.append(Notice("frames_scaled", "warning", sentence("told.scaled", share=share)))
        if self._unreadable_in_a_row >= MAX_UNREADABLE:
            notices.append(Notice("stamp_unreadable", "error", sentence("told.damaged")))
        if self.failures:
            notices.append(Notice("tracking_failed", "error", sentence("told.restarted", count=self.failures)))
        return notices

    def _tell_estimate(self) -> None:
        """Report the estimate of a session that ends, and keep it as a profile if one was asked for."""
        profile = self._subjects.options.profile
        estimate = None if self._session is None else self._session.finish()
        if estimate is None:
            return
        logger.info("%s", estimate.text)
        if profile is None or not estimate.is_determined or self._shape is None:
            return
        try:
            path = tracking.keep_profile(estimate, profile, self._subjects.options.source, self._shape[2])
            logger.info("wrote %s; use it with --camera profile:%s", path, profile)
        except ArviewError as error:
            logger.error("%s", error)

    def _start(self) -> None:
        self._thread = threading.Thread(target=self._run, name=f"arview-{self.kind}", daemon=True)
        self._thread.start()

    @property
    def _is_replaced(self) -> bool:
        """Whether the calling thread was given up: then another one tracks the stream."""
        return threading.current_thread() is not self._thread

    def _run(self) -> None:
        while (incoming := self._slot.take()) is not None:
            self._step_began_s = time.monotonic()
            try:
                self._step(incoming)
            except Exception:  # a bug must not end the stream: restart with the next frame, and report it
                if not self._is_replaced:
                    logger.exception("tracking failed and is restarted")
                    self.failures += 1
                    self._shape = None
            if self._is_replaced:
                return
            self._step_began_s = None
        self._tell_estimate()
        # Reference cycles can keep a broken connection alive for a while; its pictures are released now.
        self._kept.clear()
        self._session = self.newest = None

    def _step(self, incoming: IncomingFrame) -> None:
        started_s = time.monotonic()
        frame = incoming.decode()
        if frame is None:
            self.unreadable += 1
            self._unreadable_in_a_row += 1
            return
        self._unreadable_in_a_row = 0
        tracked = self._track(frame, incoming.arrived_s, started_s)
        if self._is_replaced:
            return
        self.newest = tracked
        self._kept.append(tracked)
        self.tracked_rate.tick()
        for listener in tuple(self._listeners):
            listener(tracked)

    def _track(self, frame: DecodedFrame, arrived_s: float, started_s: float) -> TrackedFrame:
        height, width = frame.image.shape[:2]
        shape = width, height, frame.quarter_turns_clockwise
        if shape != self._shape:
            self._start_session(shape, frame.unsquared_size)
        if self._session is not None:
            self._prepare(self._session)
        if self._view is not None and self._view.is_resampling:
            picture = self._view.picture(np.ascontiguousarray(frame.image), frame.frame_id)
            frame = replace(frame, image=picture, original=frame.image)
        self._serial += 1
        if self._session is None:
            reason = self._refused.text if self._refused else ""
            pose = Pose(
                None,
                None,
                0.0,
                state=TrackingState.SEARCHING,
                time_s=arrived_s,
                index=frame.frame_id,
                ms=0.0,
                reason=reason,
            )
            poses = tuple(replace(pose, instance=one.name) for one in self._subjects)
        else:
            poses = self._session.process(np.ascontiguousarray(frame.image), frame.frame_id, arrived_s)
            self._camera = self._session.camera
        return TrackedFrame(
            frame=frame,
            poses=poses,
            camera=self._camera,
            arrived_s=arrived_s,
            started_s=started_s,
            done_s=time.monotonic(),
            dropped=self.dropped,
            revision=self._subjects.revision,
            serial=self._serial,
            subjects=self._subjects,
        )

    def _prepare(self, session: tracking.TrackingSession) -> None:
        """Tell a session of which serial numbers the labels are, and what the user has asked for since."""
        session.expect(self._subjects.serial_numbers)
        while self._wanted:
            what, part = self._wanted.popleft()
            if what == "reset":
                session.reset(part)
            else:
                session.confirm(part)

    def _start_session(self, shape: tuple[int, int, int], unsquared_size: tuple[int, int] | None) -> None:
        """Start a session for frames of another size or orientation, or note why there is none."""
        width, height, turns = shape
        self._tell_estimate()
        self._shape, self._session, self._view, self._refused = shape, None, None, None
        try:
            camera = self._subjects.camera(width, height, turns, unsquared_size)
            if self.kind == "phone":  # whose page shows the picture of the phone as it is
                camera = require_brown(camera, "pictures of a phone")
            self._view = FrameView(camera, UNDISTORT)
            self._camera = self._view.tracked_camera
            self._session = self._subjects.session(self._camera)
        except ArviewError as error:
            self._camera = guess_camera(width, height)
            self._refused = Notice(
                "size_refused", "error", without_folder(str(error), self._subjects.options.camera or "")
            )
