"""The models of polygons that `tools/benchmarks/peers` writes for ViSP."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from arview_lab.studies.common import SECTIONS, post

TOOLS = Path(__file__).resolve().parents[2]

CORNERS = np.array([[(i >> k) & 1 for k in range(3)] for i in range(8)], dtype=np.float64)
QUADS = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]


@pytest.fixture
def cao(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(str(TOOLS / "benchmarks"))
    from peers import cao

    return cao


def outward(polygons: Any, center: np.ndarray) -> list[bool]:
    """Whether the first three corners of each polygon turn counterclockwise seen from outside."""
    found = []
    for loop in polygons.loops:
        a, b, c = polygons.points[list(loop[:3])]
        found.append(bool(np.cross(b - a, c - a) @ (a - center) > 0))
    return found


def test_a_box_in_separate_triangles_is_six_squares(cao: Any) -> None:
    triangles = [face for a, b, c, d in QUADS for face in ((a, b, c), (a, c, d))]
    soup = CORNERS[np.array(triangles)].reshape(-1, 3)
    polygons = cao.polygons_of(soup, np.arange(36, dtype=np.int32).reshape(-1, 3))
    assert len(polygons.points) == 8
    assert [len(loop) for loop in polygons.loops] == [4] * 6
    assert polygons.smooth == {}
    assert all(outward(polygons, np.full(3, 0.5)))


def test_the_wall_of_a_post_is_smooth_and_its_rims_are_sharp(cao: Any) -> None:
    surface, center = post()
    polygons = cao.polygons_of(surface.vertices, surface.faces)
    assert sorted(len(loop) for loop in polygons.loops) == [4] * SECTIONS + [SECTIONS] * 2
    assert len(polygons.smooth) == SECTIONS
    assert all(outward(polygons, center))


def test_a_face_with_a_hole_stays_in_triangles_whose_inner_edges_are_smooth(cao: Any) -> None:
    outer = np.array([[0, 0, 0], [3, 0, 0], [3, 3, 0], [0, 3, 0]], dtype=np.float64)
    inner = np.array([[1, 1, 0], [2, 1, 0], [2, 2, 0], [1, 2, 0]], dtype=np.float64)
    faces = [
        face for k in range(4) for face in ((k, (k + 1) % 4, 4 + k), ((k + 1) % 4, 4 + (k + 1) % 4, 4 + k))
    ]  # fmt: skip
    polygons = cao.polygons_of(np.concatenate([outer, inner]), np.array(faces, dtype=np.int32))
    assert [len(loop) for loop in polygons.loops] == [3] * 8
    assert len(polygons.smooth) == 8


def test_the_file_lists_points_and_faces_between_empty_sections(cao: Any, tmp_path: Path) -> None:
    triangle = cao.polygons_of(CORNERS[[0, 1, 2]], np.array([[0, 1, 2]], dtype=np.int32))
    cao.write_cao(tmp_path / "model.cao", triangle)
    lines = (tmp_path / "model.cao").read_text().split("\n")
    assert lines[:2] == ["V1", "3"]
    assert lines[5:8] == ["0", "0", "1"]
    assert lines[8].split()[0] == "3"
    assert lines[9:] == ["0", "0", ""]
