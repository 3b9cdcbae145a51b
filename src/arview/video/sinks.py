"""VideoSink: writes annotated frames to an H.264 file with the source's time stamps and sound."""

from __future__ import annotations

import errno
import queue
import threading
from collections.abc import Iterator
from contextlib import suppress
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import Self

import av
import cv2
import numpy as np
from av.audio.stream import AudioStream
from av.container import InputContainer, OutputContainer
from av.packet import Packet
from av.video.reformatter import ColorPrimaries, ColorRange, Colorspace, ColorTrc
from av.video.stream import VideoStream

from arview.core.atomic import begin_unfinished, write_file
from arview.errors import OutputError
from arview.video.frame import Image
from arview.video.source import FrameSource

CONTAINERS = {".mp4": "mp4", ".m4v": "mp4", ".mov": "mov"}
"""Container format by file suffix."""
TICKS_PER_S = 90_000
"""Time base, fine enough for 30, 29.97, 25 and 24 fps and irregular time stamps of cameras."""
ENCODER_PARAMETERS = "bframes=0:cabac=0"
"""Neither B-frames nor arithmetic coding: at the same quality files are larger, but encoding leaves more time to the
tracking on the same cores."""
QUEUED_FRAMES = 4
"""Frames that may wait for the encoder; 25 MB at 1080p."""
_INDEX_IN_FRONT = {"movflags": "+faststart"}
_FRAGMENTED = {"movflags": "+hybrid_fragmented", "frag_duration": "1000000", "flush_packets": "1"}
"""Fragments of a second, µs, until the file is finished; then it is made an ordinary one."""
_AUDIO_LEAD_S = 0.05
"""Sound this long before the first frame is kept, because AAC starts with a silent packet."""


class PictureSink:
    """The annotated picture of a source that is one picture.

    Attributes:
        frames_written: 1 once there is one.
        audio_note: empty, as there is no sound.
    """

    audio_note = ""
    frames_written = 0

    def __init__(self, path: str | Path) -> None:
        """A file whose name is that of a picture; see `VideoSink`."""
        self.path = Path(path)

    def write(self, image: Image, time_s: float) -> None:
        """Keep the frame (H,W,3) uint8 RGB."""
        self._image, self.frames_written = image.copy(), 1

    def close(self) -> None:
        """Write the file. Raises OutputError."""
        write_file(self.path, cv2.imencode(self.path.suffix, self._image[..., ::-1])[1].tobytes())

    def abort(self) -> None:
        """Nothing was written yet."""


class VideoSink:
    """Context manager that writes H.264 (yuv420p, BT.709, index in front) in a thread of its own.

    The file is written under a temporary name beside the target and renamed when it is complete. Leaving the ``with``
    block finishes the file, also on Ctrl-C, so that what was written can be played; any other exception removes it. The
    first frame is at time 0 of the file and the others keep their distance from it. Sound is copied from the source
    without decoding, from the first to the last frame.

    Attributes:
        frames_written: frames queued so far.
        audio_note: why the source's sound is not in the file, or empty.
    """

    def __init__(
        self,
        path: str | Path,
        width: int,
        height: int,
        fps_hint: float | None = 30.0,
        source: FrameSource | str | Path | None = None,
        crf: int = 20,
        preset: str = "superfast",
        is_recoverable: bool = False,
    ) -> None:
        """Open the file.

        Args:
            path: target, ending in .mp4, .m4v or .mov; an existing file is replaced at the end.
            width: width of the frames in px; odd sizes are padded by a pixel.
            height: height of the frames in px.
            fps_hint: nominal frame rate, for the header and the duration of the last frame.
            source: source or file whose sound is copied; None: no sound.
            crf: quality of x264, 0 (lossless) to 51; 18–23 is usual.
            preset: speed of x264; "veryfast" makes files about 6 % smaller in twice the time.
            is_recoverable: write the unfinished file in fragments of a second, which can be read after a crash; the
                index of the finished file is then at its end.

        Raises:
            OutputError: the name is not valid, or the folder cannot be written to.
        """
        self.path = Path(path)
        self.frames_written = 0
        self.audio_note = ""
        self._width, self._height = width, height
        rate = fps_hint if fps_hint is not None and 1.0 <= fps_hint <= 1000.0 else 30.0
        self._fps = Fraction(rate).limit_denominator(1001)
        self._layout = _FRAGMENTED if is_recoverable else _INDEX_IN_FRONT
        self._part = begin_unfinished(self.path)
        if self.path.suffix.lower() not in CONTAINERS:
            raise OutputError(f"{path}: the name of the video must end in {', '.join(CONTAINERS)}")
        if not self.path.parent.is_dir():
            raise OutputError(f"{path}: there is no folder {self.path.parent}; create it first")
        if self.path.is_dir():
            raise OutputError(f"{path}: is a folder; give the name of a file")
        self._sound = _open_sound(source)
        self._sound_start_s = source.audio_start_s if isinstance(source, FrameSource) else 0.0
        try:
            self._container, self._video, self._audio = self._opened(crf, preset)
        except BaseException:
            self._remove_part()
            raise
        self._frames: queue.Queue[tuple[Image, float] | None] = queue.Queue(QUEUED_FRAMES)
        self._error: Exception | None = None
        self._closed = False
        self._encoder = threading.Thread(target=self._encode_all, name="arview-encoder", daemon=True)
        self._encoder.start()

    def write(self, image: Image, time_s: float) -> None:
        """Add a frame (H,W,3) uint8 RGB with its time stamp in the source; the array may be reused afterwards.

        A time stamp that does not increase is moved to just after the previous one.

        Raises:
            ValueError: the image has another size than the sink.
            OutputError: the disk is full or the file cannot be written.
        """
        if image.shape != (self._height, self._width, 3):
            raise ValueError(f"image is {image.shape}, the sink expects ({self._height}, {self._width}, 3)")
        if self._error is not None:
            raise self._error
        pad_right, pad_bottom = self._width % 2, self._height % 2
        if pad_right or pad_bottom:
            image = cv2.copyMakeBorder(image, 0, pad_bottom, 0, pad_right, cv2.BORDER_REPLICATE)
        self._frames.put((np.array(image, order="C"), time_s))
        self.frames_written += 1

    def close(self) -> None:
        """Finish and rename the file; further calls do nothing.

        Raises:
            OutputError: no frame was written, or the file cannot be completed; no file is left then.
        """
        if self._closed:
            return
        self._closed = True
        try:
            self._stop_encoder()
            if self._error is not None:
                raise self._error
            if self.frames_written == 0:
                raise OutputError(f"{self.path}: no frame was written, so there is no video")
            try:
                self._container.close()
                self._part.replace(self.path)
            except (av.FFmpegError, OSError) as error:
                raise self._explained(error) from error
        finally:
            self._discard()

    def abort(self) -> None:
        """Stop and remove what was written; an older file of the same name stays."""
        if not self._closed:
            self._closed = True
            self._stop_encoder()
            self._discard()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is None or (isinstance(error, KeyboardInterrupt) and self.frames_written):
            self.close()
        else:
            self.abort()

    def _opened(self, crf: int, preset: str) -> tuple[OutputContainer, VideoStream, AudioStream | None]:
        container_format = CONTAINERS[self.path.suffix.lower()]
        try:
            container = av.open(str(self._part.absolute()), "w", format=container_format, options=self._layout)
            video = container.add_stream("libx264", rate=self._fps)
            video.width, video.height = self._width + self._width % 2, self._height + self._height % 2
            video.pix_fmt = "yuv420p"
            video.options = {"crf": str(crf), "preset": preset, "x264-params": ENCODER_PARAMETERS}
            context = video.codec_context
            context.time_base = Fraction(1, TICKS_PER_S)
            context.colorspace, context.color_range = Colorspace.ITU709, ColorRange.MPEG
            context.color_primaries, context.color_trc = ColorPrimaries.BT709, ColorTrc.BT709
            audio = self._add_audio(container)
            container.start_encoding()
        except (av.FFmpegError, OSError) as error:
            raise self._explained(error) from error
        return container, video, audio

    def _add_audio(self, container: OutputContainer) -> AudioStream | None:
        if self._sound is None or not self._sound.streams.audio:
            return None
        template = self._sound.streams.audio[0]
        codec = template.codec_context.name if template.codec_context else "unknown"
        if codec not in container.supported_codecs:
            self.audio_note = f"the sound ({codec}) cannot be copied into {self.path.suffix}; the video is silent"
            return None
        return container.add_stream_from_template(template)

    def _stop_encoder(self) -> None:
        """Wait until the encoder has written the queued frames and ended."""
        self._frames.put(None)
        self._encoder.join()

    def _discard(self) -> None:
        """Close what is still open and remove the temporary file."""
        # After a second Ctrl-C the encoder may still be running; its container must not be closed then.
        if not self._encoder.is_alive():
            with suppress(av.FFmpegError, OSError):
                self._container.close()
        self._remove_part()

    def _remove_part(self) -> None:
        if self._sound is not None:
            self._sound.close()
        with suppress(OSError):
            self._part.unlink(missing_ok=True)

    def _encode_all(self) -> None:
        """Body of the encoder thread; after an error it empties the queue, so that no writer waits."""
        queued = iter(self._frames.get, None)
        try:
            self._encode(queued)
        except (av.FFmpegError, OSError) as error:
            self._error = self._explained(error)
        except Exception as error:  # raised again by write() or close()
            self._error = error
        for _ in queued:
            pass

    def _encode(self, queued: Iterator[tuple[Image, float]]) -> None:
        origin_s: float | None = None
        sound: Iterator[Packet[AudioStream]] = iter(())
        waiting: Packet[AudioStream] | None = None
        ticks, frame_ticks = -1, round(TICKS_PER_S / self._fps)
        for image, time_s in queued:
            if origin_s is None:
                origin_s = time_s
                sound = self._sound_packets(origin_s + self._sound_start_s)
                waiting = next(sound, None)
            ticks = max(round((time_s - origin_s) * TICKS_PER_S), ticks + 1)
            frame = av.VideoFrame.from_numpy_buffer(image, format="rgb24").reformat(
                format="yuv420p",
                dst_colorspace=Colorspace.ITU709,
                dst_color_range=ColorRange.MPEG,
                threads=1,
            )
            frame.pts, frame.time_base, frame.duration = ticks, Fraction(1, TICKS_PER_S), frame_ticks
            self._container.mux(self._video.encode(frame))
            # Sound follows the picture closely, so that the muxer never buffers much of either.
            while waiting is not None and _end_s(waiting) <= (ticks + frame_ticks) / TICKS_PER_S:
                self._container.mux(waiting)
                waiting = next(sound, None)
        self._container.mux(self._video.encode(None))

    def _sound_packets(self, origin_s: float) -> Iterator[Packet[AudioStream]]:
        """Sound packets from a time stamp of the source's file on, that of the first frame, which becomes 0."""
        if self._sound is None or self._audio is None:
            return
        stream = self._sound.streams.audio[0]
        if origin_s > 1.0:
            with suppress(av.FFmpegError):
                self._sound.seek(int((origin_s - 1.0) * av.time_base))
        with suppress(av.FFmpegError):  # a truncated file has sound up to its end
            for packet in self._sound.demux(stream):
                if packet.pts is None or packet.dts is None or packet.time_base is None:
                    continue
                if packet.pts * packet.time_base < origin_s - _AUDIO_LEAD_S:
                    continue
                shift = round(origin_s / packet.time_base)
                packet.pts -= shift
                packet.dts -= shift
                packet.stream = self._audio
                yield packet

    def _explained(self, error: Exception) -> OutputError:
        code = getattr(error, "errno", None)
        if code == errno.ENOSPC:
            return OutputError(f"{self.path}: the disk is full; free some space or choose another folder")
        if code in (errno.EACCES, errno.EPERM, errno.EROFS):
            return OutputError(f"{self.path}: the folder cannot be written to; choose another folder with -o")
        return OutputError(f"{self.path}: cannot write the video: {getattr(error, 'strerror', None) or error}")


def _open_sound(source: FrameSource | str | Path | None) -> InputContainer | None:
    """The opened file whose sound is copied; None if there is none."""
    path = source.audio_path if isinstance(source, FrameSource) else source
    if path is None:
        return None
    try:
        return av.open(str(Path(path).absolute()))
    except (av.FFmpegError, OSError, ValueError):
        return None


def _end_s(packet: Packet[AudioStream]) -> float:
    """End time of a sound packet, seconds."""
    assert packet.pts is not None and packet.time_base is not None
    return float((packet.pts + (packet.duration or 0)) * packet.time_base)


def open_sink(path: str | Path, source: FrameSource) -> VideoSink | PictureSink:
    """The file for the annotated frames of a source: a picture if it is one and the name is that of one, else a video.

    Raises:
        OutputError: see `VideoSink`.
    """
    is_picture = source.frame_count == 1 and Path(path).suffix.lower() in (".jpg", ".jpeg", ".png")
    return PictureSink(path) if is_picture else VideoSink(path, source.width, source.height, source.fps, source)
