"""Calibration of fisheye lenses, from corners and from rendered boards, and which lens model is recommended."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from click.testing import CliRunner

from arview.calibration.board_view import BoardView
from arview.calibration.lens_comparison import compare_lenses
from arview.calibration.projection import CalibratedLens, fisheye_camera, intrinsics_of, project
from arview.calibration.run import calibrate
from arview.calibration.solve import picture_grid, pixel_uncertainty, seen_by_lens, solve
from arview.calibration.verdict import Grade, assess
from arview.camera import Camera
from arview.camera.lens import LensDistortion, LensModel
from arview.camera.read import load_camera
from arview.camera.write import FORMATS, write_camera
from arview.cli import ExitCode, main
from arview.errors import InputError
from arview.fiducials.board import cv_board, spec_of
from arview.geometry import Array, exp_so3, rigid
from helpers.board_scene import BOARD, LENS, photograph, pose, wide_pose
from helpers.lens_difference import pixel_difference

FISHEYE = Camera(
    960, 720, 315.0, 316.0, 483.0, 352.5, lens=LensDistortion(LensModel.FISHEYE, (-0.021, 0.0061, -0.0034, 0.0007))
)
"""An action camera: 170° across."""
CORNERS = np.asarray(cv_board(BOARD).getChessboardCorners(), dtype=np.float64)


def corners_of(camera: Camera, rng: np.random.Generator, count: int, noise_px: float = 0.1) -> list[BoardView]:
    views: list[BoardView] = []
    while len(views) < count:
        cam_from_board = wide_pose(BOARD, rng) if camera.lens else pose(BOARD, camera, rng, aside=0.42)
        points = CORNERS @ cam_from_board[:3, :3].T + cam_from_board[:3, 3]
        pixels = project(CORNERS, camera, cam_from_board)[0]
        seen = (points[:, 2] > 0.15 * np.linalg.norm(points, axis=1)) & np.all(
            (pixels > 4) & (pixels < [camera.width - 5, camera.height - 5]), axis=1
        )
        if np.count_nonzero(seen) >= 15:
            found = pixels[seen] + rng.normal(0.0, noise_px, (np.count_nonzero(seen), 2))
            views.append(BoardView(f"view {len(views)}", np.flatnonzero(seen), CORNERS[seen], found))
    return views


def seen_grid() -> Array:
    grid = picture_grid(FISHEYE.width, FISHEYE.height, 17, 13)
    return grid[seen_by_lens(FISHEYE, FISHEYE.unproject(grid))]


def test_projection_is_that_of_opencv_and_its_derivatives_are_right() -> None:
    cam_from_board = rigid(exp_so3([0.1, 0.2, 0.3]), np.array([50.0, -30.0, 200.0]))
    pixels, by_intrinsics, by_pose = project(CORNERS, FISHEYE, cam_from_board)
    assert FISHEYE.lens is not None
    turn, shift = cv2.Rodrigues(cam_from_board[:3, :3])[0], cam_from_board[:3, 3]
    expected = cv2.fisheye.projectPoints(CORNERS[:, None], turn, shift, FISHEYE.matrix, np.array(FISHEYE.lens.terms))
    np.testing.assert_allclose(pixels, expected[0][:, 0], rtol=0, atol=1e-9)
    values = intrinsics_of(FISHEYE)
    for k in range(8):
        step = np.eye(8)[k] * 1e-5
        ends = [project(CORNERS, fisheye_camera(960, 720, values + sign * step), cam_from_board)[0] for sign in (1, -1)]
        np.testing.assert_allclose((ends[0] - ends[1]).ravel() / 2e-5, by_intrinsics[:, k], atol=1e-5)
    for k in range(6):
        step = np.eye(6)[k] * 1e-6
        moved = [rigid(exp_so3(sign * step[:3]) @ cam_from_board[:3, :3], shift + sign * step[3:]) for sign in (1, -1)]
        ends = [project(CORNERS, FISHEYE, one)[0] for one in moved]
        np.testing.assert_allclose((ends[0] - ends[1]).ravel() / 2e-6, by_pose[:, k], atol=1e-4)


@pytest.mark.slow
def test_u_of_a_fisheye_holds_the_truth_as_often_as_it_says() -> None:
    """12 calibrations from corners with noise of 0.1 px: 96 numbers, and the places of rays."""
    z, within, off_px = [], [], []
    grid = seen_grid()
    for seed in range(12):
        solution = solve(corners_of(FISHEYE, np.random.default_rng(seed), 18), 960, 720, lens=CalibratedLens.FISHEYE)
        assert not solution.rejected
        z.append((intrinsics_of(solution.camera) - intrinsics_of(FISHEYE)) / solution.std)
        off = np.linalg.norm(pixel_difference(FISHEYE, solution.camera, grid), axis=1)
        known = pixel_uncertainty(solution, grid)
        off_px.append(off)
        within.append(off[np.isfinite(known)] <= known[np.isfinite(known)])
        assert assess(solution).grade is Grade.GOOD
    assert 0.88 <= np.mean(np.abs(z) <= 2.0) <= 0.99
    assert 0.88 <= np.mean(np.concatenate(within)) <= 1.0
    assert np.median(off_px) < 0.08
    assert np.max(off_px) < 0.5


def test_wrong_corners_and_views_of_a_fisheye_are_left_out() -> None:
    rng = np.random.default_rng(3)
    views = corners_of(FISHEYE, rng, 20)
    for k in (2, 7, 11):
        pixels = views[k].pixels.copy()
        pixels[rng.integers(0, len(pixels), 2)] += rng.normal(0.0, 15.0, (2, 2))
        views[k] = replace(views[k], pixels=pixels)
    views[4] = replace(views[4], pixels=views[4].pixels + rng.normal(0.0, 2.5, views[4].pixels.shape))
    solution = solve(views, 960, 720, lens=CalibratedLens.FISHEYE)
    assert set(solution.rejected) == {"view 4"}
    assert solution.corners_left_out >= 4
    off = np.linalg.norm(pixel_difference(FISHEYE, solution.camera, seen_grid()), axis=1)
    assert off.max() < 0.6


def test_the_lens_model_that_fits_is_recommended() -> None:
    rng = np.random.default_rng(1)
    wide, narrow = corners_of(FISHEYE, rng, 16), corners_of(LENS, rng, 16)
    found = compare_lenses(wide, 960, 720, CalibratedLens.BROWN)
    assert found.is_other_better
    assert found.other_px < 0.25 < found.used_px
    assert found.advice.startswith("calibrate with --lens fisheye: ")
    assert not compare_lenses(wide, 960, 720, CalibratedLens.FISHEYE).is_other_better
    assert not compare_lenses(narrow, 640, 480, CalibratedLens.BROWN).is_other_better
    skewed = replace(LENS, dist=LENS.dist + np.array([0, 0, 0.02, -0.02, 0]))  # tangential, which a fisheye has not
    told = compare_lenses(corners_of(skewed, rng, 16), 640, 480, CalibratedLens.FISHEYE)
    assert told.advice.startswith("calibrate with --lens brown: ")


@pytest.mark.slow
def test_pictures_of_a_fisheye(tmp_path: Path) -> None:
    """22 rendered pictures with blur and noise: the camera, and the command with either lens."""
    rng = np.random.default_rng(11)
    folder = tmp_path / "photos"
    folder.mkdir()
    for k in range(22):
        picture = photograph(BOARD, FISHEYE, wide_pose(BOARD, rng, 55.0), rng)
        cv2.imwrite(str(folder / f"p{k:02}.png"), picture)
    result = calibrate([folder], BOARD, lens=CalibratedLens.FISHEYE)
    camera = result.camera
    assert len(result.solution.views) >= 17
    assert abs(camera.fx / FISHEYE.fx - 1.0) < 0.002
    assert np.hypot(camera.cx - FISHEYE.cx, camera.cy - FISHEYE.cy) < 0.5
    off = np.linalg.norm(pixel_difference(FISHEYE, camera, seen_grid()), axis=1)
    assert np.median(off) < 0.12
    assert off.max() < 0.8
    assert result.verdict.grade in (Grade.GOOD, Grade.USABLE)
    target = tmp_path / "camera.json"
    arguments = ["calibrate", str(folder), "--board", spec_of(BOARD), "-o", str(target)]
    done = CliRunner().invoke(main, [*arguments, "--lens", "fisheye", "--plot", str(tmp_path / "plot.png")])
    assert done.exit_code == ExitCode.DONE, done.output
    assert "lens (fisheye): k1 " in done.output
    again = load_camera(target)
    assert again.lens is not None
    np.testing.assert_allclose(intrinsics_of(again), intrinsics_of(camera), rtol=1e-12)
    brown = CliRunner().invoke(main, [*arguments[:-1], str(tmp_path / "brown.json"), "--anyway"])
    assert "--lens fisheye" in brown.output
    assert "verdict: good" not in brown.output


@pytest.mark.parametrize("kind", sorted(set(FORMATS) - {"bop"}))
@pytest.mark.parametrize("lens", [
    FISHEYE.lens, LensDistortion(LensModel.RATIONAL, (0.5, -2.7, 1e-3, -2e-4, 1.5, 0.4, -2.5, 1.4)),
    LensDistortion(LensModel.RATIONAL, (0.5, -2.7, 1e-3, -2e-4, 1.5, 0.4, -2.5, 1.4, 1e-3, 2e-3, -1e-3, 5e-4)),
    LensDistortion(LensModel.FOV, (0.9,)), LensDistortion(LensModel.DIVISION, (-0.2,)),
])  # fmt: skip
def test_lenses_are_read_back_or_refused(kind: str, lens: LensDistortion, tmp_path: Path) -> None:
    camera = replace(FISHEYE, lens=lens)
    holds = kind in ("arview", "colmap") or lens.model in (LensModel.FISHEYE, LensModel.RATIONAL)
    if not holds or (kind == "colmap" and any(lens.terms[8:])):
        with pytest.raises(InputError, match=f"camera format {kind}: the lens model {lens.model}"):
            write_camera(camera, tmp_path / "camera", kind)
        return
    write_camera(camera, tmp_path / "camera", kind)
    again = load_camera(tmp_path / "camera")
    assert again.lens is not None
    assert again.lens.model is lens.model
    np.testing.assert_allclose(again.lens.terms, lens.terms, rtol=1e-14)
    np.testing.assert_allclose(intrinsics_of_any(again), intrinsics_of_any(camera), rtol=1e-14)


def intrinsics_of_any(camera: Camera) -> Array:
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy])
