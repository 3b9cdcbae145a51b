from __future__ import annotations

import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image, ImageFile

from arview.camera import Camera
from arview.camera.exif import PhotoExif, focal_length_px, read_exif, sensor_width_mm
from arview.camera.read import save_camera
from arview.core.stage_cache import key_of
from arview.errors import InputError, MismatchError
from arview.reconstruction.intake import VideoIntakeOptions, intake_frames, intake_photos, intake_video, read_photo
from arview.reconstruction.intake.checks import blur_and_texture, same_views, thumbnail
from arview.reconstruction.intake.lenses import Lens, lenses_of
from arview.reconstruction.intake.reading import glance
from arview.reconstruction.intake.video import choose_frames
from arview.video import VideoSink
from helpers.paths import SHARED

Pixels = NDArray[np.uint8]
PLATE = SHARED / "plate/photos"
SEQUENCES = SHARED / "sequences"
SIZE = (800, 600)


def surface(seed: int = 0, width: int = 1600, height: int = 1200) -> Pixels:
    """A sharp RGB picture of scratches, blobs and outlines at all scales, (H,W,3)."""
    rng = np.random.default_rng(seed)
    gray = np.zeros((height, width), np.float32)
    for sigma, amplitude in ((60, 30), (15, 15), (4, 10)):
        noise = cv2.GaussianBlur(rng.standard_normal((height, width)).astype(np.float32), (0, 0), sigma)
        gray += amplitude * noise / noise.std()
    for _ in range(250):
        x, y, level = rng.integers(0, width), rng.integers(0, height), float(rng.uniform(-70, 70))
        angle, length = rng.uniform(0, np.pi), rng.uniform(10, 120)
        end = int(x + length * np.cos(angle)), int(y + length * np.sin(angle))
        gray = cv2.line(gray, (int(x), int(y)), end, level, int(rng.integers(1, 9)))
    gray = cv2.GaussianBlur(gray + 125, (0, 0), 0.6)
    return np.clip(np.stack([gray, 0.9 * gray, 0.8 * gray], axis=-1), 0, 255).astype(np.uint8)


SURFACE = surface()


def view(x: int, y: int = 0, seed: int = 0) -> Pixels:
    """800 × 600 window of the surface from (x, y), with sensor noise."""
    window = SURFACE[y : y + SIZE[1], x : x + SIZE[0]].astype(np.float32)
    return np.clip(window + np.random.default_rng(seed).normal(0, 2, window.shape), 0, 255).astype(np.uint8)


def save(path: Path, pixels: Pixels, quality: int = 92, **tags: object) -> Path:
    """Write a photo with EXIF tags: make, model, orientation, focal, focal_35mm, zoom, taken, serial."""
    exif = Image.Exif()
    codes = {"make": 0x010F, "model": 0x0110, "orientation": 0x0112}
    inner = {"focal": 0x920A, "focal_35mm": 0xA405, "zoom": 0xA404, "taken": 0x9003, "serial": 0xA431}
    for name, value in tags.items():
        if name in codes:
            exif[codes[name]] = value
        else:
            exif.get_ifd(0x8769)[inner[name]] = value
    Image.fromarray(pixels).save(path, exif=exif, quality=quality)
    return path


def fill(folder: Path, count: int = 8, **tags: object) -> Path:
    """A folder of good photos a.0.jpg … of different places."""
    folder.mkdir(exist_ok=True, parents=True)
    for k in range(count):
        save(folder / f"good_{k}.jpg", view(80 * k, 60 * k, k), **tags)
    return folder


def names(intake_rejected: tuple[tuple[str, str], ...]) -> dict[str, str]:
    return dict(intake_rejected)


# --- Reading --------------------------------------------------------------------------------------------


def test_all_orientations_come_out_upright(tmp_path: Path) -> None:
    truth = cv2.resize(view(0), (160, 120), interpolation=cv2.INTER_AREA)
    # How each orientation's pixels are stored, from the definition of the tag (0th row, 0th column).
    stored = {
        1: truth, 2: truth[:, ::-1], 3: truth[::-1, ::-1], 4: truth[::-1],
        5: truth.transpose(1, 0, 2), 6: np.rot90(truth, 1), 7: truth.transpose(1, 0, 2)[::-1, ::-1],
        8: np.rot90(truth, -1),
    }  # fmt: skip
    for orientation, pixels in stored.items():
        path = save(tmp_path / f"o{orientation}.png", np.ascontiguousarray(pixels), orientation=orientation)
        assert np.array_equal(read_photo(path), truth), orientation
        assert read_exif(path).upright_size == (160, 120)
        seen = glance(path.read_bytes()).gray
        assert np.abs(seen.astype(int) - np.asarray(Image.fromarray(truth).convert("L"))).max() <= 1


@pytest.mark.slow
def test_formats(tmp_path: Path) -> None:
    truth = view(100)
    picture = Image.fromarray(truth)
    picture.save(tmp_path / "a.tiff")
    picture.convert("RGBA").save(tmp_path / "alpha.png")
    picture.convert("P", palette=Image.Palette.ADAPTIVE).save(tmp_path / "palette.png")
    picture.save(tmp_path / "a.bmp")
    for name in ("a.tiff", "alpha.png", "a.bmp"):
        assert np.array_equal(read_photo(tmp_path / name), truth)
    assert np.abs(read_photo(tmp_path / "palette.png").astype(int) - truth).mean() < 6
    picture.convert("CMYK").save(tmp_path / "cmyk.jpg", quality=95)
    assert np.abs(read_photo(tmp_path / "cmyk.jpg").astype(int) - truth).mean() < 3
    gray = np.asarray(picture.convert("L"))
    for name in ("gray16.png", "gray16.tif"):
        Image.fromarray(gray.astype(np.uint16) * 257).save(tmp_path / name)
        assert np.array_equal(read_photo(tmp_path / name), np.repeat(gray[..., None], 3, axis=2))
    for name in ("rgb16.png", "rgb16.tiff"):
        cv2.imwrite(str(tmp_path / name), truth[..., ::-1].astype(np.uint16) * 257)
        assert np.abs(read_photo(tmp_path / name).astype(int) - truth).max() <= 1
    Image.fromarray(gray.astype(np.float32)).save(tmp_path / "float.tif")
    with pytest.raises(InputError, match=r"float\.tif: holds floating-point pixels"):
        read_photo(tmp_path / "float.tif")


@pytest.mark.slow
def test_heic(tmp_path: Path) -> None:
    pillow_heif = pytest.importorskip("pillow_heif")
    truth = cv2.resize(view(50), (320, 240), interpolation=cv2.INTER_AREA)
    exif = Image.Exif()
    exif[0x0110] = "iPhone 12"
    exif.get_ifd(0x8769)[0xA405] = 26
    heif = pillow_heif.from_pillow(Image.fromarray(truth))
    for name in ("a.heic", "named_wrongly.jpg"):
        heif.save(tmp_path / name, quality=95, exif=exif.tobytes())
        assert np.abs(read_photo(tmp_path / name).astype(int) - truth).mean() < 4
        assert read_exif(tmp_path / name).model == "iPhone 12"
        assert read_exif(tmp_path / name).focal_length_35mm_mm == 26
    exif[0x0112] = 6
    heif.save(tmp_path / "turned.heic", quality=95, exif=exif.tobytes())
    turned = read_exif(tmp_path / "turned.heic")  # its reader turns the pixels; the turn stays known for the camera
    assert (turned.upright_size, turned.orientation, turned.quarter_turns_clockwise) == ((240, 320), 1, 1)
    assert np.abs(read_photo(tmp_path / "turned.heic").astype(int) - np.rot90(truth, -1)).mean() < 4
    data = (tmp_path / "a.heic").read_bytes()
    (tmp_path / "cut.heic").write_bytes(data[: len(data) // 2])
    with pytest.raises(InputError, match=r"cut\.heic"):
        read_photo(tmp_path / "cut.heic")


def test_broken_files_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # As WeasyPrint leaves it, which makes the reports of the same process.
    monkeypatch.setattr(ImageFile, "LOAD_TRUNCATED_IMAGES", True)
    data = save(tmp_path / "whole.jpg", view(0)).read_bytes()
    half = len(data) // 2
    broken = {
        "empty.jpg": b"", "text.jpg": b"<html>not found</html>", "half.jpg": data[:half], "tail.jpg": data[:-30],
        "head.jpg": data[:300], "zeros.jpg": data[:half] + bytes(600) + data[half + 600 :],
    }  # fmt: skip
    Image.fromarray(view(0)).save(tmp_path / "p.png")
    png = (tmp_path / "p.png").read_bytes()
    broken["half.png"] = png[: len(png) // 2]
    broken["flipped.png"] = png[: len(png) // 2] + bytes(500) + png[len(png) // 2 + 500 :]
    (tmp_path / "p.png").unlink()
    (tmp_path / "whole.jpg").unlink()
    folder = fill(tmp_path / "photos", 6)
    for name, content in broken.items():
        (folder / name).write_bytes(content)
        if name != "zeros.jpg":  # Pillow makes a picture of it; only intake finds the damage
            with pytest.raises(InputError, match=name):
                read_photo(folder / name)
    (folder / "notes.txt").write_text("not a photo")
    (folder / "._good_0.jpg").write_bytes(b"resource fork")
    (folder / "raw.dng").write_bytes(b"II*\0")
    (folder / "good_0.nef").write_bytes(b"II*\0")  # beside its JPEG: passed over
    intake = intake_photos(folder)
    assert [photo.name for photo in intake.photos] == [f"good_{k}.jpg" for k in range(6)]
    assert set(names(intake.rejected)) == {*broken, "raw.dng"}
    assert "0 bytes" in names(intake.rejected)["empty.jpg"]
    assert "damaged" in names(intake.rejected)["zeros.jpg"]
    with pytest.raises(InputError, match=r"no_such\.jpg: cannot be read"):
        read_photo(tmp_path / "no_such.jpg")


# --- Lenses and cameras ---------------------------------------------------------------------------------


def lens(exif: PhotoExif, camera: str | Path | None = None) -> Lens:
    (found,), _ = lenses_of([exif], camera)
    assert isinstance(found, Lens)
    return found


def test_first_focal_length() -> None:
    assert lens(PhotoExif(4000, 3000)).camera.fx == pytest.approx(1.2 * 4000)
    assert lens(PhotoExif(4000, 3000, focal_length_35mm_mm=26.0)).camera.fx == pytest.approx(26 * 5000 / 43.2666, 1e-5)
    sony = PhotoExif(6000, 4000, model="ILCE-6400", focal_length_mm=35.0)
    assert lens(sony).camera.fx == pytest.approx(35 / 23.5 * 6000)
    assert focal_length_px(PhotoExif(6000, 4000, model="ILCE-6400", focal_length_mm=35.0, digital_zoom=2.0), 6000, 4000)
    assert lens(PhotoExif(4000, 3000, model="Nobody 1", focal_length_mm=5.0)).camera.fx == pytest.approx(4800)
    assert lens(PhotoExif(4000, 3000, focal_length_35mm_mm=9999.0)).camera.fx == pytest.approx(4800)  # not believed
    portrait = lens(PhotoExif(4000, 3000, 1, orientation=6, focal_length_35mm_mm=26.0)).camera
    assert (portrait.width, portrait.height) == (3000, 4000)
    assert portrait.fx == pytest.approx(26 * 5000 / 43.2666, 1e-5)
    assert (portrait.cx, portrait.cy) == (1499.5, 1999.5)
    assert sensor_width_mm("NIKON D7000") == 23.6
    assert sensor_width_mm("NIKON D700") == 35.9
    assert sensor_width_mm("nobody") is None


def test_photos_of_one_lens_share_their_key() -> None:
    phone = {"width": 4032, "height": 3024, "make": "Apple", "model": "iPhone 12", "focal_length_35mm_mm": 26.0}
    exifs = [
        PhotoExif(**phone, focal_length_mm=4.2),  # type: ignore[arg-type]
        PhotoExif(**phone, focal_length_mm=4.25),  # type: ignore[arg-type]  # the same, less rounded
        PhotoExif(**phone, focal_length_mm=4.2500001, serial="7"),  # type: ignore[arg-type]
        PhotoExif(**phone | {"focal_length_35mm_mm": 52.0}, focal_length_mm=4.25, digital_zoom=2.0),  # type: ignore[arg-type]
        PhotoExif(**phone | {"focal_length_35mm_mm": 13.0}, focal_length_mm=1.54),  # type: ignore[arg-type]
        PhotoExif(**phone, focal_length_mm=4.2, orientation=6, quarter_turns_clockwise=1),  # type: ignore[arg-type]
        PhotoExif(**phone, focal_length_mm=4.2, orientation=3, quarter_turns_clockwise=2),  # type: ignore[arg-type]
        PhotoExif(4032, 3024),
        PhotoExif(4032, 3024),
        PhotoExif(1600, 1200),
    ]
    lenses, warnings = lenses_of(exifs, None)
    keys = [found.key for found in lenses if isinstance(found, Lens)]
    first = {key: keys.index(key) for key in keys}
    assert [first[key] for key in keys] == [0, 0, 0, 3, 4, 5, 0, 7, 7, 9]
    assert not warnings


def test_calibrated_camera_is_scaled_turned_or_refused(tmp_path: Path) -> None:
    calibrated = Camera(4000, 3000, 3210.0, 3215.0, 2020.0, 1480.0, np.array([0.05, -0.02, 1e-3, -5e-4, 0.0]))
    file = tmp_path / "camera.json"
    save_camera(calibrated, file)
    half = lens(PhotoExif(2000, 1500), file)
    assert half.is_calibrated and half.camera.fx == pytest.approx(1605.0)
    for orientation, turns in ((6, 1), (3, 2), (8, 3)):
        turned = lens(PhotoExif(4000, 3000, turns, orientation=orientation), file)
        point = np.array([0.1, 0.2, 1.0])
        expected = calibrated.rotated(turns).project(point)
        assert turned.is_calibrated
        assert turned.camera.project(point) == pytest.approx(expected, abs=1e-9)
    both, _ = lenses_of([PhotoExif(4000, 3000), PhotoExif(4000, 3000, 2, orientation=3)], file)
    assert both[0].key != both[1].key  # type: ignore[union-attr]  # turned by 180° the principal point is mirrored
    # Portrait without orientation: which way it was turned is unknown, so it is a guess and said so.
    (upright,), warnings = lenses_of([PhotoExif(3000, 4000)], file)
    assert isinstance(upright, Lens) and not upright.is_calibrated
    assert upright.camera.fy == 3210.0
    assert "initial guess" in warnings[0]
    (refused,), _ = lenses_of([PhotoExif(4000, 2250)], file)
    assert isinstance(refused, MismatchError) and "aspect ratio" in str(refused)
    # One zoom fits the calibration, the other does not.
    fits, zoomed = (PhotoExif(4000, 3000, focal_length_35mm_mm=mm) for mm in (28.0, 56.0))
    lenses, warnings = lenses_of([fits, zoomed], file)
    assert [found.is_calibrated for found in lenses if isinstance(found, Lens)] == [True, False]
    assert "the zoom differs" in warnings[0]


def test_camera_of_photos_on_disk(tmp_path: Path) -> None:
    folder = fill(tmp_path / "photos", 4, make="Apple", model="iPhone 12", focal=4.25, focal_35mm=26)
    portrait = np.ascontiguousarray(np.rot90(view(700, 500)))
    save(folder / "portrait.jpg", portrait, make="Apple", model="iPhone 12", focal=4.2, focal_35mm=26, orientation=6)
    intake = intake_photos(folder)
    sizes = {photo.name: (photo.width, photo.height) for photo in intake.photos}
    assert sizes["portrait.jpg"] == (800, 600)  # stored 600 × 800, upright as the others
    assert len({photo.lens for photo in intake.photos}) == 1
    assert intake.photos[0].camera.fx == pytest.approx(26 * 1000 / 43.2666, 1e-5)
    assert "35 mm" in intake.lenses[0].focal_from
    save_camera(Camera(1000, 1000, 900, 900, 500, 500), tmp_path / "square.json")
    with pytest.raises(MismatchError, match="aspect ratio"):
        intake_photos(folder, tmp_path / "square.json")
    with pytest.raises(InputError, match="not found"):
        intake_photos(folder, tmp_path / "none.json")


# --- Checks ---------------------------------------------------------------------------------------------


def gray_of(pixels: Pixels) -> Pixels:
    return cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY)


def noisy(gray: NDArray[np.float32], sigma: float = 2.0) -> Pixels:
    return np.clip(gray + np.random.default_rng(1).normal(0, sigma, gray.shape), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("sigma", [1.0, 1.5, 2.0, 3.0])
def test_blur_is_measured_in_pixels(sigma: float) -> None:
    gray = gray_of(SURFACE).astype(np.float32)
    spread, textured = blur_and_texture(noisy(cv2.GaussianBlur(gray, (0, 0), sigma)))
    assert spread == pytest.approx(np.hypot(sigma, 0.6), rel=0.2)
    assert textured > 0.5
    half = blur_and_texture(noisy(0.4 * cv2.GaussianBlur(gray, (0, 0), sigma) + 80))[0]
    assert half == pytest.approx(spread, rel=0.25)  # whatever the contrast


def test_motion_blur_shows_in_its_direction() -> None:
    gray = gray_of(SURFACE).astype(np.float32)
    kernel = np.zeros((13, 13), np.float32)
    kernel[6] = 1 / 13
    assert blur_and_texture(noisy(gray))[0] < 1.0
    for turn in (kernel, kernel.T, cv2.warpAffine(kernel, cv2.getRotationMatrix2D((6, 6), 30, 1), (13, 13))):
        assert blur_and_texture(noisy(cv2.filter2D(gray, -1, turn / turn.sum())))[0] > 2.5


def test_sharp_photo_of_little_texture_is_sharp() -> None:
    plain = np.full((1200, 1600), 120, np.float32)
    cv2.rectangle(plain, (300, 300), (1000, 800), 160, -1)
    cv2.circle(plain, (900, 600), 200, 90, -1)
    plain = cv2.GaussianBlur(plain, (0, 0), 0.8)
    spread, textured = blur_and_texture(noisy(plain))
    assert 0.5 < spread < 1.1
    assert 0.1 < textured < 0.4
    assert blur_and_texture(noisy(cv2.GaussianBlur(plain, (0, 0), 3.0)))[0] > 2.5


@pytest.mark.parametrize("noise", [1.0, 4.0, 8.0])
def test_a_wall_has_no_texture(noise: float) -> None:
    shading = np.full((1200, 1600), 180, np.float32) + np.linspace(-40, 30, 1600, dtype=np.float32)
    spread, textured = blur_and_texture(noisy(shading, noise))
    assert np.isnan(spread) and textured == 0.0


def test_bad_photos_are_named_and_good_ones_kept(tmp_path: Path) -> None:
    folder = fill(tmp_path / "photos")
    bad = view(300, 100).astype(np.float32)
    save(folder / "slightly_blurred.jpg", noisy(cv2.GaussianBlur(bad, (0, 0), 2.5)))
    save(folder / "blurred.jpg", noisy(cv2.GaussianBlur(view(500, 50).astype(np.float32), (0, 0), 6.0)))
    save(folder / "bright.jpg", noisy(view(600, 300) * 4.0))
    save(folder / "dark.jpg", noisy(view(200, 400) * 0.2, 1.0))
    save(folder / "black.jpg", noisy(np.zeros((600, 800, 3), np.float32)))
    save(folder / "wall.jpg", noisy(np.full((600, 800, 3), 150, np.float32)))
    save(folder / "small.jpg", view(0)[::4, ::4].copy())
    save(folder / "panorama.jpg", SURFACE[:400].copy())
    intake = intake_photos(folder)
    rejected = names(intake.rejected)
    assert set(rejected) == {"blurred.jpg", "black.jpg", "wall.jpg", "small.jpg", "panorama.jpg"}
    assert "too blurred to be used" in rejected["blurred.jpg"] and "black" in rejected["black.jpg"]
    assert "no texture" in rejected["wall.jpg"] and "panorama" in rejected["panorama.jpg"]
    told = "\n".join(intake.warnings)
    assert "1 of 11 photos is blurred (slightly_blurred.jpg)" in told
    assert "overexposed (bright.jpg)" in told and "very dark (dark.jpg)" in told
    assert "good_" not in told
    assert len(intake.photos) == 11
    assert {check.name for check in intake.checks} == {p.name for p in folder.iterdir()}


def test_duplicates(tmp_path: Path) -> None:
    folder = fill(tmp_path / "photos")
    original = (folder / "good_3.jpg").read_bytes()
    (folder / "copy.jpg").write_bytes(original)
    dimmer = cv2.resize((view(80, 60, 99) * 0.8 + 10).astype(np.uint8), (640, 480), interpolation=cv2.INTER_AREA)
    save(folder / "again.jpg", dimmer, quality=70)
    moved = save(folder / "moved.jpg", view(80 + 12, 60))  # 1.5 % to the side: a view of its own
    changed = view(80 * 5, 60 * 5, 42)
    changed[300:340, 400:440] = view(0, 0)[:40, :40]  # the same place, but something is different there
    save(folder / "changed.jpg", changed)
    intake = intake_photos(folder)
    rejected = names(intake.rejected)
    assert set(rejected) == {"again.jpg", "copy.jpg"} or set(rejected) == {"again.jpg", "good_3.jpg"}
    assert "good_1.jpg" in rejected["again.jpg"]
    assert moved.name in {photo.name for photo in intake.photos}
    thumbs = [thumbnail(gray_of(view(x))) for x in (0, 4, 8, 16)]
    assert same_views(thumbs) == []
    assert same_views([thumbs[0], thumbnail(gray_of(view(0, 0, 5)))]) == [(0, 1)]


def test_too_little_to_work_with(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such folder"):
        intake_photos(tmp_path / "none")
    (tmp_path / "notes.txt").write_text("x")
    with pytest.raises(InputError, match="holds no photos"):
        intake_photos(tmp_path)
    two = fill(tmp_path / "two", 2)
    (two / "c.jpg").write_bytes(b"")
    with pytest.raises(InputError, match=r"only 2 of 3 photos .*c\.jpg is empty.* 20 to 40"):
        intake_photos(two)
    intake = intake_photos(fill(tmp_path / "three", 3))
    assert len(intake.photos) == 3
    assert any("only 3 photos" in warning for warning in intake.warnings)
    for k in range(5):
        (tmp_path / f"bad_{k}.jpg").write_bytes(b"\xff\xd8\xff nothing")
    with pytest.raises(InputError, match=r"none of 5 photos can be used \(bad_0\.jpg is not a readable"):
        intake_photos(str(tmp_path / "*.jpg"))
    walls = tmp_path / "walls"
    walls.mkdir()
    for k in range(6):
        save(walls / f"{k}.jpg", noisy(np.full((600, 800, 3), 140 + 8 * k, np.float32), 2.0 + 0.2 * k))
    with pytest.raises(InputError, match="6 of 6 photos show no texture"):
        intake_photos(walls)


def test_sources_and_names(tmp_path: Path) -> None:
    fill(tmp_path / "set/left", 3)
    (tmp_path / "set").mkdir(exist_ok=True)
    for k in range(4, 7):
        (tmp_path / "set/right").mkdir(exist_ok=True)
        save(tmp_path / f"set/right/good_{k}.jpg", view(80 * k, 60 * k))
    intake = intake_photos(tmp_path / "set")
    assert [photo.name for photo in intake.photos][:2] == ["left/good_0.jpg", "left/good_1.jpg"]
    assert len(intake.photos) == 6
    calls: list[tuple[int, int]] = []
    listed = sorted((tmp_path / "set/left").iterdir())
    intake = intake_photos([*listed, listed[0]], progress=lambda done, total: calls.append((done, total)))
    assert [photo.name for photo in intake.photos] == [path.name for path in listed]
    assert calls == [(1, 3), (2, 3), (3, 3)]


def test_odd_size_is_warned_of(tmp_path: Path) -> None:
    folder = fill(tmp_path / "photos")
    save(folder / "cropped.jpg", view(700, 20)[:500])
    intake = intake_photos(folder)
    assert any(warning.startswith("cropped.jpg differs") for warning in intake.warnings)
    assert [found.camera.height for found in intake.lenses] == [600, 500]


@pytest.mark.slow
@pytest.mark.shared
def test_the_plate_photos_pass_without_a_word() -> None:
    start = time.process_time()
    intake = intake_photos(PLATE)
    assert len(intake.photos) == 24
    assert intake.rejected == () and intake.warnings == ()
    assert len({photo.lens for photo in intake.photos}) == 1
    assert time.process_time() - start < 10.0


# --- Video ----------------------------------------------------------------------------------------------


def clip(path: Path, places: list[tuple[int, int]], blurred: set[int] = frozenset()) -> Path:  # type: ignore[assignment]
    """A video of the surface's windows at these places; frames in ``blurred`` are shaken."""
    with VideoSink(path, *SIZE, crf=18) as sink:
        for k, (x, y) in enumerate(places):
            frame = np.ascontiguousarray(SURFACE[y : y + SIZE[1], x : x + SIZE[0]])
            sink.write(cv2.blur(frame, (15, 1)) if k in blurred else frame, k / 30.0)
    return path


@pytest.mark.slow
def test_video_frames_are_sharp_and_spread(tmp_path: Path) -> None:
    places = [(4 * k, 3 * k) for k in range(40)] + [(160, 120)] * 20 + [(160 + 5 * k, 120) for k in range(40)]
    blurred = {k for k in range(100) if k % 3 == 0}
    path = clip(tmp_path / "a.mp4", places, blurred)
    options = VideoIntakeOptions(looks_per_s=30.0)
    calls: list[tuple[int, int]] = []
    intake = intake_video(path, tmp_path / "frames", options, progress=lambda done, total: calls.append((done, total)))
    indices = [int(photo.name[6:12]) for photo in intake.photos]
    assert not blurred & set(indices)
    taken = np.array([places[index] for index in indices], float)
    steps = np.linalg.norm(np.diff(taken, axis=0), axis=1)
    assert 13 <= len(indices) <= 17  # 400 px of travel in steps of 25 px
    assert steps.min() > 8 and steps.max() < 50
    assert sum(40 <= index < 60 for index in indices) <= 1  # the pause gives one frame at most
    assert np.abs(read_photo(intake.photos[2].path).astype(int) - view(*places[indices[2]])).mean() < 8
    assert calls[-1][0] <= calls[-1][1] == 200
    again = intake_frames(path, tmp_path / "frames", options)
    assert key_of(again.photos) == key_of(intake.photos)
    assert (again.rejected, again.warnings) == (intake.rejected, intake.warnings)
    few = intake_video(path, tmp_path / "few", VideoIntakeOptions(max_frames=7, looks_per_s=30.0))
    assert 5 <= len(few.photos) <= 7
    assert sorted(p.name for p in (tmp_path / "few").iterdir()) == sorted(photo.name for photo in few.photos)


def test_static_video_is_refused_in_words(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    trembling = [(300 + int(dx), 200 + int(dy)) for dx, dy in rng.integers(-2, 3, (45, 2))]
    with pytest.raises(InputError, match="hardly moves"):
        intake_video(clip(tmp_path / "a.mp4", trembling), tmp_path / "frames")
    with pytest.raises(InputError, match="0"):
        intake_video(clip(tmp_path / "b.mp4", [(0, 0)] * 3), tmp_path / "frames", VideoIntakeOptions(max_frames=0))


def test_choice_prefers_the_sharpest_in_the_middle_of_each_step() -> None:
    travel = np.linspace(0, 1.0, 101)
    sharpness = np.ones(101)
    sharpness[[12, 37, 61, 88]] = 2.0
    sharpness[25] = 9.0  # at the border of two steps
    options = VideoIntakeOptions(max_frames=4, min_step=0.01)
    assert choose_frames(travel, sharpness, options) == [12, 37, 61, 88]


@pytest.mark.shared
def test_frames_of_a_real_sequence(tmp_path: Path) -> None:
    frames = str(SEQUENCES / "castle/test/000001/rgb/*.png")
    intake = intake_video(frames, tmp_path / "frames", camera=None)
    assert 3 <= len(intake.photos) <= 60
    assert not any("blurred" in warning for warning in intake.warnings)
