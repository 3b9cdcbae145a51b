"""The decision rule at its limits, and the record that holds its answers."""

from __future__ import annotations

import json
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from arview.cad.model import Component, Model, make_model
from arview.errors import InputError
from arview.inspection import (
    BudgetLine,
    ComponentDeviation,
    DatumReport,
    DatumSystem,
    Details,
    Inspection,
    MethodAgreement,
    MethodResult,
    Provenance,
    Verdict,
    load_inspection,
    save_inspection,
)
from arview.measurement.uncertainty.decision import (
    DecisionOptions,
    decide,
    worst,
    zone_diameter_mm,
)

PASS, FAIL, UNDECIDED = Verdict.PASS, Verdict.FAIL, Verdict.UNDECIDED


@pytest.mark.parametrize(
    ("value", "uncertainty", "guard", "expected"),
    [
        (0.38, 0.12, 1.0, PASS),  # just touches the limit
        (0.39, 0.12, 1.0, UNDECIDED),
        (0.62, 0.12, 1.0, UNDECIDED),
        (0.63, 0.12, 1.0, FAIL),
        (0.49, 0.12, 0.0, PASS),
        (0.50, 0.12, 0.0, PASS),
        (0.51, 0.12, 0.0, FAIL),
        (0.43, 0.12, 0.5, PASS),
        (0.57, 0.12, 0.5, FAIL),
        (0.30, 0.12, 2.0, UNDECIDED),
        (0.00, 0.60, 1.0, UNDECIDED),
    ],
)
def test_guard_bands(value: float, uncertainty: float, guard: float, expected: Verdict) -> None:
    assert decide(value, uncertainty, 0.5, guard) is expected


def test_without_tolerance_or_value() -> None:
    assert decide(0.1, 0.02, None) is Verdict.MEASURED
    assert decide(None, None, 0.5) is Verdict.NOT_MEASURED
    assert worst([PASS, UNDECIDED, FAIL]) is FAIL
    assert worst([PASS, Verdict.NOT_MEASURED]) is Verdict.NOT_MEASURED
    assert worst([Verdict.MEASURED, PASS]) is PASS
    assert worst([Verdict.MEASURED, FAIL]) is FAIL
    assert worst([]) is Verdict.NOT_MEASURED
    assert zone_diameter_mm(0.5) == 1.0
    with pytest.raises(InputError, match="guard factor"):
        DecisionOptions(guard=-0.1)


def test_few_verdicts_are_wrong() -> None:
    """Of parts anywhere near the limit, at most 2.5 % on its wrong side pass, and of good ones fail."""
    rng = np.random.default_rng(1)
    true = rng.uniform(0.3, 0.7, 40_000)
    measured = np.abs(true + rng.normal(0, 0.03, true.size))
    verdicts = np.array([decide(value, 0.06, 0.5).value for value in measured])
    near = (true > 0.5) & (true < 0.53)
    assert np.mean(verdicts[near] == "pass") < 0.025
    near = (true < 0.5) & (true > 0.47)
    assert np.mean(verdicts[near] == "fail") < 0.025
    assert set(verdicts[np.abs(true - 0.5) > 0.19]) == {"pass", "fail"}
    simple = np.array([decide(value, 0.06, 0.5, 0.0).value for value in measured])
    assert 0.2 < np.mean(simple[(true > 0.5) & (true < 0.53)] == "pass") < 0.4


# --- the record ------------------------------------------------------------------------------------------


@pytest.fixture
def model() -> Model:
    corners = np.array([[0, 0, 0], [10, 0, 0], [0, 10, 0], [0, 0, 10.0]])
    faces = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]])
    return make_model("part", (Component("post", corners, faces),))


def full(model: Model) -> Inspection:
    identity = tuple(tuple(float(v) for v in row) for row in np.eye(4))
    details = Details(
        center_mm=(5.0, 5.0, 5.0),
        measured_from_nominal=identity,
        covariance=((1e-4, 0.0), (0.0, 1e-4)),
        undetermined=((0.0, 0.0, 1.0, 0.0, 0.0, 0.0),),
        radius_mm=8.66,
        k=2.0,
        interval_mm=(0.44, 0.56),
        corrected_distance_mm=0.498,
        zone_diameter_mm=1.0,
        angle_deg=0.2,
        angle_uncertainty_deg=0.1,
        methods=(
            MethodResult("sweep", (0.3, 0.4, None), (0.1, 0.0, None), (0.01, 0.01, None), 800, 0.02, 0.9, notes=("x",)),
            MethodResult("cloud", reason="no cloud"),
        ),
        agreement=(MethodAgreement(("sweep", "edges"), 0.02, 0.06, True),),
        budget=(BudgetLine("scale", 0.02), BudgetLine("noise of sweep", 0.01)),
        notes=("a note",),
    )
    component = ComponentDeviation(
        "post", (0.3, 0.4, None), 0.5, (True, True, False, True, True, False), 0.06, 0.5, UNDECIDED, 0.2, None,
        details=details,
    )  # fmt: skip
    datums = (DatumReport("B", "hole", "plate", "tx ty", 120, 130, 0.02, 0.021, 0.05, "edges"),)
    system = DatumSystem(datums, identity, ((1e-6,),), (-130.0, -130.0, 0.0), 139.26, 1.5e-4, "a board", ("rz by B",))
    provenance = Provenance(
        "arview measure", "0.1", "sweep", photos_hash="ab12", photos=24, software=(("numpy", "2"),),
        options=(("guard", "1"),), cpu_s=3.5,
    )  # fmt: skip
    created = datetime(2026, 3, 1, tzinfo=UTC)
    return Inspection("plate", "", model.source_hash, created, (component,), provenance, system, ("careful",))


def test_a_full_record_comes_back_as_it_was(model: Model, tmp_path: Path) -> None:
    inspection = full(model)
    save_inspection(inspection, tmp_path / "inspection.json")
    assert load_inspection(tmp_path / "inspection.json", model) == inspection
    content = json.loads((tmp_path / "inspection.json").read_text(encoding="utf-8"))
    assert content["schema_version"] == "1.3"
    assert content["components"][0]["details"]["budget"][0] == {"name": "scale", "std_mm": 0.02}
    assert "reason" not in content["components"][0]["details"]["methods"][0]  # defaults are left out


def test_files_of_version_1_0_are_read_and_hold_no_details(model: Model, tmp_path: Path) -> None:
    plain = replace(full(model), datum_system=None, warnings=(), provenance=Provenance("arview", "0.1", "none"))
    plain = replace(plain, components=(replace(plain.components[0], details=None),))
    save_inspection(plain, tmp_path / "inspection.json")
    content = json.loads((tmp_path / "inspection.json").read_text(encoding="utf-8"))
    content["schema_version"] = "1.0"
    (tmp_path / "old.json").write_text(json.dumps(content), encoding="utf-8")
    assert load_inspection(tmp_path / "old.json", model) == plain
    content["warnings"] = ["new in 1.1"]
    (tmp_path / "mixed.json").write_text(json.dumps(content), encoding="utf-8")
    with pytest.raises(InputError, match="warnings"):
        load_inspection(tmp_path / "mixed.json")


def test_details_are_checked_by_the_schema(model: Model, tmp_path: Path) -> None:
    save_inspection(full(model), tmp_path / "inspection.json")
    content = json.loads((tmp_path / "inspection.json").read_text(encoding="utf-8"))
    content["components"][0]["details"]["k"] = "two"
    (tmp_path / "inspection.json").write_text(json.dumps(content), encoding="utf-8")
    with pytest.raises(InputError, match=r"components\[0\].details.k"):
        load_inspection(tmp_path / "inspection.json")
