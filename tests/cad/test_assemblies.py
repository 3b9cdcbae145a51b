"""Large assemblies in `check`: the tree, gathered rows, equal shapes once; tolerances that cannot be meant."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from arview.cad.assembly_tree import MAX_LINES, tree_lines
from arview.cad.check import GATHERED_ROWS, check_part
from arview.cad.model import Component, make_model
from arview.cad.part import ComponentSettings, Part
from arview.cad.part_file import load_part
from arview.cad.shape.equal_shapes import ShapeSymmetries
from arview.cad.tolerance_check import EXPECTED_U_PX, tolerance_remarks
from arview.cli import main
from helpers.cad_files import box, glb_with_boxes


def test_the_tree_gathers_what_is_equal() -> None:
    arms = [("machine", f"arm_{k}", name) for k in range(1, 5) for name in ("lever", "pin_1", "pin_2")]
    lines = tree_lines([("machine", "frame"), *arms, ("machine", "arm_5", "lever")])
    assert lines == [
        "machine: 14 components",
        "  frame",
        "  arm_1 … arm_4  × 4: 3 components each",
        "    lever",
        "    pin_1 … pin_2  × 2",
        "  arm_5: 1 components",
        "    lever",
    ]
    assert tree_lines([("a",), ("b",)]) == []
    assert tree_lines([("root", "a"), ("root", "b")]) == []
    assert tree_lines([("r", "s", "screw"), ("r", "s", "screw"), ("r", "nut")])[2] == "    screw  × 2"
    letters = "abcdefghijklmnopqrst"
    many = tree_lines([(x, y, z) for x in letters[:3] for y in letters for z in letters[:3]])
    assert len(many) == MAX_LINES + 1
    assert many[-1].endswith("more lines")


def test_check_prints_the_tree_and_the_selector_works(tmp_path: Path) -> None:
    nodes: list[dict[str, object]] = [
        {"name": "root", "children": [1, 3]},
        {"name": "sub_1", "children": [2]},
        {"name": "post", "mesh": 0},
        {"name": "sub_2", "children": [4, 5]},
        {"name": "post", "mesh": 0, "translation": [0.1, 0, 0]},
        {"name": "nut", "mesh": 0, "translation": [0.2, 0, 0]},
    ]
    glb_with_boxes(tmp_path / "a.glb", nodes, [0])
    (tmp_path / "p.toml").write_text('[part]\ncad = "a.glb"\n[components]\n"sub_2/*".role = "base"\n')
    assert load_part(tmp_path / "p.toml").component_settings("nut").role == "base"
    done = CliRunner().invoke(main, ["check", str(tmp_path / "p.toml")])
    assert done.exit_code == 0
    assert "root: 3 components\n  sub_1: 1 components\n    post\n  sub_2: 2 components\n" in done.output
    assert '[components."NAME/*"]' in done.output


def assembly(count: int) -> Part:
    rng = np.random.default_rng(0)
    corners, faces = box((0, 0, 0), (4, 3, 10))[0], box((0, 0, 0), (4, 3, 10))[1].astype(np.int32)
    components = tuple(
        Component(
            f"pin_{k}", corners + np.array([12.0 * (k % 25), 12.0 * (k // 25), 0]) + rng.normal(0, 1e-6, 3), faces
        )
        for k in range(count)
    )
    settings = tuple(ComponentSettings(one.name, position_tolerance_mm=0.5) for one in components)
    return Part("a", Path("a.toml"), Path("a.step"), make_model("a", components), settings)


def test_five_hundred_components_are_checked_in_seconds_on_few_lines() -> None:
    part = assembly(500)
    start = time.process_time()
    check = check_part(part)
    text = check.format()
    assert time.process_time() - start < 10.0
    assert len(check.components) == 500 > GATHERED_ROWS
    assert "pin_0 … pin_499 (500)" in text
    assert len(text.splitlines()) < 40
    assert len(text) < 20_000


def test_symmetries_of_equal_shapes_are_moved_along() -> None:
    one, other = assembly(2).model.components
    turned = replace(one, name="turned", vertices_in_model=one.vertices_in_model[:, [1, 0, 2]] * [1, -1, 1])
    shapes = ShapeSymmetries()
    first, second, third = shapes.of(one), shapes.of(other), shapes.of(turned)
    assert [f.symmetry.axis_in_model for f in first] == [f.symmetry.axis_in_model for f in second]
    assert len(first) >= 2
    for a, b in zip(first, second, strict=True):
        np.testing.assert_allclose(
            np.subtract(b.symmetry.through_in_model, a.symmetry.through_in_model)[1:], 0, atol=1e-4
        )
        assert b.symmetry.through_in_model[0] - a.symmetry.through_in_model[0] == pytest.approx(12.0, abs=1e-4)
    np.testing.assert_allclose(third[0].symmetry.through_in_model, turned.bounds_in_model.mean(axis=0), atol=1e-6)


def test_the_search_for_symmetries_is_limited_and_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    one, other = assembly(2).model.components
    wide = replace(other, name="wide", vertices_in_model=other.vertices_in_model * [2.0, 1.0, 1.0])
    monkeypatch.setattr("arview.cad.shape.equal_shapes.MAX_SHAPES", 1)
    shapes = ShapeSymmetries()
    assert shapes.of(one)
    assert shapes.of(other)
    assert shapes.of(wide) == ()
    assert shapes.skipped == ["wide"]


@pytest.mark.parametrize(("changes", "expected"), [
    ({"position_tolerance_mm": 60.0}, "pin has a position_tolerance_mm of 60, larger than itself (50 mm)"),
    ({"angle_tolerance_deg": 90.0}, "pin has an angle_tolerance_deg of 90, with which hardly any rotation fails"),
    ({"position_tolerance_mm": 0.01}, "of 0.01, below the uncertainty to be expected of photos from the nearest"),
    ({"position_tolerance_mm": 0.5, "angle_tolerance_deg": 1.0}, ""),
    ({"position_tolerance_mm": 60.0, "role": "base"}, ""),
])  # fmt: skip
def test_tolerances_that_cannot_be_meant(changes: dict[str, Any], expected: str) -> None:
    settings = replace(ComponentSettings("pin"), **changes)
    remarks = tolerance_remarks(settings, (50.0, 8.0, 8.0), 0.4)
    assert bool(remarks) == bool(expected)
    assert not expected or expected in f"{remarks[0].name} {remarks[0].text}"
    assert EXPECTED_U_PX * 0.4 > 0.01


def test_distances_in_metres_are_asked_about(tmp_path: Path) -> None:
    glb_with_boxes(tmp_path / "a.glb", [{"name": "post", "mesh": 0}], [0])
    (tmp_path / "p.toml").write_text('[part]\ncad = "a.glb"\n[view_range]\ndistance_mm = [0.4, 0.9]\n')
    done = CliRunner().invoke(main, ["check", str(tmp_path / "p.toml")])
    assert "is it given in metres?" in done.output
    (tmp_path / "q.toml").write_text('[part]\ncad = "a.glb"\n[components.post]\nposition_tolerance_mm = 0\n')
    done = CliRunner().invoke(main, ["check", str(tmp_path / "q.toml")])
    assert "position_tolerance_mm = 0: expected a positive number" in done.output


def test_parts_that_are_too_near_to_be_tracked_are_told() -> None:
    part = assembly(2)
    tiny = tuple(replace(one, vertices_in_model=one.vertices_in_model * 0.01) for one in part.model.components)
    said = [f.text for f in check_part(replace(part, model=make_model("a", tiny))).findings if f.severity == "problem"]
    assert any("detection and tracking need 3 mm and more" in text for text in said)
    assert not any("need 3 mm" in f.text for f in check_part(part).findings)
