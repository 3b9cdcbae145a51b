"""Circular edges measured in the photos: the rims of holes and pins."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from arview.errors import InputError
from arview.geometry import Array
from arview.measurement.photo.edges import (
    MIN_POINTS,
    MIN_SIGMA_PX,
    SPACING_PX,
    SYSTEMATIC_PX,
    EdgeOffsets,
    edge_offsets,
    pose_gain,
)
from arview.measurement.photo.fit import fit_rigid
from arview.measurement.photo.patches import tangents_of
from arview.measurement.photo.rival_edges import EdgePoints
from arview.measurement.photo.views import PhotoViews


@dataclass(frozen=True)
class RimFit:
    """Measured position of a circular edge in its plane.

    Attributes:
        shift_mm: (3,) displacement of its centre from nominal, orthogonal to the axis, in model axes.
        covariance: (3,3) of ``shift_mm``, zero along the axis.
        radius_shift_mm: found minus nominal radius, which includes effects of light and chamfers and is therefore not a
            measurement of the bore.
        used: number of edge points that agree.
        residual_mm: robust standard deviation of their residuals.
        support: 0–1, share of the points searched that agree.
    """

    shift_mm: Array
    covariance: Array
    radius_shift_mm: float
    used: int
    residual_mm: float
    support: float


def fit_rim(
    center_in_model: Array,
    axis: Array,
    diameter_mm: float,
    views: PhotoViews,
    reach_mm: float = 3.0,
) -> RimFit:
    """Fit the translation of a circular edge within its plane, which is taken to be known.

    Args:
        center_in_model: (3,) centre of the edge, mm. For a hole in a plate this is the rim on the cameras' side; a
            chamfer has two such edges, of which the outer one, where the face ends, is meant.
        axis: (3,) normal of the edge's plane, towards the cameras.
        diameter_mm: of the edge.
        views: the photos.
        reach_mm: largest displacement that is found.

    Raises:
        InputError: the edge is not found in at least three photos.
    """
    axis = np.asarray(axis, dtype=np.float64) / np.linalg.norm(axis)
    center = np.asarray(center_in_model, dtype=np.float64)
    first, second = (vectors[0] for vectors in tangents_of(axis[None]))
    px_mm = views.mm_per_px(center)
    count = int(np.clip(np.pi * diameter_mm / (SPACING_PX * px_mm), 24, 180))
    angle = 2.0 * np.pi * (np.arange(count) + 0.5) / count
    radial = np.cos(angle)[:, None] * first + np.sin(angle)[:, None] * second
    around = np.cross(axis, radial)
    # Rotations and the translation along the axis are excluded; the radius takes the place of the first rotation.
    locked = [*np.eye(6)[1:3].tolist(), [0.0, 0.0, 0.0, *axis.tolist()]]
    shift, radius_mm = np.zeros(3), 0.5 * diameter_mm
    reaches_px = [max(reach_mm / px_mm, 4.0), 5.0, 3.0, 3.0, 3.0]
    for reach_px in reaches_px:
        rim = center + shift + radius_mm * radial
        edges, outward = _seen(views, rim, radial, around, axis)
        # The opposite side of the rim must stay out of reach.
        found = edge_offsets(edges, center + shift, views, min(reach_px, 0.8 * radius_mm / px_mm))
        ok = found.seen & (found.slopes != 0.0)
        if np.count_nonzero(ok) < MIN_POINTS or len(np.unique(edges.view[ok])) < 3:
            raise InputError(
                f"rim of ⌀{diameter_mm:g} mm at ({', '.join(f'{x:.1f}' for x in center)}): its edge is found in "
                f"{len(np.unique(edges.view[ok]))} photos at {np.count_nonzero(ok)} points; take photos that show it"
            )
        fit = fit_rigid(
            _rows(found, outward)[ok],
            found.offsets_mm[ok],
            0.3 * found.mm_per_px[ok],
            free=np.array(locked),
            radius_mm=1.0,
            undetermined_mm=reach_mm,
            places=edges.points[ok] / (4.0 * px_mm),
            min_sigma=MIN_SIGMA_PX / 0.3,
        )
        shift = shift + fit.twist[3:]
        radius_mm += float(fit.twist[0])
    systematic_mm = SYSTEMATIC_PX * px_mm
    covariance = fit.covariance[3:, 3:] + systematic_mm**2 * (np.eye(3) - np.outer(axis, axis))
    if views.pose_covariance is not None:
        by_poses = pose_gain(views, fit, edges.view[ok], found.pose_rows[ok])[3:]
        covariance = covariance + by_poses @ views.pose_covariance @ by_poses.T
    used = int(np.count_nonzero(fit.weights > 0.1))
    return RimFit(
        shift, covariance, radius_mm - 0.5 * diameter_mm, used, fit.residual_mm, used / max(1, len(edges.points))
    )


def _rows(found: EdgeOffsets, outward: Array) -> Array:
    """(N,6) derivatives of the offsets by the radius, by two placeholders, and by the translation."""
    grown = np.sum(found.directions * outward, axis=1)
    return np.concatenate([grown[:, None], np.zeros((len(grown), 2)), found.directions], axis=1)


def _seen(views: PhotoViews, rim: Array, radial: Array, around: Array, axis: Array) -> tuple[EdgePoints, Array]:
    """Points of the rim that each photo shows, tested just above the rim, and their outward directions (N,3)."""
    points, tangents, outward, owner = [], [], [], []
    groups = (rim + 0.1 * axis)[:, None]
    for view in range(len(views.cameras)):
        window = views.window(view, None, np.eye(4), groups.reshape(-1, 3))
        seen = views.visible(view, window, groups) & ((views.centres[view] - rim) @ axis > 0)
        points.append(rim[seen])
        tangents.append(around[seen])
        outward.append(radial[seen])
        owner.append(np.full(np.count_nonzero(seen), view))
    edges = EdgePoints(np.concatenate(points), np.concatenate(tangents), np.concatenate(owner))
    return edges, np.concatenate(outward)
