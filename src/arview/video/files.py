"""Sources on disk: video files."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import av
from av.container import InputContainer
from av.video.frame import VideoFrame
from av.video.stream import VideoStream

from arview.errors import InputError
from arview.video.clock import FrameClock, plausible_fps
from arview.video.deinterlace import Deinterlacer
from arview.video.frame import Frame
from arview.video.source import FrameRange, FrameSource, read_ahead
from arview.video.upright import UprightPictures

NO_TIMESTAMPS = 0x80
"""FFmpeg's AVFMT_NOTIMESTAMPS."""


class VideoFileSource(FrameSource):
    """Frames of a video file at their times from the first one on, also of variable frame rate.

    The rotation of the display matrix is applied, pixels are made square, interlaced frames are deinterlaced, frames
    of another size are scaled to the first one; 10-bit and HDR clips are converted to 8-bit BT.709. Packets and frames
    that cannot be decoded are skipped and counted. A mirroring display matrix is not applied, because the stored
    picture is what the lens saw.

    Raises:
        InputError: on construction, if no frame of the file can be decoded.
    """

    def __init__(self, path: Path, wanted: FrameRange) -> None:
        self.name = str(path)
        self.audio_path = path
        self._path = path
        self._wanted = wanted
        with self._opened() as (container, stream):
            first = next(self._decoded(container, stream), None)
            if first is None:
                raise InputError(f"{path}: the video contains no frame that can be decoded; record or copy it again")
            frame = first[1]
            # A raw stream has no time stamps: what looks like some, and its average rate, are defaults of the demuxer.
            self._has_stamps = not container.format.flags & NO_TIMESTAMPS
            self._is_avi = container.format.name == "avi"
            rates = (stream.average_rate, stream.guessed_rate)
            self.fps = plausible_fps(*(rates if self._has_stamps else reversed(rates)))
            self._total: int | None = stream.frames or None
            self._pixel_aspect = stream.sample_aspect_ratio
        self.audio_start_s = self._stamp_s(frame) or 0.0
        pictures = UprightPictures(frame, self._pixel_aspect)
        self._first = frame
        self.quarter_turns_clockwise = pictures.quarter_turns_clockwise
        self.width, self.height = pictures.width, pictures.height
        self.unsquared_size = None if pictures.is_square else pictures.stored_size
        if self._total is not None:
            self.frame_count = wanted.count(self._total)
            if self.frame_count == 0:
                raise InputError(f"{path}: start {wanted.start} is past the last of its {self._total} frames")

    def __iter__(self) -> Iterator[Frame]:
        return read_ahead(self._frames)

    def _frames(self) -> Iterator[Frame]:
        self.skipped, self.ended_reason, self.notes = 0, "", ()
        pictures = UprightPictures(self._first, self._pixel_aspect)
        clock = FrameClock(self.fps)
        progressive: Deinterlacer[tuple[int, float]] = Deinterlacer()
        index = -1
        try:
            with self._opened() as (container, stream):
                for index, frame in self._decoded(container, stream):
                    time_s = clock.time_s(index, self._stamp_s(frame))
                    # One frame before the range, because a deinterlaced frame depends on its neighbours.
                    if index < self._wanted.start - 1:
                        continue
                    yield from self._wanted_pictures(progressive.push(frame, (index, time_s)), pictures)
                    if self._wanted.is_past(index):
                        break
                yield from self._wanted_pictures(progressive.flush(), pictures)
        finally:  # also where the iteration is left early
            self._take_notes(pictures, clock, progressive.is_active)
        if (
            self._total is not None
            and index + 1 < self._total
            and not (self.ended_reason or self._wanted.is_past(index))
        ):
            self.ended_reason = (
                f"{self.name}: the file is cut short or damaged; "
                f"{index + 1 - self.skipped} of {self._total} frames could be read"
            )

    def _stamp_s(self, frame: VideoFrame) -> float | None:
        """Time stamp of a frame by the clock of the file, seconds; None without one."""
        # AVI numbers frames in the order of decoding, also where they are shown in another one.
        stamp = frame.dts if self._is_avi else frame.pts
        if not self._has_stamps or stamp is None or frame.time_base is None:
            return None
        return float(stamp * frame.time_base)

    def _wanted_pictures(
        self, frames: Sequence[tuple[tuple[int, float], VideoFrame]], pictures: UprightPictures
    ) -> Iterator[Frame]:
        """The pictures of decoded frames, as far as they are wanted."""
        for (index, time_s), frame in frames:
            if not self._wanted.wants(index):
                continue
            image = pictures.image_of(frame, index)
            if image is None:
                self.skipped += 1
            else:
                yield Frame(image, index, time_s)

    def _take_notes(self, pictures: UprightPictures, clock: FrameClock, is_interlaced: bool) -> None:
        """Keep what was changed in the frames."""
        notes = (
            "the film is interlaced: it was deinterlaced" if is_interlaced else "",
            pictures.note,
            f"the time stamps start again {clock.restarts} times: times go on from there" if clock.restarts else "",
        )
        self.notes = tuple(note for note in notes if note)

    @contextmanager
    def _opened(self) -> Iterator[tuple[InputContainer, VideoStream]]:
        """The opened container and its video stream; raises InputError."""
        try:
            # Absolute, because FFmpeg takes the text before a colon in a relative name for a protocol.
            container = av.open(str(self._path.absolute()))
        except (av.FFmpegError, OSError, ValueError) as error:
            raise InputError(f"{self.name}: {_why_unreadable(self._path, error)}") from error
        with container:
            # The cover picture of a music file is a video stream too, but not one to track in.
            streams = [
                stream
                for stream in container.streams.video
                if not stream.disposition & av.stream.Disposition.attached_pic
            ]
            if not streams:
                raise InputError(f"{self.name}: contains no video stream; give a video file")
            if container.format.name == "tty":
                raise InputError(f"{self.name}: is a text file, not a video; give a video file")
            streams[0].thread_type = "AUTO"
            yield container, streams[0]

    def _decoded(self, container: InputContainer, stream: VideoStream) -> Iterator[tuple[int, VideoFrame]]:
        """Index and frame of all frames that can be decoded; the others are counted in ``skipped``."""
        index, packets = 0, container.demux(stream)
        while True:
            try:
                packet = next(packets, None)
            except av.FFmpegError as error:
                self.ended_reason = f"{self.name}: cannot be read beyond frame {index}: {error.strerror}"
                return
            if packet is None:
                return
            try:
                frames: Sequence[VideoFrame] = packet.decode()
            except av.FFmpegError:
                self.skipped += 1
                index += 1
                continue
            for frame in frames:
                if frame.is_corrupt:
                    self.skipped += 1
                else:
                    yield index, frame
                index += 1


def _why_unreadable(path: Path, error: Exception) -> str:
    """What is wrong with a file that the demuxer rejects, and what to do."""
    try:
        size = path.stat().st_size
        with path.open("rb") as file:
            head = file.read(4096)
    except OSError as os_error:
        return f"cannot be read: {os_error.strerror or os_error}; check the file and its permissions"
    if size == 0:
        return "is empty (0 bytes); record or copy it again"
    if head[4:8] == b"ftyp":
        return "is a damaged or cut-short MP4 (its index is missing); copy it again or repair it"
    if b"\0" not in head:
        return "is a text file, not a video; give a video file"
    return f"is not a readable video ({getattr(error, 'strerror', None) or error}); give a video file"
