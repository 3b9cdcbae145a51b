"""Data that the stages of a reconstruction exchange."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from arview.camera import Camera
from arview.errors import InputError
from arview.geometry import Array, apply, invert, rigid

Indices = NDArray[np.int32]


@dataclass(frozen=True)
class Photo:
    """One photo that passed intake.

    Attributes:
        name: unique in the reconstruction: the path below the photo folder, or ``frame_000123.png`` of a video.
        path: of the file; for a video frame, of the picture that intake wrote.
        width, height: in px, upright (EXIF orientation applied).
        lens: key shared by photos of the same lens, zoom and size, which share their intrinsics.
        camera: initial intrinsics, upright; exact if ``is_calibrated``.
        is_calibrated: the camera came from a calibration, which self-calibration must not change.
        mask: picture of the photo's shape, black where the photo is not to be used; None uses all of it.
    """

    name: str
    path: Path
    width: int
    height: int
    lens: str
    camera: Camera
    is_calibrated: bool = False
    mask: Path | None = None


@dataclass(frozen=True)
class PosedPhoto:
    """A photo with the camera found by structure from motion: intrinsics with distortion, ``cam_from_scan`` (4,4)."""

    name: str
    path: Path
    camera: Camera
    cam_from_scan: Array
    mask: Path | None = None  # see `Photo`

    @property
    def centre_in_scan(self) -> Array:
        """(3,) camera centre."""
        return -self.cam_from_scan[:3, :3].T @ self.cam_from_scan[:3, 3]


@dataclass(frozen=True)
class SparseModel:
    """Camera poses and points in the ``scan`` frame and its unit.

    The unit is arbitrary until `transformed` brings the model to millimetres in the approximate CAD frame.

    Attributes:
        photos: placed photos.
        points_in_scan: (N,3).
        colors: (N,3) uint8 RGB.
        point_errors_px: (N,) mean reprojection error.
        observed_point, observed_photo: (K,) int32 indices, one entry for each observation.
        observed_px: (K,2) observed pixel in the distorted photo; integers are pixel centres.
        unplaced: (name, reason) of photos that could not be placed.
        groups: names of the photos of each group that is placed in itself, but not relative to the others; the first
            holds ``photos``. One group, or none where that is not known, is the usual case.
        remarks: what was found out about the photos, and doubts.
        pose_covariance: (6M,6M) joint covariance of the poses from bundle adjustment: for each photo a twist (rad,
            unit) applied on the left of ``cam_from_scan``, in the scan frame in which the cameras together vary least.
        lens_covariance: (9M,9M) the same with the errors of each photo's lens after its twist: of the focal length
            (relative) and of the principal point (by the longer side); None where photos share lenses.
    """

    photos: tuple[PosedPhoto, ...]
    points_in_scan: Array
    colors: NDArray[np.uint8]
    point_errors_px: Array
    observed_point: Indices
    observed_photo: Indices
    observed_px: Array
    unplaced: tuple[tuple[str, str], ...] = field(default=())
    pose_covariance: Array | None = None
    groups: tuple[tuple[str, ...], ...] = ()
    remarks: tuple[str, ...] = ()
    lens_covariance: Array | None = None

    def __post_init__(self) -> None:
        if len(self.observed_point) != len(self.observed_photo) or len(self.observed_point) != len(self.observed_px):
            raise InputError("sparse model: observations of unequal length")
        if not np.isfinite(self.points_in_scan).all():
            raise InputError("sparse model: a point is NaN or infinite")

    @classmethod
    def without_points(cls, photos: tuple[PosedPhoto, ...] = (), pose_covariance: Array | None = None) -> SparseModel:
        """Photos whose poses are known, or none, and no point."""
        none = np.zeros(0, dtype=np.int32)
        colors = np.zeros((0, 3), dtype=np.uint8)
        observed_px = np.zeros((0, 2))
        return cls(
            photos, np.zeros((0, 3)), colors, np.zeros(0), none, none, observed_px, pose_covariance=pose_covariance
        )

    @property
    def lens_stds(self) -> Array | None:
        """(3,) how much the lens changes from photo to photo; None where photos share lenses.

        Focal length (relative), and principal point (by the longer side of the picture).
        """
        cameras = [photo.camera for photo in self.photos]
        if len({(one.fx, one.cx, one.cy) for one in cameras}) < max(3, len(cameras)):
            return None
        sides = np.array([max(one.width, one.height) for one in cameras])
        focal, cx, cy = np.array([(one.fx, one.cx, one.cy) for one in cameras]).T
        return np.array([np.std(focal) / np.mean(focal), np.std(cx / sides), np.std(cy / sides)])

    def transformed(self, scale: float, new_from_scan: Array) -> SparseModel:
        """The model after ``x_new = new_from_scan @ (scale * x_scan)``; scale > 0, ``new_from_scan`` (4,4) rigid."""
        if not scale > 0:
            raise InputError(f"sparse model: scale {scale} is not positive")
        photos = []
        for photo in self.photos:
            scaled = rigid(photo.cam_from_scan[:3, :3], scale * photo.cam_from_scan[:3, 3])
            photos.append(replace(photo, cam_from_scan=scaled @ invert(new_from_scan)))
        points = apply(new_from_scan, scale * self.points_in_scan)
        covariances = []
        for covariance in (self.pose_covariance, self.lens_covariance):
            if covariance is not None:
                factors = np.ones((len(photos), len(covariance) // len(photos)))
                factors[:, 3:6] = scale
                covariance = covariance * np.outer(factors, factors)
            covariances.append(covariance)
        poses, lenses = covariances
        return replace(self, photos=tuple(photos), points_in_scan=points, pose_covariance=poses, lens_covariance=lenses)


@dataclass(frozen=True)
class DenseCloud:
    """A fused cloud in the frame of its sparse model.

    Attributes:
        points: (N,3) float64.
        normals: (N,3) float32 unit, towards the cameras.
        colors: (N,3) uint8 RGB.
        sigma: (N,) float32 standard deviation along the normal, in the unit of ``points``.
        views: (N,) uint8, number of photos that agree on the point.
    """

    points: Array
    normals: NDArray[np.float32]
    colors: NDArray[np.uint8]
    sigma: NDArray[np.float32]
    views: NDArray[np.uint8]
