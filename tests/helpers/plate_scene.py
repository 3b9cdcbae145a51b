"""A plate with two holes and four blocks: as designed, as built with known errors, and as a part to be measured."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np

from arview.cad.model import Component, Model, make_model
from arview.cad.part import ComponentSettings, Datum, Part
from arview.geometry import Array, apply, exp_so3, rigid
from helpers.cad_files import box

HOLE_MM = 16.0
BLOCKS = {"block_1": (-55, -60), "block_2": (55, -60), "block_3": (55, 60), "block_4": (-55, 60)}


def plate_with_holes() -> tuple[Array, Array]:
    """200 × 200 × 8 mm, top at z = 0, with holes of ⌀16 at (±50, 0): vertices and faces."""
    corners = np.arctan2([100, 100, -100, -100], [50, -50, -50, 50])
    angle = np.sort(np.concatenate([np.arange(48) * 2 * np.pi / 48 - np.pi + 0.01, corners]))
    direction = np.column_stack([np.cos(angle), np.sin(angle)])
    reach = np.min(np.array([50.0, 100.0]) / np.maximum(np.abs(direction), 1e-9), axis=1)
    vertices: list[Array] = []
    faces: list[tuple[int, int, int]] = []
    for mirror in (1.0, -1.0):
        middle = np.array([-50.0 * mirror, 0.0])
        turned = direction * np.array([mirror, 1.0])
        start, n = sum(len(v) for v in vertices), len(angle)
        rings = [(0.5 * HOLE_MM * np.ones(n), 0.0), (reach, 0.0), (0.5 * HOLE_MM * np.ones(n), -8.0), (reach, -8.0)]
        vertices += [np.column_stack([middle + r[:, None] * turned, np.full(n, z)]) for r, z in rings]
        for i in range(n):
            j = (i + 1) % n
            top_in, top_out, low_in, low_out = (start + k * n for k in range(4))
            sides = [
                (top_in + i, top_out + i, top_out + j, top_in + j),
                (low_in + i, low_in + j, low_out + j, low_out + i),
                (top_in + j, low_in + j, low_in + i, top_in + i),
            ]
            edge = middle[0] + mirror * (reach[[i, j]] * direction[[i, j], 0])
            if not np.allclose(edge, 0.0, atol=1e-6):
                sides.append((top_out + i, low_out + i, low_out + j, top_out + j))
            for a, b, c, d in sides:
                faces += [(a, b, c), (a, c, d)] if mirror > 0 else [(a, c, b), (a, d, c)]
    points = np.concatenate(vertices).round(9)
    unique, owner = np.unique(points, axis=0, return_inverse=True)
    return unique, owner.ravel()[np.array(faces)].astype(np.int32)


@cache
def nominal() -> Model:
    outline, triangles = plate_with_holes()
    parts = [Component("plate", outline, triangles.astype(np.int32))]
    for i, (name, (x, y)) in enumerate(BLOCKS.items()):
        half = np.array([14.0 + i, 12.0, 10.0 + 2 * i])
        vertices, faces = box((x - half[0], y - half[1], 0), (x + half[0], y + half[1], 2 * half[2]))
        parts.append(Component(name, vertices, faces.astype(np.int32)))
    return make_model("plate", tuple(parts))


TRUTH: dict[str, tuple[Array, Array]] = {
    "block_1": (np.array([1.0, -0.6, 0.0]), np.zeros(3)),
    "block_2": (np.zeros(3), np.zeros(3)),
    "block_3": (np.array([-0.2, 0.3, 0.0]), np.array([0.0, 0.0, 2.0])),
}
"""Displacement in mm and rotation vector in degrees; block_4 is missing."""


def as_built() -> Model:
    parts = [nominal().component("plate")]
    for name, (shift, turn_deg) in TRUTH.items():
        component = nominal().component(name)
        center = component.bounds_in_model.mean(axis=0)
        rotation = exp_so3(np.deg2rad(turn_deg))
        place = rigid(rotation, center - rotation @ center + shift)
        parts.append(replace(component, vertices_in_model=apply(place, component.vertices_in_model)))
    return make_model("built", tuple(parts))


def part(datums: bool = True) -> Part:
    settings = [ComponentSettings("plate", "base")]
    settings += [ComponentSettings(name, "inspect", 0.5, 1.0 if name == "block_3" else None) for name in BLOCKS]
    system = (
        Datum("A", "plane", "plate", (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
        Datum("B", "hole", "plate", (-50.0, 0.0, 0.0), (0.0, 0.0, 1.0), HOLE_MM),
        Datum("C", "hole", "plate", (50.0, 0.0, 0.0), (0.0, 0.0, 1.0), HOLE_MM),
    )
    model = nominal()
    return Part("plate", Path("part.toml"), Path("plate.step"), model, tuple(settings), datums=system if datums else ())
