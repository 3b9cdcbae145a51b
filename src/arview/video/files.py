"""Sources on disk: video files and sequences of pictures."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import av
import cv2
import numpy as np
from av.container import InputContainer
from av.video.frame import VideoFrame
from av.video.stream import VideoStream

from arview.camera.exif import PHOTO_SUFFIXES, read_exif
from arview.errors import InputError
from arview.video.color import rgb_from_video_frame
from arview.video.frame import Frame, Image
from arview.video.source import FrameRange, FrameSource, read_ahead

_CV2_ROTATIONS = {1: cv2.ROTATE_90_CLOCKWISE, 2: cv2.ROTATE_180, 3: cv2.ROTATE_90_COUNTERCLOCKWISE}


def turns_of(frame: VideoFrame) -> int:
    """Quarter turns clockwise, 0–3, that the frame's display matrix declares."""
    return round(-frame.rotation / 90.0) % 4


def upright_image(frame: VideoFrame, quarter_turns_clockwise: int) -> Image:
    """(H,W,3) uint8 RGB of a decoded frame, rotated by quarter turns."""
    image = rgb_from_video_frame(frame)
    if quarter_turns_clockwise:
        image = cv2.rotate(image, _CV2_ROTATIONS[quarter_turns_clockwise])
    return image


class VideoFileSource(FrameSource):
    """Frames of a video file with its time stamps, also of variable frame rate.

    The rotation of the display matrix is applied; 10-bit and HDR clips are converted to 8-bit BT.709. Packets and
    frames that cannot be decoded are skipped and counted. A mirroring display matrix is not applied, because the stored
    picture is what the lens saw. Pixels are assumed to be square.

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
            rate = stream.average_rate or stream.guessed_rate
            self.fps = float(rate) if rate else None
            self._total: int | None = stream.frames or None
        self.quarter_turns_clockwise = turns_of(frame)
        self._stored_size = (frame.width, frame.height)
        sideways = self.quarter_turns_clockwise % 2
        self.width, self.height = reversed(self._stored_size) if sideways else self._stored_size
        if self._total is not None:
            self.frame_count = wanted.count(self._total)
            if self.frame_count == 0:
                raise InputError(f"{path}: start {wanted.start} is past the last of its {self._total} frames")

    def __iter__(self) -> Iterator[Frame]:
        return read_ahead(self._frames)

    def _frames(self) -> Iterator[Frame]:
        self.skipped, self.ended_reason = 0, ""
        index = -1
        with self._opened() as (container, stream):
            for index, frame in self._decoded(container, stream):
                if self._wanted.is_past(index):
                    return
                if not self._wanted.wants(index):
                    continue
                if (frame.width, frame.height) != self._stored_size:
                    self.skipped += 1
                    continue
                time_s = index / (self.fps or 30.0) if frame.time is None else float(frame.time)
                yield Frame(upright_image(frame, self.quarter_turns_clockwise), index, time_s)
        if self._total is not None and index + 1 < self._total and not self.ended_reason:
            self.ended_reason = (
                f"{self.name}: the file is cut short or damaged; "
                f"{index + 1 - self.skipped} of {self._total} frames could be read"
            )

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
        index = 0
        packets = container.demux(stream)
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


class PictureSource(FrameSource):
    """Frames from picture files in the given order; the EXIF orientation is applied.

    Pictures that cannot be read or differ in size from the first are skipped and counted. Time stamps are index / fps.

    Raises:
        InputError: on construction, if no picture can be read.
    """

    def __init__(self, name: str, paths: Sequence[Path], wanted: FrameRange, fps: float) -> None:
        self.name = name
        self.fps = self._pictures_per_s = fps
        self._paths = paths
        self._wanted = wanted
        self.frame_count = wanted.count(len(paths))
        if self.frame_count == 0:
            raise InputError(f"{name}: start {wanted.start} is past the last of its {len(paths)} pictures")
        for path in paths:
            first = _read_picture(path)
            if first is not None:
                break
        else:
            raise InputError(f"{name}: none of the {len(paths)} pictures can be read; save them as JPEG or PNG")
        self.height, self.width = first.shape[:2]
        self.quarter_turns_clockwise = _turns_of_picture(path)

    def __iter__(self) -> Iterator[Frame]:
        return read_ahead(self._frames)

    def _frames(self) -> Iterator[Frame]:
        self.skipped = 0
        for index, path in enumerate(self._paths):
            if not self._wanted.wants(index):
                continue
            image = _read_picture(path)
            if image is None or image.shape != (self.height, self.width, 3):
                self.skipped += 1
                continue
            yield Frame(image, index, index / self._pictures_per_s)


def picture_paths(folder: Path) -> list[Path]:
    """Picture files of a folder in natural order (2 before 10)."""
    return sorted_naturally(path for path in folder.iterdir() if path.suffix.lower() in PHOTO_SUFFIXES)


def sorted_naturally(paths: Iterator[Path]) -> list[Path]:
    """Paths in an order that takes runs of digits as numbers."""

    def key(path: Path) -> list[tuple[int, str]]:
        parts = re.split(r"([0-9]+)", str(path).lower())
        return [(int(part), part) if part.isdecimal() and part.isascii() else (-1, part) for part in parts]

    return sorted(paths, key=key)


def _read_picture(path: Path) -> Image | None:
    """(H,W,3) uint8 RGB, upright; None if the file is not a readable picture."""
    try:
        data = np.fromfile(path, dtype=np.uint8)
    except OSError:
        return None
    if data.size == 0:
        return None
    bgr = cv2.imdecode(data, cv2.IMREAD_COLOR)
    return None if bgr is None else cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)


def _turns_of_picture(path: Path) -> int:
    try:
        return read_exif(path).quarter_turns_clockwise
    except InputError:
        return 0
