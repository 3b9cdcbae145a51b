"""Photos are placed where they were taken, and what cannot be placed is named."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from arview.camera import Camera
from arview.errors import CannotMeasureError
from arview.geometry import Array, invert, skew
from arview.reconstruction.colmap import read_reconstruction, sparse_model_of
from arview.reconstruction.features import FeatureOptions, Features, find_features
from arview.reconstruction.matching import match_along_lines, match_descriptors
from arview.reconstruction.scale.similarity import fit_points
from arview.reconstruction.sparse import SparseOptions, reconstruct_sparse
from arview.reconstruction.types import Photo, SparseModel
from helpers.photo_scene import CAMERA, Picture, bench, photograph, ring, write_photos

pytestmark = pytest.mark.slow  # features and matches of all photos

OPTIONS = SparseOptions(features=FeatureOptions(max_features=2500), first_features=1500, threads=2)
GUESS = Camera(CAMERA.width, CAMERA.height, 768.0, 768.0, CAMERA.cx, CAMERA.cy)


def photos_of(paths: Sequence[Path], camera: Camera = GUESS, is_calibrated: bool = False) -> list[Photo]:
    return [Photo(path.name, path, camera.width, camera.height, "lens", camera, is_calibrated) for path in paths]


def aligned(sparse: SparseModel, truth: dict[str, Array]) -> tuple[SparseModel, Array]:
    """The model moved onto the true camera centres by a similarity, and what is left at each centre, mm."""
    a = np.array([photo.centre_in_scan for photo in sparse.photos])
    b = np.array([invert(truth[photo.name])[:3, 3] for photo in sparse.photos])
    fit = fit_points(a, b).similarity
    moved = sparse.transformed(fit.scale, fit.model_from_scan)
    centres = np.array([photo.centre_in_scan for photo in moved.photos])
    return moved, np.linalg.norm(centres - b, axis=1)


@pytest.fixture(scope="module")
def pictures() -> list[Picture]:
    return [photograph(bench(), pose) for pose in ring(12)]


@pytest.fixture(scope="module")
def paths(pictures: list[Picture], tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    return write_photos(tmp_path_factory.mktemp("photos"), pictures)


@pytest.fixture(scope="module")
def placed(paths: list[Path], tmp_path_factory: pytest.TempPathFactory) -> tuple[SparseModel, Path]:
    folder = tmp_path_factory.mktemp("sparse")
    return reconstruct_sparse(photos_of(paths), folder, OPTIONS), folder


def test_cameras_and_points_against_truth(placed: tuple[SparseModel, Path], paths: list[Path]) -> None:
    sparse, _ = placed
    truth = {path.name: pose for path, pose in zip(paths, ring(12), strict=True)}
    assert len(sparse.photos) == 12 and sparse.unplaced == ()
    moved, errors_mm = aligned(sparse, truth)
    assert np.median(errors_mm) < 0.2 and errors_mm.max() < 0.6
    camera = sparse.photos[0].camera
    assert camera.fx == pytest.approx(CAMERA.fx, rel=1e-3)
    assert camera.dist[0] == pytest.approx(CAMERA.dist[0], abs=0.01)
    assert (camera.cx, camera.cy) == (CAMERA.cx, CAMERA.cy)
    on_plate = np.abs(moved.points_in_scan[:, :2]).max(axis=1) < 95
    heights = moved.points_in_scan[on_plate & (np.abs(moved.points_in_scan[:, 2]) < 2.0), 2]
    assert len(heights) > 300
    assert abs(np.median(heights)) < 0.05 and np.median(np.abs(heights)) < 0.15


def test_files_hold_the_same_model(placed: tuple[SparseModel, Path], paths: list[Path]) -> None:
    sparse, folder = placed
    again = sparse_model_of(read_reconstruction(folder / "model"), photos_of(paths))
    assert np.allclose(again.points_in_scan, sparse.points_in_scan)
    assert np.array_equal(again.observed_px, sparse.observed_px)
    assert again.photos[3].camera.fx == pytest.approx(sparse.photos[3].camera.fx)


def test_covariance_predicts_the_size_of_the_errors(placed: tuple[SparseModel, Path], paths: list[Path]) -> None:
    sparse, _ = placed
    moved, errors_mm = aligned(sparse, {path.name: pose for path, pose in zip(paths, ring(12), strict=True)})
    assert moved.pose_covariance is not None
    variances = np.diag(moved.pose_covariance).reshape(-1, 6)[:, 3:].sum(axis=1)
    assert 0.3 < np.sqrt(np.mean(errors_mm**2) / np.mean(variances)) < 3.0


def test_same_seed_same_model(placed: tuple[SparseModel, Path], paths: list[Path], tmp_path: Path) -> None:
    again = reconstruct_sparse(photos_of(paths), tmp_path, OPTIONS)
    assert np.allclose(again.points_in_scan, placed[0].points_in_scan, atol=1e-6)


def test_calibrated_camera_is_left_as_it_is(paths: list[Path], tmp_path: Path) -> None:
    sparse = reconstruct_sparse(photos_of(paths, CAMERA, is_calibrated=True), tmp_path, OPTIONS)
    assert len(sparse.photos) == 12
    assert np.allclose(sparse.photos[0].camera.matrix, CAMERA.matrix)
    assert np.allclose(sparse.photos[0].camera.dist, CAMERA.dist)


def test_photos_of_another_part_are_named(paths: list[Path], tmp_path: Path) -> None:
    others = [photograph(bench(9), pose, seed=77) for pose in ring(12)[:5]]
    mixed = photos_of([*paths, *write_photos(tmp_path / "other", others, "other")])
    sparse = reconstruct_sparse(mixed, tmp_path / "sparse", OPTIONS)
    assert {photo.name for photo in sparse.photos} == {path.name for path in paths}
    reasons = dict(sparse.unplaced)
    assert set(reasons) == {f"other_{i:03d}.png" for i in range(5)}
    assert all("common" in reason for reason in reasons.values())


def test_missing_texture_is_reported(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    walls = [np.clip(rng.normal(200, 1.0, (480, 640, 3)), 0, 255).astype(np.uint8) for _ in range(4)]
    with pytest.raises(CannotMeasureError, match="texture"):
        reconstruct_sparse(photos_of(write_photos(tmp_path, walls)), tmp_path / "sparse", OPTIONS)


def test_photos_with_nothing_in_common_are_refused(tmp_path: Path) -> None:
    strangers = [photograph(bench(i), ring(12)[3 * i], seed=i) for i in range(4)]
    with pytest.raises(CannotMeasureError, match="in common"):
        reconstruct_sparse(photos_of(write_photos(tmp_path, strangers)), tmp_path / "sparse", OPTIONS)


def test_key_points_are_not_biased() -> None:
    """The middle of a drawn blob, to a tenth of a pixel: OpenCV's default is a quarter off."""
    offsets = []
    rows, columns = np.mgrid[0:120, 0:120].astype(float)
    for u, v in [(60.0, 60.0), (60.25, 59.5), (59.4, 60.7), (61.0, 58.9)]:
        grey = 60 + 150 * np.exp(-((columns - u) ** 2 + (rows - v) ** 2) / (2 * 4.0**2))
        found = find_features(np.repeat(grey.astype(np.uint8)[..., None], 3, axis=2))
        offsets.append(found.points_px[np.argmin(np.linalg.norm(found.points_px - (u, v), axis=1))] - (u, v))
    assert np.abs(np.mean(offsets, axis=0)).max() < 0.08


def test_descriptor_matches_are_those_of_a_plain_search() -> None:
    rng = np.random.default_rng(4)
    ones = rng.random((700, 128)).astype(np.float32) ** 4
    others = np.concatenate(
        [
            ones[:300] + rng.normal(0, 0.03, (300, 128)).astype(np.float32),
            ones[400:420] * 0 + rng.random((20, 128)).astype(np.float32),
        ]
    )
    ones /= np.linalg.norm(ones, axis=1, keepdims=True)
    others = np.abs(others) / np.linalg.norm(others, axis=1, keepdims=True)
    similarity = ones @ others.T
    expected = set()
    for i in range(len(ones)):
        order = np.argsort(-similarity[i])
        angle, next_angle = np.arccos(np.clip(similarity[i, order[:2]], -1, 1))
        if similarity[:, order[0]].argmax() == i and angle < 0.8 * next_angle and angle < 0.7:
            expected.add((i, int(order[0])))
    assert {(int(i), int(j)) for i, j in match_descriptors(ones, others)} == expected
    assert len(expected) > 250


def test_matches_along_lines_find_what_repeats() -> None:
    """Points that all look alike: appearance alone finds none of them, the epipolar lines find most."""
    rng = np.random.default_rng(5)
    points = np.column_stack([rng.uniform(-100, 100, (400, 2)), rng.uniform(-20, 20, 400)])
    poses = ring(12)[:2]
    rays = [(points @ pose[:3, :3].T + pose[:3, 3]) for pose in poses]
    rays = [np.ascontiguousarray(ray[:, :2] / ray[:, 2:]) for ray in rays]
    word = rng.random((1, 128)).astype(np.float32)

    def features(ray: Array) -> Features:
        noisy = word + rng.normal(0, 0.01, (400, 128)).astype(np.float32)
        noisy /= np.linalg.norm(noisy, axis=1, keepdims=True)
        pixels = (ray * 900 + 400).astype(np.float32)
        return Features(pixels, noisy.astype(np.float32), np.full(400, 4.0, np.float32), np.zeros((400, 3), np.uint8))

    both = (features(rays[0]), features(rays[1]))
    assert len(match_descriptors(both[0].descriptors, both[1].descriptors)) < 20
    relative = poses[1] @ invert(poses[0])
    essential = skew(relative[:3, 3]) @ relative[:3, :3]
    matches = match_along_lines((rays[0], rays[1]), 900.0, both, essential, 0.5)
    assert len(matches) > 100
    assert np.mean(matches[:, 0] == matches[:, 1]) > 0.9
