"""Datums of a part file that are not in the geometry are told, with the nearest feature that is."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from arview.cad import check_part, make_model
from arview.cad.datum_check import datum_problems, find_rims
from arview.cad.model import Component
from arview.cad.part import ComponentSettings, Datum, Part
from arview.geometry import apply, exp_so3, rigid
from helpers.cad_files import box

TURN = rigid(exp_so3([0.3, -0.2, 0.5]), [10.0, 20.0, 30.0])
CORNERS = 36


def washer(outer_mm: float, inner_mm: float, height_mm: float) -> Component:
    """A ring about +Z standing on z = 0, of radii and height."""
    angle = 2 * np.pi * np.arange(CORNERS) / CORNERS
    ring = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    up = np.array([0, 0, height_mm])
    vertices = np.concatenate([outer_mm * ring, outer_mm * ring + up, inner_mm * ring, inner_mm * ring + up])
    faces = []
    for i in range(CORNERS):
        j = (i + 1) % CORNERS
        for a, b, c, d in ((0, 0, 1, 1), (1, 1, 3, 3), (3, 3, 2, 2), (2, 2, 0, 0)):
            p, q, r, s = a * CORNERS + i, b * CORNERS + j, c * CORNERS + j, d * CORNERS + i
            faces += [(p, q, r), (p, r, s)]
    return Component("ring", vertices, np.array(faces, dtype=np.int32))


def part_of(component: Component, *datums: Datum) -> Part:
    model = make_model("p", (component,))
    settings = (ComponentSettings(component.name, "base"),)
    return Part("p", Path("p.toml"), Path("p.glb"), model, settings, datums=datums)


def turned(component: Component) -> Component:
    return Component(component.name, apply(TURN, component.vertices_in_model), component.faces)


def test_rims_are_found_with_centre_axis_and_radius() -> None:
    rims = find_rims(turned(washer(20.0, 6.0, 10.0)))
    assert sorted(round(rim.radius_mm, 6) for rim in rims) == [6.0, 6.0, 20.0, 20.0]
    for rim in rims:
        assert abs(rim.axis_in_model @ TURN[:3, 2]) == pytest.approx(1.0)
        aside = np.cross(rim.center_in_model - TURN[:3, 3], TURN[:3, 2])
        assert np.linalg.norm(aside) < 1e-6
    assert find_rims(Component("b", *box((0, 0, 0), (10, 20, 30)))) == []


@pytest.mark.parametrize(
    ("datum", "expected"),
    [
        (Datum("B", "hole", "ring", (0, 0, 10), (0, 0, 1), 12.0), ""),
        (Datum("B", "hole", "ring", (0.5, 0, 4), (0, 0, -1), 12.2), ""),
        (Datum("B", "cylinder", "ring", (0, 0, 0), (0, 0, 1), 40.0), ""),
        (
            Datum("B", "hole", "ring", (0, 0, 10), (0, 0, 1), 10.0),
            "no hole of ⌀ 10 mm at (0, 0, 10); the nearest round edge has ⌀ 12 mm at (0, 0, 10)",
        ),
        (
            Datum("B", "pin", "ring", (9, 0, 0), (0, 0, 1), 12.0),
            "no pin of ⌀ 12 mm at (9, 0, 0); the nearest round edge has ⌀ 12 mm at (0, 0, 0)",
        ),
        (Datum("B", "hole", "ring", (0, 0, 0), (1, 0, 0), 12.0), "no hole of ⌀ 12 mm at (0, 0, 0); the nearest"),
        (Datum("A", "plane", "ring", (0, 0, 10), (0, 0, 1)), ""),
        (
            Datum("A", "plane", "ring", (0, 0, 12), (0, 0, 1)),
            "at (0, 0, 12) with normal (0, 0, 1); the nearest is -2 mm",
        ),
        (Datum("A", "plane", "ring", (0, 0, 10), (0, 0.6, 0.8)), "no face of it is parallel"),
    ],
)
def test_datums_are_compared_with_the_geometry(datum: Datum, expected: str) -> None:
    texts = datum_problems(part_of(washer(20.0, 6.0, 10.0), datum))
    assert len(texts) == bool(expected)
    if expected:
        assert texts[0].startswith(f"datum {datum.label}: ring has no ")
        assert expected in texts[0]


def test_check_tells_of_a_component_without_round_edges() -> None:
    block = Component("block", *box((0, 0, 0), (100, 60, 30)))
    datum = Datum("B", "hole", "block", (10.0, 10.0, 30.0), (0.0, 0.0, 1.0), 8.0)
    said = [finding.text for finding in check_part(part_of(block, datum)).findings]
    assert any(text.startswith("datum B") and text.endswith("it has no round edges at all") for text in said)
