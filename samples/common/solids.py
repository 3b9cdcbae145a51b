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


def seated(origin, normal, right=(1.0, 0.0, 0.0)) -> bd.Location:
    """A seat: +Z along its normal, +X as near to ``right`` as it can be."""
    normal, right = np.asarray(normal, float), np.asarray(right, float)
    normal = normal / np.linalg.norm(normal)
    across = right - (right @ normal) * normal
    return bd.Plane(tuple(map(float, origin)), tuple(across), tuple(normal)).location


def matrix(location: bd.Location) -> np.ndarray:
    """A location as a (4,4) matrix."""
    transform = location.wrapped.Transformation()
    return np.array([[transform.Value(i, j) for j in range(1, 5)] for i in range(1, 4)] + [[0.0, 0.0, 0.0, 1.0]])


def turned(*profile) -> bd.Part:
    """Solid of revolution about Z of (radius, height) points."""
    outline = bd.make_face(bd.Polyline(*((float(r), 0.0, float(z)) for r, z in profile), close=True))
    return bd.revolve(outline, bd.Axis.Z)


def hexagon(across_flats: float, height: float) -> bd.Part:
    """Hexagonal prism standing on z = 0."""
    return bd.extrude(bd.RegularPolygon(across_flats / 2, 6, major_radius=False), height)


def clip(length: float, width: float, rise: float, thickness: float) -> bd.Part:
    """Saddle clip of sheet, standing on z = 0: two feet along X, a half-round arch between, a hole in each foot."""
    radius = rise
    arch = bd.Cylinder(radius, width, rotation=(90, 0, 0)) - bd.Cylinder(
        radius - thickness, 3 * width, rotation=(90, 0, 0)
    )
    arch -= bd.Pos(0, 0, -radius) * bd.Box(4 * radius, 3 * width, 2 * radius)
    foot = length / 2 - radius + thickness
    part = arch
    for side in (-1, 1):
        middle = side * (length - foot) / 2
        part += bd.Pos(middle, 0, 0) * box(foot, width, thickness)
        part -= bd.Pos(side * (length / 2 - 0.45 * foot), 0, 0) * bd.Cylinder(0.18 * width, 4 * thickness)
    return part


def angle(width: float, foot: float, height: float, thickness: float, hole: float, bend: float = 0.0) -> bd.Part:
    """Angle bracket: foot along +Y, wall in the XZ plane with one hole, ``bend`` the outer radius between them."""
    part = bd.Pos(0, foot / 2, 0) * box(width, foot, thickness) + bd.Pos(0, thickness / 2, 0) * box(
        width, thickness, height
    )
    if bend:
        outer = part.edges().filter_by(bd.Axis.X).filter_by(lambda e: abs(e.center().Y) + abs(e.center().Z) < 1e-6)
        part = bd.fillet(outer, bend)
    return part - bd.Pos(0, 0, 0.62 * height) * bd.Rot(90, 0, 0) * bd.Cylinder(hole / 2, 20)
