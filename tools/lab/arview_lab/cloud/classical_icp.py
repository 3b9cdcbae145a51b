"""The classical way to the position of a component in a cloud: crop, grid average, point-to-point, point-to-plane ICP.

Reference and measured cloud are cut out around the component's nominal place with a margin t, averaged on a grid, and
registered by ICP between points (Besl & McKay 1992), then from points to planes (Chen & Medioni 1992), as Open3D has
them (Zhou, Park & Koltun 2018). It is there to be compared with the registration to the exact surface.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from arview.errors import InputError
from arview.geometry import Array, invert
from arview.measurement.cloud.open3d_library import load_open3d
from arview.measurement.cloud.registration import twist_about
from arview.measurement.types import Move

Distance = Literal["point", "plane"]
"""Distance that a step of ICP minimises: to the nearest point, or to the plane at it."""


@dataclass(frozen=True)
class ClassicalIcpOptions:
    """Options of the classical way."""

    margin_mm: float = 5.0  # t: the cloud is cut out within this distance of the component's nominal bounding box
    grid_mm: float = 0.5  # both clouds are averaged on this grid; 0 keeps every point
    reach_mm: float = 10.0  # partners farther apart are no pair
    last_reach_mm: float = 2.0  # the same in the last step
    steps: tuple[Distance, ...] = ("point", "plane")  # ICP variants, one after the other
    tolerance: float = 1e-9  # converged when share and rms of the pairs change by less, relative
    max_iterations: int = 300  # of each variant
    min_points: int = 20


@dataclass(frozen=True)
class ClassicalIcpResult:
    """Result of the classical way.

    Attributes:
        reference_from_measured: (4,4) mm.
        rms_mm: root mean square distance of the pairs.
        share: share of the measured points that have a partner.
        points: measured and reference points after crop and average.
    """

    reference_from_measured: Array
    rms_mm: float
    share: float
    points: tuple[int, int]


def classical_icp(
    measured: Array, reference: Array, reference_normals: Array, bounds: Array,
    options: ClassicalIcpOptions | None = None,
) -> ClassicalIcpResult:  # fmt: skip
    """Position of measured points (N,3) against a sampled reference (M,3) with unit normals (M,3), in mm.

    Args:
        measured: cloud, near its nominal place.
        reference: points of the nominal surface.
        reference_normals: their normals.
        bounds: (2,3) nominal bounding box, around which both are cut out.
        options: see `ClassicalIcpOptions`.

    Raises:
        InputError: too few points are left, or no point has a partner.
    """
    o = options or ClassicalIcpOptions()
    o3d = load_open3d()
    source = _prepared(o3d, measured, None, bounds, o)
    target = _prepared(o3d, reference, reference_normals, bounds, o)
    counts = (len(source.points), len(target.points))
    if min(counts) < o.min_points:
        raise InputError(f"registration: {counts[0]} measured and {counts[1]} reference points are too few for ICP")
    methods = o3d.pipelines.registration
    until = methods.ICPConvergenceCriteria(o.tolerance, o.tolerance, o.max_iterations)
    pose, found = np.eye(4), None
    for index, step in enumerate(o.steps):
        reach = o.last_reach_mm if index + 1 == len(o.steps) and index > 0 else o.reach_mm
        distance = (
            methods.TransformationEstimationPointToPoint()
            if step == "point"
            else methods.TransformationEstimationPointToPlane()
        )
        found = methods.registration_icp(source, target, reach, pose, distance, until)
        if not len(found.correspondence_set):
            raise InputError(f"registration: no point has a partner within {reach:g} mm")
        pose = np.array(found.transformation)
    assert found is not None
    return ClassicalIcpResult(pose, float(found.inlier_rmse), float(found.fitness), counts)


def icp_move(
    found: Move, measured: Array, reference: Array, reference_normals: Array, bounds: Array,
    options: ClassicalIcpOptions | None = None,
) -> Move:  # fmt: skip
    """A component's move by the classical ICP, from its points (N,3) and a sampled reference (M,3).

    ICP has no covariance that includes the pairing of points; the move keeps that of the exact surface, and what both
    ways differ by is added. Directions that are undetermined there stay so.

    Raises:
        InputError: too few points are left, or no point has a partner.
    """
    fit = classical_icp(measured, reference, reference_normals, bounds, options)
    scales = np.array([found.radius_mm] * 3 + [1.0] * 3)
    determined = np.eye(6) - found.undetermined.T @ found.undetermined
    twist = determined @ (twist_about(found.center_in_model, invert(fit.reference_from_measured)) * scales) / scales
    apart = twist - found.twist
    note = f"placed by ICP: {np.linalg.norm(apart[3:]):.3f} mm from the registration to the exact surface"
    return replace(
        found, twist=twist, covariance=found.covariance + np.outer(apart, apart), residual_mm=fit.rms_mm,
        notes=(*found.notes, note),
    )  # fmt: skip


def _prepared(o3d: Any, points: Array, normals: Array | None, bounds: Array, o: ClassicalIcpOptions) -> Any:
    """An Open3D cloud of the points within the margin of the bounds, averaged on the grid."""
    inside = np.all((points >= bounds[0] - o.margin_mm) & (points <= bounds[1] + o.margin_mm), axis=1)
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points[inside]))
    if normals is not None:
        cloud.normals = o3d.utility.Vector3dVector(normals[inside])
    if o.grid_mm > 0.0 and inside.any():
        cloud = cloud.voxel_down_sample(o.grid_mm)
    if normals is not None:
        cloud.normalize_normals()
    return cloud
