"""Calibration from rendered boards with known intrinsics; the board's PDF; what is said when it does not work."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from click.testing import CliRunner
from PIL import Image

from arview.calibration.board_view import BoardView
from arview.calibration.choose import ChoiceOptions, choose_views
from arview.calibration.plot import draw
from arview.calibration.run import calibrate, record_of
from arview.calibration.solve import Solution, picture_grid, pixel_uncertainty, solve
from arview.calibration.verdict import Grade, assess
from arview.calibration.views import BoardFinder
from arview.camera import Camera
from arview.camera.exif import PhotoExif, read_exif
from arview.camera.profiles import (
    exif_of_video,
    lens_record,
    list_profiles,
    profile_name,
    same_lens,
)
from arview.camera.read import load_camera
from arview.camera.write import FORMATS, write_camera
from arview.cli import ExitCode, main
from arview.errors import InputError
from arview.fiducials.board import Board, cv_board, parse_board, spec_of
from arview.geometry import Array
from arview.reconstruction.intake.lenses import Lens, lenses_of
from helpers.board_scene import BOARD, LENS, photograph, pose
from helpers.lens_difference import pixel_difference
from helpers.video_files import write_clip

SPEC = spec_of(BOARD)
GRID = picture_grid(LENS.width, LENS.height)
MM_PER_PT = 25.4 / 72.0


def numbers(camera: Camera) -> Array:
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy, *camera.dist])


def views_of(
    rng: np.random.Generator, count: int, noise_px: float = 0.08, together_px: float = 0.0, aside: float = 0.42,
    tilt_deg: tuple[float, float] = (10.0, 45.0),
) -> list[BoardView]:  # fmt: skip
    """Corners as found in pictures: with noise of their own, and errors that all corners of a view share."""
    corners = np.asarray(cv_board(BOARD).getChessboardCorners(), dtype=np.float64)
    views: list[BoardView] = []
    while len(views) < count:
        cam_from_board = pose(BOARD, LENS, rng, tilt_deg, aside=aside)
        pixels = LENS.project(corners @ cam_from_board[:3, :3].T + cam_from_board[:3, 3])
        seen = np.all((pixels > 4) & (pixels < np.array([LENS.width - 5, LENS.height - 5])), axis=1)
        if np.count_nonzero(seen) >= 12:
            bend = rng.normal(0.0, 1.0, (1, 2)) * (pixels - pixels.mean(axis=0)) / 200.0
            found = pixels + rng.normal(0.0, noise_px, pixels.shape) + together_px * bend
            views.append(BoardView(f"view {len(views)}", np.flatnonzero(seen), corners[seen], found[seen]))
    return views


@pytest.fixture(scope="module")
def pictures() -> list[np.ndarray]:
    """22 sharp pictures of the board to all corners of the picture."""
    rng = np.random.default_rng(5)
    return [photograph(BOARD, LENS, pose(BOARD, LENS, rng, aside=0.42), rng) for _ in range(22)]


def write_photo(path: Path, gray: np.ndarray, turns: int = 0, model: str = "Pixel 9") -> None:
    """A JPEG as a phone writes it: the sensor's pixels, and how to turn them."""
    exif = Image.Exif()
    exif[0x010F], exif[0x0110] = "Google", model
    exif[0x0112] = {0: 1, 1: 6, 2: 3, 3: 8}[turns]
    exif.get_ifd(0x8769)[0x920A] = 6.9
    Image.fromarray(gray).save(path, quality=95, exif=exif.tobytes())


@pytest.fixture(scope="module")
def photos(pictures: list[np.ndarray], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The pictures, every third one in portrait, and what else lies in such a folder."""
    folder = tmp_path_factory.mktemp("calibration") / "photos"
    folder.mkdir()
    for k, gray in enumerate(pictures):
        write_photo(folder / f"p{k:02}.jpg", gray, turns=k % 3 if k % 3 < 2 else 3)
    rng = np.random.default_rng(0)
    write_photo(folder / "x_cat.jpg", rng.integers(60, 200, (LENS.height, LENS.width), dtype=np.uint8))
    # A board that was bent: right in the middle, off at its sides.
    bent = pictures[0][:, np.clip(np.arange(640) + np.round(5e-5 * (np.arange(640) - 320.0) ** 2), 0, 639).astype(int)]
    write_photo(folder / "x_bent.jpg", bent)
    write_photo(folder / "x_wide.jpg", cv2.resize(pictures[1], (800, 600)))
    (folder / "x_cut.jpg").write_bytes((folder / "p01.jpg").read_bytes()[:9000])
    return folder


# --- the camera ----------------------------------------------------------------------------------------------


def assert_near_truth(solution: Solution, focal: float, centre_px: float, pixel_px: float, corner_px: float) -> None:
    camera = solution.camera
    assert abs(camera.fx / LENS.fx - 1.0) < focal
    assert abs(camera.fy / LENS.fy - 1.0) < focal
    assert np.hypot(camera.cx - LENS.cx, camera.cy - LENS.cy) < centre_px
    off = np.linalg.norm(pixel_difference(LENS, camera, GRID), axis=1)
    assert np.median(off) < pixel_px
    assert off[[0, 8, 54, 62]].max() < corner_px  # the corners of the picture


@pytest.mark.slow
def test_a_folder_of_photos(photos: Path) -> None:
    result = calibrate([photos], BOARD)
    solution, judged = result.solution, result.verdict
    assert len(solution.views) == 22
    assert set(result.rejected) == {"x_cat.jpg", "x_bent.jpg", "x_wide.jpg", "x_cut.jpg"}
    assert "no marker" in result.rejected["x_cat.jpg"]
    assert "does not fit the others" in result.rejected["x_bent.jpg"]
    assert "800×600" in result.rejected["x_wide.jpg"]
    assert (solution.camera.width, solution.camera.height) == (640, 480)  # of portrait photos too
    assert_near_truth(solution, focal=0.001, centre_px=0.6, pixel_px=0.1, corner_px=0.6)
    errors = numbers(solution.camera) - numbers(LENS)
    assert np.count_nonzero(np.abs(errors) <= 2.0 * solution.std) >= 7
    assert solution.rms_px < 0.15
    assert judged.grade in (Grade.GOOD, Grade.USABLE)
    assert judged.focal_u < 0.002
    assert judged.coverage > 0.9
    record = json.loads(json.dumps(record_of(result), allow_nan=False))
    assert record["lens"]["model"] == "Pixel 9"
    assert record["calibration"]["views_used"] == 22
    assert draw(result)[:8] == b"\x89PNG\r\n\x1a\n"


@pytest.mark.slow
def test_blur_and_noise(pictures: list[np.ndarray]) -> None:
    """Half the contrast, twice the noise, edges three times as soft: five times less exact, and U says so."""
    rng = np.random.default_rng(9)
    finder = BoardFinder(BOARD)
    found = []
    for k, gray in enumerate(pictures):
        soft = cv2.GaussianBlur(gray, (0, 0), 1.4).astype(float) * 0.6 + 20.0 + rng.normal(0.0, 6.0, gray.shape)
        view = finder.find(str(k), np.clip(soft, 0, 255).astype(np.uint8))
        if isinstance(view, BoardView):
            found.append(view)
    assert len(found) >= 14
    solution = solve(found, 640, 480)
    assert_near_truth(solution, focal=0.006, centre_px=4.0, pixel_px=0.6, corner_px=3.0)
    errors = numbers(solution.camera) - numbers(LENS)
    assert np.count_nonzero(np.abs(errors) <= 2.0 * solution.std) >= 8
    off = np.linalg.norm(pixel_difference(LENS, solution.camera, GRID), axis=1)
    assert np.mean(off <= pixel_uncertainty(solution, GRID)) >= 0.8


@pytest.mark.slow
@pytest.mark.parametrize("together_px", [0.0, 0.1])
def test_u_holds_the_truth_as_often_as_it_says(together_px: float) -> None:
    """20 calibrations: of 180 numbers and 1,260 places, 95 % are within U, also when corners of a view err together."""
    z, within = [], []
    for seed in range(20):
        views = views_of(np.random.default_rng(seed), 18, together_px=together_px)
        solution = solve(views, 640, 480)
        z.append((numbers(solution.camera) - numbers(LENS)) / solution.std)
        off = np.linalg.norm(pixel_difference(LENS, solution.camera, GRID), axis=1)
        within.append(off <= pixel_uncertainty(solution, GRID))
    share = float(np.mean(np.abs(z) <= 2.0))
    assert 0.90 <= share <= 0.99
    assert 0.88 <= np.mean(within) <= 0.99
    assert 0.75 <= np.sqrt(np.mean(np.square(z))) <= 1.2  # neither too small nor too wide


def test_wrong_corners_and_wrong_views_are_left_out() -> None:
    rng = np.random.default_rng(3)
    views = views_of(rng, 20)
    clean = solve(views, 640, 480)
    for k in (2, 7, 11, 15):  # other corners: off by a square, or anywhere
        pixels = views[k].pixels.copy()
        pixels[rng.integers(0, len(pixels), 3)] += rng.normal(0.0, 15.0, (3, 2))
        views[k] = replace(views[k], pixels=pixels)
    for k in (4, 13):  # moved while it was read out
        views[k] = replace(views[k], pixels=views[k].pixels + rng.normal(0.0, 2.5, views[k].pixels.shape))
    solution = solve(views, 640, 480)
    assert set(solution.rejected) == {"view 4", "view 13"}
    assert 8 <= solution.corners_left_out <= 16
    assert solution.rms_px < 0.1
    assert np.all(solution.std < 1.5 * clean.std)
    assert_near_truth(solution, focal=0.001, centre_px=0.6, pixel_px=0.08, corner_px=0.5)


def test_views_of_a_video_are_chosen_by_what_they_tell() -> None:
    rng = np.random.default_rng(1)
    dull = views_of(rng, 90, tilt_deg=(0.0, 6.0), aside=0.05)  # straight and in the middle
    telling = views_of(rng, 40)
    blurred = [replace(view, blur_px=6.0) for view in views_of(rng, 12)]
    still = [replace(dull[0], pixels=dull[0].pixels + rng.normal(0, 0.08, dull[0].pixels.shape)) for _ in range(10)]
    views = [replace(v, name=f"frame {k}") for k, v in enumerate([*dull, *telling, *blurred, *still])]
    chosen, rejected = choose_views(views, 640, 480, ChoiceOptions(max_views=25))
    names = {view.name for view in chosen}
    assert len(names) == 25
    assert len(names | set(rejected)) == len(views)
    assert not names & {f"frame {k}" for k in range(130, 142)}
    assert sum(90 <= int(name.split()[1]) < 130 for name in names) >= 14
    assert sum("better view" in reason for reason in rejected.values()) >= 10
    best, first = solve(chosen, 640, 480), solve(views[:25], 640, 480)
    assert best.std[0] < 0.2 * first.std[0]


def test_straight_views_are_not_enough_and_say_so() -> None:
    for seed in range(3):
        views = views_of(np.random.default_rng(seed), 20, tilt_deg=(0.0, 1.0))
        try:
            judged = assess(solve(views, 640, 480))
        except InputError as error:
            assert "tilt it" in str(error)
            continue
        assert judged.grade is Grade.NOT_ENOUGH
        assert judged.focal_u > 0.01
        assert any("tilt the board more" in advice for advice in judged.advice)


def test_views_in_the_middle_are_not_enough_and_say_so() -> None:
    views = views_of(np.random.default_rng(2), 20, aside=0.02)
    small = []
    for view in views:
        keep = np.max(np.abs(view.pixels - [320, 240]), axis=1) < 110
        small.append(replace(view, ids=view.ids[keep], points_in_board=view.points_in_board[keep],
                             pixels=view.pixels[keep]))  # fmt: skip
    judged = assess(solve(small, 640, 480))
    assert judged.grade is Grade.NOT_ENOUGH
    assert judged.coverage < 0.4
    assert any("upper left, upper right, lower left, lower right" in advice for advice in judged.advice)


def test_too_few_views_are_refused() -> None:
    with pytest.raises(InputError, match="only 4 of 4 views"):
        solve(views_of(np.random.default_rng(0), 4), 640, 480)


# --- what goes wrong -----------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    ("spec", "expected"),
    [
        ("charuco:9x8:21:16:DICT_5X5_100", "a board with 11 columns instead of 9"),
        ("charuco:11x8:21:16:DICT_4X4_50", "no marker of DICT_4X4_50 was found, but some of DICT_5X5"),
        ("grid:11x8:16:5:DICT_5X5_100", "needs a ChArUco board"),
    ],
)
def test_another_board_is_named(spec: str, expected: str, pictures: list[np.ndarray], tmp_path: Path) -> None:
    for k, gray in enumerate(pictures[:3]):
        write_photo(tmp_path / f"{k}.jpg", gray)
    with pytest.raises(InputError, match=expected):
        calibrate([tmp_path], parse_board(spec))


@pytest.mark.slow
def test_another_size_of_squares_gives_the_same_camera(pictures: list[np.ndarray]) -> None:
    """Lengths on the board scale the distance and nothing else; a wrong share of the markers hardly matters."""
    cameras = []
    for spec in (SPEC, "charuco:11x8:42:32:DICT_5X5_100", "charuco:11x8:21:15:DICT_5X5_100"):
        finder = BoardFinder(parse_board(spec))
        views = [found for k, g in enumerate(pictures[:12]) if isinstance(found := finder.find(str(k), g), BoardView)]
        cameras.append(solve(views, 640, 480).camera)
    assert np.abs(pixel_difference(cameras[0], cameras[1], GRID)).max() < 0.02
    assert np.median(np.abs(pixel_difference(cameras[0], cameras[2], GRID))) < 0.05


def test_boards_of_old_opencv_are_recognised() -> None:
    board = Board("charuco", 6, 8, 25.0, 18.0, "DICT_5X5_100")
    drawn = cv_board(board)
    drawn.setLegacyPattern(True)
    gray = cv2.copyMakeBorder(drawn.generateImage((360, 480)), 60, 60, 60, 60, cv2.BORDER_CONSTANT, value=255)
    view = BoardFinder(board).find("old", gray)
    assert isinstance(view, BoardView)
    assert len(view.ids) == 35


@pytest.mark.slow
def test_photos_of_several_cameras_and_none_with_a_board(pictures: list[np.ndarray], tmp_path: Path) -> None:
    for k in range(2):
        write_photo(tmp_path / f"a{k}.jpg", pictures[k])
        write_photo(tmp_path / f"b{k}.jpg", cv2.resize(pictures[k], (800, 600)))
    with pytest.raises(InputError, match=r"photos of 2 cameras, zooms or sizes \(2 of .*; 2 of "):
        calibrate([tmp_path], BOARD)
    empty = tmp_path / "empty"
    empty.mkdir()
    with pytest.raises(InputError, match="holds no photos"):
        calibrate([empty], BOARD)
    write_photo(empty / "wall.jpg", np.full((480, 640), 130, np.uint8))
    with pytest.raises(InputError, match="no marker of the board was found in any of 1 picture;"):
        calibrate([empty], BOARD)
    for k in range(3):
        write_photo(empty / f"{k}.jpg", pictures[k])
    with pytest.raises(InputError, match="the board is seen in 3 of 4 pictures, at least 5 are needed"):
        calibrate([empty], BOARD)


@pytest.mark.slow
def test_a_video_and_a_corrupt_one(pictures: list[np.ndarray], tmp_path: Path) -> None:
    images = [cv2.cvtColor(gray, cv2.COLOR_GRAY2RGB) for gray in pictures]
    clip = write_clip(tmp_path / "clip.mp4", images, [0.5 * k for k in range(len(images))], faststart=True)
    result = calibrate([clip], BOARD)
    assert result.sightings.searched >= 20
    assert_near_truth(result.solution, focal=0.002, centre_px=1.0, pixel_px=0.12, corner_px=0.8)
    torn = tmp_path / "torn.mp4"
    torn.write_bytes(clip.read_bytes()[: clip.stat().st_size // 9])
    with pytest.raises(InputError, match=r"torn\.mp4"):
        calibrate([torn], BOARD)
    (tmp_path / "text.mp4").write_text("no video")
    with pytest.raises(InputError, match="not a video"):
        calibrate([tmp_path / "text.mp4"], BOARD)


# --- files ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", sorted(FORMATS))
@pytest.mark.parametrize("camera", [LENS, LENS.without_distortion(), replace(LENS, dist=np.array([0.1, -0.2, 1e-3]))])
def test_every_format_is_read_back(kind: str, camera: Camera, tmp_path: Path) -> None:
    path = tmp_path / "camera"
    write_camera(camera, path, kind, {"lens": {"width": 3, "K": [1]}})
    again = load_camera(path)
    expected = camera.without_distortion() if kind == "bop" else camera
    assert (again.width, again.height) == (640, 480)
    assert np.allclose(numbers(again), numbers(expected), rtol=1e-14, atol=1e-14)


@pytest.mark.slow
def test_profiles_are_found_by_what_pictures_say(photos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ARVIEW_PROFILES", str(tmp_path / "kept"))
    with pytest.raises(InputError, match="there are none in"):
        load_camera("profile:phone")
    arguments = ["calibrate", str(photos), "--board", SPEC, "--profile", "-o", str(tmp_path / "camera.json")]
    done = CliRunner().invoke(main, arguments)
    assert done.exit_code == 0, done.output
    (kept,) = list_profiles()
    assert kept.name == "google-pixel-9-6.9mm-640x480"
    camera = load_camera(f"profile:{kept.name}")
    assert np.array_equal(numbers(camera), numbers(load_camera(tmp_path / "camera.json")))
    # A portrait photo of this phone: the camera is found, and turned with it.
    upright = load_camera("profile", 480, 640, source=photos / "p01.jpg", quarter_turns_clockwise=1)
    assert np.allclose(numbers(upright), numbers(camera.rotated(1)))
    lenses, _ = lenses_of([read_exif(photos / "p00.jpg"), read_exif(photos / "p01.jpg")], "profile")
    for lens, turned in zip(lenses, (camera, camera.rotated(1)), strict=True):
        assert isinstance(lens, Lens)
        assert lens.is_calibrated
        assert np.allclose(numbers(lens.camera), numbers(turned))
    write_photo(tmp_path / "other.jpg", np.zeros((480, 640), np.uint8), model="Pixel 3")
    with pytest.raises(InputError, match=r"none for google-pixel-3-6\.9mm-640x480; there are google-pixel-9"):
        load_camera("profile", 640, 480, source=tmp_path / "other.jpg")
    assert "1 profile in" in CliRunner().invoke(main, ["calibrate", "profiles"]).output


def test_lenses_are_distinguished() -> None:
    phone = PhotoExif(4032, 3024, make="Apple", model="iPhone 12", focal_length_mm=4.2, focal_length_35mm_mm=26.0)
    main_lens = lens_record(phone, 4032, 3024)
    wide = lens_record(replace(phone, focal_length_mm=1.55, focal_length_35mm_mm=13.0), 4032, 3024)
    zoomed = lens_record(replace(phone, digital_zoom=2.0), 4032, 3024)
    cropped = lens_record(phone, 3840, 2160)
    assert profile_name(main_lens) == "apple-iphone-12-4.2mm-4032x3024"
    assert same_lens(main_lens, lens_record(replace(phone, focal_length_mm=4.17), 4032, 3024))
    assert not any(same_lens(main_lens, other) for other in (wide, zoomed, cropped))
    assert not same_lens(lens_record(PhotoExif(10, 10), 10, 10), lens_record(PhotoExif(10, 10), 10, 10))


def test_make_and_model_of_a_video(tmp_path: Path) -> None:
    import av

    path = tmp_path / "clip.mov"
    with av.open(str(path), "w", options={"movflags": "use_metadata_tags"}) as container:
        container.metadata["com.apple.quicktime.make"] = "Apple"
        container.metadata["com.apple.quicktime.model"] = "iPhone 12"
        stream = container.add_stream("mpeg4", rate=30)
        stream.width, stream.height = 64, 48
        for packet in [*stream.encode(av.VideoFrame(64, 48, "yuv420p")), *stream.encode()]:
            container.mux(packet)
    exif = exif_of_video(path, 64, 48)
    assert (exif.make, exif.model, exif.width) == ("Apple", "iPhone 12", 64)


def invoke(*arguments: object) -> tuple[int, str]:
    done = CliRunner().invoke(main, ["calibrate", *map(str, arguments)])
    return done.exit_code, done.output


@pytest.mark.slow
def test_the_commands(photos: Path, tmp_path: Path) -> None:
    code, said = invoke("board", "-o", tmp_path / "board.pdf", "--paper", "A3")
    assert code == 0
    assert (tmp_path / "board.pdf").read_bytes().startswith(b"%PDF-1.7")
    spec = re.search(r"--board (\S+)", said)
    assert spec is not None
    assert parse_board(spec[1]).cell_mm == 32.0
    outputs: Sequence[object] = (
        "-o",
        tmp_path / "a.json",
        "-o",
        f"ros:{tmp_path / 'b.yaml'}",
        "-o",
        tmp_path / "c.txt",
    )
    code, said = invoke("lens", photos, "--board", SPEC, *outputs, "--plot", tmp_path / "plot.svg")
    assert code == 0, said
    assert "verdict: " in said
    assert "left out x_cat.jpg: shows no marker" in said
    cameras = [numbers(load_camera(tmp_path / name)) for name in ("a.json", "b.yaml", "c.txt")]
    assert np.allclose(cameras[0], cameras[1])
    assert np.allclose(cameras[0], cameras[2])
    assert (tmp_path / "plot.svg").read_bytes().startswith(b"<?xml")
    assert invoke(photos, "--board", SPEC)[0] == ExitCode.BAD_INPUT  # nothing to write
    assert invoke(photos, "--board", SPEC, "-o", tmp_path / "a.tiff")[0] == ExitCode.BAD_INPUT
    assert invoke(tmp_path / "nowhere", "--board", SPEC, "-o", tmp_path / "d.json")[0] == ExitCode.BAD_INPUT
    assert not (tmp_path / "d.json").exists()


def test_a_calibration_that_is_not_enough_is_not_written(pictures: list[np.ndarray], tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    for k in range(6):  # nearly straight, small, in the middle
        gray = photograph(BOARD, LENS, pose(BOARD, LENS, rng, (0.0, 4.0), (0.3, 0.35), 0.02), rng)
        write_photo(tmp_path / f"{k}.jpg", gray)
    target = tmp_path / "camera.json"
    code, said = invoke(tmp_path, "--board", SPEC, "-o", target)
    assert code == ExitCode.CANNOT_MEASURE, said
    assert "verdict: not enough" in said
    assert "tilt the board more" in said
    assert not target.exists()
