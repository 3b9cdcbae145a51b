"""Verdicts, tilt and observability about a component's own axes, and what is never passed."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from arview.cad.model import Component, Model, make_model
from arview.cad.part import ComponentSettings, Part
from arview.geometry import Array, apply, exp_so3, rigid
from arview.inspection import (
    ComponentDeviation,
    Inspection,
    MeasuredPresence,
    Provenance,
    Verdict,
    load_inspection,
    save_inspection,
)
from arview.measurement.datums.alignment import Alignment, align
from arview.measurement.datums.equations import move_equations
from arview.measurement.measurand import measurand_of
from arview.measurement.options import METHODS, ComponentMeasurement, MeasureOptions
from arview.measurement.records import component_record
from arview.measurement.types import Method, Move, NotMeasured
from arview.measurement.uncertainty.budget import UncertaintyOptions
from helpers.cad_files import box
from helpers.synthetic import post

INCLINED = exp_so3(np.deg2rad([0.0, 45.0, 0.0]))
"""The face of the wedge rises at 45°: its normal is (1, 0, 1) / √2."""
OPTIONS = MeasureOptions(uncertainty=UncertaintyOptions(draws=2000))
RADIUS_MM = 20.0
NOISE = np.diag([0.01 / RADIUS_MM] * 3 + [0.01] * 3) ** 2


def _placed(name: str, mesh: tuple[Array, Array], place: Array) -> Component:
    return Component(name, apply(place, mesh[0]), mesh[1].astype(np.int32))


def model() -> Model:
    """A plate with an inclined face (a turned slab), on which a block and a round stud stand at 45°."""
    slab = rigid(INCLINED, [0.0, 0.0, 0.0])
    return make_model(
        "inclined",
        (
            _placed("slab", box((-60, -60, -10), (60, 60, 0)), slab),
            _placed("block", box((-30, -8, 0), (-10, 8, 12)), slab),
            _placed("stud", post((25.0, 10.0), 5.0, 0.0, 30.0, 40), slab),
        ),
    )


def part(angle_tolerance_deg: float | None = 1.0) -> Part:
    settings = [ComponentSettings("slab", "base")]
    settings += [ComponentSettings(name, "inspect", 0.5, angle_tolerance_deg) for name in ("block", "stud")]
    return Part("inclined", Path("part.toml"), Path("inclined.step"), model(), tuple(settings))


def frame() -> Alignment:
    exact = Move("slab", "edges", np.zeros(3), np.zeros(6), 1e-10 * np.eye(6), np.zeros((0, 6)), 80.0, 9, 0.0, 1.0)
    return align([], np.zeros(3), 80.0, move_equations("slab", exact)[0])


def move(
    name: str, turn_deg: Array, shift: Array, method: Method = "edges", undetermined: Array | None = None,
    covariance: Array = NOISE,
) -> Move:  # fmt: skip
    """A move measured without error, zero along the undetermined directions."""
    free = np.zeros((0, 6)) if undetermined is None else undetermined
    unit = np.array([RADIUS_MM] * 3 + [1.0] * 3)
    project = (np.eye(6) - free.T @ free) / unit[:, None] * unit
    twist = project @ np.concatenate([np.deg2rad(turn_deg), shift])
    center = model().component(name).centroid_in_model
    return Move(name, method, center, twist, project @ covariance @ project.T, free, RADIUS_MM, 400, 0.02, 0.8)


def recorded(*moves: Move, tolerance_deg: float | None = 1.0) -> ComponentDeviation:
    name, of = moves[0].component, part(tolerance_deg)
    measured = ComponentMeasurement(moves, ())
    return component_record(name, measured, measurand_of(name, of), frame(), None, of, OPTIONS)


def test_tilt_of_what_stands_on_an_inclined_face() -> None:
    """Turned by 1.0° about a line in the face, it is tilted by 1.0°; about +Z of the model that reads 0.7°."""
    found = recorded(move("block", INCLINED @ [1.0, 0.0, 0.0], np.zeros(3)), tolerance_deg=2.0)
    assert found.tilt_deg == pytest.approx(1.0, abs=1e-6) and found.twist_deg == pytest.approx(0.0, abs=1e-6)
    assert found.details is not None and found.details.axis_from == "seat" and found.details.axes is not None
    assert found.details.axes[2] == pytest.approx(INCLINED[:, 2])
    turned = recorded(move("block", INCLINED @ [0.0, 0.0, 1.5], np.zeros(3)), tolerance_deg=2.0)
    assert turned.tilt_deg == pytest.approx(0.0, abs=1e-4) and turned.twist_deg == pytest.approx(1.5, abs=1e-6)
    assert turned.details is not None and turned.details.tilt_uncertainty_deg is not None
    assert 0.05 < turned.details.tilt_uncertainty_deg < 0.2  # 0.01 mm at 20 mm are 0.03°


SPIN = np.concatenate([INCLINED[:, 2], np.zeros(3)])[None]
SLIDE = np.concatenate([np.zeros(3), INCLINED[:, 2]])[None]


def test_an_inclined_stud_that_is_three_degrees_off_fails() -> None:
    """Its spin cannot be seen, its tilt can: no rotation about an axis of the model is determined by itself."""
    found = recorded(move("stud", INCLINED @ [3.0, 0.0, 0.0], np.zeros(3), undetermined=SPIN))
    assert found.tilt_deg == pytest.approx(3.0, abs=1e-6) and found.twist_deg is None
    assert found.verdict is Verdict.FAIL
    assert found.details is not None and found.details.angle_deg == pytest.approx(3.0, abs=1e-6)
    assert found.observable == (False, True, False, True, True, True)
    assert found.details.own_rotation_deg is not None and found.details.own_rotation_deg[2] is None
    straight = recorded(move("stud", np.zeros(3), np.zeros(3), undetermined=SPIN))
    assert straight.verdict is Verdict.PASS  # the spin is free by its symmetry, and nothing to be judged


def test_what_is_free_turns_with_the_component() -> None:
    """Tilted by 8°, it spins about its measured axis, which is 8° off the nominal one."""
    turned = exp_so3(np.deg2rad(INCLINED @ [8.0, 0.0, 0.0])) @ INCLINED
    spin = np.concatenate([turned[:, 2], np.zeros(3)])[None]
    found = recorded(move("stud", INCLINED @ [8.0, 0.0, 0.0], np.zeros(3), undetermined=spin))
    assert found.tilt_deg == pytest.approx(8.0, abs=0.1) and found.twist_deg is None


def test_what_is_open_along_its_own_axis_is_stated_so() -> None:
    """Displaced by 0.2 mm across, unknown along its axis: the distance across is known, and it cannot pass."""
    across = 0.2 * INCLINED[:, 0]
    found = recorded(move("stud", np.zeros(3), across, undetermined=np.concatenate([SPIN, SLIDE])))
    assert found.distance_mm == pytest.approx(0.2, abs=1e-6)
    assert found.displacement_mm == (None, pytest.approx(0.0, abs=1e-9), None)
    assert found.details is not None and found.details.own_displacement_mm is not None
    assert found.details.own_displacement_mm[2] is None
    assert np.linalg.norm([v for v in found.details.own_displacement_mm if v is not None]) == pytest.approx(
        0.2, abs=1e-6
    )
    assert found.verdict is Verdict.UNDECIDED
    assert any("along (0.71, 0.00, 0.71) is undetermined" in note for note in found.details.notes)


def test_a_tolerance_that_was_not_judged_is_not_passed() -> None:
    """The block's tilt about one line is open: its position passes, its angle tolerance does not."""
    tip = np.concatenate([INCLINED[:, 0], np.zeros(3)])[None]
    one = move("block", np.zeros(3), np.array([0.05, 0.0, 0.0]), undetermined=tip)
    found = recorded(one)
    assert found.verdict is Verdict.UNDECIDED and found.tilt_deg is None
    assert found.details is not None
    assert any("angle tolerance of 1° is not judged" in note for note in found.details.notes)
    assert recorded(one, tolerance_deg=None).verdict is Verdict.PASS
    turns = np.concatenate([np.eye(3), np.zeros((3, 3))], axis=1)
    nothing = recorded(move("block", np.zeros(3), np.zeros(3), undetermined=turns))
    assert nothing.verdict is Verdict.UNDECIDED and nothing.details is not None and nothing.details.angle_deg is None
    shifts = np.concatenate([np.zeros((3, 3)), np.eye(3)], axis=1)
    no_place = recorded(move("block", np.zeros(3), np.zeros(3), undetermined=shifts))
    assert no_place.distance_mm is None and no_place.verdict is Verdict.UNDECIDED


def test_methods_that_contradict_each_other_are_never_a_pass() -> None:
    sweep = move("block", np.zeros(3), np.array([0.02, 0.0, 0.0]), "sweep")
    near = move("block", np.zeros(3), np.array([0.03, 0.01, 0.0]))
    assert recorded(sweep, near).verdict is Verdict.PASS
    turned = move("block", np.array([0.0, 0.6, 0.0]), np.array([0.02, 0.0, 0.0]))
    found = recorded(sweep, turned, tolerance_deg=None)
    assert found.verdict is Verdict.UNDECIDED  # at the same place, but not turned alike
    assert found.details is not None and found.details.agreement[0].agree is False
    assert any("contradict each other" in note for note in found.details.notes)
    away = move("block", np.zeros(3), np.array([0.02, 0.3, 0.0]))
    found = recorded(sweep, away, tolerance_deg=None)
    assert found.verdict is Verdict.UNDECIDED and found.details is not None
    assert found.details.budget[0].name == "methods disagree" and found.details.budget[0].std_mm > 0.08
    # Only one is far off what the other leaves open too: nothing contradicts.
    loose = move("block", np.zeros(3), np.array([0.02, 0.3, 0.0]), undetermined=np.eye(6)[4:5])
    assert recorded(sweep, loose, tolerance_deg=None).verdict is Verdict.PASS
    cloud = move("block", np.zeros(3), np.array([0.02, 0.3, 0.0]), "cloud")
    assert recorded(sweep, near, cloud, tolerance_deg=None).verdict is Verdict.PASS  # only for comparison


def test_missing_is_told_from_not_seen() -> None:
    of = part()

    def found(*failures: NotMeasured) -> ComponentDeviation:
        measured = ComponentMeasurement((), failures)
        return component_record("block", measured, measurand_of("block", of), frame(), None, of, OPTIONS)

    few = [NotMeasured("block", method, "fewer than 3 photos", is_unseen=True) for method in METHODS[:2]]
    unseen = found(*few)
    assert unseen.presence is MeasuredPresence.NOT_SEEN and unseen.verdict is Verdict.NOT_MEASURED
    doubtful = found(NotMeasured("block", "sweep", "weak", is_unseen=True), NotMeasured("block", "edges", "elsewhere"))
    assert doubtful.presence is MeasuredPresence.UNKNOWN and doubtful.finding is None
    gone = found(NotMeasured("block", "edges", "missing", is_missing=True))
    assert gone.presence is MeasuredPresence.MISSING and gone.verdict is Verdict.FAIL


def test_the_record_is_written_and_read(tmp_path: Path) -> None:
    across = 0.2 * INCLINED[:, 0]
    open_one = recorded(move("stud", INCLINED @ [2.0, 0.0, 0.0], across, undetermined=np.concatenate([SPIN, SLIDE])))
    whole = recorded(move("block", np.zeros(3), across))
    made = Inspection(
        "inclined", "", model().source_hash, datetime(2026, 3, 1, tzinfo=UTC), (open_one, whole),
        Provenance("arview measure", "0.1", "edges"),
    )  # fmt: skip
    save_inspection(made, tmp_path / "a.json")
    assert load_inspection(tmp_path / "a.json", model()) == made
    assert replace(open_one, distance_mm=0.2).is_present
