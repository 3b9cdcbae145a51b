"""Films of 16 bits of which fewer are used, and TIFF files of several pages."""

from __future__ import annotations

import struct
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from PIL import Image

from arview.errors import InputError
from arview.video import open_source
from arview.video.tiff import tiff_pages

RAMP = np.tile(np.linspace(0.0, 1.0, 64), (48, 1))


def write_deep(path: Path, images: list[np.ndarray], form: str, layout: str = "gray16le") -> Path:
    with av.open(str(path), "w") as film:
        stream = film.add_stream("ffv1", rate=30)
        stream.width, stream.height, stream.pix_fmt = 64, 48, form
        for image in images:
            film.mux(stream.encode(av.VideoFrame.from_ndarray(image, format=layout)))
        film.mux(stream.encode())
    return path


@pytest.mark.parametrize("bits", [8, 10, 12, 14, 16])
@pytest.mark.parametrize("form", ["gray16le", "gbrp16le"])
def test_bits_of_16_that_a_film_uses(bits: int, form: str, tmp_path: Path) -> None:
    image = (RAMP * (2**bits - 1)).round().astype(np.uint16)
    if form == "gbrp16le":
        image = np.stack([image, image // 2, 0 * image], axis=2)
    layout = "gray16le" if form == "gray16le" else "rgb48le"
    frames = list(open_source(write_deep(tmp_path / "a.mkv", [image, image], form, layout)))
    assert len(frames) == 2 and frames[0].image.shape == (48, 64, 3)
    np.testing.assert_allclose(frames[1].image[:, :, 0], 255.0 * RAMP, atol=1.0)
    green = RAMP if form == "gray16le" else 0.5 * RAMP
    np.testing.assert_allclose(frames[1].image[:, :, 1], 255.0 * green, atol=2.0)


def test_a_brighter_frame_is_not_cut_off(tmp_path: Path) -> None:
    images = [(RAMP * peak).astype(np.uint16) for peak in (1000, 4095, 1000)]
    peaks = [int(frame.image.max()) for frame in open_source(write_deep(tmp_path / "a.mkv", images, "gray16le"))]
    assert peaks == [pytest.approx(249, abs=1), 255, pytest.approx(62, abs=1)]


def level_of(image: np.ndarray) -> int:
    return round(float(image.mean()) / 10.0)


def write_pages(path: Path, levels: list[int], **options: object) -> Path:
    pages = [Image.fromarray(np.full((48, 64, 3), 10 * level, np.uint8)) for level in levels]
    pages[0].save(path, save_all=True, append_images=pages[1:], **options)
    return path


@pytest.mark.parametrize("options", [{}, {"compression": "tiff_deflate"}, {"big_tiff": True}])
def test_pages_are_frames(options: dict[str, object], tmp_path: Path) -> None:
    path = write_pages(tmp_path / "a.tif", [3, 7, 11, 15, 19], **options)
    source = open_source(path, fps=10.0)
    assert source.frame_count == 5
    frames = list(source)
    assert [level_of(frame.image) for frame in frames] == [3, 7, 11, 15, 19]
    assert [frame.index for frame in frames] == [0, 1, 2, 3, 4]
    np.testing.assert_allclose([frame.time_s for frame in frames], [0.0, 0.1, 0.2, 0.3, 0.4])
    assert [frame.index for frame in open_source(path, start=1, stride=2)] == [1, 3]
    with pytest.raises(InputError, match="start 5 is past the last of its 5 pictures"):
        open_source(path, start=5)


def test_pages_of_a_folder_follow_each_other(tmp_path: Path) -> None:
    write_pages(tmp_path / "a1.tif", [3, 7])
    write_pages(tmp_path / "a2.tiff", [11])
    assert cv2.imwritemulti(str(tmp_path / "a5.tif"), [np.full((48, 64), v << 8, np.uint16) for v in (150, 190)])
    frames = list(open_source(tmp_path))
    assert [level_of(frame.image) for frame in frames] == [3, 7, 11, 15, 19]
    assert [frame.file for frame in frames] == ["a1.tif", "a1.tif", "a2.tiff", "a5.tif", "a5.tif"]


def bare_tiff(path: Path, order: str, kinds: list[int], last: int = 0) -> Path:
    """A TIFF of directories that hold nothing but the kind of the page, the last of which names a further one."""
    data = (b"II*\0" if order == "<" else b"MM\0*") + struct.pack(order + "I", 8)
    for number, kind in enumerate(kinds, start=1):
        following = 8 + 18 * number if number < len(kinds) else last
        data += struct.pack(order + "HHHIII", 1, 254, 4, 1, kind, following)
    path.write_bytes(data)
    return path


@pytest.mark.parametrize("order", ["<", ">"])
def test_previews_and_masks_are_no_pictures(order: str, tmp_path: Path) -> None:
    assert tiff_pages(bare_tiff(tmp_path / "a.tif", order, [0, 1, 2, 4, 0])) == [0, 2, 4]
    # A chain that comes back to its start, and one that leads nowhere.
    assert tiff_pages(bare_tiff(tmp_path / "b.tif", order, [0, 0], last=8)) == [0, 1]
    assert tiff_pages(bare_tiff(tmp_path / "c.tif", order, [0, 0], last=9_000)) == [0, 1]


def test_damaged_pages_are_skipped_and_counted(tmp_path: Path) -> None:
    path = write_pages(tmp_path / "a.tif", [3, 7, 11])
    path.write_bytes(path.read_bytes()[:-6000])
    source = open_source(path)
    assert [level_of(frame.image) for frame in source][:2] == [3, 7]
    (tmp_path / "b.tif").write_bytes(b"II*\0\x08\0\0\0")
    with pytest.raises(InputError, match=r"b\.tif: the picture cannot be read"):
        open_source(tmp_path / "b.tif")


def test_frames_of_an_animated_png(tmp_path: Path) -> None:
    path = write_pages(tmp_path / "a.png", [3, 9, 20], duration=100)
    frames = list(open_source(path))
    assert [level_of(frame.image) for frame in frames] == [3, 9, 20]
    np.testing.assert_allclose([frame.time_s for frame in frames], [0.0, 0.1, 0.2], atol=1e-6)
    still = write_pages(tmp_path / "b.png", [7])
    assert [level_of(frame.image) for frame in open_source(still)] == [7]
