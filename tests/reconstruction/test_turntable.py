"""A part that turns before a still camera: its background is recognised and left out, by itself or by masks."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from arview.cad.model import Model, make_model
from arview.camera import Camera
from arview.errors import InputError
from arview.geometry import invert
from arview.reconstruction.features import FeatureOptions, Features, find_features
from arview.reconstruction.intake import intake_photos
from arview.reconstruction.intake.masks import read_mask, with_masks
from arview.reconstruction.scale.similarity import fit_points
from arview.reconstruction.sparse import SparseOptions, reconstruct_sparse
from arview.reconstruction.still import still_features, still_remark
from arview.reconstruction.types import Photo, SparseModel
from helpers.photo_scene import CAMERA, Picture, bench, photograph, ring, write_photos

OPTIONS = SparseOptions(features=FeatureOptions(max_features=2000), first_features=1500, threads=2)
POSES = ring(16, 420.0, (40.0,))
"""The part turns by 22.5° between two photos: what the camera on its stand sees of it."""


def turning_part() -> Model:
    """The plate with its blocks, without the bench, which does not turn."""
    return make_model("part", bench().components[1:])


def still_wall(seed: int = 3) -> np.ndarray:
    """(H,W) grey values of a wall with texture at several sizes."""
    rng = np.random.default_rng(seed)
    wall = np.full((CAMERA.height, CAMERA.width), 120.0)
    for step, weight in ((64, 30.0), (24, 30.0), (8, 30.0), (4, 20.0)):
        small = rng.uniform(-1.0, 1.0, (CAMERA.height // step + 2, CAMERA.width // step + 2))
        wall += weight * cv2.resize(small, (CAMERA.width, CAMERA.height), interpolation=cv2.INTER_CUBIC)
    return wall


@cache
def turntable(count: int = len(POSES)) -> tuple[list[Picture], list[np.ndarray]]:
    """Photos of the turning part before the wall, with new noise in each, and where the part is in them."""
    wall, rng = still_wall(), np.random.default_rng(8)
    pictures, parts = [], []
    for pose in POSES[:count]:
        clean = photograph(turning_part(), pose, noise=0.0)
        part = cv2.erode((np.abs(clean[..., 0].astype(int) - 30) > 0).astype(np.uint8), np.ones((3, 3))) > 0
        grey = np.where(part, clean[..., 0], wall) + rng.normal(0.0, 2.0, part.shape)
        pictures.append(np.repeat(np.clip(grey, 0, 255).astype(np.uint8)[..., None], 3, axis=2))
        parts.append(part)
    return pictures, parts


def photos_of(paths: list[Path], masks: list[Path] | None = None) -> list[Photo]:
    guess = Camera(CAMERA.width, CAMERA.height, 740.0, 740.0, CAMERA.cx, CAMERA.cy)
    return [
        Photo(path.name, path, guess.width, guess.height, "lens", guess, mask=None if masks is None else masks[i])
        for i, path in enumerate(paths)
    ]


def centre_errors_mm(sparse: SparseModel) -> np.ndarray:
    """Distance of each camera centre from its true one, relative to the part, after a similarity fit."""
    true = {f"img_{i:03d}.png": invert(pose)[:3, 3] for i, pose in enumerate(POSES)}
    a = np.array([photo.centre_in_scan for photo in sparse.photos])
    b = np.array([true[photo.name] for photo in sparse.photos])
    fit = fit_points(a, b).similarity
    return np.linalg.norm(fit.scale * a @ fit.model_from_scan[:3, :3].T + fit.model_from_scan[:3, 3] - b, axis=1)


@pytest.mark.slow  # features of eight photos
def test_still_features_are_those_of_the_wall() -> None:
    pictures, parts = turntable(8)
    features = [find_features(picture, OPTIONS.features) for picture in pictures]
    still = still_features(features)
    wall_found, part_dropped = [], []
    for found, dropped, part in zip(features, still, parts, strict=True):
        column, row = np.rint(found.points_px).astype(int).T
        inner = cv2.erode(part.astype(np.uint8), np.ones((25, 25)))[row, column] > 0
        outer = cv2.dilate(part.astype(np.uint8), np.ones((45, 45)))[row, column] == 0
        wall_found.append(np.mean(dropped[outer & (found.sizes_px < 12)]))
        part_dropped.append(np.mean(dropped[inner]))
    assert np.mean(wall_found) > 0.75 and np.mean(part_dropped) < 0.01
    assert "turntable" in still_remark(features, still)


@pytest.mark.slow  # features of eight photos
def test_a_walk_around_a_part_has_no_still_features() -> None:
    features = [find_features(photograph(bench(), pose), OPTIONS.features) for pose in ring(8)]
    still = still_features(features)
    assert sum(len(one) for one in features) > 4000
    assert np.mean(np.concatenate(still)) < 0.005 and still_remark(features, still) == ""


@pytest.mark.slow  # features and matches of all photos
def test_turntable_is_placed_by_the_part(tmp_path: Path) -> None:
    paths = write_photos(tmp_path / "photos", turntable()[0])
    sparse = reconstruct_sparse(photos_of(paths), tmp_path / "sparse", OPTIONS)
    assert len(sparse.photos) >= 14
    assert np.median(centre_errors_mm(sparse)) < 1.0
    assert any("stand still" in remark for remark in sparse.remarks)


@pytest.mark.slow  # features and matches of all photos
def test_turntable_is_placed_with_masks(tmp_path: Path) -> None:
    pictures, parts = turntable()
    paths = write_photos(tmp_path / "photos", pictures)
    masks = [tmp_path / f"{path.name}.png" for path in paths]
    for path, part in zip(masks, parts, strict=True):
        cv2.imwrite(str(path), part.astype(np.uint8) * 255)
    sparse = reconstruct_sparse(photos_of(paths, masks), tmp_path / "sparse", OPTIONS)
    assert len(sparse.photos) >= 14
    assert np.median(centre_errors_mm(sparse)) < 1.0
    for photo, mask in zip(sparse.photos, sparse.photos, strict=True):
        assert photo.mask is not None and mask.mask == tmp_path / f"{photo.name}.png"


def test_masks_are_found_by_name_and_checked(tmp_path: Path) -> None:
    paths = write_photos(tmp_path / "photos", [photograph(bench(), pose) for pose in ring(4)])
    intake = intake_photos(tmp_path / "photos")
    masks = tmp_path / "masks"
    with pytest.raises(InputError, match="no such folder"):
        with_masks(intake, masks)
    masks.mkdir()
    with pytest.raises(InputError, match=r"img_000\.png\.png"):
        with_masks(intake, masks)
    half = np.zeros((CAMERA.height // 2, CAMERA.width // 2), np.uint8)
    half[:, : CAMERA.width // 4] = 255
    cv2.imwrite(str(masks / f"{paths[0].name}.png"), half)  # half the size is scaled to the photo
    found = with_masks(intake, masks)
    assert any("3 of 4 photos have no mask" in warning for warning in found.warnings)
    mask = read_mask(found.photos[0])
    assert mask is not None and mask.shape == (CAMERA.height, CAMERA.width)
    assert mask[:, : CAMERA.width // 2].all() and not mask[:, CAMERA.width // 2 :].any()
    assert read_mask(found.photos[1]) is None
    inside = find_features(photograph(bench(), ring(4)[0]), OPTIONS.features, mask)
    assert isinstance(inside, Features) and len(inside) > 100
    assert inside.points_px[:, 0].max() < CAMERA.width // 2 + 1
    cv2.imwrite(str(masks / f"{paths[1].name}.png"), np.full((200, 100), 255, np.uint8))
    with pytest.raises(InputError, match="100×200"):
        with_masks(intake, masks)
    cv2.imwrite(str(masks / f"{paths[1].name}.png"), np.zeros_like(half))
    with pytest.raises(InputError, match="black everywhere"):
        with_masks(intake, masks)
    (masks / f"{paths[1].name}.png").write_bytes(b"no picture")
    with pytest.raises(InputError, match="not a picture"):
        with_masks(intake, masks)
