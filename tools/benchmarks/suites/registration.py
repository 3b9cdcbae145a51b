"""Registration of a simulated post: the exact surface and ICP of arview beside open3d and small_gicp."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from importlib.util import find_spec

import numpy as np

from arview.geometry import Array, apply
from arview.measurement.cloud.registration import register_to_surface
from arview_lab.cloud.icp import (
    IcpOptions,
    IcpTarget,
    register_clouds,
)
from arview_lab.studies.common import EXACT, post
from recordings import skip

REFERENCE, MEASURED = 240_965, 24_099
SHIFT_MM = np.array([0.8, -0.6, 0.0])
RUNS = 5


def registrations() -> Iterator[tuple[str, float, float]]:
    """For each method its name, median CPU seconds with trees and normals, and mean error of the centre, µm."""
    surface, center = post()

    def exact(points: Array, reference: Array, normals: Array) -> Array:
        return register_to_surface(points, surface, center=center, options=EXACT).surface_from_points

    def plane(points: Array, reference: Array, normals: Array) -> Array:
        return register_clouds(points, IcpTarget(reference, normals)).target_from_source

    def point(points: Array, reference: Array, normals: Array) -> Array:
        options = IcpOptions(method="point")
        return register_clouds(points, IcpTarget(reference, normals), options=options).target_from_source

    methods: dict[str, Callable[[Array, Array, Array], Array]] = {
        "exact surface": exact, "point to plane": plane, "point to point": point, **_of_open3d(), **_of_small_gicp(),
    }  # fmt: skip
    for name, method in methods.items():
        seconds, errors = [], []
        for seed in range(RUNS):
            points, _ = surface.spread(MEASURED, seed)
            reference, faces = surface.spread(REFERENCE, 100 + seed)
            began = time.process_time()
            pose = method(points + SHIFT_MM, reference, surface.face_normals[faces])
            seconds.append(time.process_time() - began)
            errors.append(1e3 * float(np.linalg.norm(apply(pose, center + SHIFT_MM) - center)))
        yield name, float(np.median(seconds)), float(np.mean(errors))


def _of_open3d() -> dict[str, Callable[[Array, Array, Array], Array]]:
    if find_spec("open3d") is None:
        skip("open3d", "pip install open3d")
        return {}
    import open3d

    ways = open3d.pipelines.registration
    until = ways.ICPConvergenceCriteria(1e-12, 1e-9, 200)

    def cloud(points: Array, normals: Array | None = None) -> object:
        made = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
        if normals is not None:
            made.normals = open3d.utility.Vector3dVector(normals)
        return made

    def by(estimation: object) -> Callable[[Array, Array, Array], Array]:
        def method(points: Array, reference: Array, normals: Array) -> Array:
            found = ways.registration_icp(cloud(points), cloud(reference, normals), 5.0, np.eye(4), estimation, until)
            return np.asarray(found.transformation)

        return method

    return {
        "open3d point to plane": by(ways.TransformationEstimationPointToPlane()),
        "open3d point to point": by(ways.TransformationEstimationPointToPoint()),
    }


def _of_small_gicp() -> dict[str, Callable[[Array, Array, Array], Array]]:
    if find_spec("small_gicp") is None:
        skip("small_gicp", "pip install small_gicp")
        return {}
    import small_gicp

    def by(kind: str) -> Callable[[Array, Array, Array], Array]:
        def method(points: Array, reference: Array, normals: Array) -> Array:
            found = small_gicp.align(
                reference, points, registration_type=kind, downsampling_resolution=0.01,
                max_correspondence_distance=5.0, num_threads=1, max_iterations=200,
            )  # fmt: skip
            return np.asarray(found.T_target_source)

        return method

    return {"small_gicp GICP": by("GICP"), "small_gicp point to point": by("ICP")}
