"""Rework: the moves undo a known displacement and are called by what is there; nothing else is asked for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from arview.cad import Part, load_part
from arview.cad.part import ReworkAxis, ReworkSettings
from arview.cad.view_range import Up
from arview.core.messages import with_messages
from arview.errors import MismatchError
from arview.geometry import Array, apply, exp_so3, rigid
from arview.inspection import ComponentDeviation, Details, Verdict
from arview.quality.rework import Instruction, instruction_document, make_instructions
from helpers.inspections import deviation, inspection, missing, not_measured
from helpers.paths import SAMPLES
from helpers.rework_part import UP, off, wall

WALL = wall()


def told(part: Part, *components: ComponentDeviation) -> tuple[Instruction, ...]:
    return make_instructions(part, inspection(part.model, components))


def total(one: Instruction) -> Array:
    return np.asarray(sum((np.array(m.axis_in_model) * m.distance_mm for m in one.moves), start=np.zeros(3)))


@pytest.mark.parametrize(
    ("name", "moved", "words"),
    [
        ("block_1", (-2.0, 0.0, 0.0), "move 2.00 ± 0.06 mm towards east"),
        ("block_1", (2.0, 0.0, 0.0), "move 2.00 ± 0.06 mm towards west"),
        ("block_1", (0.0, 2.0, 0.0), "move 2.00 ± 0.06 mm towards south"),
        ("block_1", (0.8, -0.6, 0.0), "move 1.00 ± 0.06 mm towards hole_B"),  # (-80, 60) from the middle
        ("block_1", (0.0, 0.0, 0.9), "move 0.90 ± 0.06 mm down, towards plate"),
        ("block_1", (0.0, 0.0, -0.9), "move 0.90 ± 0.06 mm up, away from plate"),
        ("clip", (0.0, 0.0, -0.9), "move 0.90 ± 0.06 mm up"),
        ("clip", (0.0, 0.0, 0.9), "move 0.90 ± 0.06 mm down"),
        ("clip", (-0.9, 0.0, 0.0), "move 0.90 ± 0.06 mm towards lamp"),
        ("clip", (0.0, -0.9, 0.0), "move 0.90 ± 0.06 mm in, towards wall"),
        ("clip", (0.0, 0.9, 0.0), "move 0.90 ± 0.06 mm out, away from wall"),
    ],
)
@pytest.mark.parametrize("up", list(UP))
def test_a_move_is_called_by_what_is_there(name: str, moved: tuple[float, float, float], words: str, up: Up) -> None:
    part = wall(up)
    (one,) = told(part, off(part, name, moved, up=up))
    assert one.what == words
    assert np.allclose(total(one), -UP[up] @ np.array(moved), atol=1e-6)
    assert one.turn is None and one.how == "adjust" and one.remark == ""


def test_an_oblique_move_is_two_that_add_up() -> None:
    (one,) = told(WALL, off(WALL, "block_1", (-2.0, 2.0, 0.0)))
    assert [move.text for move in one.moves] == [
        "move 2.00 ± 0.06 mm towards east", "move 2.00 ± 0.06 mm towards south",
    ] or [move.text for move in one.moves] == [
        "move 2.00 ± 0.06 mm towards south", "move 2.00 ± 0.06 mm towards east",
    ]  # fmt: skip
    assert np.allclose(total(one), (2.0, -2.0, 0.0), atol=1e-6)


FINITE = st.floats(-4.0, 4.0)


@settings(max_examples=80, deadline=None)
@given(moved=st.tuples(FINITE, FINITE, FINITE), name=st.sampled_from(["block_1", "clip", "lamp"]))
def test_the_moves_undo_any_displacement(moved: tuple[float, float, float], name: str) -> None:
    wrong = off(WALL, name, moved)
    (one,) = told(WALL, wrong)
    rest = total(one) + np.array(moved)
    # What is left out is smaller than the U of its direction, at most two of the three.
    assert np.linalg.norm(rest) <= 0.06 * 2.0
    assert all(move.distance_mm > move.uncertainty_mm for move in one.moves) or np.linalg.norm(moved) < 0.5
    for move in one.moves:
        assert np.linalg.norm(move.axis_in_model) == pytest.approx(1.0)
        assert " dx" not in move.text and " dy" not in move.text


@settings(max_examples=60, deadline=None)
@given(
    moved=st.tuples(FINITE, FINITE, FINITE),
    turned=st.tuples(*[st.floats(-3.0, 3.0)] * 3),
    name=st.sampled_from(["block_1", "clip"]),
)
def test_moves_and_turn_bring_every_corner_home(
    moved: tuple[float, float, float], turned: tuple[float, float, float], name: str
) -> None:
    wrong = off(WALL, name, moved, turned, angle_tolerance_deg=0.5)
    (one,) = told(WALL, wrong)
    assert wrong.details is not None and wrong.details.measured_from_nominal is not None
    place = np.array(wrong.details.measured_from_nominal)
    component = WALL.model.component(name)
    center = component.centroid_in_model
    here = apply(place, center)
    turn = np.eye(3) if one.turn is None else exp_so3(
        np.array(one.turn.axis_in_model) * np.deg2rad(one.turn.angle_deg)
    )  # fmt: skip
    fixed = rigid(turn, here - turn @ here + total(one)) @ place
    rest = np.linalg.norm(apply(fixed, component.vertices_in_model) - component.vertices_in_model, axis=1)
    # Parts of the turn that are below their U (0.036°) are left out, and moves below 0.06 mm.
    assert rest.max() < 0.06 * 2.0 + 20.0 * np.deg2rad(0.037) * 2.0


@pytest.mark.parametrize(
    ("name", "turned", "words"),
    [
        ("block_1", (0.0, 0.0, 2.0), "turn 2.00 ± 0.04° clockwise seen from above"),
        ("block_1", (0.0, 0.0, -2.0), "turn 2.00 ± 0.04° counter-clockwise seen from above"),
        # It leans to +x (about +y), so that its free end goes back to -x.
        ("block_1", (0.0, 2.0, 0.0), "tilt its free end 2.00 ± 0.04° towards west"),
        ("block_1", (-2.0, 0.0, 0.0), "tilt its free end 2.00 ± 0.04° towards south"),
        ("clip", (0.0, -2.0, 0.0), "turn 2.00 ± 0.04° clockwise seen with wall behind it"),
        ("clip", (2.0, 0.0, 0.0), "tilt its free end 2.00 ± 0.04° up"),  # its outer end, at -y, goes down about +x
    ],
)
@pytest.mark.parametrize("up", ["z", "y"])
def test_turns_are_called_by_how_they_are_seen(
    name: str, turned: tuple[float, float, float], words: str, up: Up
) -> None:
    part = wall(up)
    (one,) = told(part, off(part, name, (0.0, 0.0, 0.0), turned, angle_tolerance_deg=1.0, up=up))
    assert one.moves == ()
    assert one.turn is not None and one.turn.text == words
    assert one.turn.angle_deg == pytest.approx(2.0)
    assert np.allclose(np.array(one.turn.axis_in_model) * 2.0, -UP[up] @ np.array(turned), atol=1e-6)


def test_below_u_nothing_is_asked_for() -> None:
    (one,) = told(WALL, off(WALL, "block_1", (-2.0, 0.05, 0.05), (0.0, 0.0, 0.01)))
    assert one.what == "move 2.00 ± 0.06 mm towards east" and one.turn is None


def test_a_small_turn_without_an_angle_limit_is_asked_for_when_the_ends_are_out() -> None:
    (one,) = told(WALL, off(WALL, "block_1", (-2.0, 0.0, 0.0), (0.0, 0.0, 0.3)))
    assert one.turn is None  # 17 mm · 0.3° = 0.09 mm, less than half of 0.5 mm
    (one,) = told(WALL, off(WALL, "block_1", (-2.0, 0.0, 0.0), (0.0, 0.0, 1.5)))
    assert one.turn is not None
    assert "turn it about that point" in one.remark and "centre of mass" in one.remark


def test_what_is_undetermined_is_said_and_never_asked_for() -> None:
    wrong = off(WALL, "block_1", (-2.0, 0.0, 0.0))
    assert wrong.details is not None
    free = ((0.0, 0.0, 0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 1.0, 0.0, 0.0, 0.0))
    wrong = replace(
        wrong, displacement_mm=(-2.0, 0.0, None), observable=(True, True, False, True, True, False),
        details=replace(wrong.details, undetermined=free),
    )  # fmt: skip
    (one,) = told(WALL, wrong)
    assert one.what == "move 2.00 ± 0.06 mm towards east"
    assert one.remark == (
        "How far it is off up, away from plate, or the other way, was not determined."
        " Its turn about its own axis was not determined."
    )


def test_a_missing_component_is_installed_where_it_belongs() -> None:
    center = WALL.model.component("block_1").centroid_in_model
    (one,) = told(WALL, missing("block_1", center))
    assert (one.how, one.what, one.moves, one.turn) == ("install", "install it", (), None)
    assert one.place in ("on plate, 65 mm from east and 65 mm from south",
                         "on plate, 65 mm from west and 65 mm from south",
                         "on plate, 65 mm from south and 65 mm from east",
                         "on plate, 65 mm from south and 65 mm from west")  # fmt: skip
    assert one.place in one.steps[1]


def test_missing_components_are_no_direction() -> None:
    gone = missing("east", WALL.model.component("east").centroid_in_model)
    one, _ = told(WALL, off(WALL, "block_1", (-2.0, 0.0, 0.0)), gone)
    assert "east" not in one.what
    assert one.what == "move 2.00 ± 0.06 mm away from west"


def test_only_what_fails_is_reworked() -> None:
    center = WALL.model.component("east").centroid_in_model
    found = make_instructions(
        WALL,
        inspection(
            WALL.model,
            (
                deviation("east", (0.01, 0.0, 0.0), center), deviation("west", (0.48, 0.0, 0.0), center),
                not_measured("south", center), off(WALL, "block_1", (-2.0, 0.0, 0.0)),
            ),
            foreign=True,
        ),
    )  # fmt: skip
    assert [one.component for one in found] == ["block_1"]


def test_a_record_without_details_is_enough() -> None:
    wrong = replace(off(WALL, "block_1", (-2.0, 0.0, 0.0)), details=None)
    (one,) = told(WALL, wrong)
    assert one.what == "move 2.00 ± 0.06 mm towards east"
    old = replace(wrong, details=Details(center_mm=(0.0, 0.0, 10.0)))
    assert told(WALL, old)[0].what == one.what


def test_directions_of_the_part_file_come_first() -> None:
    axes = (
        ReworkAxis(direction_in_model=(1.0, 0.0, 0.0), name="towards the hinge"),
        ReworkAxis("away from", "south", name="to the stop"),
        ReworkAxis(direction_in_model=(0.0, 0.0, 1.0), name="off the plate"),
    )
    part = wall(rework=ReworkSettings(axes=axes))
    (one,) = told(part, off(part, "block_1", (-2.0, 1.0, -0.7)))
    assert one.what == (
        "move 2.00 ± 0.06 mm towards the hinge, then move 1.00 ± 0.06 mm towards south,"
        " then move 0.70 ± 0.06 mm off the plate"
    )
    (one,) = told(part, off(part, "block_1", (1.0, -1.5, 0.7)))
    assert one.what == (
        "move 1.50 ± 0.06 mm to the stop, then move 1.00 ± 0.06 mm opposite to “towards the hinge”,"
        " then move 0.70 ± 0.06 mm opposite to “off the plate”"
    )


def test_shims_have_their_thickness() -> None:
    part = wall(rework=ReworkSettings("shim"))
    (one,) = told(part, off(part, "block_1", (0.0, 0.0, -0.7)))
    assert "Put shims of 0.70 ± 0.06 mm between block_1 and plate, then move 0.70 ± 0.06 mm up" in one.steps[1]
    (one,) = told(part, off(part, "block_1", (0.0, 0.0, 0.7)))
    assert "Take 0.70 ± 0.06 mm of shims out between block_1 and plate" in one.steps[1]
    (one,) = told(part, off(part, "block_1", (0.0, 0.0, 0.0), (0.0, 2.0, 0.0), angle_tolerance_deg=1.0))
    # Its free end has to go west, so it is raised on the east.
    assert "put the thicker shims on the side towards east: 34.9 mm for 1 m of width" in one.steps[1].lower()


@pytest.mark.parametrize("how", ["adjust", "unbolt", "reweld", "reglue", "shim", "bend", "replace"])
def test_every_kind_has_steps_that_end_with_the_check(how: str) -> None:
    part = wall(rework=ReworkSettings(how, text="by the book"))
    wrong = off(part, "block_1", (-2.0, 0.0, 0.0))
    (one,) = told(part, wrong)
    assert one.how == how and one.text == "by the book" and len(one.steps) >= 3
    assert one.steps[-1].startswith("Check block_1 again")
    assert not any("{" in step for step in one.steps)
    assert all(step[-1] == "." for step in one.steps)
    asked = [step for step in one.steps if "ove 2.00 ± 0.06 mm towards east" in step]
    assert len(asked) == (0 if how == "replace" else 1)
    if how == "replace":
        assert one.moves == () and "65 mm from" in one.place and "would have to move 2.00" in one.what


def test_steps_of_the_part_file_replace_the_usual_ones() -> None:
    part = wall(rework=ReworkSettings("unbolt", steps=("Lift the cover of {component}", "{move}")))
    (one,) = told(part, off(part, "block_1", (-2.0, 0.0, 0.0)))
    assert one.steps[:2] == ("Lift the cover of block_1.", "Move 2.00 ± 0.06 mm towards east.")


def test_the_document_has_the_numbers() -> None:
    (one,) = told(WALL, off(WALL, "block_1", (-2.0, 0.0, 0.0), (0.0, 0.0, 2.0), angle_tolerance_deg=1.0))
    document = instruction_document(one)
    assert document["moves"][0]["distance_mm"] == pytest.approx(2.0)
    assert document["moves"][0]["U_mm"] == pytest.approx(0.06)
    assert document["moves"][0]["axis_in_model"] == pytest.approx([1.0, 0.0, 0.0])
    assert document["turn"]["angle_deg"] == pytest.approx(2.0)
    assert set(document) == {
        "component", "how", "what", "moves", "turn", "text", "steps", "remark", "place", "pictures",
    }  # fmt: skip


def test_an_inspection_of_another_model_is_refused() -> None:
    other = wall("y")
    with pytest.raises(MismatchError):
        make_instructions(WALL, inspection(other.model, (off(other, "block_1", (2.0, 0.0, 0.0)),)))


@pytest.mark.slow
def test_walls_and_slopes_of_a_real_part() -> None:
    part = load_part(SAMPLES / "manifold")
    nipple = part.model.component("nipple_1").centroid_in_model  # on a slope of 45°, facing -x and up
    slope = np.array([1.0, 0.0, 1.0]) / np.sqrt(2.0)
    down = tuple((-0.9 * slope).tolist())
    (one,) = told(part, replace(deviation("nipple_1", down, nipple), verdict=Verdict.FAIL))
    assert np.allclose(total(one), 0.9 * slope, atol=1e-6)
    assert len(one.moves) == 1
    outward = np.array([-1.0, 0.0, 1.0]) / np.sqrt(2.0)
    (one,) = told(part, deviation("nipple_1", tuple((0.9 * outward).tolist()), nipple))
    assert one.what.endswith("in, towards body") and np.allclose(total(one), -0.9 * outward, atol=1e-6)
    plug = part.model.component("plug_1").centroid_in_model
    (one,) = told(part, deviation("plug_1", (0.0, 0.0, -0.9), plug))
    assert one.what.split(" mm ")[1] == "up"


@pytest.mark.parametrize("angle_deg", range(0, 360, 15))
def test_no_move_is_longer_than_the_displacement(angle_deg: int) -> None:
    moved = (np.cos(np.deg2rad(angle_deg)), np.sin(np.deg2rad(angle_deg)), 0.0)
    (one,) = told(WALL, off(WALL, "block_1", (float(moved[0]), float(moved[1]), 0.0)))
    assert one.moves and max(move.distance_mm for move in one.moves) <= 1.0 + 1e-6
    assert np.allclose(total(one), -np.array(moved), atol=0.3)


def test_what_is_said_has_keys_for_the_language_of_a_page() -> None:
    (one,) = told(WALL, off(WALL, "block_1", (0.8, -0.3, 0.9)))
    messages = with_messages(instruction_document(one))["messages"]
    assert {text for text in one.steps if text not in messages} == set()
    assert all(move.text in messages for move in one.moves)
    step = next(text for text in one.steps if one.moves[0].text.lower() in text.lower())
    assert messages[step]["values"]["move"]["key"] in ("rework.move", "rework.then")
