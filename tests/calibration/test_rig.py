"""Where fixed cameras stand, by a board and by the part, against exact truth."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from arview.calibration import CameraRig, rig_from_board, rig_from_part
from arview.calibration.verdict import Grade
from arview.camera import LensDistortion, LensModel
from arview.errors import InputError
from arview.geometry import Array, exp_se3, invert, log_se3
from helpers.rig_cell import BOARD, CAMERA, Cell, board_shots, cell, names_of, write_pictures

pytestmark = pytest.mark.slow  # two dozen pictures of 2 Mpx

SCENE = cell(9, 4, 3)
LENSES = dict.fromkeys(names_of(SCENE), CAMERA)


@pytest.fixture(scope="module")
def shots(tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, Path]]:
    return board_shots(tmp_path_factory.mktemp("board"), SCENE, 5)


@pytest.fixture(scope="module")
def rig(shots: list[dict[str, Path]]) -> CameraRig:
    return rig_from_board(shots, LENSES, BOARD)


def errors_of(rig: CameraRig, scene: Cell) -> Array:
    """(M,6) twists from the true poses, in the frame in which they are smallest together."""
    frame = invert(scene.cams_from_rig[0]) @ rig.cams_from_rig[0]
    for _ in range(5):
        left = np.array(
            [
                log_se3(invert(true @ frame) @ found)
                for true, found in zip(scene.cams_from_rig, rig.cams_from_rig, strict=True)
            ]
        )
        frame = frame @ exp_se3(left.mean(axis=0))
    return np.array(
        [
            log_se3(found @ invert(true @ frame))
            for true, found in zip(scene.cams_from_rig, rig.cams_from_rig, strict=True)
        ]
    )


def test_a_board_places_the_cameras_within_their_u(rig: CameraRig) -> None:
    errors = errors_of(rig, SCENE)
    turns_deg, shifts_mm = np.rad2deg(np.abs(errors[:, :3])).max(axis=1), np.abs(errors[:, 3:]).max(axis=1)
    assert turns_deg.max() < 0.006 and shifts_mm.max() < 0.04
    assert (turns_deg <= rig.uncertainties[:, 0]).all() and (shifts_mm <= rig.uncertainties[:, 1]).all()
    assert rig.uncertainties[:, 0].max() < 0.02 and rig.uncertainties[:, 1].max() < 0.12, "U is no shrug"
    assert rig.grade == (Grade.GOOD, ()) and rig.shots == (5, 5, 5, 5)


def test_a_rig_is_kept_in_a_file(rig: CameraRig, tmp_path: Path) -> None:
    path = tmp_path / "rig.json"
    rig.save(path)
    again = CameraRig.load(path)
    assert again.names == rig.names and repr(again.cameras) == repr(rig.cameras) and again.created == rig.created
    assert np.allclose(again.cameras[2].dist, CAMERA.dist)
    assert np.allclose(again.cams_from_rig, rig.cams_from_rig) and np.allclose(again.covariance, rig.covariance)
    path.write_text(path.read_text()[:-200])
    with pytest.raises(InputError, match=r"rig\.json: is no rig of cameras, or is damaged .*calibrate again"):
        CameraRig.load(path)
    with pytest.raises(InputError, match="station calibrate"):
        CameraRig.load(tmp_path / "none.json")


def test_a_camera_that_sees_the_board_alone_is_named(shots: list[dict[str, Path]]) -> None:
    """Of camera 4 only the shots are left that no other camera has, and the reverse."""
    apart = [{k: v for k, v in shot.items() if (k == "cam_4") == (i < 2)} for i, shot in enumerate(shots)]
    with pytest.raises(InputError, match="cam_4: sees the board in no shot together with the other cameras"):
        rig_from_board(apart, LENSES, BOARD)


def test_few_shots_are_said(shots: list[dict[str, Path]]) -> None:
    grade, reasons = rig_from_board(shots[:3], LENSES, BOARD).grade
    assert grade is Grade.USABLE and "fewer than 5 shots" in reasons[0]


def test_the_part_places_the_cameras_within_their_u(tmp_path: Path) -> None:
    write_pictures(tmp_path, SCENE, 0)
    rig = rig_from_part([{name: tmp_path / name / "part_000.png" for name in LENSES}], LENSES, SCENE.part)
    errors = errors_of(rig, SCENE)
    assert np.rad2deg(np.abs(errors[:, :3])).max() < 0.03 and np.abs(errors[:, 3:]).max() < 0.25
    assert (np.rad2deg(np.abs(errors[:, :3])).max(axis=1) <= rig.uncertainties[:, 0]).all()
    assert max(rig.residuals_px) < 0.1
    with pytest.raises(InputError, match="the part is not found in the picture of the camera cam_1"):
        blank = {**{name: tmp_path / name / "part_000.png" for name in LENSES}, "cam_1": tmp_path / "blank.png"}
        import cv2

        cv2.imwrite(str(blank["cam_1"]), np.full((CAMERA.height, CAMERA.width), 90, dtype=np.uint8))
        rig_from_part([blank], LENSES, SCENE.part)


def test_a_lens_that_is_not_browns_is_refused() -> None:
    fisheye = replace(
        CAMERA, fx=600.0, fy=600.0, dist=np.zeros(5), lens=LensDistortion(LensModel.FISHEYE, (0.05, 0.01))
    )
    shot = {name: Path(f"{name}.png") for name in LENSES}
    with pytest.raises(InputError, match="cam_2: the lens model fisheye"):
        rig_from_part([shot], {**LENSES, "cam_2": fisheye}, SCENE.part)
