"""The drawing of a rework: true scale in mm, the displacement magnified, and nothing said by colour alone."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest

from arview.cad import load_part
from arview.errors import InputError
from arview.geometry import Array
from arview.inspection import ComponentDeviation, Verdict
from arview.quality.rework import drawing_svg
from arview.quality.rework.svg import DESIGN, INK, MEASURED, ZONE, nice, wrapped
from helpers.inspections import inspection, missing, not_measured
from helpers.paths import SAMPLES
from helpers.rework_part import off, wall

NS = "{http://www.w3.org/2000/svg}"
WALL = wall()


def drawn(*components: ComponentDeviation, name: str = "block_1") -> ElementTree.Element:
    text = drawing_svg(WALL, inspection(WALL.model, components), name)
    assert "style" not in text  # the policy of the report forbids it
    return ElementTree.fromstring(text)


def panels(root: ElementTree.Element) -> list[ElementTree.Element]:
    return [one for one in root.iter(f"{NS}g") if "clip-path" in one.attrib]


def extent(panel: ElementTree.Element, color: str) -> Array:
    """Lower and upper corner of the path of a colour."""
    (path,) = [one for one in panel.iter(f"{NS}path") if one.get("stroke") == color and "," in one.get("d", "")][:1]
    points = np.array(
        [[float(v) for v in pair.split(",")] for pair in re.findall(r"[-\d.]+,[-\d.]+", path.get("d", ""))]
    )
    return np.stack([points.min(axis=0), points.max(axis=0)])


def texts(root: ElementTree.Element) -> list[str]:
    return [one.text or "" for one in root.iter(f"{NS}text")]


def test_the_plan_is_at_true_scale() -> None:
    root = drawn(off(WALL, "block_1", (-2.0, 1.0, 0.0)))
    width, height = (float(root.get(name, "").removesuffix("mm")) for name in ("width", "height"))
    assert width == 180.0
    assert [float(v) for v in root.get("viewBox", "").split()] == pytest.approx([0.0, 0.0, width, height])
    plan, magnified = panels(root)
    design, measured = extent(plan, DESIGN), extent(plan, MEASURED)
    assert design[1] - design[0] == pytest.approx([20.0, 20.0], abs=0.01)  # block_1 is 20 × 20 mm
    # -2 mm along x is to the left, +1 mm along y upwards, and y runs down on the sheet.
    assert (measured - design).mean(axis=0) == pytest.approx([-2.0, -1.0], abs=0.01)
    assert "1 : 1 at 100 % print size, seen from above" in texts(root)
    assert any(one.startswith("magnified 10 times") for one in texts(root))
    (zone,) = [one for one in magnified.iter(f"{NS}circle") if one.get("stroke") == ZONE]
    assert float(zone.get("r", "")) == pytest.approx(0.5 * 10.0)


def test_the_arrow_leads_from_the_measured_to_the_design_place() -> None:
    _, magnified = panels(drawn(off(WALL, "block_1", (-2.0, 1.0, 0.0))))
    rings = list(magnified.iter(f"{NS}circle"))
    at = {one.get("stroke"): np.array([float(one.get("cx", "")), float(one.get("cy", ""))]) for one in rings}
    assert at[MEASURED] - at[ZONE] == pytest.approx([-20.0, -10.0], abs=0.01)
    heads = list(magnified.iter(f"{NS}polygon"))
    assert len(heads) == 2  # east, then south
    tips = [np.array([float(v) for v in one.get("points", "").split()[0].split(",")]) for one in heads]
    assert tips[-1] == pytest.approx(at[ZONE], abs=0.01)
    labels = texts(magnified)
    assert "2.00 mm" in labels and "1.00 mm" in labels


def test_a_turn_is_drawn_in_its_sense() -> None:
    for angle, is_clockwise in ((2.0, True), (-2.0, False)):
        root = drawn(off(WALL, "block_1", (0.0, 0.0, 0.0), (0.0, 0.0, angle), angle_tolerance_deg=1.0))
        plan = panels(root)[0]
        arc = next(one for one in plan.iter(f"{NS}path") if one.get("stroke") == INK)
        pairs = re.findall(r"([-\d.]+),([-\d.]+)", arc.get("d", ""))
        assert (float(pairs[-1][0]) > float(pairs[0][0])) == is_clockwise
        assert "2.00°" in texts(plan)


def test_a_move_off_the_seat_is_seen_from_the_side() -> None:
    root = drawn(off(WALL, "block_1", (0.0, 0.0, 0.9)))
    plan, _ = panels(root)
    design, measured = extent(plan, DESIGN), extent(plan, MEASURED)
    assert (measured - design).mean(axis=0) == pytest.approx([0.0, -0.9], abs=0.01)
    assert any("seen from the side, plate below" in one for one in texts(root))


def test_a_component_on_a_wall_is_seen_against_it() -> None:
    root = drawn(off(WALL, "clip", (-0.9, 0.0, 0.0)), name="clip")
    plan, _ = panels(root)
    design, measured = extent(plan, DESIGN), extent(plan, MEASURED)
    assert design[1] - design[0] == pytest.approx([20.0, 20.0], abs=0.01)
    # Seen from -y with +z up, +x is to the right.
    assert (measured - design).mean(axis=0) == pytest.approx([-0.9, 0.0], abs=0.01)
    assert any("seen with wall behind it" in one for one in texts(root))


def test_names_that_are_told_are_shown() -> None:
    root = drawn(off(WALL, "block_1", (-2.0, 0.0, 0.0)))
    assert "east" in texts(root) and "to east" not in texts(root)  # outside of the window: named at its edge


def test_nothing_is_said_by_colour_alone() -> None:
    root = drawn(off(WALL, "block_1", (-2.0, 0.0, 0.0)))
    plan = panels(root)[0]
    dashes = {one.get("stroke"): one.get("stroke-dasharray") for one in plan.iter(f"{NS}path")}
    assert dashes[DESIGN] is None and dashes[MEASURED]
    for words in ("design place", "as measured", "tolerance zone, radius 0.5 mm", "U = 0.06 mm"):
        assert words in texts(root)
    assert "Rework of block_1: move 2.00" in root.get("aria-label", "")


def test_a_missing_component_is_shown_on_the_whole_part() -> None:
    center = WALL.model.component("block_1").centroid_in_model
    root = drawn(missing("block_1", center))
    assert any("the whole part" in one for one in texts(root))
    assert "as measured" not in texts(root)
    assert [one for one in root.iter() if one.get("stroke") == MEASURED] == []
    root = drawn(not_measured("block_1", center))
    assert "Nothing is asked for." in texts(root)


def test_large_components_are_drawn_smaller_and_say_so() -> None:
    root = drawn(replace(off(WALL, "wall", (0.0, -2.0, 0.0)), verdict=Verdict.FAIL), name="wall")
    plan, _ = panels(root)
    design = extent(plan, DESIGN)
    assert design[1][0] - design[0][0] == pytest.approx(200.0 / 5.0, abs=0.01) or "1 : 2 at" in " ".join(texts(root))
    assert any(re.match(r"1 : [25] at 100 %", one) for one in texts(root))


def test_names_are_escaped() -> None:
    one = off(WALL, "block_1", (-2.0, 0.0, 0.0))
    made = replace(inspection(WALL.model, (one,)), serial='<script>"&')
    root = ElementTree.fromstring(drawing_svg(WALL, made, "block_1"))
    assert any('<script>"&' in words for words in texts(root))


def test_an_unknown_component_is_named() -> None:
    with pytest.raises(InputError, match="no component 'x'; it has: block_1"):
        drawn(off(WALL, "block_1", (-2.0, 0.0, 0.0)), name="x")


def test_ids_differ_between_drawings() -> None:
    made = inspection(WALL.model, (off(WALL, "block_1", (-2.0, 0.0, 0.0)), off(WALL, "clip", (-0.9, 0.0, 0.0))))
    ids = [re.findall(r'id="([^"]+)"', drawing_svg(WALL, made, name)) for name in ("block_1", "clip")]
    assert len(ids[0]) == 2 and not set(ids[0]) & set(ids[1])


@pytest.mark.slow
def test_samples_are_drawn() -> None:
    for sample, name in (("plate", "link_1"), ("manifold", "nipple_1"), ("panel", "bracket_3")):
        part = load_part(SAMPLES / sample)
        one = off(part, name, (-1.2, 0.8, 0.0))
        root = ElementTree.fromstring(drawing_svg(part, inspection(part.model, (one,)), name))
        plan = panels(root)[0]
        size = extent(plan, DESIGN)
        assert np.all(size[1] - size[0] > 5.0)


def test_steps_of_scales_and_lines_of_texts() -> None:
    assert [nice(value) for value in (0.9, 1.0, 4.9, 50.0, 199.0, 0.024)] == [0.5, 1.0, 2.0, 50.0, 100.0, 0.02]
    lines = wrapped("one two three four five six seven", 20.0, 3.0)
    assert " ".join(lines) == "one two three four five six seven" and max(len(line) for line in lines) <= 11


def test_on_a_screen_letters_are_large_and_what_is_shown_is_told_as_messages() -> None:
    found = inspection(WALL.model, [off(WALL, "block_1", (-2.0, 0.0, 0.0))])
    text = drawing_svg(WALL, found, "block_1", "screen")
    root = ElementTree.fromstring(text)
    width = float(root.get("viewBox", "").split()[2])
    sizes = [float(one.get("font-size", "0")) for one in root.iter(f"{NS}text")]
    assert sizes and min(sizes) * 336.0 / width >= 14.0  # px on a phone of 360 px
    (about,) = root.iter(f"{NS}metadata")
    told = json.loads(about.text or "")
    assert told["messages"][told["text"]]["key"].startswith("rework.seen_") and told["tolerance"] == "0.5"
    assert not any("design place" in one or "magnified" in one for one in texts(root))
