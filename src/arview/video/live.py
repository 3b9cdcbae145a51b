"""Live sources: cameras and network streams, of which only the newest frame is kept."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from typing import Protocol

import av
import cv2

from arview.errors import InputError, without_credentials
from arview.video.clock import plausible_fps
from arview.video.deinterlace import Deinterlacer
from arview.video.frame import Frame, Image
from arview.video.pictures import quiet_opencv
from arview.video.source import FrameRange, FrameSource
from arview.video.upright import UprightPictures


class StreamEnded(Exception):
    """The device or stream delivers no more frames; the message says why."""


class Grabber(Protocol):
    """A device or connection that blocks until its next frame."""

    fps: float | None
    quarter_turns_clockwise: int
    unsquared_size: tuple[int, int] | None

    def read(self) -> Image | None:
        """Next frame (H,W,3) uint8 RGB, None for a broken one; raises StreamEnded if there are no more."""

    def close(self) -> None:
        """Release the device."""


class LiveSource(FrameSource):
    """The newest frame of a camera or stream at each step of the iteration; frames in between are dropped.

    A thread opens and reads the device. ``Frame.index`` counts all received frames, so that gaps show how many were
    dropped; ``Frame.time_s`` is the arrival time since the first one. The iteration ends, with ``ended_reason`` set,
    when the stream ends or no frame arrives for ``read_timeout_s``.

    Raises:
        InputError: on construction, if no frame arrives within ``open_timeout_s``.
    """

    is_live = True

    def __init__(
        self,
        name: str,
        open_grabber: Callable[[], Grabber],
        wanted: FrameRange,
        open_timeout_s: float,
        read_timeout_s: float,
    ) -> None:
        self.name = name
        self._open_grabber = open_grabber
        self._wanted = wanted
        self._read_timeout_s = read_timeout_s
        self._changed = threading.Condition()
        self._newest: Frame | None = None
        self._arrived_s = 0.0  # monotonic time of the last frame
        self._opened = False
        self._finished = False
        self._closing = False
        threading.Thread(target=self._run, name="arview-live", daemon=True).start()
        with self._changed:
            answered = self._changed.wait_for(lambda: self._opened or self._finished, timeout=open_timeout_s)
            if not self._opened:
                self._closing = True
                why = self.ended_reason if answered else f"{name}: no frame within {open_timeout_s:g} s"
                raise InputError(f"{why}; check the address, the cable and that no other program uses it")

    def __iter__(self) -> Iterator[Frame]:
        while (frame := self._next_frame()) is not None:
            yield frame

    def _next_frame(self) -> Frame | None:
        """The next wanted frame, the newest; None at the end or after ``read_timeout_s`` without a frame."""
        with self._changed:
            while self._newest is None and not self._finished:
                patience_s = self._arrived_s + self._read_timeout_s - time.monotonic()
                if patience_s <= 0:
                    self.ended_reason = f"{self.name}: no frame for {self._read_timeout_s:g} s; is it still connected?"
                    self._closing = True
                    return None
                self._changed.wait(patience_s)
            frame, self._newest = self._newest, None
            return frame

    def close(self) -> None:
        """Stop reading; the device is released as soon as its pending read returns."""
        with self._changed:
            self._closing = self._finished = True
            self._newest = None
            self._changed.notify_all()

    def _run(self) -> None:
        """Body of the reader thread: open, read until the end, keep the reason of the end."""
        try:
            grabber = self._open_grabber()
        except StreamEnded as ended:
            self._finish(str(ended))
            return
        try:
            self._read_all(grabber)
        except StreamEnded as ended:
            self._finish(str(ended))
        finally:
            grabber.close()

    def _read_all(self, grabber: Grabber) -> None:
        index, first_s = 0, 0.0
        while not self._closing:
            image, now_s = grabber.read(), time.monotonic()
            with self._changed:
                self._arrived_s = now_s
                if not self._opened and image is not None:
                    first_s = now_s
                    self.height, self.width = image.shape[:2]
                    self.fps = grabber.fps
                    self.quarter_turns_clockwise = grabber.quarter_turns_clockwise
                    self.unsquared_size = grabber.unsquared_size
                    self._opened = True
                if image is None or image.shape[:2] != (self.height, self.width):
                    self.skipped += 1
                elif self._wanted.wants(index) and not self._closing:
                    self._newest = Frame(image, index, now_s - first_s)
                self._changed.notify_all()
            index += 1
            if self._wanted.is_past(index):
                self._finish("")
                return

    def _finish(self, reason: str) -> None:
        with self._changed:
            if not self._closing and reason:
                self.ended_reason = f"{self.name}: {reason}"
            self._finished = True
            self._changed.notify_all()


class UrlGrabber:
    """Reads an RTSP, HTTP or other network stream; opening and reading end after their timeouts."""

    def __init__(self, url: str, open_timeout_s: float, read_timeout_s: float) -> None:
        options = {"rtsp_transport": "tcp", "fflags": "nobuffer"} if url.startswith("rtsp") else {}
        try:
            self._container = av.open(url, timeout=(open_timeout_s, read_timeout_s), options=options)
        except (av.FFmpegError, OSError, ValueError) as error:
            raise StreamEnded(f"cannot be opened: {_reason(error)}") from error
        if not self._container.streams.video:
            self._container.close()
            raise StreamEnded("contains no video stream")
        stream = self._container.streams.video[0]
        stream.thread_type = "SLICE"  # frame threads would delay frames
        self.fps = plausible_fps(stream.average_rate, stream.guessed_rate)
        self.quarter_turns_clockwise = 0
        self.unsquared_size: tuple[int, int] | None = None
        self._stream = stream
        self._packets = self._container.demux(stream)
        self._progressive: Deinterlacer[bool] = Deinterlacer()
        self._pictures: UprightPictures | None = None
        self._decoded: list[tuple[bool, av.VideoFrame]] = []

    def read(self) -> Image | None:
        """Next frame, None for a broken one; raises StreamEnded at the end or when the connection fails."""
        while not self._decoded:
            try:
                packet = next(self._packets, None)
            except (av.FFmpegError, OSError) as error:
                raise StreamEnded(f"the connection failed: {_reason(error)}") from error
            if packet is None:
                raise StreamEnded("the stream ended")
            try:
                for frame in packet.decode():
                    self._decoded += self._progressive.push(frame, frame.is_corrupt)
            except av.FFmpegError:
                return None
        is_corrupt, frame = self._decoded.pop(0)
        if is_corrupt:
            return None
        if self._pictures is None:
            self._pictures = UprightPictures(frame, self._stream.sample_aspect_ratio)
            self.quarter_turns_clockwise = self._pictures.quarter_turns_clockwise
            self.unsquared_size = None if self._pictures.is_square else self._pictures.stored_size
        return self._pictures.image_of(frame, 0)

    def close(self) -> None:
        """Close the connection."""
        self._container.close()


class CameraGrabber:
    """Reads a camera of this machine through OpenCV."""

    quarter_turns_clockwise = 0
    unsquared_size: tuple[int, int] | None = None

    def __init__(self, index: int) -> None:
        with quiet_opencv():
            self._capture = cv2.VideoCapture(index)
        if not self._capture.isOpened():
            raise StreamEnded(f"there is no camera {index}, or it is in use")
        self.fps = plausible_fps(self._capture.get(cv2.CAP_PROP_FPS))

    def read(self) -> Image | None:
        """Next frame; raises StreamEnded if the camera was unplugged."""
        read, bgr = self._capture.read()
        if not read:
            raise StreamEnded("the camera delivers no more frames; was it unplugged?")
        return cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)

    def close(self) -> None:
        """Release the camera."""
        self._capture.release()


def _reason(error: Exception) -> str:
    if isinstance(error, av.error.ExitError):
        return "no answer in time"
    return without_credentials(getattr(error, "strerror", None) or str(error))
