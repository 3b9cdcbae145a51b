"""Films and pictures of unusual kinds: clocks, pixel shapes, fields, sizes, colours, names and bits."""

import sys
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from arview.camera import Camera
from arview.camera.read import save_camera
from arview.errors import InputError, MismatchError, MissingDependencyError
from arview.video import VideoSink, open_source
from arview.video.clock import FrameClock, plausible_fps
from arview.video.intrinsics import load_camera_of
from arview.video.pictures import frame_numbers, significant_bits
from helpers.film_kinds import STEP_PX, left_ends, rgb_of_code, write_film, write_interlaced, write_tagged
from helpers.video_files import number_of, numbered, quarters, turn_by_metadata, write_clip

CLIP = [numbered(k) for k in range(20)]


def write_picture(path: Path, image: np.ndarray) -> Path:
    cv2.imwrite(str(path), image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    return path


# --- Clocks ---


def test_times_count_from_the_first_frame(tmp_path: Path) -> None:
    clip = write_film(tmp_path / "a.ts", CLIP, first_s=582.0)
    with av.open(str(clip)) as container:
        assert next(container.decode(video=0)).time > 580.0
    frames = list(open_source(clip))
    np.testing.assert_allclose([frame.time_s for frame in frames], np.arange(20) / 30, atol=1e-4)
    assert [number_of(frame.image) for frame in frames] == list(range(20))


def test_sound_stays_in_step_with_a_clock_that_starts_late(tmp_path: Path) -> None:
    """The sound of the second second of a film whose clock starts at 100 s goes with its pictures."""
    plain = write_clip(tmp_path / "plain.mp4", [numbered(k % 20) for k in range(90)], with_sound=True)
    late = tmp_path / "late.ts"
    with av.open(str(plain)) as source, av.open(str(late), "w") as target:
        streams = {stream: target.add_stream_from_template(stream) for stream in source.streams}
        for packet in source.demux():
            if packet.dts is None:
                continue
            packet.pts += round(100 / packet.time_base)
            packet.dts += round(100 / packet.time_base)
            packet.stream = streams[packet.stream]
            target.mux(packet)
    with open_source(late) as source, VideoSink(tmp_path / "out.mp4", 160, 120, source=source) as sink:
        assert source.audio_start_s > 99.0
        for frame in source:
            if 1.0 <= frame.time_s < 2.0:
                sink.write(frame.image, frame.time_s)
    with av.open(str(tmp_path / "out.mp4")) as container:
        sound = [float(packet.pts * packet.time_base) for packet in container.demux(audio=0) if packet.pts is not None]
    assert len(sound) > 40
    assert -0.06 <= sound[0] <= 0.06 and 0.9 <= sound[-1] <= 1.0


@pytest.mark.parametrize(
    ("name", "codec", "parameters"),
    [
        ("raw.h264", "libx264", ""),
        ("raw.m2v", "mpeg2video", ""),
        ("b_frames.avi", "libx264", "bframes=3:b-adapt=0"),  # numbered in the order of decoding
        ("b_frames.mp4", "libx264", "bframes=3:b-adapt=0"),  # decoding times below 0
    ],
)
def test_films_without_time_stamps_or_in_another_order(tmp_path: Path, name: str, codec: str, parameters: str) -> None:
    source = open_source(write_film(tmp_path / name, CLIP, codec=codec, parameters=parameters))
    assert source.fps == 30.0
    frames = list(source)
    np.testing.assert_allclose([frame.time_s for frame in frames], np.arange(20) / 30, atol=1e-4)
    assert [number_of(frame.image) for frame in frames] == list(range(20))


@pytest.mark.parametrize(
    ("stamps_s", "expected_s"),
    [
        ([None, None, None], [0.0, 0.1, 0.2]),
        ([5.0, None, 5.2], [0.0, 0.1, 0.2]),
        ([None, 7.0, 7.1], [0.0, 0.1, 0.2]),
        ([-0.2, -0.1, 0.0], [0.0, 0.1, 0.2]),
        ([0.0, 0.1, 0.1, 0.3], [0.0, 0.1, 0.125, 0.3]),
        ([0.0, 0.1, 0.05, 0.3], [0.0, 0.1, 0.125, 0.3]),
        ([90.0, 90.1, 0.0, 0.1, 0.2], [0.0, 0.1, 0.2, 0.3, 0.4]),
    ],
)
def test_clock(stamps_s: list[float | None], expected_s: list[float]) -> None:
    clock = FrameClock(10.0)
    times_s = [clock.time_s(k, stamp) for k, stamp in enumerate(stamps_s)]
    assert times_s == pytest.approx(expected_s, abs=1e-9)
    assert clock.restarts == (1 if stamps_s[0] == 90.0 else 0)


def test_a_frame_rate_of_nought_is_unknown() -> None:
    assert plausible_fps(0.0, None, Fraction(25)) == 25.0
    assert plausible_fps(0, -1.0, float("nan"), Fraction(90_000), None) is None


# --- Pixel shapes, rotation and fields ---


@pytest.mark.parametrize(("turns", "size"), [(0, (216, 120)), (1, (120, 216))])
def test_anamorphic_film_gets_square_pixels(tmp_path: Path, turns: int, size: tuple[int, int]) -> None:
    clip = write_film(tmp_path / "a.mp4", [quarters(162, 120)] * 3, pixel_aspect=Fraction(4, 3))
    turn_by_metadata(clip, turns)
    source = open_source(clip)
    assert (source.width, source.height) == size
    assert source.unsquared_size == ((162, 120) if turns == 0 else (120, 162))
    frames = list(source)
    assert len(frames) == 3 and frames[0].image.shape == (size[1], size[0], 3)
    expected = np.rot90(quarters(*((216, 120))), -turns)
    assert np.abs(frames[0].image.astype(int) - expected).mean() < 6.0


def test_pixels_narrower_than_high_gain_height(tmp_path: Path) -> None:
    source = open_source(write_film(tmp_path / "a.mp4", [quarters(160, 120)], pixel_aspect=Fraction(8, 9)))
    assert (source.width, source.height) == (160, 135)


def test_intrinsics_follow_square_pixels(tmp_path: Path) -> None:
    """A camera of the stored frames and one of the square ones give the same; another shape is refused."""
    source = open_source(write_film(tmp_path / "a.mp4", [quarters(162, 120)], pixel_aspect=Fraction(4, 3)))
    square = Camera(216, 120, 200.0, 200.0, 110.0, 58.0, np.array([0.1, -0.05, 0.001, 0.002, 0.0]))
    for name, camera in (("stored", square.scaled(162, 120)), ("square", square), ("double", square.scaled(432, 240))):
        save_camera(camera, tmp_path / f"{name}.json")
        got = load_camera_of(source, tmp_path / f"{name}.json")
        np.testing.assert_allclose([got.fx, got.fy, got.cx, got.cy], [200, 200, 110, 58], atol=1e-6)
        assert (got.width, got.height) == (216, 120)
        np.testing.assert_allclose(got.dist, square.dist, atol=1e-12)
    for camera in (square, square.scaled(162, 120)):  # without a size in the file
        matrix = [[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]]
        (tmp_path / "no_size.json").write_text(f'{{"camera_matrix": {matrix}}}')
        assert load_camera_of(source, tmp_path / "no_size.json").fy == pytest.approx(200.0)
        assert load_camera_of(source, tmp_path / "no_size.json").fx == pytest.approx(200.0)
    assert load_camera_of(source, "fov:60").fx == pytest.approx(108 / np.tan(np.radians(30)))
    save_camera(square.scaled(200, 200), tmp_path / "other.json")
    with pytest.raises(MismatchError, match="another aspect ratio"):
        load_camera_of(source, tmp_path / "other.json")


def test_interlaced_film_is_deinterlaced(tmp_path: Path) -> None:
    """In every row the bar lies where the first field has it, at the time of the frame; no frame is lost."""
    clip = write_interlaced(tmp_path / "a.mp4", 12)
    with av.open(str(clip)) as container:
        stored = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    assert np.ptp(left_ends(stored[5])) == STEP_PX // 2
    source = open_source(clip)
    frames = list(source)
    assert [frame.index for frame in frames] == list(range(12))
    np.testing.assert_allclose([frame.time_s for frame in frames], np.arange(12) / 25, atol=1e-4)
    for frame in frames[1:-1]:
        np.testing.assert_allclose(left_ends(frame.image), 20 + STEP_PX * frame.index, atol=1)
    assert source.notes == ("the film is interlaced: it was deinterlaced",)
    left_early = open_source(clip)
    for frame in left_early:
        assert frame.index == 0
        break
    assert left_early.notes == source.notes
    some = list(open_source(clip, start=4, end=9, stride=2))
    assert [frame.index for frame in some] == [4, 6, 8]
    np.testing.assert_array_equal(some[0].image, frames[4].image)
    np.testing.assert_array_equal(some[2].image, frames[8].image)


def test_progressive_film_is_left_alone(tmp_path: Path) -> None:
    source = open_source(write_clip(tmp_path / "a.mp4", CLIP))
    assert len(list(source)) == 20 and source.notes == ()


# --- Size changes ---


def write_changing(folder: Path, size: tuple[int, int]) -> Path:
    """Raw H.264 of ten frames of 160 × 120 px and ten of another size."""
    first = write_film(folder / "first.h264", CLIP[:10])
    second = write_film(folder / "second.h264", [numbered(k, *size) for k in range(10, 20)])
    changed = folder / "change.h264"
    changed.write_bytes(first.read_bytes() + second.read_bytes())
    return changed


def test_frames_of_another_size_are_scaled(tmp_path: Path) -> None:
    source = open_source(write_changing(tmp_path, (80, 60)))
    frames = list(source)
    assert [number_of(frame.image) for frame in frames] == list(range(20))
    assert {frame.image.shape for frame in frames} == {(120, 160, 3)} and source.skipped == 0
    assert np.abs(frames[12].image[10:50, 10:35].astype(int) - quarters(160, 120)[10:50, 10:35]).max() < 12
    assert source.notes == (
        "the size changes from 160×120 to 80×60 px at frame 10: frames of another size are scaled to it",
    )


def test_frames_of_another_shape_are_left_out_by_name(tmp_path: Path) -> None:
    source = open_source(write_changing(tmp_path, (160, 80)))
    assert [frame.index for frame in source] == list(range(10))
    assert source.skipped == 10
    assert source.notes == (
        "the size changes from 160×120 to 160×80 px at frame 10: frames of another shape are left out",
    )


# --- Colours ---


@pytest.mark.parametrize("matrix", [1, 6, 9])
@pytest.mark.parametrize("color_range", [1, 2])
@pytest.mark.parametrize("size", [(160, 120), (960, 720)])
def test_colours_by_the_tags_of_the_stream(
    tmp_path: Path, matrix: int, color_range: int, size: tuple[int, int]
) -> None:
    code = (100, 110, 150)
    image = next(iter(open_source(write_tagged(tmp_path / "a.mp4", size, code, matrix, color_range)))).image
    np.testing.assert_allclose(image[60, 60], rgb_of_code(code, matrix, color_range), atol=3.0)


# --- Pictures ---


def test_printf_patterns(tmp_path: Path) -> None:
    for k in (3, 4, 6, 12):
        write_picture(tmp_path / f"frame_{k:04d}.png", numbered(k))
    write_picture(tmp_path / "frame_5.png", numbered(5))  # does not fit %04d
    write_picture(tmp_path / "frame_0007.jpg", numbered(7))
    source = open_source(tmp_path / "frame_%04d.png", fps=10)
    frames = list(source)
    assert [number_of(frame.image) for frame in frames] == [3, 4, 6, 12] == [frame.index for frame in frames]
    assert [frame.time_s for frame in frames] == pytest.approx([0.0, 0.1, 0.3, 0.9])
    assert [frame.file for frame in frames] == [f"frame_{k:04d}.png" for k in (3, 4, 6, 12)]
    assert source.frame_count == 4
    some = open_source(tmp_path / "frame_%04d.png", start=4, end=12)
    assert [frame.index for frame in some] == [4, 6] and some.frame_count == 2
    assert len(list(open_source(tmp_path / "frame_%d.png"))) == 5
    with pytest.raises(InputError, match=r"no file in .* fits the pattern"):
        open_source(tmp_path / "shot_%04d.png")
    with pytest.raises(InputError, match=r"the folder .* cannot be read"):
        open_source(tmp_path / "none" / "frame_%04d.png")


def test_exif_of_a_pattern(tmp_path: Path) -> None:
    from PIL import Image

    for k in (1, 2):
        picture = Image.fromarray(numbered(k))
        exif = picture.getexif()
        exif.get_ifd(0x8769)[0xA405] = 28
        picture.save(tmp_path / f"shot_{k:03d}.jpg", exif=exif)
    source = open_source(tmp_path / "shot_%03d.jpg")
    camera = load_camera_of(source, "exif", tmp_path / "shot_%03d.jpg")
    assert camera.fx == pytest.approx(28 * 200 / np.hypot(36, 24))


def test_gaps_stay_gaps(tmp_path: Path) -> None:
    for k in (0, 1, 2, 7, 8):
        write_picture(tmp_path / f"frame_{k:04d}.png", numbered(k))
    frames = list(open_source(tmp_path, fps=20))
    assert [frame.index for frame in frames] == [0, 1, 2, 7, 8]
    assert [frame.time_s for frame in frames] == pytest.approx([0.0, 0.05, 0.1, 0.35, 0.4])
    assert frames[3].file == "frame_0007.png"


@pytest.mark.parametrize(
    ("names", "numbers"),
    [
        (["cam2_9.png", "cam2_10.png"], [9, 10]),
        (["a.png", "b.png"], None),
        (["a1_1.png", "a2_2.png"], None),
        (["1.png", "01.png"], None),
        (["1732672526123.png", "1732672526156.png"], None),
        (["IMG_0007.jpg"], None),
    ],
)
def test_which_names_are_numbered(names: list[str], numbers: list[int] | None) -> None:
    assert frame_numbers([Path(name) for name in names]) == numbers


def with_significant_bits(path: Path, bits: int) -> None:
    """Insert an sBIT chunk for grey or RGB after the header of a PNG."""
    import struct
    import zlib

    data = path.read_bytes()
    payload = b"sBIT" + bytes([bits] * (1 if data[25] == 0 else 3))
    chunk = struct.pack(">I", len(payload) - 4) + payload + struct.pack(">I", zlib.crc32(payload))
    path.write_bytes(data[:33] + chunk + data[33:])


@pytest.mark.parametrize(("bits", "declared"), [(10, None), (12, None), (12, 12), (14, None), (16, None), (16, 12)])
def test_bits_of_16_that_are_used(tmp_path: Path, bits: int, declared: int | None) -> None:
    """A ramp comes out from black to white, whether its values lie in 10, 12, 14 or 16 bits."""
    ramp = np.linspace(0, 2**bits - 1, 256).round().astype(np.uint16)[None].repeat(64, 0)
    for k, share in enumerate((1.0, 0.5, 0.25)):  # darker pictures are not brightened on their own
        path = write_picture(tmp_path / f"frame_{k}.png", (share * ramp).astype(np.uint16))
        if declared:
            with_significant_bits(path, declared)
            assert significant_bits(path.read_bytes()) == declared
    frames = list(open_source(tmp_path))
    assert len(frames) == 3
    for frame, share in zip(frames, (1.0, 0.5, 0.25), strict=True):
        np.testing.assert_allclose(frame.image[30, :, 1], share * np.arange(256), atol=1.0)


def test_declared_bits_hold_for_a_dark_picture(tmp_path: Path) -> None:
    path = write_picture(tmp_path / "a.png", np.full((60, 80), 400, np.uint16))
    with_significant_bits(path, 12)
    assert next(iter(open_source(path))).image[5, 5, 0] == round(400 * 255 / 4095)


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_pictures_that_say_that_their_pixels_are_not_square(tmp_path: Path, suffix: str) -> None:
    """As FFmpeg writes the frames of an anamorphic film."""
    for index, ratio in enumerate(["4/3", "1/1"]):
        folder = tmp_path / str(index)
        folder.mkdir()
        for k in range(2):
            frame = av.VideoFrame.from_ndarray(np.full((48, 64, 3), 90 + k, np.uint8), format="rgb24")
            codec = av.CodecContext.create("png" if suffix == ".png" else "mjpeg", "w")
            codec.width, codec.height, codec.time_base = 64, 48, Fraction(1, 30)
            codec.pix_fmt = "rgb24" if suffix == ".png" else "yuvj420p"
            codec.sample_aspect_ratio = Fraction(ratio)
            packets = [*codec.encode(frame.reformat(format=codec.pix_fmt)), *codec.encode(None)]
            (folder / f"f{k}{suffix}").write_bytes(b"".join(bytes(packet) for packet in packets))
        with open_source(folder) as source:
            assert len([*source]) == 2
            assert (source.width, source.height) == (64, 48)
            told = any("its pixels are not square (4:3)" in note for note in source.notes)
        assert told == (ratio == "4/3")


def test_folder_of_heic(tmp_path: Path) -> None:
    pillow_heif = pytest.importorskip("pillow_heif")
    for k in (1, 2, 4):
        pillow_heif.from_bytes(mode="RGB", size=(160, 120), data=numbered(k).tobytes()).save(
            tmp_path / f"IMG_000{k}.HEIC", quality=95
        )
    (tmp_path / "IMG_0003.HEIC").write_bytes(b"\0\0\0\x18ftypheic broken")
    (tmp_path / "._IMG_0001.HEIC").write_bytes(b"\0\5\x16\7")
    source = open_source(tmp_path)
    frames = list(source)
    assert [number_of(frame.image) for frame in frames] == [1, 2, 4]
    assert [frame.file for frame in frames] == ["IMG_0001.HEIC", "IMG_0002.HEIC", "IMG_0004.HEIC"]
    assert source.skipped == 1 and (source.width, source.height) == (160, 120)


def write_dng(path: Path, level: int) -> None:
    """A DNG of 64 × 48 px of Bayer pixels RGGB of 12 bits, all of one level."""
    import struct

    pixels = np.full((48, 64), level, "<u2").tobytes()
    identity = [value for k in range(9) for value in (int(k % 4 == 0), 1)]
    tags = [
        (254, "I", [0]), (256, "I", [64]), (257, "I", [48]), (258, "H", [16]), (259, "H", [1]), (262, "H", [32803]),
        (271, "c", b"Test\0"), (272, "c", b"Test\0"), (273, "I", [8]), (274, "H", [1]), (277, "H", [1]),
        (278, "I", [48]), (279, "I", [len(pixels)]), (33421, "H", [2, 2]), (33422, "B", [0, 1, 1, 2]),
        (50706, "B", [1, 4, 0, 0]), (50708, "c", b"Test\0"), (50714, "I", [0]), (50717, "I", [4095]),
        (50721, "srational", identity), (50728, "rational", [1, 1, 1, 1, 1, 1]), (50778, "H", [21]),
    ]  # fmt: skip
    codes = {"B": 1, "c": 2, "H": 3, "I": 4, "rational": 5, "srational": 10}
    directory = struct.pack("<H", len(tags))
    extra, extra_at = b"", 8 + len(pixels) + 2 + 12 * len(tags) + 4
    for tag, kind, values in tags:
        form = {"rational": "I", "srational": "i", "c": "B"}.get(kind, kind)
        content = struct.pack(f"<{len(values)}{form}", *values)
        count = len(values) // 2 if "rational" in kind else len(values)
        if len(content) > 4:
            place, extra = struct.pack("<I", extra_at + len(extra)), extra + content + b"\0" * (len(content) % 2)
        else:
            place = content.ljust(4, b"\0")
        directory += struct.pack("<HHI", tag, codes[kind], count) + place
    path.write_bytes(struct.pack("<2sHI", b"II", 42, 8 + len(pixels)) + pixels + directory + b"\0" * 4 + extra)


def test_dng_pictures(tmp_path: Path) -> None:
    """Linear values are developed: a fifth of white is BT.709's 0.4, whatever other pictures hold."""
    pytest.importorskip("rawpy")
    for k, level in enumerate((819, 4095)):
        write_dng(tmp_path / f"IMG_000{k}.dng", level)
    write_dng(tmp_path / "IMG_0002.dng", 819)
    write_picture(tmp_path / "IMG_0002.jpg", np.zeros((48, 64, 3), np.uint8))  # developed already
    frames = list(open_source(tmp_path))
    assert [frame.file for frame in frames] == ["IMG_0000.dng", "IMG_0001.dng", "IMG_0002.jpg"]
    fifth = 255 * (1.099 * 0.2**0.45 - 0.099)
    np.testing.assert_allclose(frames[0].image[24, 32], fifth, atol=4)
    assert frames[1].image[24, 32].min() >= 250


def test_dng_without_its_reader_is_one_clear_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_dng(tmp_path / "a.dng", 819)
    monkeypatch.setitem(sys.modules, "rawpy", None)
    with pytest.raises(MissingDependencyError, match=r"DNG pictures needs rawpy.*pip install .*\[formats\]"):
        open_source(tmp_path)


def test_pictures_that_would_take_minutes_or_gigabytes(tmp_path: Path) -> None:
    """A JPEG of thousands of scans, and PNGs of 10^9 pixels or a chunk of 4 GB, are refused in a moment."""
    import io
    import struct
    import time
    import zlib

    from PIL import Image

    buffer = io.BytesIO()
    Image.new("RGB", (640, 640), (9, 9, 9)).save(buffer, "JPEG", progressive=True)
    data = buffer.getvalue()
    last = data[data.rfind(b"\xff\xda") : -2]
    (tmp_path / "scans.jpg").write_bytes(data[:-2] + last * 3000 + b"\xff\xd9")
    header = struct.pack(">IIBBBBB", 32000, 32000, 8, 0, 0, 0, 0)
    chunks = ((b"IHDR", header), (b"IDAT", zlib.compress(bytes(10**6))), (b"IEND", b""))
    (tmp_path / "bomb.png").write_bytes(
        b"\x89PNG\r\n\x1a\n"
        + b"".join(
            struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
            for kind, body in chunks
        )
    )
    write_picture(tmp_path / "chunk.png", numbered(1))
    damaged = bytearray((tmp_path / "chunk.png").read_bytes())
    damaged[33:37] = b"\xec\xbc\x1d\x03"  # a chunk of 4 GB
    (tmp_path / "chunk.png").write_bytes(damaged)
    (tmp_path / "good.jpg").write_bytes(data)
    began_s = time.perf_counter()
    with pytest.raises(InputError, match=r"scans\.jpg: the picture is a JPEG of 30\d\d scans"):
        open_source(tmp_path / "scans.jpg")
    with pytest.raises(
        InputError, match=r"bomb\.png: the picture is a damaged PNG: \d+ bytes cannot hold 32000×32000 px"
    ):
        open_source(tmp_path / "bomb.png")
    source = open_source(tmp_path)
    assert [frame.file for frame in source] == ["good.jpg"] and source.skipped == 3
    assert time.perf_counter() - began_s < 5.0
