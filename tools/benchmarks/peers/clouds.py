"""Rigid registration of a measured cloud to a known surface: arview beside open3d and small_gicp, with a known pose."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from arview.cad import load_part
from arview.geometry import Array, apply, exp_so3, invert, rigid, rotation_angle_rad
from arview.measurement.cloud.mesh_surface import MeshSurface
from arview.measurement.cloud.registration import register_to_surface
from arview_lab.studies.common import EXACT, post
from peers.alone import alone, environment
from suites.registration import of_open3d, of_small_gicp
from suites.scaling import PLATE

REFERENCE, MEASURED = 240_000, 24_000
"""Points that stand for the surface, which ICP needs, and points of the measured cloud."""
NOISE_MM = 0.05
SHIFT_MM = (0.8, -0.6, 0.4)
TURN_DEG = 0.5
SEED_OF_REFERENCE = 100
PEERS = ("open3d point to plane", "small_gicp GICP")


@dataclass(frozen=True)
class Surface:
    """A surface to register to, its centre (3,), mm, and whether its points determine all rotations."""

    name: str
    vertices: Array
    faces: Array
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
    peers = {name: way for name, way in {**of_open3d(), **of_small_gicp()}.items() if name in PEERS}
    return [row for surface in surfaces() for row in _on(surface, peers, rounds)]


def _on(surface: Surface, peers: dict[str, Callable[[Array, Array, Array], Array]], rounds: int) -> list[CloudRow]:
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
