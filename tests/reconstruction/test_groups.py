"""Groups of photos that are not placed relative to each other: found, named, and only one of them used."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from arview.camera import Camera
from arview.geometry import Array, apply
from arview.reconstruction.adjustment.covariance import gauge_of
from arview.reconstruction.features import FeatureOptions
from arview.reconstruction.groups import group_names, groups_warning, linked_groups, relative_px, shared_points
from arview.reconstruction.sparse import SparseOptions, reconstruct_sparse
from arview.reconstruction.types import Photo, PosedPhoto, SparseModel
from helpers.photo_scene import CAMERA, bench, photograph, ring, write_photos

RNG = np.random.default_rng(5)


def model_of(seen: list[tuple[range, range]], count: int = 8, pose_std: float = 1e-5) -> SparseModel:
    """Cameras of a ring and points, of which ``seen`` lists (photos, points) that see each other; equal accuracies."""
    photos = tuple(PosedPhoto(f"img_{i}.jpg", Path(), CAMERA, pose) for i, pose in enumerate(ring(count)))
    points = RNG.uniform(-80, 80, (400, 3)) * (1, 1, 0.2)
    pairs = sorted({(point, photo) for photos_, points_ in seen for photo in photos_ for point in points_})
    point, photo = np.array(pairs, dtype=np.int32).T
    px = np.array(
        [CAMERA.project(apply(photos[j].cam_from_scan, points[i][None]))[0] for i, j in zip(point, photo, strict=True)]
    )
    covariance = np.diag(np.tile([pose_std] * 3 + [500.0 * pose_std] * 3, count) ** 2)
    return SparseModel(
        photos, points, np.zeros((400, 3), np.uint8), np.zeros(400), point, photo, px, pose_covariance=covariance
    )


def moved_part(sparse: SparseModel, members: list[int], std: Array) -> SparseModel:
    """The model whose photos ``members`` may move together against the others by a similarity of these deviations."""
    gauge = gauge_of(sparse)[0].copy()
    keep = np.repeat(np.isin(np.arange(len(sparse.photos)), members), 6)
    gauge[~keep] = 0.0
    assert sparse.pose_covariance is not None
    return replace(sparse, pose_covariance=sparse.pose_covariance + gauge @ np.diag(std**2) @ gauge.T)


def test_photos_that_share_points_are_one_group() -> None:
    sparse = model_of([(range(5), range(200)), (range(3, 8), range(150, 400))])
    assert linked_groups(sparse) == (tuple(range(8)),)
    assert shared_points(sparse)[0, 4] == 200 and shared_points(sparse)[0, 7] == 50


def test_groups_without_a_common_point() -> None:
    sparse = model_of([(range(3), range(200)), (range(3, 8), range(200, 400))])
    assert linked_groups(sparse) == ((3, 4, 5, 6, 7), (0, 1, 2))


def test_too_few_common_points_are_no_link(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ten points that two photos of the two groups both see may be due to chance."""
    sparse = model_of([(range(4), range(210)), (range(4, 8), range(200, 400))])
    assert linked_groups(sparse) == ((0, 1, 2, 3), (4, 5, 6, 7))
    monkeypatch.setattr("arview.reconstruction.groups.MIN_SHARED_POINTS", 10)
    assert len(linked_groups(sparse)) == 1


def test_a_link_that_leaves_the_groups_free_to_move() -> None:
    """Forty common points, but by the covariance one group may turn against the other: not one frame."""
    sparse = model_of([(range(5), range(240)), (range(5, 8), range(200, 400))])
    free = np.array([1e-1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    assert len(linked_groups(moved_part(sparse, [5, 6, 7], 1e-3 * free))) == 1
    assert linked_groups(moved_part(sparse, [5, 6, 7], free)) == ((0, 1, 2, 3, 4), (5, 6, 7))


def test_relative_deviation_is_that_of_the_pixels(monkeypatch: pytest.MonkeyPatch) -> None:
    """Against a Monte Carlo of the smaller part's common move, seen in its photos."""
    sparse = model_of([(range(5), range(240)), (range(5, 8), range(200, 400))], pose_std=1e-9)
    std = np.array([2e-3, 3e-3, 1e-3, 0.5, 0.2, 0.8, 2e-3])
    sparse = moved_part(sparse, [5, 6, 7], std)
    monkeypatch.setattr("arview.reconstruction.groups.POINTS_OF_PHOTO", 400)
    predicted = relative_px(sparse, ((0, 1, 2, 3, 4), (5, 6, 7)))
    shifts = []
    for move in RNG.normal(0.0, std, (200, 7)):
        turn = np.eye(3) + np.cross(np.eye(3), -move[:3])
        u, _, vt = np.linalg.svd(turn)
        scan = (1.0 + move[6]) * sparse.points_in_scan @ (u @ vt).T + move[3:6]
        for i in (5, 6, 7):
            seen = sparse.observed_point[sparse.observed_photo == i]
            photo = sparse.photos[i]
            before = CAMERA.project(apply(photo.cam_from_scan, sparse.points_in_scan[seen]))
            shifts.append(CAMERA.project(apply(photo.cam_from_scan, scan[seen])) - before)
    measured = float(np.sqrt(np.mean(np.concatenate(shifts) ** 2)))
    assert measured > 0.1 and predicted == pytest.approx(measured, rel=0.15)


def test_words() -> None:
    order = [f"img_{i:03d}.jpg" for i in range(17)]
    one, two = order[:5], order[12:]
    assert group_names(order, one) == "img_000.jpg to img_004.jpg"
    assert group_names(order, [order[0], order[2], order[3]]) == "img_000.jpg, img_002.jpg, img_003.jpg"
    text = groups_warning(order, [one, two])
    assert "img_000.jpg to img_004.jpg (5 photos, used); img_012.jpg to img_016.jpg (5 photos)" in text
    assert "between img_004.jpg and img_012.jpg" in text
    assert groups_warning(order, [order]) == "" and groups_warning(order, []) == ""


@pytest.mark.slow  # features and matches of ten photos
def test_two_groups_of_photos_are_told_apart(tmp_path: Path) -> None:
    """Five photos from either side: only one group is used, and every photo of the other is named with its company."""
    poses = [*ring(24)[:5], *ring(24)[12:17]]
    paths = write_photos(tmp_path / "photos", [photograph(bench(), pose) for pose in poses])
    guess = Camera(CAMERA.width, CAMERA.height, 740.0, 740.0, CAMERA.cx, CAMERA.cy)
    photos = [Photo(path.name, path, guess.width, guess.height, "lens", guess) for path in paths]
    options = SparseOptions(features=FeatureOptions(max_features=2500), first_features=1500, threads=2)
    sparse = reconstruct_sparse(photos, tmp_path / "sparse", options)
    names = {photo.name for photo in sparse.photos}
    halves = ({path.name for path in paths[:5]}, {path.name for path in paths[5:]})
    assert names in halves and sparse.pose_covariance is not None
    assert {name for name, _ in sparse.unplaced} == set.union(*halves) - names
    assert all("common" in reason for _, reason in sparse.unplaced)
    deviations_mm = np.sqrt(np.diag(sparse.pose_covariance).reshape(-1, 6)[:, 3:].sum(axis=1))
    size = np.linalg.norm(np.ptp([photo.centre_in_scan for photo in sparse.photos], axis=0))
    assert deviations_mm.max() < 0.02 * size  # not the whole scene, as where nothing joins the groups
    assert len(sparse.groups) >= 1 and set(sparse.groups[0]) == names


def test_intrinsics_do_not_loosen_a_group() -> None:
    """A wrong principal point turns all cameras alike and leaves the pixels: the photos are still one group."""
    sparse = model_of([(range(5), range(240)), (range(5, 8), range(200, 400))])
    turned = np.tile([0.02, 0.01, 0.0, 0.0, 0.0, 0.0], 8)
    assert sparse.pose_covariance is not None
    loose = replace(sparse, pose_covariance=sparse.pose_covariance + np.outer(turned, turned))
    assert linked_groups(loose) == (tuple(range(8)),)
