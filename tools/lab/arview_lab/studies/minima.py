"""Local minima: whether a registration from the nominal place finds posts that are 1 to 9 mm away."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from arview.errors import InputError
from arview.geometry import Array, apply, rigid
from arview.measurement.cloud.mesh_surface import MeshSurface
from arview.measurement.cloud.registration import register_from_starts, register_to_surface
from arview_lab.chart import Chart, stack
from arview_lab.cloud.classical_icp import ClassicalIcpOptions, classical_icp
from arview_lab.studies.common import EXACT, Study, post

SIGMA_MM = 0.1
"""Noise of a point along each axis."""
COUNT = 6000
NEAR_MM = 0.1
"""A run that ends farther from the truth, across what the shape leaves free, ended in another minimum."""
LENGTHS_MM = tuple(float(length) for length in range(1, 10))
WAYS = ("one start", "several starts", "classical ICP")
DIRECTIONS = ("sideways", "upward")


def minima_study(is_quick: bool = False, seed: int = 0) -> Study:
    """Register four kinds of posts displaced by 1 to 9 mm sideways and upward, and count the minima of the cost.

    The posts are round, hexagonal, stepped (two diameters) and grooved (a groove every 4 mm, so that the cost has a
    minimum each time its grooves meet others).
    """
    runs, count = (2, 1000) if is_quick else (12, COUNT)
    lengths = LENGTHS_MM[::4] if is_quick else LENGTHS_MM
    rows: list[tuple[object, ...]] = []
    curves: list[tuple[object, ...]] = []
    summary, pictures = [], []
    for kind, surface in posts().items():
        chart = Chart(f"Found at the true place: {kind} post", "displacement / mm", "share of runs")
        for direction in DIRECTIONS:
            minima = _curve(surface, direction, count, seed, kind, curves)
            for way in WAYS:
                shares = []
                for length in lengths:
                    found = [_found(surface, way, direction, length, count, [seed, k]) for k in range(runs)]
                    shares.append(float(np.mean(found)))
                    rows.append((kind, direction, way, length, shares[-1], runs))
                chart.add(lengths, shares, f"{way}, {direction}")
                lost = [length for length, share in zip(lengths, shares, strict=True) if share < 1.0]
                where = f"first lost at {lost[0]:g} mm, {np.mean(shares):.0%} of all found" if lost else "all found"
                summary.append(f"{kind} post, {direction}, {way}: {where}")
            summary.append(f"{kind} post, {direction}: the cost has {minima} minima within 9 mm")
        pictures.append(chart.draw())
    tables = {
        "minima": (("post", "direction", "way", "displacement_mm", "found", "runs"), rows),
        "minima_cost": (("post", "direction", "shift_mm", "rms_mm"), curves),
    }
    return Study("minima", tables, stack(pictures), tuple(summary))


def posts() -> dict[str, MeshSurface]:
    """The four kinds, 40 mm high and about 16 mm across."""
    stepped = [(8.0, 0.0), (8.0, 20.0), (5.5, 20.0), (5.5, 40.0)]
    grooved: list[tuple[float, float]] = []
    for k in range(10):
        low = 4.0 * k
        grooved += [(8.0, low), (8.0, low + 2.5), (6.8, low + 2.5), (6.8, low + 4.0)]
    return {
        "round": post()[0],
        "hexagonal": turned([(8.0, 0.0), (8.0, 40.0)], 6),
        "stepped": turned(stepped, 64),
        "grooved": turned(grooved, 64),
    }


def turned(profile: Sequence[tuple[float, float]], sections: int) -> MeshSurface:
    """A closed post with a profile of (radius, height) and regular polygons as cross sections."""
    angles = np.arange(sections) * 2.0 * np.pi / sections
    rings = [np.column_stack([r * np.cos(angles), r * np.sin(angles), np.full(sections, z)]) for r, z in profile]
    ends = [[0.0, 0.0, profile[0][1]], [0.0, 0.0, profile[-1][1]]]
    vertices = np.concatenate([*rings, ends])
    i = np.arange(sections)
    j, faces = (i + 1) % sections, []
    for ring in range(len(profile) - 1):
        a, b = ring * sections, (ring + 1) * sections
        faces += [np.stack([a + i, a + j, b + j], axis=1), np.stack([a + i, b + j, b + i], axis=1)]
    top = (len(profile) - 1) * sections
    foot, head = len(vertices) - 2, len(vertices) - 1
    faces += [
        np.stack([j, i, np.full(sections, foot)], axis=1),
        np.stack([top + i, top + j, np.full(sections, head)], axis=1),
    ]
    return MeshSurface(vertices, np.concatenate(faces))


def _found(surface: MeshSurface, way: str, direction: str, length_mm: float, count: int, seeds: list[int]) -> bool:
    """Whether one run ends at the true place."""
    rng = np.random.default_rng([*seeds, round(1000 * length_mm)])
    points, faces = surface.spread(count, int(rng.integers(1 << 31)))
    seen = surface.face_normals[faces][:, 2] > -0.5
    angle = rng.uniform(0.0, 2.0 * np.pi)
    along = np.array([np.cos(angle), np.sin(angle), 0.0]) if direction == "sideways" else np.array([0.0, 0.0, 1.0])
    shift = length_mm * along
    measured = points[seen] + shift + rng.normal(0.0, SIGMA_MM, (int(seen.sum()), 3))
    normals = surface.face_normals[faces[seen]]
    center = surface.triangles.reshape(-1, 3).mean(axis=0)
    options = replace(EXACT, first_distance_mm=11.0)
    try:
        if way == WAYS[2]:
            reference, of_face = surface.spread(4 * count, int(rng.integers(1 << 31)))
            bounds = np.stack([surface.triangles.min(axis=(0, 1)), surface.triangles.max(axis=(0, 1))])
            icp = ClassicalIcpOptions(margin_mm=12.0, reach_mm=11.0)
            pose = classical_icp(
                measured, reference, surface.face_normals[of_face], bounds, icp
            ).reference_from_measured
        elif way == WAYS[1]:
            starts = [rigid(np.eye(3), s * 5.0 * axis) for axis in np.eye(3) for s in (-1.0, 1.0)]
            pose = register_from_starts(
                measured, surface, [np.eye(4), *starts], normals=normals, options=options, center=center
            ).surface_from_points
        else:
            pose = register_to_surface(
                measured, surface, center=center, normals=normals, options=options
            ).surface_from_points
    except InputError:
        return False
    return float(np.linalg.norm(apply(pose, center + shift) - center)) < NEAR_MM


def _curve(
    surface: MeshSurface, direction: str, count: int, seed: int, kind: str, curves: list[tuple[object, ...]]
) -> int:
    """Add the robust cost over the displacement to the table, and return the number of its minima."""
    points, faces = surface.spread(count, seed)
    points = points[surface.face_normals[faces][:, 2] > -0.5]
    points = points + np.random.default_rng(seed).normal(0.0, SIGMA_MM, points.shape)
    along = np.array([1.0, 0.0, 0.0]) if direction == "sideways" else np.array([0.0, 0.0, 1.0])
    shifts = np.arange(-9.0, 9.01, 0.25)
    cost: Array = np.array(
        [np.sqrt(np.mean(np.minimum(np.abs(surface.closest(points + d * along).distances), 2.0) ** 2)) for d in shifts]
    )
    curves += [(kind, direction, float(d), float(c)) for d, c in zip(shifts, cost, strict=True)]
    inner = cost[1:-1]
    return int(np.count_nonzero((inner < cost[:-2] - 1e-4) & (inner < cost[2:] - 1e-4)))
