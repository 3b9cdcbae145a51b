"""Video sources and sinks: frames and time stamps read and written, and one clear line for each bad input."""

import resource
import subprocess
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from av.video.reformatter import ColorTrc

from arview.errors import InputError, OutputError
from arview.video import VideoSink, open_source
from arview.video.color import RGB709_FROM_RGB2020, light_of_hlg, light_of_pq, tables, tone_map
from helpers.paths import SHARED
from helpers.video_files import (
    COLORS,
    number_of,
    numbered,
    quarters,
    turn_by_metadata,
    write_clip,
    write_hdr_clip,
)

CLIP = [numbered(k) for k in range(20)]


def corner_colors(image: np.ndarray) -> np.ndarray:
    """(4,3) colours near the corners: top left, top right, bottom left, bottom right."""
    return np.array([image[8, 8], image[8, -9], image[-9, 8], image[-9, -9]], dtype=int)


def names_in(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


# --- Video files ---


def test_file_gives_every_frame_with_its_colours(tmp_path: Path) -> None:
    with open_source(write_clip(tmp_path / "a.mp4", CLIP)) as source:
        assert (source.width, source.height, source.fps, source.frame_count) == (160, 120, 30.0, 20)
        assert not source.is_live
        frames = list(source)
        again = list(source)
    assert [frame.index for frame in frames] == list(range(20)) == [frame.index for frame in again]
    assert [number_of(frame.image) for frame in frames] == list(range(20))
    np.testing.assert_allclose([frame.time_s for frame in frames], np.arange(20) / 30, atol=1e-4)
    for frame in (frames[0], frames[-1]):
        assert frame.image.shape == (120, 160, 3) and frame.image.dtype == np.uint8
        np.testing.assert_allclose(corner_colors(frame.image), COLORS, atol=6)
    assert source.skipped == 0 and source.ended_reason == ""


def test_variable_frame_rate_keeps_its_time_stamps(tmp_path: Path) -> None:
    times_s = [0.0, 0.033, 0.05, 0.2, 0.21, 0.5, 0.9, 0.91, 1.4, 1.5]
    clip = write_clip(tmp_path / "vfr.mp4", CLIP[:10], times_s)
    np.testing.assert_allclose([frame.time_s for frame in open_source(clip)], times_s, atol=2e-5)
    with open_source(clip) as source, VideoSink(tmp_path / "out.mp4", 160, 120, source=source) as sink:
        for frame in source:
            sink.write(frame.image, frame.time_s)
    written = list(open_source(tmp_path / "out.mp4"))
    np.testing.assert_allclose([frame.time_s for frame in written], times_s, atol=2e-5)
    assert [number_of(frame.image) for frame in written] == list(range(10))


def test_start_end_stride(tmp_path: Path) -> None:
    clip = write_clip(tmp_path / "a.mp4", CLIP)
    source = open_source(clip, start=5, end=16, stride=4)
    frames = list(source)
    assert [frame.index for frame in frames] == [5, 9, 13] == [number_of(frame.image) for frame in frames]
    assert source.frame_count == 3 and source.ended_reason == ""
    assert frames[0].time_s == pytest.approx(5 / 30, abs=1e-4)
    with pytest.raises(InputError, match="start 20 is past the last of its 20 frames"):
        open_source(clip, start=20)
    with pytest.raises(InputError, match="end 3 is not after start 5"):
        open_source(clip, start=5, end=3)
    with pytest.raises(InputError, match="stride"):
        open_source(clip, stride=0)


@pytest.mark.parametrize("turns", [0, 1, 2, 3])
def test_rotation_metadata_is_applied(tmp_path: Path, turns: int) -> None:
    clip = write_clip(tmp_path / "turned.mp4", [quarters(160, 120)] * 2)
    turn_by_metadata(clip, turns)
    source = open_source(clip)
    assert source.quarter_turns_clockwise == turns
    assert (source.width, source.height) == ((120, 160) if turns % 2 else (160, 120))
    image = next(iter(source)).image
    assert image.shape == (source.height, source.width, 3) and image.flags.c_contiguous
    expected = corner_colors(np.rot90(quarters(160, 120), -turns))
    np.testing.assert_allclose(corner_colors(image), expected, atol=6)


def test_names_with_a_colon(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with VideoSink("take:2.mp4", 160, 120) as sink:
        write_frames(sink, 2)
    assert open_source("take:2.mp4").frame_count == 2


def test_leaving_early_ends_the_reader(tmp_path: Path) -> None:
    source = open_source(write_clip(tmp_path / "a.mp4", CLIP))
    for frame in source:
        if frame.index == 2:
            assert [thread for thread in threading.enumerate() if thread.name == "arview-reader"]
            break
    assert not [thread for thread in threading.enumerate() if thread.name == "arview-reader"]


def test_broken_packets_are_skipped_and_counted(tmp_path: Path) -> None:
    clip = write_clip(tmp_path / "a.mp4", CLIP, gop=1)
    with av.open(str(clip)) as container:
        places = [(packet.pos, packet.size) for packet in container.demux(video=0) if packet.size]
    data = bytearray(clip.read_bytes())
    for position, size in places[6:9]:
        data[position : position + size] = bytes(size)
    clip.write_bytes(data)
    source = open_source(clip)
    frames = list(source)
    assert source.skipped == 3
    assert [number_of(frame.image) for frame in frames] == [*range(6), *range(9, 20)]
    assert [frame.index for frame in frames] == [*range(6), *range(9, 20)]


def test_truncated_mp4(tmp_path: Path) -> None:
    whole = write_clip(tmp_path / "a.mp4", CLIP, faststart=True, gop=1)
    data = whole.read_bytes()
    half = tmp_path / "half.mp4"
    half.write_bytes(data[: len(data) * 6 // 10])
    source = open_source(half)
    frames = list(source)
    assert 5 <= len(frames) < 20
    assert [number_of(frame.image) for frame in frames] == list(range(len(frames)))
    assert f"cut short or damaged; {len(frames)} of 20 frames could be read" in source.ended_reason
    plain = write_clip(tmp_path / "b.mp4", CLIP)
    plain.write_bytes(plain.read_bytes()[:-2000])
    with pytest.raises(InputError, match="damaged or cut-short MP4"):
        open_source(plain)


def write_without_frames(path: Path) -> None:
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=30)
        stream.width, stream.height, stream.pix_fmt = 64, 64, "yuv420p"
        container.start_encoding()


def write_sound_only(path: Path) -> None:
    with av.open(str(path), "w") as container:
        audio = container.add_stream("aac", rate=48_000)
        for k in range(5):
            sound = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), "fltp", "mono")
            sound.pts, sound.sample_rate = k * 1024, 48_000
            container.mux(audio.encode(sound))
        container.mux(audio.encode(None))


BAD_FILES = {
    "zero.mp4": (lambda path: path.write_bytes(b""), "is empty"),
    "text.mp4": (lambda path: path.write_text("not a video\n" * 100), "is a text file, not a video"),
    "text.txt": (lambda path: path.write_text("not a video\n" * 100), "is a text file, not a video"),
    "noise.mp4": (lambda path: path.write_bytes(bytes(range(256)) * 8), "is not a readable video"),
    "no_frames.mp4": (write_without_frames, "no frame that can be decoded|no video stream|cut-short"),
    "sound.mp4": (write_sound_only, "contains no video stream"),
    "empty.png": (lambda path: path.write_bytes(b""), "the picture is empty .0 bytes.; save it as JPEG or PNG"),
    "folder": (lambda path: path.mkdir(), "contains no pictures"),
    "missing.mp4": (lambda path: None, "no such file or folder"),
    "missing*.png": (lambda path: None, "no picture .* matches"),
}


@pytest.mark.parametrize("name", BAD_FILES)
def test_bad_files_give_one_clear_line(tmp_path: Path, name: str) -> None:
    write, message = BAD_FILES[name]
    write(tmp_path / name)
    with pytest.raises(InputError, match=message) as caught:
        open_source(str(tmp_path / name))
    assert str(caught.value).startswith(str(tmp_path / name))
    assert "\n" not in str(caught.value)


# --- High dynamic range ---


@pytest.mark.parametrize("is_pq", [False, True])
def test_tone_mapping_agrees_with_a_plain_reference(is_pq: bool) -> None:
    signal = np.random.default_rng(1).integers(0, 65536, (40, 50, 3)).astype(np.uint16)
    light = (light_of_pq if is_pq else light_of_hlg)((signal >> 4) / 4095.0)
    light = np.clip(np.minimum(light, 8.0) @ RGB709_FROM_RGB2020.T.astype(float), 0.0, 8.0)
    code = np.interp(light, np.linspace(0, 8, 65536), tables(is_pq)[1].astype(float))
    assert np.abs(tone_map(signal, is_pq) - code).max() <= 1.0


def test_hdr_clips_become_8_bit(tmp_path: Path) -> None:
    """Grey stays grey, diffuse white comes near white, and the steps stay in order."""
    # Limited-range 10-bit codes of the signals 0, 0.375, 0.5, 0.75 (diffuse white of HLG) and 1.
    levels = [64, 392, 502, 721, 940]
    clip = write_hdr_clip(tmp_path / "hlg.mp4", levels, int(ColorTrc.ARIB_STD_B67))
    image = next(iter(open_source(clip))).image
    bars = image[32, 32::64].astype(int)
    assert np.ptp(bars, axis=1).max() <= 2
    # HLG 0.5 is 1/12 of the peak, 0.314 of diffuse white: 1.099 × 0.314^0.45 − 0.099 = 0.553. Diffuse white
    # is rolled off to 1 − 0.2 / e = 0.926.
    np.testing.assert_allclose(bars[[0, 2, 3, 4], 0], [0, 141, 245, 255], atol=2)
    assert np.all(np.diff(bars[:, 0]) > 0)
    # PQ 0.58 is 203 cd/m².
    white = 64 + round(0.58 * 876)
    clip = write_hdr_clip(tmp_path / "pq.mp4", [64, white, 64, white, 64], int(ColorTrc.SMPTE2084))
    bars = next(iter(open_source(clip))).image[32, 32::64].astype(int)
    np.testing.assert_allclose(bars[:, 0], [0, 246, 0, 246, 0], atol=2)


# --- Pictures ---


def test_folder_and_glob_of_pictures(tmp_path: Path) -> None:
    for k in (10, 2, 1, 9):
        cv2.imwrite(str(tmp_path / f"img_{k}.png"), cv2.cvtColor(numbered(k), cv2.COLOR_RGB2BGR))
    (tmp_path / "notes.txt").write_text("not a picture")
    for spec in (tmp_path, tmp_path / "img_*.png"):
        source = open_source(str(spec), fps=10)
        frames = list(source)
        assert [number_of(frame.image) for frame in frames] == [1, 2, 9, 10]
        np.testing.assert_array_equal(frames[1].image, numbered(2))
        assert [frame.time_s for frame in frames] == pytest.approx([0, 0.1, 0.8, 0.9])
        assert [frame.index for frame in frames] == [1, 2, 9, 10]
        assert [frame.file for frame in frames] == ["img_1.png", "img_2.png", "img_9.png", "img_10.png"]
        assert (source.fps, source.frame_count) == (10, 4)
    assert [frame.index for frame in open_source(tmp_path, start=2, stride=2)] == [2, 10]
    with pytest.raises(InputError, match=r"no picture has a number from 11 on; the numbers .* go from 1 to 10"):
        open_source(tmp_path, start=11)


def test_pictures_that_do_not_fit_are_skipped(tmp_path: Path) -> None:
    for k in range(5):
        size = (80, 60) if k == 2 else (160, 120)
        cv2.imwrite(str(tmp_path / f"{k}.bmp"), cv2.cvtColor(numbered(k, *size), cv2.COLOR_RGB2BGR))
    (tmp_path / "3.bmp").write_bytes(b"BM broken")
    source = open_source(tmp_path)
    assert [frame.index for frame in source] == [0, 1, 4]
    assert source.skipped == 2


def test_exif_orientation_of_pictures(tmp_path: Path) -> None:
    from PIL import Image

    stored = Image.fromarray(quarters(160, 120))
    exif = stored.getexif()
    exif[0x0112] = 6
    stored.save(tmp_path / "a.jpg", exif=exif, quality=95)
    source = open_source(tmp_path / "a.jpg")
    assert (source.width, source.height, source.quarter_turns_clockwise) == (120, 160, 1)
    expected = corner_colors(np.rot90(quarters(160, 120), -1))
    np.testing.assert_allclose(corner_colors(next(iter(source)).image), expected, atol=6)


@pytest.mark.shared
def test_shared_sequence() -> None:
    clip = SHARED / "sequences" / "plate" / "video.mp4"
    source = open_source(clip, end=5)
    assert [frame.index for frame in source] == list(range(5))
    assert (source.width, source.height) == (640, 480)


# --- Live ---


class StreamServer(ThreadingHTTPServer):
    """MJPEG over HTTP on a free port: sends some frames, then hangs up or falls silent."""

    daemon_threads = True

    def __init__(self, frames: int, hang: bool) -> None:
        super().__init__(("127.0.0.1", 0), _StreamHandler)
        self.frames, self.hang = frames, hang
        self.done = threading.Event()

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_address[1]}/stream"


class _StreamHandler(BaseHTTPRequestHandler):
    server: StreamServer

    def do_GET(self) -> None:
        self.send_response(200)
        self.send_header("Content-Type", "multipart/x-mixed-replace;boundary=frame")
        self.end_headers()
        for k in range(self.server.frames):
            jpeg = cv2.imencode(".jpg", cv2.cvtColor(numbered(k % 20), cv2.COLOR_RGB2BGR))[1].tobytes()
            head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n\r\n"
            try:
                self.wfile.write(head.encode() + jpeg + b"\r\n")
            except OSError:
                return
            self.server.done.wait(0.03)
        if self.server.hang:
            self.server.done.wait(10)

    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def serve() -> Iterator[object]:
    servers: list[StreamServer] = []

    def start(frames: int, hang: bool = False) -> StreamServer:
        servers.append(StreamServer(frames, hang))
        threading.Thread(target=servers[-1].serve_forever, args=(0.02,), daemon=True).start()
        return servers[-1]

    yield start
    for server in servers:
        server.done.set()
        server.shutdown()
        server.server_close()


def test_stream_that_ends(serve) -> None:
    with open_source(serve(30).url, read_timeout_s=2) as source:
        assert source.is_live and (source.width, source.height) == (160, 120)
        frames = list(source)
    assert len(frames) > 3
    indices = [frame.index for frame in frames]
    assert min(np.diff(indices)) >= 1
    assert min(np.diff([frame.time_s for frame in frames])) > 0
    assert "the stream ended" in source.ended_reason or "connection failed" in source.ended_reason


def test_slow_consumer_gets_the_newest_frame(serve) -> None:
    with open_source(serve(40).url, read_timeout_s=2) as source:
        pause = threading.Event()
        indices = []
        for frame in source:
            indices.append(frame.index)
            pause.wait(0.2)
    assert max(np.diff(indices[:-1])) >= 3


def test_stream_that_falls_silent_never_hangs(serve) -> None:
    with open_source(serve(10, hang=True).url, read_timeout_s=0.5) as source:
        count = sum(1 for _ in source)
    assert 1 <= count <= 10
    assert "no frame for 0.5 s" in source.ended_reason or "no answer" in source.ended_reason


def test_dead_addresses_are_refused_at_start(serve) -> None:
    with pytest.raises(InputError, match="cannot be opened: Connection refused; check the address"):
        open_source("rtsp://127.0.0.1:9/nothing", open_timeout_s=2)
    with pytest.raises(InputError, match=r"no answer in time|no frame within 0.3 s"):
        open_source(serve(0, hang=True).url, open_timeout_s=0.3)
    with pytest.raises(InputError, match="there is no camera 97"):
        open_source("97", open_timeout_s=5)


class FakeCapture:
    """Stands for cv2.VideoCapture: a camera that is unplugged after a few frames."""

    def __init__(self, index: int) -> None:
        self.left = 5

    def isOpened(self) -> bool:
        return True

    def get(self, key: int) -> float:
        return 25.0

    def read(self) -> tuple[bool, np.ndarray]:
        self.left -= 1
        threading.Event().wait(0.02)
        return (True, cv2.cvtColor(quarters(160, 120), cv2.COLOR_RGB2BGR)) if self.left >= 0 else (False, None)

    def release(self) -> None:
        pass


def test_camera_that_is_unplugged(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cv2, "VideoCapture", FakeCapture)
    with open_source("0") as source:
        assert (source.name, source.fps, source.is_live) == ("camera 0", 25.0, True)
        frames = list(source)
    assert 1 <= len(frames) <= 5
    np.testing.assert_array_equal(frames[0].image, quarters(160, 120))
    assert source.ended_reason == "camera 0: the camera delivers no more frames; was it unplugged?"
    with open_source("0", start=2, end=4) as source:
        indices = [frame.index for frame in source]
    assert indices and set(indices) <= {2, 3}
    assert source.ended_reason == ""


# --- Sink ---


def write_frames(sink: VideoSink, count: int, shape: tuple[int, int] = (120, 160)) -> None:
    for k in range(count):
        sink.write(numbered(k % 20, shape[1], shape[0]), k / 30)


def test_sink_writes_playable_h264(tmp_path: Path) -> None:
    with VideoSink(tmp_path / "out.mp4", 160, 120, 30.0) as sink:
        write_frames(sink, 15)
        assert names_in(tmp_path)[0].endswith(".part")
    assert names_in(tmp_path) == ["out.mp4"]
    data = (tmp_path / "out.mp4").read_bytes()
    assert data.index(b"moov") < data.index(b"mdat")
    with av.open(str(tmp_path / "out.mp4")) as container:
        stream = container.streams.video[0]
        assert (stream.codec_context.name, stream.codec_context.pix_fmt) == ("h264", "yuv420p")
        assert stream.frames == 15 and float(stream.duration * stream.time_base) == pytest.approx(0.5, abs=1e-3)
    frames = list(open_source(tmp_path / "out.mp4"))
    assert [number_of(frame.image) for frame in frames] == list(range(15))
    np.testing.assert_allclose(corner_colors(frames[7].image), COLORS, atol=8)


def test_odd_sizes_are_padded(tmp_path: Path) -> None:
    with VideoSink(tmp_path / "out.mp4", 161, 121) as sink:
        write_frames(sink, 3, (121, 161))
        with pytest.raises(ValueError, match=r"the sink expects \(121, 161, 3\)"):
            sink.write(numbered(0), 1.0)
    source = open_source(tmp_path / "out.mp4")
    assert (source.width, source.height) == (162, 122)


def sound_packets(path: Path) -> list[tuple[float, bytes]]:
    with av.open(str(path)) as container:
        packets = [packet for packet in container.demux(audio=0) if packet.size]
        return [(float(packet.pts * packet.time_base), bytes(packet)) for packet in packets]


@pytest.mark.parametrize("suffix", ["mp4", "mov"])
def test_sound_is_passed_through(tmp_path: Path, suffix: str) -> None:
    clip = write_clip(tmp_path / "a.mp4", [*CLIP, *CLIP], with_sound=True)
    out = tmp_path / f"out.{suffix}"
    with open_source(clip) as source, VideoSink(out, 160, 120, source=source) as sink:
        for frame in source:
            sink.write(frame.image, frame.time_s)
    before, after = sound_packets(clip), sound_packets(out)
    assert len(before) > 50 and len(before) - len(after) <= 2
    assert [data for _, data in after] == [data for _, data in before[: len(after)]]
    np.testing.assert_allclose([t for t, _ in after], [t for t, _ in before[: len(after)]], atol=2e-3)
    assert sink.audio_note == ""


def test_sound_of_a_part_stays_in_step(tmp_path: Path) -> None:
    clip = write_clip(tmp_path / "a.mp4", [*CLIP, *CLIP], with_sound=True)
    source = open_source(clip, start=15, end=30)
    with VideoSink(tmp_path / "out.mp4", 160, 120, source=source) as sink:
        for frame in source:
            sink.write(frame.image, frame.time_s)
    time_of = {data: time_s for time_s, data in sound_packets(clip)}
    shifts = [time_of[data] - time_s for time_s, data in sound_packets(tmp_path / "out.mp4")]
    assert len(shifts) > 15
    np.testing.assert_allclose(shifts, 0.5, atol=1e-3)


def test_keyboard_interrupt_leaves_a_playable_file(tmp_path: Path) -> None:
    def interrupted() -> None:
        with VideoSink(tmp_path / "out.mp4", 160, 120) as sink:
            write_frames(sink, 8)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert len(list(open_source(tmp_path / "out.mp4"))) == 8
    assert names_in(tmp_path) == ["out.mp4"]


def test_other_errors_leave_the_older_file(tmp_path: Path) -> None:
    (tmp_path / "out.mp4").write_text("older")

    def failing() -> None:
        with VideoSink(tmp_path / "out.mp4", 160, 120) as sink:
            write_frames(sink, 3)
            raise RuntimeError("tracking failed")

    with pytest.raises(RuntimeError, match="tracking failed"):
        failing()
    assert names_in(tmp_path) == ["out.mp4"] and (tmp_path / "out.mp4").read_text() == "older"
    with pytest.raises(OutputError, match="no frame was written"), VideoSink(tmp_path / "x.mp4", 160, 120):
        pass
    assert names_in(tmp_path) == ["out.mp4"]


def test_names_that_cannot_be_written(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match=r"must end in \.mp4"):
        VideoSink(tmp_path / "out.jpg", 160, 120)
    with pytest.raises(OutputError, match="there is no folder"):
        VideoSink(tmp_path / "none" / "out.mp4", 160, 120)
    (tmp_path / "dir.mp4").mkdir()
    with pytest.raises(OutputError, match="is a folder"):
        VideoSink(tmp_path / "dir.mp4", 160, 120)


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    disk = tmp_path / "disk"
    disk.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=256k", "tmpfs", str(disk)]
    try:
        subprocess.run(command, check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError) as error:
        pytest.skip(f"no right to mount a small tmpfs here: {error}")
    yield disk
    subprocess.run(["umount", str(disk)], check=True)


def write_noise(path: Path) -> None:
    rng = np.random.default_rng(0)
    with VideoSink(path, 320, 240, crf=5) as sink:
        for k in range(60):
            sink.write(rng.integers(0, 255, (240, 320, 3), dtype=np.uint8), k / 30)


def test_full_disk(small_disk: Path) -> None:
    with pytest.raises(OutputError, match="the disk is full; free some space"):
        write_noise(small_disk / "out.mp4")
    assert names_in(small_disk) == []


def test_read_only_folder(small_disk: Path) -> None:
    subprocess.run(["mount", "-o", "remount,ro", str(small_disk)], check=True)
    with pytest.raises(OutputError, match="cannot be written to; choose another folder"):
        VideoSink(small_disk / "out.mp4", 160, 120)
    assert names_in(small_disk) == []


def test_file_size_limit(tmp_path: Path) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, hard))
    try:
        with pytest.raises(OutputError, match="cannot write the video: File too large"):
            write_noise(tmp_path / "out.mp4")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert names_in(tmp_path) == []
