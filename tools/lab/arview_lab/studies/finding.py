"""A quarter of a part beside ten times as many foreign points: found by pairs of points, and by FPFH and RANSAC."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from arview.cad import load_part
from arview.cad.model import Model
from arview.errors import InputError
from arview.geometry import Array, apply, exp_so3, invert, rigid
from arview.measurement.cloud.mesh_surface import MeshSurface
from arview.measurement.cloud.open3d_library import load_open3d
from arview.measurement.cloud.pair_registration import find_by_pairs
from arview_lab.chart import Chart
from arview_lab.studies.common import Study

POINTS = 12_000
"""Points of the part that the cloud shows."""
SHARE = 0.25
"""Share of the part's surface that it shows."""
FOREIGN = 10
"""Foreign points for each point of the part."""
NOISE = 2e-4
"""Noise of a point, and below the error of a place that counts as found, both in diameters."""
FOUND = 0.01
METHODS = ("pairs of points", "FPFH and RANSAC")


@dataclass(frozen=True)
class ClutteredCloud:
    """A cloud with its truth: points (N,3) and normals (N,3) in mm, and ``model_from_scan`` (4,4), None if absent."""

    points: Array
    normals: Array
    model_from_scan: Array | None


def finding_study(part_path: str, is_quick: bool = False, seed: int = 0, runs: int | None = None) -> Study:
    """Search a part in random clouds that show a quarter of it, and in clouds without it, which must be refused.

    FPFH and RANSAC (Rusu et al., ICRA 2009; as in Open3D) states a place always; it is refined by point-to-plane ICP.

    Args:
        part_path: part or CAD file.
        is_quick: one cloud with the part and none without.
        seed: of the clouds.
        runs: clouds with the part, default 6; half as many without it.
    """
    model = load_part(part_path).model
    runs = 1 if is_quick else runs or 6
    jobs = [(k, True) for k in range(runs)] + [(k, False) for k in range(0 if is_quick else runs // 2)]
    rows: list[tuple[object, ...]] = []
    for k, has_part in jobs:
        scene = scene_of(model, has_part, np.random.default_rng([seed, k, int(has_part)]))
        for method in METHODS:
            start = time.process_time()
            found, score = _searched(method, scene, model)
            spent = time.process_time() - start
            error = _error(found, scene, model)
            right = found is None if not has_part else error is not None and error < FOUND
            rows.append((
                k, "part" if has_part else "no part", method, "" if error is None else error,
                "" if score is None else score, "refused" if found is None else "placed", int(right), spent,
            ))  # fmt: skip
    chart = Chart("Error of the place", "cloud", "error / diameters", False, True)
    summary = []
    for method in METHODS:
        mine = [row for row in rows if row[2] == method]
        placed = [row for row in mine if row[1] == "part"]
        absent = [row for row in mine if row[1] == "no part"]
        text = f"{method}: found in {sum(int(str(row[6])) for row in placed)} of {len(placed)} clouds"
        wrong = sum(row[5] == "placed" and not row[6] for row in mine)
        cpu = float(np.mean([float(str(row[7])) for row in mine]))
        if absent:
            text += f", refused in {sum(int(str(row[6])) for row in absent)} of {len(absent)} without it"
        summary.append(f"{text}; {wrong} wrong places; {cpu:.0f} s of CPU time each")
        chart.add(
            [float(str(row[0])) for row in placed if row[3] != ""],
            [float(str(row[3])) for row in placed if row[3] != ""], method, "points",
        )  # fmt: skip
    columns = ("cloud", "holds", "method", "error_diameters", "score", "result", "right", "cpu_s")
    return Study("finding", {"finding": (columns, rows)}, chart.draw(), tuple(summary))


def scene_of(model: Model, has_part: bool, rng: np.random.Generator) -> ClutteredCloud:
    """A random cloud: one end of the part, boxes, tubes and balls around it, all in a random frame."""
    vertices, faces, _ = model.mesh
    surface = MeshSurface(vertices, faces)
    size = model.diameter_mm
    points, of_face = surface.spread(round(POINTS / SHARE), int(rng.integers(1 << 31)))
    along = points @ _unit(rng)
    shown = along <= np.quantile(along, SHARE)
    seen, sides = points[shown], surface.face_normals[of_face[shown]]
    low, high = vertices.min(axis=0) - 0.01 * size, vertices.max(axis=0) + 0.01 * size
    others = [_thing(rng, size, seen.mean(axis=0)) for _ in range(14)]
    around, around_normals = (np.concatenate([one[i] for one in others]) for i in (0, 1))
    free = ~np.all((around > low) & (around < high), axis=1)
    few = rng.permutation(np.flatnonzero(free))[: FOREIGN * len(seen)]
    all_points, all_normals = around[few], around_normals[few]
    if has_part:
        all_points, all_normals = np.concatenate([seen, all_points]), np.concatenate([sides, all_normals])
    all_points = all_points + rng.normal(0.0, NOISE * size, all_points.shape)
    place = rigid(exp_so3(rng.uniform(0.0, np.pi) * _unit(rng)), rng.uniform(-500.0, 500.0, 3))
    return ClutteredCloud(apply(place, all_points), all_normals @ place[:3, :3].T, invert(place) if has_part else None)


def _thing(rng: np.random.Generator, size: float, middle: Array) -> tuple[Array, Array]:
    """Points and normals of a random box, tube or ball near the part."""
    count = 2 * FOREIGN * POINTS // 14
    half = rng.uniform(0.06, 0.4, 3) * size
    kind = int(rng.integers(3))
    if kind == 0:
        axis = rng.choice(3, count, p=1.0 / half / np.sum(1.0 / half))
        sign = rng.choice([-1.0, 1.0], count)
        points = rng.uniform(-1.0, 1.0, (count, 3)) * half
        points[np.arange(count), axis] = sign * half[axis]
        normals = np.zeros((count, 3))
        normals[np.arange(count), axis] = sign
    else:
        normals = rng.normal(size=(count, 3))
        normals[:, 2] *= kind - 1
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        points = 0.5 * half[0] * normals
        points[:, 2] += (2 - kind) * rng.uniform(-1.0, 1.0, count) * half[2]
    turn = exp_so3(rng.uniform(0.0, np.pi) * _unit(rng))
    at = middle + rng.uniform(0.2, 1.2) * size * _unit(rng)
    return points @ turn.T + at, normals @ turn.T


def _unit(rng: np.random.Generator) -> Array:
    """(3,) random direction."""
    vector = rng.normal(size=3)
    return np.asarray(vector / np.linalg.norm(vector))


def _searched(method: str, scene: ClutteredCloud, model: Model) -> tuple[Array | None, float | None]:
    """``model_from_scan`` and its score; None if the part is said not to be there."""
    if method == METHODS[0]:
        try:
            found = find_by_pairs(scene.points, scene.normals, model)
        except InputError:
            return None, None
        return found.model_from_scan, found.score
    return _by_features(scene, model)


def _by_features(scene: ClutteredCloud, model: Model) -> tuple[Array, float]:
    """Place by FPFH, RANSAC and ICP as in Open3D's examples."""
    o3d = load_open3d()
    methods = o3d.pipelines.registration
    vertices, faces, _ = model.mesh
    surface = MeshSurface(vertices, faces)
    cell = 0.014 * model.diameter_mm
    samples, of_face = surface.spread(60_000, 0)

    def prepared(points: Array, normals: Array) -> tuple[Any, Any]:
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
        cloud.normals = o3d.utility.Vector3dVector(normals)
        cloud = cloud.voxel_down_sample(cell)
        cloud.normalize_normals()
        return cloud, methods.compute_fpfh_feature(cloud, o3d.geometry.KDTreeSearchParamHybrid(5.0 * cell, 100))

    o3d.utility.set_verbosity_level(o3d.utility.VerbosityLevel.Error)
    o3d.utility.random.seed(0)
    part, of_part = prepared(samples, surface.face_normals[of_face])
    cloud, of_cloud = prepared(scene.points, scene.normals)
    found = methods.registration_ransac_based_on_feature_matching(
        part, cloud, of_part, of_cloud, True, 1.5 * cell, methods.TransformationEstimationPointToPoint(False), 3,
        [methods.CorrespondenceCheckerBasedOnEdgeLength(0.9), methods.CorrespondenceCheckerBasedOnDistance(1.5 * cell)],
        methods.RANSACConvergenceCriteria(400_000, 0.999),
    )  # fmt: skip
    plane = methods.TransformationEstimationPointToPlane()
    finer = methods.registration_icp(part, cloud, cell, found.transformation, plane)
    return invert(np.array(finer.transformation)), float(finer.fitness)


def _error(found: Array | None, scene: ClutteredCloud, model: Model) -> float | None:
    """Mean distance of the model's corners from where they are, in diameters; None without a place or a truth."""
    if found is None or scene.model_from_scan is None:
        return None
    corners = np.array([[model.bounds_in_model[i, k] for k, i in enumerate(which)] for which in np.ndindex(2, 2, 2)])
    moved = apply(found @ invert(scene.model_from_scan), corners)
    return float(np.linalg.norm(moved - corners, axis=1).mean() / model.diameter_mm)
