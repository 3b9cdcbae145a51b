"""Simple solids and the STEP file of the samples' CAD models. Lengths in mm."""

from __future__ import annotations

from pathlib import Path

import build123d as bd
import numpy as np


def on_plate(x: float, y: float, turn_deg: float = 0.0) -> bd.Location:
    return bd.Location((x, y, 0.0), (0.0, 0.0, turn_deg))


def post(diameter: float, height: float) -> bd.Part:
    """Round post standing on z = 0 with a 1 mm chamfer at its top."""
    post = bd.Solid.make_cylinder(diameter / 2, height)
    return post.chamfer(1.0, None, post.edges().sort_by(bd.Axis.Z)[-1:])


def box(x: float, y: float, z: float) -> bd.Part:
    """Box centred in x and y, standing on z = 0."""
    return bd.Pos(0, 0, z / 2) * bd.Box(x, y, z)


def ring(outer: float, inner: float, height: float) -> bd.Part:
    ring = bd.Cylinder(outer / 2, height) - bd.Cylinder(inner / 2, 3 * height)
    return bd.Pos(0, 0, height / 2) * ring


def write_step(path: Path, label: str, components) -> None:
    """Write (name, solid, colour) as STEP AP214 with product names, colours and millimetres."""
    children = []
    for name, shape, color in components:
        solid = shape.solid() if hasattr(shape, "solid") else shape
        solid.label = name
        solid.color = bd.Color(*color)
        children.append(solid)
    assembly = bd.Compound(label=label, children=children)
    bd.export_step(assembly, str(path), unit=bd.Unit.MM)


def tessellated(components, linear_mm: float = 0.02, angular_rad: float = 0.12) -> dict:
    """Finely tessellated (name, solid, colour): name → vertices (V,3), faces (F,3)."""
    meshes = {}
    for name, shape, _ in components:
        vertices, faces = shape.tessellate(linear_mm, angular_rad)
        meshes[name] = np.array([tuple(v) for v in vertices]), np.array(faces)
    return meshes
