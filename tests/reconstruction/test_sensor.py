"""Portrait and landscape photos of one phone: one lens, in one orientation relative to the sensor."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from arview.camera import Camera
from arview.geometry import Array, exp_so3, invert, rigid
from arview.reconstruction.features import FeatureOptions
from arview.reconstruction.intake import intake_photos, read_photo
from arview.reconstruction.intake.sensor import share_lenses
from arview.reconstruction.scale.similarity import fit_points
from arview.reconstruction.sparse import SparseOptions, reconstruct_sparse
from helpers.photo_scene import CAMERA, bench, photograph, ring

SENSOR = replace(CAMERA, cx=327.0, cy=233.0)
TURNS = {1: 0.0, 6: 0.5 * np.pi, 8: -0.5 * np.pi, 3: np.pi}
"""By EXIF orientation: how far the phone is turned about its viewing axis, so that the upright picture is upright."""


def taken(folder: Path, orientations: list[int]) -> tuple[list[Array], list[np.ndarray]]:
    """JPEG files as a phone writes them: the sensor's pixels and how to turn them; true poses of the sensor, pixels."""
    folder.mkdir(parents=True)
    poses, pictures = [], []
    for i, (orientation, pose) in enumerate(zip(orientations, ring(len(orientations)), strict=True)):
        rolled = rigid(exp_so3(np.array([0.0, 0.0, -TURNS[orientation]])), np.zeros(3)) @ pose
        picture = photograph(bench(), rolled, SENSOR)
        exif = Image.Exif()
        exif.update({0x010F: "maker", 0x0110: "phone", 0x0112: orientation})
        exif.get_ifd(0x8769).update({0x920A: 4.2, 0xA405: 38})
        Image.fromarray(picture).save(folder / f"img_{i:03d}.jpg", quality=97, subsampling=0, exif=exif)
        poses.append(rolled)
        pictures.append(picture)
    return poses, pictures


def test_upright_pictures_show_the_part_upright(tmp_path: Path) -> None:
    """The test's own convention: turned upright, a portrait photo has the part's vertical axis up in the picture."""
    for orientation in (6, 8, 3):
        poses, _ = taken(tmp_path / str(orientation), [1, orientation, 1])
        up = poses[1][:3, :3] @ [0.0, 0.0, 1.0]  # in the sensor's frame: x right, y down
        turn = {6: 1, 3: 2, 8: 3}[orientation]  # quarter turns clockwise, by which the picture is turned upright
        angle = 0.5 * np.pi * turn
        upright = np.array(
            [np.cos(angle) * up[0] - np.sin(angle) * up[1], np.sin(angle) * up[0] + np.cos(angle) * up[1]]
        )
        assert upright[1] < -0.3 and abs(upright[0]) < 0.05


@pytest.mark.parametrize("orientations", [[1, 6, 1, 6, 1, 8, 3], [6, 6, 1, 6, 8, 6, 6]])
def test_turned_photos_share_the_lens(tmp_path: Path, orientations: list[int]) -> None:
    _, pictures = taken(tmp_path / "photos", orientations)
    before = intake_photos(tmp_path / "photos")
    assert len(before.lenses) == 2 and len(before.photos) == 7
    after = share_lenses(before, tmp_path / "sensor")
    assert len(after.lenses) == 1 and {photo.lens for photo in after.photos} == {after.lenses[0].key}
    assert len({(photo.width, photo.height) for photo in after.photos}) == 1
    assert not any("differs from the other photos" in warning for warning in after.warnings)
    usual = 0 if orientations[0] == 1 else -1  # quarter turns of the most frequent orientation
    for photo, picture in zip(after.photos, pictures, strict=True):
        pixels = read_photo(photo.path)
        assert pixels.shape[:2] == (photo.height, photo.width)
        assert np.abs(pixels.astype(int) - np.rot90(picture, usual)).mean() < 3.0


def test_one_orientation_is_left_alone(tmp_path: Path) -> None:
    taken(tmp_path / "photos", [6, 6, 6, 6])
    before = intake_photos(tmp_path / "photos")
    assert share_lenses(before, tmp_path / "sensor") is before and not (tmp_path / "sensor").exists()


@pytest.mark.slow  # features and matches of ten photos
def test_reconstruction_has_one_camera(tmp_path: Path) -> None:
    poses, _ = taken(tmp_path / "photos", [1, 6] * 6)
    intake = share_lenses(intake_photos(tmp_path / "photos"), tmp_path / "sensor")
    options = SparseOptions(features=FeatureOptions(max_features=2500), first_features=1500, threads=2)
    sparse = reconstruct_sparse(intake.photos, tmp_path / "sparse", options)
    assert len(sparse.photos) == 12
    cameras: list[Camera] = [photo.camera for photo in sparse.photos]
    assert len({(one.width, one.fx, one.cx, one.cy, *one.dist.tolist()) for one in cameras}) == 1
    assert cameras[0].fx == pytest.approx(SENSOR.fx, rel=2e-3)
    assert (cameras[0].cx, cameras[0].cy) == pytest.approx((SENSOR.cx, SENSOR.cy), abs=1.5)
    a = np.array([photo.centre_in_scan for photo in sparse.photos])
    b = np.array([invert(pose)[:3, 3] for pose in poses])
    fit = fit_points(a, b).similarity
    left = fit.scale * a @ fit.model_from_scan[:3, :3].T + fit.model_from_scan[:3, 3] - b
    assert np.median(np.linalg.norm(left, axis=1)) < 0.3
