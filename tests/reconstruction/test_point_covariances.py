"""Covariances of the points of a block, against the inverse of its full normal equations and against simulation."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from arview.camera import Camera
from arview.errors import CannotMeasureError
from arview.geometry import Array, apply, exp_se3, look_at
from arview.reconstruction.adjustment.covariance import LOSS_PX, point_covariances, points_table, reprojection_residuals
from arview.reconstruction.types import PosedPhoto, SparseModel

CAMERA = Camera(1600, 1200, 1500.0, 1500.0, 799.5, 599.5)
FREE = slice(12, None)
"""Two cameras are held, so that the frame and nearly the scale are given."""


def block(count: int = 12, points: int = 60, noise_px: float = 0.15) -> SparseModel:
    """Cameras around points in a box of 400 mm, each of which most of them see."""
    rng = np.random.default_rng(4)
    places = rng.uniform(-200.0, 200.0, (points, 3)) * (1.0, 1.0, 0.4)
    photos, point, photo, pixels = [], [], [], []
    for k in range(count):
        azimuth = 2.0 * np.pi * k / count
        eye = 900.0 * np.array([np.cos(azimuth), np.sin(azimuth), 0.7 + 0.3 * (k % 3)])
        photos.append(PosedPhoto(f"{k}.jpg", Path(f"{k}.jpg"), CAMERA, look_at(eye, [0.0, 0.0, 0.0], [0.0, 0.0, 1.0])))
        seen = np.flatnonzero(rng.random(points) < 0.7)
        point.append(seen)
        photo.append(np.full(len(seen), k))
        pixels.append(CAMERA.project(apply(photos[-1].cam_from_scan, places[seen])))
    exact = np.concatenate(pixels)
    return SparseModel(
        tuple(photos), places, np.zeros((points, 3), np.uint8), np.zeros(points),
        np.concatenate(point).astype(np.int32), np.concatenate(photo).astype(np.int32),
        exact + rng.normal(0.0, noise_px, exact.shape),
    )  # fmt: skip


def jacobian(sparse: SparseModel) -> Array:
    """(2K, 6M + 3N) of the projections by left twists of the poses and by the points, by finite differences."""
    count = len(sparse.photos)
    columns = []
    for index in range(6 * count):
        twist = np.zeros(6)
        twist[index % 6] = 1e-6
        photo = sparse.photos[index // 6]
        moved = replace(photo, cam_from_scan=exp_se3(twist) @ photo.cam_from_scan)
        photos = (*sparse.photos[: index // 6], moved, *sparse.photos[index // 6 + 1 :])
        columns.append(reprojection_residuals(replace(sparse, photos=photos)).ravel())
    for index in range(3 * len(sparse.points_in_scan)):
        places = sparse.points_in_scan.copy()
        places[index // 3, index % 3] += 1e-4
        columns.append(reprojection_residuals(replace(sparse, points_in_scan=places)).ravel())
    steps = np.r_[np.full(6 * count, 1e-6), np.full(len(columns) - 6 * count, 1e-4)]
    return np.asarray((reprojection_residuals(sparse).ravel() - np.array(columns)).T / steps)


def adjusted() -> tuple[SparseModel, Array]:
    """A block with the covariance of its poses by the full inverse, and the (3N,3N) covariance of its points."""
    sparse = block()
    residuals = reprojection_residuals(sparse)
    weights = np.repeat(1.0 / (1.0 + np.sum(residuals**2, axis=1) / LOSS_PX**2), 2)
    rows = jacobian(sparse)[:, FREE]
    inverse = np.linalg.inv(rows.T @ (weights[:, None] * rows))
    size = 6 * len(sparse.photos)
    poses = np.zeros((size, size))
    poses[FREE, FREE] = inverse[: size - 12, : size - 12]
    return replace(sparse, pose_covariance=poses), inverse[size - 12 :, size - 12 :]


def test_points_have_the_covariance_of_the_full_adjustment(monkeypatch: pytest.MonkeyPatch) -> None:
    sparse, full = adjusted()
    monkeypatch.setattr("arview.reconstruction.adjustment.covariance.noise_variance_of", lambda sparse: 1.0)
    found = point_covariances(sparse)
    blocks = np.array([full[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] for k in range(len(found))])
    np.testing.assert_allclose(found, blocks, rtol=2e-3, atol=2e-3 * np.abs(blocks).max())
    alone = point_covariances(replace(sparse, pose_covariance=np.zeros_like(sparse.pose_covariance)))
    assert np.mean(np.trace(alone, axis1=1, axis2=2)) < 0.9 * np.mean(np.trace(found, axis1=1, axis2=2))


def test_the_table_states_places_and_their_standard_uncertainty() -> None:
    sparse, _ = adjusted()
    head, *rows = points_table(sparse, "mm").splitlines()
    assert head == "x_mm,y_mm,z_mm,ux_mm,uy_mm,uz_mm,photos,rms_px"
    values = np.array([[float(cell) for cell in row.split(",")] for row in rows])
    np.testing.assert_allclose(values[:, :3], sparse.points_in_scan, rtol=1e-4, atol=1e-3)
    np.testing.assert_allclose(values[:, 3:6] ** 2, np.einsum("nii->ni", point_covariances(sparse)), rtol=1e-3)
    assert values[:, 6].sum() == len(sparse.observed_px) and 0.05 < np.median(values[:, 7]) < 0.25


def test_without_a_covariance_of_the_poses_there_is_none_of_the_points() -> None:
    with pytest.raises(CannotMeasureError, match="covariance of the camera poses is not known"):
        point_covariances(block())
