"""A plate with a wall and blocks on both, in files with any axis up, and components of it that are displaced."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from arview.cad import Part
from arview.cad.model import Component, make_model
from arview.cad.part import ComponentSettings, Datum, ReworkSettings
from arview.cad.view_range import Up
from arview.geometry import Array, exp_so3, rigid
from arview.inspection import ComponentDeviation, Verdict
from helpers.cad_files import box
from helpers.inspections import deviation

UP: dict[str, Array] = {
    "z": np.eye(3),
    "y": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
    "-z": np.diag([1.0, -1.0, -1.0]),
    "x": np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]),
}
"""Rotations from a part whose +Z is up to the same part in files with another axis up."""


def wall(up: Up = "z", rework: ReworkSettings | None = None) -> Part:
    """A plate with a wall on it; blocks on the plate, at the sides of block_1, and two on the wall; a hole B."""
    turn = UP[up]
    boxes = {
        "plate": ((-100, -100, -10), (100, 100, 0)),
        "wall": ((-100, 80, 0), (100, 100, 80)),
        "block_1": ((-10, -10, 0), (10, 10, 20)),
        "east": ((60, -5, 0), (70, 5, 20)),
        "west": ((-70, -5, 0), (-60, 5, 20)),
        "south": ((-5, -70, 0), (5, -60, 20)),
        "clip": ((-10, 68, 30), (10, 80, 50)),
        "lamp": ((50, 68, 35), (60, 80, 45)),
    }
    parts = []
    for name, (low, high) in boxes.items():
        vertices, faces = box(low, high)
        parts.append(Component(name, np.asarray(vertices, float) @ turn.T, faces.astype(np.int32)))
    settings_of = [
        ComponentSettings(name, "base" if name in ("plate", "wall") else "inspect", 0.5,
                          rework=rework or ReworkSettings())
        for name in boxes
    ]  # fmt: skip
    hole, axis = (turn @ [-80.0, 60.0, 0.0]).tolist(), (turn @ [0.0, 0.0, 1.0]).tolist()
    datum = Datum("B", "hole", "plate", tuple(hole), tuple(axis), 10.0)
    path = Path("part.toml")
    return Part("wall", path, path, make_model("wall", tuple(parts)), tuple(settings_of), datums=(datum,), up=up)


def off(
    part: Part, name: str, moved: tuple[float, float, float], rotation_deg: tuple[float, float, float] = (0, 0, 0),
    uncertainty_mm: float = 0.06, angle_tolerance_deg: float | None = None, up: str = "z",
) -> ComponentDeviation:  # fmt: skip
    """A component displaced by a vector and turned, both in the frame whose +Z is up."""
    center = part.model.component(name).centroid_in_model
    shift = UP[up] @ np.array(moved)
    turn = exp_so3(UP[up] @ np.deg2rad(rotation_deg))
    place = rigid(turn, center - turn @ center + shift)
    x, y, z = shift.tolist()
    one = deviation(name, (x, y, z), center, uncertainty_mm=uncertainty_mm, angle_tolerance_deg=angle_tolerance_deg)
    assert one.details is not None
    std = 0.5 * uncertainty_mm
    details = replace(
        one.details,
        measured_from_nominal=tuple(tuple(float(v) for v in row) for row in place),
        covariance=tuple(tuple(float(v) for v in row) for row in np.diag([1e-7] * 3 + [std**2] * 3)),
        angle_deg=float(np.linalg.norm(rotation_deg)),
        angle_tolerance_deg=angle_tolerance_deg,
        measurand="volume_centroid",
    )
    return replace(one, details=details, verdict=Verdict.FAIL)
