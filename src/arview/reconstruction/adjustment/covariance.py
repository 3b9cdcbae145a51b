"""Noise of an adjustment, covariance of its points, and the motions that it leaves free."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from arview.core.atomic import replacing
from arview.errors import CannotMeasureError
from arview.geometry import Array, apply, skew
from arview.reconstruction.colmap import read_reconstruction, sparse_model_of
from arview.reconstruction.types import Photo, SparseModel

COVARIANCES = {"pose_covariance": "covariance.npy", "lens_covariance": "lens_covariance.npy"}
"""Files of a model's covariances."""
LOSS_PX = 0.5
"""Residual at which Cauchy's loss of the adjustment halves the weight of an observation."""
MAX_ABSORBED = 0.9
"""Largest share of the noise that the unknowns are taken to absorb; with more, nothing is known of it."""


def noise_variance_of(sparse: SparseModel) -> float:
    """Variance in px² by which the inverse of the adjustment's information is multiplied."""
    residuals = reprojection_residuals(sparse)
    unknowns = 3 * len(sparse.points_in_scan) + 6 * len(sparse.photos)
    return noise_variance(residuals, min(unknowns / max(1, residuals.size), MAX_ABSORBED))


def noise_variance(residuals: Array, absorbed: float = 0.0) -> float:
    """Variance in px² of one coordinate of observations with residuals (K,2), as their robust adjustment has it.

    An M-estimate has the covariance of least squares times ``E[ψ²] / E[ψ']²``, corrected for few observations (Huber,
    "Robust Statistics", 1981, sections 7.6 and 7.10). The adjuster's information weighs each observation by the
    derivative of its loss, Cauchy's, whose mean is the third factor. So tails count by what they do to the result:
    neither fully, as in the standard deviation of the residuals, nor not at all, as in their median.

    Args:
        residuals: observed minus projected.
        absorbed: number of fitted unknowns by that of coordinates: the share of the noise that they absorb.
    """
    squares = np.sum(residuals[np.isfinite(residuals).all(axis=1)] ** 2, axis=1) / LOSS_PX**2
    weights = 1.0 / (1.0 + squares)
    slopes = np.concatenate([weights, weights - 2.0 * squares * weights**2])  # along the residual and across it
    few = 1.0 + absorbed * float(np.var(slopes) / np.mean(slopes) ** 2)
    spread = float(np.mean(weights**2 * squares)) * LOSS_PX**2 / (2.0 * (1.0 - absorbed))
    return float(few**2 * np.mean(weights) * spread / np.mean(slopes) ** 2)


def point_covariances(sparse: SparseModel) -> Array:
    """(N,3,3) covariances of the points, in the frame in which the cameras together vary least.

    By the Schur complement of the adjustment (Triggs et al., "Bundle adjustment — a modern synthesis", 2000, section 6)
    that of a point is what its own observations leave open with known poses, and the poses' covariance carried to it.
    What scale and intrinsics add is not in it.

    Raises:
        CannotMeasureError: the covariance of the poses is not known.
    """
    if sparse.pose_covariance is None:
        raise CannotMeasureError("points: the covariance of the camera poses is not known, so their U is not either")
    count, noise = len(sparse.points_in_scan), noise_variance_of(sparse)
    squares = np.sum(reprojection_residuals(sparse) ** 2, axis=1) / LOSS_PX**2
    by_point = np.empty((len(squares), 2, 3))
    by_pose = np.empty((len(squares), 2, 6))
    for index, photo in enumerate(sparse.photos):
        of = np.flatnonzero(sparse.observed_photo == index)
        rotation = photo.cam_from_scan[:3, :3]
        in_cam = apply(photo.cam_from_scan, sparse.points_in_scan[sparse.observed_point[of]])
        by_cam = photo.camera.slopes(in_cam)
        by_point[of] = by_cam @ rotation
        by_pose[of] = np.concatenate([np.cross(in_cam[:, None], by_cam), by_cam], axis=2)
    weighed = by_point / (1.0 + squares)[:, None, None]
    information = np.zeros((count, 3, 3))
    np.add.at(information, sparse.observed_point, np.einsum("kpi,kpj->kij", weighed, by_point))
    inverse = np.linalg.pinv(information, hermitian=True)
    carried = -inverse[sparse.observed_point] @ np.einsum("kpi,kpj->kij", weighed, by_pose)
    result: Array = np.asarray(noise * inverse, dtype=np.float64)
    order = np.argsort(sparse.observed_point, kind="stable")
    starts = np.searchsorted(sparse.observed_point[order], np.arange(count + 1))
    for point in range(count):
        of = order[starts[point] : starts[point + 1]]
        columns = (6 * sparse.observed_photo[of][:, None] + np.arange(6)).ravel()
        along = np.concatenate(list(carried[of]), axis=1) if len(of) else np.zeros((3, 0))
        result[point] += along @ sparse.pose_covariance[np.ix_(columns, columns)] @ along.T
    return result


def points_table(sparse: SparseModel, unit: str) -> str:
    """The points as CSV: place and standard uncertainty (k = 1) along the axes, photos and rms residual of each."""
    std = np.sqrt(np.einsum("nii->ni", point_covariances(sparse)))
    photos = np.bincount(sparse.observed_point, minlength=len(std))
    squares = np.sum(reprojection_residuals(sparse) ** 2, axis=1)
    rms = np.sqrt(np.bincount(sparse.observed_point, squares, len(std)) / np.maximum(2 * photos, 1))
    names = [f"{name}_{unit}" for name in ("x", "y", "z", "ux", "uy", "uz")]
    rows = [
        ",".join([*(f"{value:.6g}" for value in (*place, *sigma)), str(number), f"{residual:.3f}"])
        for place, sigma, number, residual in zip(sparse.points_in_scan, std, photos, rms, strict=True)
    ]
    return "\n".join([",".join([*names, "photos", "rms_px"]), *rows]) + "\n"


def read_model(folder: Path, photos: Sequence[Photo]) -> SparseModel:
    """The model of a ``sparse`` folder: COLMAP's, and the covariances that `write_covariances` left.

    Raises:
        OSError, ValueError, RuntimeError: a file is missing or damaged.
    """
    sparse = sparse_model_of(read_reconstruction(folder / "model"), photos)
    found = {name: folder / file for name, file in COVARIANCES.items() if (folder / file).is_file()}
    return replace(sparse, **{name: np.load(path) for name, path in found.items()})


def write_covariances(sparse: SparseModel, folder: Path) -> None:
    """Write the covariances that are known."""
    for name, file in COVARIANCES.items():
        covariance = getattr(sparse, name)
        (folder / file).unlink(missing_ok=True)
        if covariance is not None:
            with replacing(folder / file) as handle:
                np.save(handle, covariance)


def reprojection_residuals(sparse: SparseModel) -> Array:
    """(K,2) observed minus projected pixels of every observation."""
    residuals = np.empty_like(sparse.observed_px)
    for index, photo in enumerate(sparse.photos):
        seen = sparse.observed_photo == index
        points = sparse.points_in_scan[sparse.observed_point[seen]]
        in_cam = points @ photo.cam_from_scan[:3, :3].T + photo.cam_from_scan[:3, 3]
        residuals[seen] = sparse.observed_px[seen] - photo.camera.project(in_cam)
    return residuals


def free_frame_projection(sparse: SparseModel) -> Array:
    """(6M,6M) projection that removes a rotation, translation or scaling of the whole frame from left twists."""
    gauge, weights = gauge_of(sparse)
    weighed = gauge * weights[:, None]
    return np.eye(len(gauge)) - (gauge @ np.linalg.pinv(weighed)) * weights[None, :]


def gauge_of(sparse: SparseModel) -> tuple[Array, Array]:
    """(6M,7) left twists of all photos for each free motion of the whole frame, and (6M,) weights of their entries.

    The motions are rotations, translations and a scaling about the frame's origin. The weights convert lengths to
    angles by the extent of the cameras' positions.
    """
    blocks = []
    for photo in sparse.photos:
        rotation, translation = photo.cam_from_scan[:3, :3], photo.cam_from_scan[:3, 3]
        block = np.zeros((6, 7))
        block[:3, :3] = rotation
        block[3:, :3] = skew(translation) @ rotation
        block[3:, 3:6] = rotation
        block[3:, 6] = translation
        blocks.append(block)
    centres = np.array([photo.centre_in_scan for photo in sparse.photos])
    unit = float(np.linalg.norm(centres - centres.mean(axis=0), axis=1).mean())
    weights = np.tile([1.0, 1.0, 1.0, 1.0 / unit, 1.0 / unit, 1.0 / unit], len(sparse.photos))
    return np.concatenate(blocks), weights
