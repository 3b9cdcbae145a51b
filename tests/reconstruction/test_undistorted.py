"""Photos of lenses that reconstruction does not know become photos of a pinhole camera."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from arview.camera import Camera
from arview.camera.lens import LensDistortion, LensModel
from arview.camera.read import save_camera
from arview.errors import InputError
from arview.reconstruction.colmap import colmap_camera
from arview.reconstruction.intake import intake_photos, read_photo, undistort_photos

FISHEYE = Camera(640, 480, 400.0, 400.0, 322.0, 238.0, lens=LensDistortion(LensModel.FISHEYE, (0.02, 0.01)))


def photos(folder: Path, count: int) -> Path:
    """Photos of a black disc on noise, at a different pixel in each."""
    folder.mkdir()
    rng = np.random.default_rng(3)
    for index in range(count):
        picture = cv2.resize(rng.integers(90, 255, (120, 160, 3), dtype=np.uint8), (640, 480))
        cv2.circle(picture, (120 + 100 * index, 150 + 40 * index), 9, (0, 0, 0), -1, cv2.LINE_AA)
        cv2.imwrite(str(folder / f"{index}.png"), picture)
    return folder


@pytest.mark.slow
def test_photos_of_a_fisheye_are_copied_as_a_pinhole_camera_sees_them(tmp_path: Path) -> None:
    save_camera(FISHEYE, tmp_path / "fisheye.json")
    intake = intake_photos(photos(tmp_path / "photos", 4), tmp_path / "fisheye.json")
    found = undistort_photos(intake, tmp_path / "copies")
    assert len(found.photos) == 4
    for index, photo in enumerate(found.photos):
        assert photo.is_calibrated and not photo.camera.is_distorted
        pixels = read_photo(photo.path)
        assert pixels.shape == (photo.height, photo.width, 3) == (photo.camera.height, photo.camera.width, 3)
        # The disc is seen along the same ray.
        dark = np.argwhere(pixels.max(axis=2) < 30)
        assert len(dark) > 100
        ray = FISHEYE.unproject([120.0 + 100 * index, 150.0 + 40 * index])
        np.testing.assert_allclose(dark.mean(axis=0)[::-1], photo.camera.project(ray), atol=0.6)
        assert colmap_camera(photo.camera, True).model.name == "FULL_OPENCV"
    with pytest.raises(InputError, match="reconstruction: the lens model fisheye"):
        colmap_camera(intake.photos[0].camera, True)


@pytest.mark.slow
def test_photos_of_other_cameras_stay_as_they_are(tmp_path: Path) -> None:
    mild = Camera(
        640, 480, 900.0, 900.0, 322.0, 238.0, lens=LensDistortion(LensModel.RATIONAL, (0.1, 0, 0, 0, 0, 0.05))
    )
    save_camera(mild, tmp_path / "mild.json")
    intake = intake_photos(photos(tmp_path / "photos", 3), tmp_path / "mild.json")
    assert [photo.camera.lens for photo in intake.photos] == [None] * 3
    assert all(photo.camera.dist[0] != 0.0 for photo in intake.photos)
    assert undistort_photos(intake, tmp_path / "copies") is intake
    assert not (tmp_path / "copies").exists()
