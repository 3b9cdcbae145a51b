"""Rigid registration of a measured cloud to a known surface: arview beside open3d and small_gicp, with a known pose."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec

import numpy as np
from numpy.typing import NDArray

from arview.cad import load_part
from arview.geometry import Array, apply, exp_so3, invert, rigid, rotation_angle_rad
from arview.measurement.cloud.mesh_surface import MeshSurface
from arview.measurement.cloud.registration import register_to_surface
from arview_lab.studies.common import EXACT, post
from peers.alone import alone, environment
from recordings import skip
from suites.scaling import PLATE

REFERENCE, MEASURED = 240_000, 24_000
"""Points that stand for the surface, which ICP needs, and points of the measured cloud."""
NOISE_MM = 0.05
SHIFT_MM = (0.8, -0.6, 0.4)
TURN_DEG = 0.5
SEED_OF_REFERENCE = 100
REACH_MM = 5.0
"""Largest distance of corresponding points, for all."""
STRICT = (1e-12, 1e-9, 200)
"""Relative changes of fitness and of RMS error at which ICP ends, and most iterations: as exact as it gets."""

Way = Callable[[Array, Array, Array], Array]
"""``target_from_source`` (4,4) of points (N,3), reference points (M,3) and their normals (M,3), mm."""


@dataclass(frozen=True)
class Surface:
    """A surface to register to: vertices (V,3) and centre (3,), mm, faces (F,3); whether it is one of revolution."""

    name: str
    vertices: Array
    faces: NDArray[np.integer]
    center: Array
    is_round: bool


@dataclass(frozen=True)
class CloudRow:
    """One way on one surface: CPU seconds of each round, trees included, and its errors.

    Attributes:
        on, way: names.
        rounds_s: CPU seconds.
        translation_mm: (rounds) errors of the place of the centre.
        rotation_deg: (rounds) errors of the orientation, or None on a round surface, which does not determine it.
    """

    on: str
    way: str
    rounds_s: list[float]
    translation_mm: list[float]
    rotation_deg: list[float] | None


def surfaces() -> list[Surface]:
    """A post, and the plate of the samples with what stands on it."""
    of_post, center = post()
    model = load_part(PLATE / "part.toml").model
    vertices, faces, _ = model.mesh
    return [
        Surface("post", of_post.vertices, of_post.faces, center, True),
        Surface("sample plate", vertices, faces, model.center_in_model, False),
    ]


def cloud_rows(rounds: int) -> list[CloudRow]:
    """All ways on all surfaces, in a process in which OpenMP has one thread: idle ones would count."""
    with environment(OMP_NUM_THREADS="1"):
        return alone(_rows, rounds)


def _rows(rounds: int) -> list[CloudRow]:
    peers = {**_of_open3d(), **_of_small_gicp()}
    return [row for surface in surfaces() for row in _on(surface, peers, rounds)]


def _on(surface: Surface, peers: dict[str, Way], rounds: int) -> list[CloudRow]:
    known = MeshSurface(surface.vertices, surface.faces)
    move = rigid(exp_so3(np.radians(TURN_DEG) * np.array([0.6, 0.0, 0.8])), np.array(SHIFT_MM))
    move[:3, 3] += surface.center - move[:3, :3] @ surface.center  # turns about the centre

    def exact(points: Array, reference: Array, normals: Array) -> Array:
        fresh = MeshSurface(surface.vertices, surface.faces)
        return register_to_surface(points, fresh, center=surface.center, options=EXACT).surface_from_points

    ways = {"arview, to the exact surface": exact, **peers}
    rows = {name: CloudRow(surface.name, name, [], [], None if surface.is_round else []) for name in ways}
    for seed in range(-1, rounds):  # the first round, which loads code, does not count
        rng = np.random.default_rng(seed + 1)
        clean, _ = known.spread(MEASURED, seed + 1)
        points = apply(move, clean + rng.normal(0.0, NOISE_MM, clean.shape))
        reference, of_face = known.spread(REFERENCE, SEED_OF_REFERENCE + seed)
        for name, way in ways.items():
            began_s = time.process_time()
            found = way(points, reference, known.face_normals[of_face])
            spent_s = time.process_time() - began_s
            if seed < 0:
                continue
            row, truth = rows[name], invert(move)
            row.rounds_s.append(spent_s)
            moved = apply(move, surface.center)
            row.translation_mm.append(float(np.linalg.norm(apply(found, moved) - surface.center)))
            if row.rotation_deg is not None:
                row.rotation_deg.append(float(np.degrees(rotation_angle_rad(truth, found))))
    return list(rows.values())


def _of_open3d() -> dict[str, Way]:
    if find_spec("open3d") is None:
        skip("open3d", "pip install open3d")
        return {}
    import open3d

    ways, vector = open3d.pipelines.registration, open3d.utility.Vector3dVector

    def by(criteria: object) -> Way:
        def way(points: Array, reference: Array, normals: Array) -> Array:
            source, target = (open3d.geometry.PointCloud(vector(each)) for each in (points, reference))
            target.normals = vector(normals)
            plane = ways.TransformationEstimationPointToPlane()
            found = ways.registration_icp(source, target, REACH_MM, np.eye(4), plane, criteria)
            return np.asarray(found.transformation)

        return way

    return {
        "open3d point to plane, its defaults": by(ways.ICPConvergenceCriteria()),
        "open3d point to plane, to the end": by(ways.ICPConvergenceCriteria(*STRICT)),
    }


def _of_small_gicp() -> dict[str, Way]:
    if find_spec("small_gicp") is None:
        skip("small_gicp", "pip install small_gicp")
        return {}
    import small_gicp

    def by(kind: str) -> Way:
        def way(points: Array, reference: Array, normals: Array) -> Array:
            found = small_gicp.align(
                reference, points, registration_type=kind, downsampling_resolution=0.01,
                max_correspondence_distance=REACH_MM, num_threads=1,
            )  # fmt: skip
            return np.asarray(found.T_target_source)

        return way

    return {"small_gicp point to plane": by("PLANE_ICP"), "small_gicp GICP": by("GICP")}
