"""Two parts that look alike are named as confusable with each other; unlike ones are told apart."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest
import trimesh
from click.testing import CliRunner

from arview.cad import load_part
from arview.cli.__main__ import main
from arview.guideviews.look_alikes import compare_parts
from helpers.studio_client import running_studio

pytestmark = pytest.mark.slow  # guide views of several parts

Box = tuple[tuple[float, float, float], tuple[float, float, float]]
PLATE: Box = ((120, 80, 10), (0, 0, 0))
BRACKETS: list[Box] = [((20, 30, 6), (-40, 0, 8)), ((6, 30, 40), (-50, 0, 25)), ((20, 30, 6), (30, 0, 8))]
POSTS: list[Box] = [((6, 30, 25), (20, 0, 18)), ((14, 14, 20), (45, 25, 15)), ((9, 9, 30), (-10, -25, 20))]
OTHERS: list[Box] = [((20, 30, 6), (40, 0, 8)), ((6, 30, 60), (-20, 0, 35)), ((25, 25, 12), (-45, -25, 11))]


def written(path: Path, boxes: list[Box]) -> Path:
    """A GLB of boxes (size and centre, mm) in metres."""
    scene = trimesh.Scene()
    for index, (size, centre) in enumerate(boxes):
        mesh = trimesh.creation.box(np.array(size) / 1000)
        mesh.apply_translation(np.array(centre) / 1000)
        scene.add_geometry(mesh, node_name=f"c{index}", geom_name=f"c{index}")
    scene.export(path)
    return path


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("parts")
    moved = [(size, (x + 4 * (index == 1), y, z)) for index, (size, (x, y, z)) in enumerate(POSTS)]
    return {
        "left": written(folder / "left.glb", [PLATE, *BRACKETS, *POSTS]),
        "right": written(folder / "right.glb", [PLATE, *BRACKETS, *moved]),
        "other": written(folder / "other.glb", [PLATE, *OTHERS, ((5, 5, 45), (20, 25, 27))]),
        "block": written(folder / "block.glb", [PLATE]),
    }


def test_parts_that_differ_by_a_moved_post_are_confusable(files: dict[str, Path]) -> None:
    parts = {name: load_part(path) for name, path in files.items()}
    right, other, block = compare_parts(parts["left"], [parts["right"], parts["other"], parts["block"]])
    assert right.is_confusable and right.share > 0.9
    assert "confusable with right" in right.text and "likeness" in right.text
    assert not other.is_confusable and other.share < 0.3
    assert not block.is_confusable and block.share < 0.1
    (back,) = compare_parts(parts["right"], [parts["left"]])
    assert back.is_confusable
    (itself,) = compare_parts(parts["left"], [parts["left"]])
    assert itself.share == 1.0


def test_check_names_the_look_alike(files: dict[str, Path]) -> None:
    asked = ["check", str(files["left"]), "--against", str(files["right"]), "--against", str(files["block"])]
    result = CliRunner().invoke(main, asked)
    assert result.exit_code == 0, result.output
    assert "problem: confusable with right" in result.output
    assert "note: told apart from block" in result.output
    missing = CliRunner().invoke(main, ["check", str(files["left"]), "--against", str(files["left"].parent / "no.glb")])
    assert missing.exit_code != 0
    assert "no.glb" in missing.output + missing.stderr


def test_the_studio_compares(files: dict[str, Path]) -> None:
    with running_studio(files["left"], files["right"]) as studio:
        deadline = time.monotonic() + 120
        while (views := studio.http.json("GET", "/api/views"))[0] == 202 and time.monotonic() < deadline:
            time.sleep(0.1)
        (one,) = views[1]["look_alikes"]
        assert one["other"] == "right" and one["is_confusable"] and one["share"] > 0.9
