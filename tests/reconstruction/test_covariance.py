"""The covariance of camera poses against what repeated adjustments of noisy observations really scatter."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from arview.camera import Camera
from arview.geometry import invert, log_se3
from arview.reconstruction.adjustment.bundle import adjust
from arview.reconstruction.adjustment.covariance import free_frame_projection
from arview.reconstruction.adjustment.equations import LensTerms, with_covariance
from arview.reconstruction.colmap import import_pycolmap, sparse_model_of
from arview.reconstruction.scale.similarity import fit_points
from arview.reconstruction.types import Photo, SparseModel

NOISE_PX = 0.4
RUNS = 40
COMMON = LensTerms(np.zeros(6, dtype=np.int64), has_centre=False)


def synthetic_model(seed: int) -> Any:
    """Six photos of 150 points all around, no noise; the lens is like a phone's."""
    pycolmap = import_pycolmap()
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=1, num_frames_per_rig=6, num_points3D=150, camera_model_id=pycolmap.CameraModelId.RADIAL,
        camera_params=[1280.0, 512.0, 384.0, 0.05, -0.01], num_points2D_without_point3D=0,
    )  # fmt: skip
    pycolmap.set_random_seed(seed)
    return pycolmap.synthesize_dataset(options)


def photos_of(model: Any) -> list[Photo]:
    camera = Camera(1024, 768, 1280.0, 1280.0, 511.5, 383.5)
    names = sorted(model.images[image_id].name for image_id in model.reg_image_ids())
    return [Photo(name, Path(name), 1024, 768, "lens", camera) for name in names]


def with_noise(truth: Any, rng: np.random.Generator) -> Any:
    noisy = type(truth)(truth)
    for image in noisy.images.values():
        for point in image.points2D:
            point.xy = point.xy + rng.normal(0.0, NOISE_PX, 2)
    return noisy


def twists(found: SparseModel, truth: SparseModel) -> np.ndarray[Any, Any]:
    """(6M,) left twists from the true poses to the found ones, after a similarity fit of the centres."""
    a = np.array([photo.centre_in_scan for photo in found.photos])
    b = np.array([photo.centre_in_scan for photo in truth.photos])
    fit = fit_points(a, b).similarity
    aligned = found.transformed(fit.scale, fit.model_from_scan)
    pairs = zip(aligned.photos, truth.photos, strict=True)
    return np.concatenate([log_se3(one.cam_from_scan @ invert(other.cam_from_scan)) for one, other in pairs])


@pytest.mark.slow
def test_poses_scatter_as_the_covariance_says() -> None:
    truth_model = synthetic_model(3)
    photos = photos_of(truth_model)
    truth = sparse_model_of(truth_model, photos)
    rng = np.random.default_rng(1)
    errors, covariances = [], []
    for _ in range(RUNS):
        noisy = with_noise(truth_model, rng)
        adjust(noisy, 1, refines_centre=False)
        found = sparse_model_of(noisy, photos)
        covariance = with_covariance(found, COMMON).pose_covariance
        assert covariance is not None
        covariances.append(covariance)
        errors.append(free_frame_projection(truth) @ twists(found, truth))
    expected = np.sqrt(np.diag(np.mean(covariances, axis=0)))
    scattered = np.sqrt(np.mean(np.square(errors), axis=0))
    ratio = (scattered / expected).reshape(-1, 6)
    assert np.median(ratio[:, :3]) == pytest.approx(1.0, abs=0.15)
    assert np.median(ratio[:, 3:]) == pytest.approx(1.0, abs=0.15)
    assert ratio.min() > 0.6 and ratio.max() < 1.6


def test_no_camera_is_free_of_error_by_being_held() -> None:
    model = with_noise(synthetic_model(5), np.random.default_rng(2))
    adjust(model, 1, refines_centre=False)
    found = sparse_model_of(model, photos_of(model))
    covariance = with_covariance(found, COMMON).pose_covariance
    assert covariance is not None
    variances = np.diag(covariance).reshape(-1, 6).sum(axis=1)
    assert variances.min() > 0.05 * variances.max()
    assert np.linalg.eigvalsh(covariance).min() > -1e-9 * variances.max()
