"""Quality figures of a reconstruction."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from arview.reconstruction.adjustment.covariance import reprojection_residuals
from arview.reconstruction.types import DenseCloud, SparseModel


@dataclass(frozen=True)
class Quality:
    """Figures of a reconstruction. They do not prove it right; a consistency check with the CAD or known lengths does.

    Attributes:
        photos, points, observations: numbers of placed photos, points and observations.
        reprojection_rms_px: over all observations.
        reprojection_median_px: median length of the residuals.
        track_length: mean number of photos that see a point.
        points_of_photo: points seen in each photo, by its name; few mean a weakly placed photo.
        cloud_points: of the dense cloud; 0 without one.
        cloud_sigma: median standard deviation of its points along their normals, in the unit of the model.
        cloud_views: median number of photos that agree on a point.
    """

    photos: int
    points: int
    observations: int
    reprojection_rms_px: float
    reprojection_median_px: float
    track_length: float
    points_of_photo: dict[str, int]
    cloud_points: int = 0
    cloud_sigma: float | None = None
    cloud_views: float | None = None

    def as_dict(self) -> dict[str, Any]:
        """The figures for JSON."""
        return asdict(self)


def quality_of(sparse: SparseModel, cloud: DenseCloud | None) -> Quality:
    """Figures of a sparse model and, if there is one, its cloud."""
    lengths = np.linalg.norm(reprojection_residuals(sparse), axis=1)
    counts = np.bincount(sparse.observed_photo, minlength=len(sparse.photos))
    has_cloud = cloud is not None and len(cloud.points) > 0
    return Quality(
        photos=len(sparse.photos),
        points=len(sparse.points_in_scan),
        observations=len(lengths),
        reprojection_rms_px=float(np.sqrt(np.mean(lengths**2))) if len(lengths) else 0.0,
        reprojection_median_px=float(np.median(lengths)) if len(lengths) else 0.0,
        track_length=len(lengths) / max(1, len(sparse.points_in_scan)),
        points_of_photo={photo.name: int(count) for photo, count in zip(sparse.photos, counts, strict=True)},
        cloud_points=len(cloud.points) if cloud is not None else 0,
        cloud_sigma=float(np.median(cloud.sigma)) if cloud is not None and has_cloud else None,
        cloud_views=float(np.median(cloud.views)) if cloud is not None and has_cloud else None,
    )
