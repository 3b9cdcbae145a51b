"""Calibration from rendered boards without markers, with known intrinsics; what is said when it does not work."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from click.testing import CliRunner

from arview.calibration.board_view import BoardView
from arview.calibration.plain_boards import PlainBoardFinder, points_of, with_centres
from arview.calibration.run import calibrate, record_of
from arview.calibration.solve import Solution, picture_grid, pixel_uncertainty, solve
from arview.camera import Camera
from arview.camera.read import load_camera
from arview.cli import ExitCode, main
from arview.errors import InputError
from arview.fiducials.board import Board, parse_board, spec_of
from arview.geometry import Array, apply
from helpers.board_scene import BOARD, LENS, circle_radius_mm, photograph, pose
from helpers.lens_difference import pixel_difference

CHECKERBOARD = parse_board("checkerboard:9x6:24")
CIRCLES = parse_board("circles:9x7:24")
GRID = picture_grid(LENS.width, LENS.height)


def poses_of(board: Board, count: int, seed: int, aside: float = 0.3) -> list[Array]:
    """Views in which the whole board is in the picture, out to its border."""
    rng = np.random.default_rng(seed)
    poses: list[Array] = []
    while len(poses) < count:
        one = pose(board, LENS, rng, fill=(0.35, 0.7), aside=aside)
        pixels = truth(board, one)
        if np.all((pixels > 20) & (pixels < np.array([LENS.width - 21, LENS.height - 21]))):
            poses.append(one)
    return poses


def truth(board: Board, cam_from_board: Array, camera: Camera = LENS) -> Array:
    return camera.project(apply(cam_from_board, points_of(board)))


def found_in(board: Board, poses: list[Array], seed: int = 0) -> list[BoardView]:
    rng, finder = np.random.default_rng(seed), PlainBoardFinder(board)
    found = [finder.find(f"view {k}", photograph(board, LENS, one, rng)) for k, one in enumerate(poses)]
    return [view for view in found if isinstance(view, BoardView)]


def rms_to(pixels: Array, places: Array) -> float:
    """Root mean square distance to the nearest of the places, each of which must be met once."""
    away = np.linalg.norm(pixels[:, None] - places, axis=2)
    assert sorted(away.argmin(axis=1)) == list(range(len(places)))
    return float(np.sqrt(np.mean(away.min(axis=1) ** 2)))


def assert_near_truth(solution: Solution, focal: float, k1: float, pixel_px: float) -> None:
    camera = solution.camera
    assert abs(camera.fx / LENS.fx - 1.0) < focal
    assert abs(camera.fy / LENS.fy - 1.0) < focal
    assert abs(camera.dist[0] - LENS.dist[0]) < k1
    off = np.linalg.norm(pixel_difference(LENS, camera, GRID), axis=1)
    assert np.median(off) < pixel_px
    assert (
        np.mean(off <= 1.5 * pixel_uncertainty(solution, GRID)) >= 0.8
    )  # k = 3: all pixels of one solution err together
    errors = np.array([camera.fx, camera.fy, camera.cx, camera.cy, *camera.dist]) - np.array(
        [LENS.fx, LENS.fy, LENS.cx, LENS.cy, *LENS.dist]
    )
    assert np.count_nonzero(np.abs(errors) <= 2.0 * solution.std) >= 7


# --- the camera ----------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("spec", ["checkerboard:9x6:24", "checkerboard:8x6:24", "checkerboard:7x7:24"])
def test_checkerboards_also_those_that_look_alike_upside_down(spec: str) -> None:
    board = parse_board(spec)
    poses = poses_of(board, 20, seed=4)
    views = found_in(board, poses)
    assert len(views) >= 18
    for view in views:
        assert rms_to(view.pixels, truth(board, poses[int(view.name.split()[1])])) < 0.25
    assert_near_truth(solve(views, 640, 480), focal=0.002, k1=0.008, pixel_px=0.2)


@pytest.mark.slow
@pytest.mark.parametrize("spec", ["circles:9x7:24", "circles:6x6:24", "acircles:4x11:12", "acircles:5x8:16"])
def test_circle_grids_without_the_shift_by_perspective(spec: str) -> None:
    board = parse_board(spec)
    poses = poses_of(board, 20, seed=6)
    views = found_in(board, poses)
    assert len(views) >= 17
    assert np.median([view.radius_mm for view in views]) == pytest.approx(circle_radius_mm(board), rel=0.02)
    raw = solve(views, 640, 480)
    centred = [with_centres(view, raw.camera) for view in views]
    places = [truth(board, poses[int(view.name.split()[1])]) for view in views]
    before = np.median([rms_to(view.pixels, place) for view, place in zip(views, places, strict=True)])
    after = np.median([rms_to(view.pixels, place) for view, place in zip(centred, places, strict=True)])
    assert after < 0.04 < before  # px: perspective shifts the centroids by up to 0.5
    solution = solve(centred, 640, 480)
    assert_near_truth(solution, focal=0.0006, k1=0.004, pixel_px=0.1)
    assert solution.rms_px < 0.04


@pytest.mark.slow
def test_blur_and_noise_are_in_u() -> None:
    rng = np.random.default_rng(9)
    finder = PlainBoardFinder(CHECKERBOARD)
    views = []
    for k, one in enumerate(poses_of(CHECKERBOARD, 20, seed=8)):
        soft = photograph(CHECKERBOARD, LENS, one, rng, blur_px=1.6, noise=9.0) * 0.6 + 20.0
        view = finder.find(str(k), np.clip(soft, 0, 255).astype(np.uint8))
        views += [view] if isinstance(view, BoardView) else []
    assert len(views) >= 15
    solution = solve(views, 640, 480)
    assert 0.1 < solution.rms_px < 0.4
    assert_near_truth(solution, focal=0.008, k1=0.03, pixel_px=0.8)


@pytest.mark.slow
@pytest.mark.parametrize("board", [CHECKERBOARD, CIRCLES])
def test_a_folder_of_photos(board: Board, tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    for k, one in enumerate(poses_of(board, 16, seed=1)):
        cv2.imwrite(str(tmp_path / f"p{k:02}.png"), photograph(board, LENS, one, rng))
    whole = photograph(board, LENS, poses_of(board, 1, seed=1, aside=0.02)[0], rng)
    cut = whole.copy()
    cut[:, :290] = 110
    cv2.imwrite(str(tmp_path / "x_cut.png"), cut)
    cv2.imwrite(str(tmp_path / "x_wall.png"), rng.integers(90, 130, (480, 640), dtype=np.uint8))
    result = calibrate([tmp_path], board)
    assert_near_truth(result.solution, focal=0.003, k1=0.01, pixel_px=0.35)
    left_out = {name: result.rejected[name] for name in ("x_cut.png", "x_wall.png")}
    if board is CHECKERBOARD:
        assert "inner corners of a checkerboard; all 9×6 must be seen" in left_out["x_cut.png"]
        assert left_out["x_wall.png"] == "shows no checkerboard of 9×6 inner corners"
    else:
        assert set(left_out.values()) == {"does not show all 9×7 circles of the grid"}
    assert record_of(result)["calibration"]["board"] == spec_of(board)
    target = tmp_path / "camera.json"
    done = CliRunner().invoke(main, ["calibrate", str(tmp_path), "--board", spec_of(board), "-o", str(target)])
    assert done.exit_code == ExitCode.DONE, done.output
    assert load_camera(target).fx == pytest.approx(result.camera.fx)


# --- finding -------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_large_and_dim_pictures_light_circles_and_swapped_counts() -> None:
    rng = np.random.default_rng(0)
    one = poses_of(CHECKERBOARD, 1, seed=3)[0]
    large = Camera(1800, 1349, LENS.fx * 2.8, LENS.fy * 2.8, LENS.cx * 2.8, LENS.cy * 2.8, LENS.dist)
    for board, px in ((CHECKERBOARD, 0.25), (CIRCLES, 0.5)):  # of circles, centroids
        view = PlainBoardFinder(board).find("large", photograph(board, large, one, rng, blur_px=1.2))
        assert isinstance(view, BoardView)
        assert rms_to(view.pixels, truth(board, one, large)) < px
    light = PlainBoardFinder(CIRCLES).find("light", 255 - photograph(CIRCLES, LENS, one, rng))
    assert isinstance(light, BoardView)
    assert light.radius_mm == pytest.approx(6.0, rel=0.03)
    dim = photograph(CHECKERBOARD, LENS, one, rng, noise=6.0, ground=25.0) * 0.4  # before a dark, noisy wall
    seen_dim = PlainBoardFinder(CHECKERBOARD).find("dim", dim.astype(np.uint8))
    assert isinstance(seen_dim, BoardView)
    assert rms_to(seen_dim.pixels, truth(CHECKERBOARD, one)) < 0.25
    picture = photograph(CHECKERBOARD, LENS, one, rng)
    swapped = PlainBoardFinder(parse_board("checkerboard:6x9:24")).find("swapped", picture)
    assert isinstance(swapped, BoardView)
    assert rms_to(swapped.pixels, truth(CHECKERBOARD, one)) < 0.25
    homography, _ = cv2.findHomography(swapped.points_in_board[:, :2], swapped.pixels)
    there = cv2.perspectiveTransform(swapped.points_in_board[None, :, :2], homography)[0]
    assert np.abs(there - swapped.pixels).max() < 8.0  # distortion; another order is off by a board


@pytest.mark.slow
@pytest.mark.parametrize("spec", ["checkerboard:8x6:24", "checkerboard:7x7:24", "circles:7x7:24"])
def test_corners_keep_their_numbers_while_the_camera_rolls(spec: str) -> None:
    board, rng = parse_board(spec), np.random.default_rng(0)
    start = poses_of(board, 1, seed=5, aside=0.02)[0]
    finder = PlainBoardFinder(board)
    before, seen = None, 0
    for degrees in range(0, 360, 15):
        turn = np.eye(4)
        c, s = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
        turn[:2, :2] = [[c, -s], [s, c]]
        view = finder.find(str(degrees), photograph(board, LENS, turn @ start, rng))
        if not isinstance(view, BoardView):
            continue
        seen += 1
        if before is not None and degrees - before[0] == 15:
            assert np.linalg.norm(view.pixels - before[1], axis=1).max() < 90.0  # px; a half turn moves corners by 250
        before = (degrees, view.pixels)
    assert seen >= 16


# --- what goes wrong -----------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seen", "spec", "expected"),
    [
        (
            "checkerboard:9x6:24",
            "charuco:11x8:21:16:DICT_5X5_100",
            "a checkerboard without markers is seen, with 9×6 inner corners .* --board checkerboard:9x6:SQUARE_MM",
        ),
        (
            "checkerboard:9x6:24",
            "checkerboard:10x7:24",
            r"a checkerboard of 9×6 inner corners is seen in [4-6] of 6 pictures, nowhere 10×7; correct --board",
        ),
        (
            "checkerboard:9x6:24",
            "circles:9x7:24",
            "no circle grid 9×7, 24 mm with all its circles was found in any of 6",
        ),
        (spec_of(BOARD), "acircles:4x11:16", "markers of DICT_5X5_250 are seen; give the board as --board charuco:"),
        ("circles:9x7:24", "checkerboard:9x6:24", "no checkerboard 9×6, 24 mm with all its inner corners was found"),
    ],
)
def test_another_board_is_named(seen: str, spec: str, expected: str, tmp_path: Path) -> None:
    board, rng = parse_board(seen), np.random.default_rng(0)
    for k in range(6):
        one = pose(board, LENS, rng, tilt_deg=(5.0, 15.0), fill=(0.5, 0.6), aside=0.02)
        cv2.imwrite(str(tmp_path / f"{k}.png"), photograph(board, LENS, one, rng))
    with pytest.raises(InputError, match=expected) as raised:
        calibrate([tmp_path], parse_board(spec))
    assert "\n" not in str(raised.value)


def test_specs() -> None:
    assert parse_board("checkerboard:9x6:25") == Board("checkerboard", 9, 6, 25.0)
    assert parse_board("Circles:9x7:24.5").cell_mm == 24.5
    for spec in ("checkerboard:9x6:25", "circles:9x7:24.5", "acircles:4x11:20", "grid:5x7:30:6:DICT_5X5_100"):
        assert spec_of(parse_board(spec)) == spec
    np.testing.assert_array_equal(
        points_of(parse_board("acircles:4x11:20"))[[0, 1, 4]], [[0, 0, 0], [40, 0, 0], [20, 20, 0]]
    )
    for spec, message in (
        ("checkerboard:9x6", "expected charuco:.*checkerboard:COLUMNSxROWS:SQUARE_MM"),
        ("checkerboard:9x6:25:18:DICT_5X5_100", "expected charuco"),
        ("checkerboard:2x6:25", "at least 3×3"),
        ("circles:9x7:0", "not a positive length"),
    ):
        with pytest.raises(InputError, match=message):
            parse_board(spec)
    done = CliRunner().invoke(main, ["calibrate", "photos", "--board", "checkerboard:9x6", "-o", "c.json"])
    assert done.exit_code == ExitCode.BAD_INPUT
