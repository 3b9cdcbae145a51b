"""Similarity transforms between the reconstruction and the CAD, or between two sets of points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from arview.core.fits import fit_similarity
from arview.errors import InputError
from arview.geometry import Array, apply, exp_se3, invert, orthonormalise, rigid


@dataclass(frozen=True)
class Similarity:
    """``x_model = model_from_scan @ (scale * x_scan)``; scale in mm per unit, ``model_from_scan`` (4,4) rigid."""

    scale: float
    model_from_scan: Array

    def cam_from_model(self, cam_from_scan: Array) -> Array:
        """(4,4) pose in mm of a photo whose pose in the reconstruction is known."""
        scaled = rigid(cam_from_scan[:3, :3], self.scale * cam_from_scan[:3, 3])
        return np.asarray(scaled @ invert(self.model_from_scan))

    def points_in_model(self, points_in_scan: Array) -> Array:
        """(N,3) in mm, of points (N,3) of the reconstruction."""
        return apply(self.model_from_scan, self.scale * points_in_scan)

    def moved(self, step: Array, center_in_model: Array) -> Similarity:
        """The similarity after a step (7,): twist about the model's centre, right of ``cam_from_model``, and d
        log(scale).

        The change of scale leaves the centre where it is in the reconstruction.
        """
        to_center = rigid(np.eye(3), center_in_model)
        scan_from_model = invert(to_center @ exp_se3(-step[:6]) @ invert(to_center) @ self.model_from_scan)
        factor = float(np.exp(step[6]))
        scan_from_model[:3, 3] += (factor - 1.0) * apply(scan_from_model, center_in_model)
        return Similarity(self.scale * factor, orthonormalise(invert(scan_from_model)))


@dataclass(frozen=True)
class PointFit:
    """A similarity fitted to points.

    Attributes:
        similarity: the fit.
        scale_std: relative standard deviation of its scale.
        rms_mm: root mean square residual.
    """

    similarity: Similarity
    scale_std: float
    rms_mm: float


def fit_points(points_in_scan: Array, points_in_mm: Array, scale: float | None = None) -> PointFit:
    """Least-squares similarity from points (N,3) of the reconstruction to the same points in mm.

    The uncertainty of the scale follows from the residuals. With ``scale`` given, only the rigid motion is fitted.

    Raises:
        InputError: there are fewer than three points, or all coincide.
    """
    source, target = np.asarray(points_in_scan, np.float64), np.asarray(points_in_mm, np.float64)
    if len(source) < 3 or source.shape != target.shape:
        raise InputError(f"similarity: {len(source)} and {len(target)} points; expected at least three pairs")
    size = float(np.sum((target - target.mean(axis=0)) ** 2))
    if not np.ptp(source, axis=0).any() or not size > 0:
        raise InputError("similarity: all points are at the same place")
    similarity = Similarity(*fit_similarity(source, target, scale))
    left = target - similarity.points_in_model(source)
    variance = float(np.sum(left * left)) / max(1, 3 * len(source) - 7)
    std = float(np.sqrt(variance / size))
    return PointFit(similarity, std, float(np.sqrt(np.mean(np.sum(left * left, axis=1)))))
