"""Components that change places where a symmetric part fits a cloud in several ways."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from arview.cad.model import Component, Model, make_model
from arview.cad.part import ComponentSettings, Part
from arview.cad.shape.symmetry import Symmetry
from arview.inspection import ComponentDeviation, Verdict
from arview.measurement.look_alikes import with_unsure_names
from helpers.cad_files import box
from helpers.inspections import deviation, missing

CORNERS = [(30.0, 30.0), (-30.0, 30.0), (-30.0, -30.0), (30.0, -30.0)]


def block(name: str, low: tuple[float, float, float], high: tuple[float, float, float]) -> Component:
    vertices, faces = box(low, high)
    return Component(name, np.array(vertices, dtype=np.float64), np.array(faces, dtype=np.int32))


def plate(depth: float = 100.0, pin: float | None = None) -> Model:
    """A plate of 100 × ``depth`` mm with four equal posts; with ``pin`` a cube of that size beside one."""
    half = 0.5 * depth
    parts = [block("base", (-50.0, -half, -6.0), (50.0, half, 0.0))]
    parts += [
        block(f"post_{i + 1}", (x - 5.0, y - 5.0, 0.0), (x + 5.0, y + 5.0, 20.0)) for i, (x, y) in enumerate(CORNERS)
    ]
    if pin is not None:
        parts.append(block("pin", (15.0, 30.0, 0.0), (15.0 + pin, 30.0 + pin, pin)))
    return make_model("plate", tuple(parts))


def part_of(model: Model, symmetries: tuple[Symmetry, ...] = ()) -> Part:
    settings = tuple(
        ComponentSettings(c.name, "base" if c.name == "base" else "inspect", 0.3) for c in model.components
    )
    return Part("plate", Path("part.toml"), Path("plate.glb"), model, settings, symmetries=symmetries)


def records(*moved: float) -> list[ComponentDeviation]:
    return [
        deviation(f"post_{i + 1}", (dx, 0.0, 0.0), np.array([*CORNERS[i], 10.0]), 0.3, uncertainty_mm=0.02)
        for i, dx in enumerate(moved)
    ]


@pytest.mark.parametrize(("depth", "ways"), [(100.0, 4), (80.0, 2)])
def test_a_verdict_is_not_pinned_to_a_name(depth: float, ways: int) -> None:
    found, (warning,) = with_unsure_names(records(0.0, 1.0, 0.0, 0.0), part_of(plate(depth)))
    assert f"fits the CAD in {ways} ways alike" in warning and "1 of them beyond tolerance" in warning
    undecided = [one.name for one in found if one.verdict is Verdict.UNDECIDED]
    assert undecided == (["post_1", "post_2", "post_3", "post_4"] if ways == 4 else ["post_2", "post_4"])
    assert found[1].details is not None
    assert found[1].details.notes[0].startswith("it may be any of post_")


def test_a_missing_one_of_several_is_not_named() -> None:
    given = [*records(0.0, 0.0, 0.0), missing("post_4", np.array([30.0, -30.0, 10.0]))]
    found, _ = with_unsure_names(given, part_of(plate()))
    assert found[3].finding is None and found[3].verdict is Verdict.NOT_MEASURED
    assert {one.verdict for one in found[:3]} == {Verdict.UNDECIDED}


def test_equal_verdicts_hold_whichever_is_which() -> None:
    given = records(0.0, 0.01, 0.0, 0.02)
    found, warnings = with_unsure_names(given, part_of(plate()))
    assert found == given and len(warnings) == 1


@pytest.mark.parametrize("pin", [4.0, 8.0])
def test_what_breaks_the_symmetry_settles_it(pin: float) -> None:
    given = records(0.0, 1.0, 0.0, 0.0)
    assert with_unsure_names(given, part_of(plate(pin=pin))) == (given, [])


def test_a_declared_symmetry_does_not_matter() -> None:
    given = records(0.0, 1.0, 0.0, 0.0)
    declared = Symmetry((0.0, 0.0, 1.0), (0.0, 0.0, 0.0), 4)
    assert with_unsure_names(given, part_of(plate(), (declared,))) == (given, [])
    half = replace(declared, order=2)
    assert with_unsure_names(given, part_of(plate(), (half,)))[1]
