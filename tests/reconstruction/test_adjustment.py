"""Adjustments of blocks whose truth is known: COLMAP's, the free network in plain numpy, lenses that change."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from arview.camera import Camera
from arview.geometry import Array, apply, exp_se3, look_at
from arview.measurement.uncertainty.pose_propagation import shifts_from_poses
from arview.reconstruction.adjustment.bundle import adjust, photos_of_two_lenses
from arview.reconstruction.adjustment.covariance import (
    LOSS_PX,
    gauge_of,
    noise_variance_of,
    point_covariances,
    reprojection_residuals,
)
from arview.reconstruction.adjustment.equations import LensTerms, mean_lens, with_covariance, with_lens_per_photo
from arview.reconstruction.colmap import import_pycolmap, model_of_poses, sparse_model_of
from arview.reconstruction.types import Photo, PosedPhoto, SparseModel

CAMERA = Camera(1600, 1200, 1500.0, 1500.0, 799.5, 599.5, np.array([-0.05, 0.01, 0.0, 0.0, 0.0]))


def block(count: int, points: int, noise: Array, lenses: list[Camera] | None = None) -> SparseModel:
    """Cameras on rings about points in a box of 400 mm, each of which 60 % of them see; with noise (K,2) px."""
    rng = np.random.default_rng(4)
    places = rng.uniform(-200.0, 200.0, (points, 3)) * (1.0, 1.0, 0.4)
    photos, point, photo, pixels = [], [], [], []
    for k in range(count):
        azimuth = 2.0 * np.pi * k / count
        eye = 900.0 * np.array([np.cos(azimuth), np.sin(azimuth), 0.6 + 0.3 * (k % 3)])
        camera = lenses[k] if lenses else CAMERA
        pose = look_at(eye, [0.0, 0.0, 0.0], [0.0, 0.0, 1.0])
        photos.append(PosedPhoto(f"{k:03d}.jpg", Path(f"{k:03d}.jpg"), camera, pose))
        seen = np.flatnonzero((rng.random(points) < 0.6) | ((np.arange(points) - k) % count < 3))
        point.append(seen)
        photo.append(np.full(len(seen), k))
        pixels.append(camera.project(apply(pose, places[seen])))
    exact = np.concatenate(pixels)
    return SparseModel(
        tuple(photos), places, np.zeros((points, 3), np.uint8), np.zeros(points),
        np.concatenate(point).astype(np.int32), np.concatenate(photo).astype(np.int32),
        exact + np.resize(noise, exact.shape),
    )  # fmt: skip


def changed(focal: float, u: float, v: float) -> Camera:
    """The camera with another focal length (relative) and principal point (by the longer side)."""
    longer = 1500.0 * (1.0 + focal)
    return replace(CAMERA, fx=longer, fy=longer, cx=CAMERA.cx + 1600.0 * u, cy=CAMERA.cy + 1600.0 * v)


def terms_of(sparse: SparseModel) -> LensTerms:
    return LensTerms(np.full(len(sparse.photos), -1), False)


def colmap_model(sparse: SparseModel) -> tuple[Any, list[Photo]]:
    """The block as a model of COLMAP's, with calibrated photos."""
    pycolmap = import_pycolmap()
    photos = [Photo(one.name, one.path, 1600, 1200, "lens", one.camera, True) for one in sparse.photos]
    model = model_of_poses([(photo, one.cam_from_scan) for photo, one in zip(photos, sparse.photos, strict=True)])
    tracks: list[Any] = [pycolmap.Track() for _ in sparse.points_in_scan]
    for index in range(len(photos)):
        of = np.flatnonzero(sparse.observed_photo == index)
        model.images[index + 1].points2D = pycolmap.Point2DList(
            [pycolmap.Point2D(xy) for xy in sparse.observed_px[of] + 0.5]
        )
        for row, point in enumerate(sparse.observed_point[of]):
            tracks[point].add_element(index + 1, row)
    for place, track in zip(sparse.points_in_scan, tracks, strict=True):
        model.add_point3D(place, track, np.zeros(3, np.uint8))
    return model, photos


def free_network(sparse: SparseModel) -> tuple[SparseModel, Array]:
    """The block adjusted in plain numpy with all unknowns at once and inner constraints, and their cofactors.

    Robust weights of Cauchy's loss; the derivatives by points and poses are differences.
    """
    count, points = len(sparse.photos), len(sparse.points_in_scan)
    for _ in range(40):
        residuals = reprojection_residuals(sparse)
        weights = np.repeat(1.0 / (1.0 + np.sum(residuals**2, axis=1) / LOSS_PX**2), 2)
        rows = np.zeros((len(residuals), 2, 6 * count + 3 * points))
        for k, photo in enumerate(sparse.photos):
            of = np.flatnonzero(sparse.observed_photo == k)
            which = sparse.observed_point[of]
            in_cam = apply(photo.cam_from_scan, sparse.points_in_scan[which])
            exact = photo.camera.project(in_cam)
            for axis in range(6):
                twist = 1e-7 * np.eye(6)[axis]
                rows[of, :, 6 * k + axis] = (photo.camera.project(apply(exp_se3(twist), in_cam)) - exact) / 1e-7
            for axis in range(3):
                moved = in_cam + 1e-4 * photo.cam_from_scan[:3, axis]
                rows[of, :, 6 * count + 3 * which + axis] = (photo.camera.project(moved) - exact) / 1e-4
        design = rows.reshape(2 * len(residuals), -1)
        moves = _motions(sparse)
        gauge = np.linalg.svd(moves, full_matrices=False)[0]
        scale = 1.0 / np.sqrt(np.einsum("ij,i,ij->j", design, weights, design))
        normal = (design * scale).T @ ((weights[:, None] * design) * scale) + (gauge / scale[:, None]) @ (
            gauge / scale[:, None]
        ).T / np.max(1.0 / scale**2)
        cofactors = np.linalg.inv(normal) * np.outer(scale, scale)
        step = cofactors @ (design.T @ (weights * residuals.ravel()))
        by_points = np.linalg.pinv(moves[6 * count :])
        step -= moves @ (by_points @ step[6 * count :])  # the block neither moves nor grows
        photos = tuple(
            replace(photo, cam_from_scan=exp_se3(step[6 * k : 6 * k + 6]) @ photo.cam_from_scan)
            for k, photo in enumerate(sparse.photos)
        )
        places = sparse.points_in_scan + step[6 * count :].reshape(-1, 3)
        sparse = replace(sparse, photos=photos, points_in_scan=places)
    # To the frame in which the cameras vary least together, as the covariances of `SparseModel` have it.
    moves, (_, weights) = _motions(sparse), gauge_of(sparse)
    by_cameras = np.linalg.pinv(moves[: 6 * count] * weights[:, None]) * weights
    projection = np.eye(len(moves)) - moves @ np.concatenate([by_cameras, np.zeros((7, 3 * points))], axis=1)
    return sparse, projection @ cofactors @ projection.T


def _motions(sparse: SparseModel) -> Array:
    """(6M+3N,7) motions of the whole block that no observation shows: rotations, translations, scaling."""
    columns = []
    for turn, shift, factor in zip(np.eye(7, 3), np.eye(7, 3, -3), [0.0] * 6 + [1.0], strict=True):
        of_photos = []
        for photo in sparse.photos:
            rotation, origin = photo.cam_from_scan[:3, :3], photo.cam_from_scan[:3, 3]
            turned = rotation @ turn
            of_photos += [-turned, factor * origin - rotation @ shift - np.cross(origin, turned)]
        of_points = np.cross(turn, sparse.points_in_scan) + shift + factor * sparse.points_in_scan
        columns.append(np.concatenate([*of_photos, of_points.ravel()]))
    return np.array(columns).T


def same_frame(points: Array, others: Array) -> Array:
    """Points (N,3) moved onto others by the similarity that fits them best."""
    a, b = points - points.mean(axis=0), others - others.mean(axis=0)
    u, s, vt = np.linalg.svd(b.T @ a)
    return np.asarray((s.sum() / np.sum(a * a)) * a @ (u @ vt).T + others.mean(axis=0))


@pytest.mark.slow
def test_a_block_agrees_with_the_free_network() -> None:
    rng = np.random.default_rng(7)
    noise = 0.12 * rng.standard_t(4.0, (20000, 2))  # with tails
    count, points = 40, 60
    start = block(count, points, noise)
    model, photos = colmap_model(start)
    adjust(model, 2, refines_centre=False, iterations=100, tolerance=1e-14)
    ours = sparse_model_of(model, photos)
    ours = with_covariance(ours, terms_of(ours))
    free, cofactors = free_network(start)
    np.testing.assert_allclose(same_frame(ours.points_in_scan, free.points_in_scan), free.points_in_scan, atol=2e-4)
    full = noise_variance_of(free) * cofactors
    ratio = np.sqrt(np.einsum("nii->ni", point_covariances(ours)).ravel() / np.diag(full)[6 * count :])
    assert np.abs(ratio - 1.0).max() < 0.03
    assert ours.pose_covariance is not None
    std, expected = np.sqrt(np.diag(ours.pose_covariance)), np.sqrt(np.diag(full)[: 6 * count])
    assert np.abs(std / expected - 1.0).max() < 0.03
    correlations = ours.pose_covariance / np.outer(std, std) - full[: 6 * count, : 6 * count] / np.outer(
        expected, expected
    )
    assert np.abs(correlations).max() < 0.02


def test_lenses_that_change_are_found_and_others_left() -> None:
    count = 10
    rng = np.random.default_rng(3)
    noise = rng.normal(0.0, 0.15, (20000, 2))
    fixed = block(count, 300, noise)
    assert with_lens_per_photo(fixed, terms_of(fixed)) is None
    lenses = [changed(*change) for change in rng.normal(0.0, [0.003, 0.004, 0.004], (count, 3))]
    truth = block(count, 300, noise, lenses)
    model, photos = colmap_model(replace(truth, photos=tuple(replace(one, camera=CAMERA) for one in truth.photos)))
    adjust(model, 2, refines_centre=False, iterations=100)
    start = sparse_model_of(model, photos)
    found = with_lens_per_photo(start, terms_of(start))
    assert found is not None and found.lens_stds is not None
    assert np.all(found.lens_stds > (0.0015, 0.002, 0.002)) and np.all(found.lens_stds < (0.006, 0.008, 0.008))
    found = with_covariance(found, terms_of(found))
    assert found.lens_covariance is not None and found.lens_covariance.shape == (9 * count, 9 * count)
    std = np.sqrt(np.diag(found.lens_covariance)).reshape(count, 9)[:, 6:]
    errors = np.array(
        [
            (one.camera.fx / lens.fx - 1.0, (one.camera.cx - lens.cx) / 1600.0, (one.camera.cy - lens.cy) / 1600.0)
            for one, lens in zip(found.photos, lenses, strict=True)
        ]
    )
    assert np.sqrt(np.mean(errors[:, 1:] ** 2)) * 1600.0 < 2.5  # px; 6.4 before
    assert 0.2 < np.sqrt(np.mean((errors / std) ** 2)) < 1.3
    usual = mean_lens([one.camera for one in found.photos])
    assert usual.cx == pytest.approx(CAMERA.cx, abs=6.0) and usual.fx == pytest.approx(1500.0, rel=0.004)


def test_two_zooms_taken_for_one_are_told() -> None:
    noise = np.random.default_rng(5).normal(0.0, 0.2, (20000, 2))
    lenses = [changed(0.4 * (k % 2) + 0.004 * (k % 3), 0.0, 0.0) for k in range(10)]
    mixed = block(10, 200, noise, lenses)
    common = changed(0.2, 0.0, 0.0)
    photos = [Photo(one.name, one.path, 1600, 1200, "lens", common) for one in mixed.photos]
    model, _ = colmap_model(replace(mixed, photos=tuple(replace(one, camera=common) for one in mixed.photos)))
    adjust(model, 2, refines_centre=False, iterations=50)
    start = sparse_model_of(model, photos)
    terms = LensTerms(np.zeros(10, dtype=np.int64), has_centre=False)
    found = photos_of_two_lenses(start, terms, photos)
    assert found is not None
    split, remark = found
    assert [photo.lens for photo in split] == 5 * ["lens, zoom 1", "lens, zoom 2"]
    assert split[1].camera.fx / split[0].camera.fx == pytest.approx(1.4, rel=0.03) and "two lenses or zooms" in remark
    assert photos_of_two_lenses(start, terms, split) is None  # asked once
    plain = block(10, 200, noise)
    assert photos_of_two_lenses(plain, terms, photos) is None


def test_a_point_follows_the_lenses_as_its_derivative_says() -> None:
    sparse = block(6, 40, np.zeros((1, 2)))
    points = sparse.points_in_scan[:5]
    sees = np.ones((5, 6), dtype=np.bool_)
    gain = shifts_from_poses(points, sparse.photos, sees, has_lenses=True)
    change = np.random.default_rng(1).normal(0.0, 1e-4, (6, 3))
    unknowns = np.zeros((6, 9))
    unknowns[:, 6:] = change
    expected = gain @ unknowns.ravel()
    for point, shift in zip(points, expected, strict=True):
        normal, right = np.zeros((3, 3)), np.zeros(3)
        for photo, (focal, u, v) in zip(sparse.photos, change, strict=True):
            pixel = photo.camera.project(apply(photo.cam_from_scan, point[None]))[0]
            camera = replace(
                CAMERA,
                fx=1500.0 * (1 + focal),
                fy=1500.0 * (1 + focal),
                cx=CAMERA.cx + 1600 * u,
                cy=CAMERA.cy + 1600 * v,
            )
            ray = photo.cam_from_scan[:3, :3].T @ camera.unproject(pixel)
            distance = np.linalg.norm(point - photo.centre_in_scan)
            across = (np.eye(3) - np.outer(ray, ray) / (ray @ ray)) / distance**2
            normal += across
            right += across @ photo.centre_in_scan
        np.testing.assert_allclose(np.linalg.solve(normal, right) - point, shift, atol=2e-3)
        assert np.linalg.norm(shift) > 5e-3
