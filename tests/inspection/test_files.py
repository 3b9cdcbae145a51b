"""Reading, checking and writing inspection.json."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from arview.cad.model import Component, Model, make_model
from arview.errors import InputError, MismatchError, OutputError
from arview.inspection import (
    ComponentDeviation,
    Finding,
    Inspection,
    Provenance,
    Verdict,
    load_inspection,
    save_inspection,
)

FACES = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]])


@pytest.fixture
def model() -> Model:
    corners = np.array([[0, 0, 0], [10, 0, 0], [0, 10, 0], [0, 0, 10.0]])
    return make_model("part", tuple(Component(f"post_{i}", corners + 20 * i, FACES) for i in range(4)))


def document(model: Model) -> dict[str, Any]:
    seen = [True] * 6
    return {
        "schema_version": "1.0",
        "part": "plate",
        "serial": "SN 7",
        "model_hash": model.source_hash,
        "created": "2026-03-01T12:00:00Z",
        "components": [
            {
                "name": "post_0",
                "displacement_mm": [1.0, -0.61, 0.0],
                "distance_mm": 1.17,
                "rotation": {"tilt_deg": 0.4, "twist_deg": None},
                "observable": seen,
                "uncertainty_mm": 0.12,
                "tolerance_mm": 0.5,
                "verdict": "fail",
            },
            {
                "name": "post_1",
                "displacement_mm": [0.03, 0.04, None],
                "distance_mm": 0.05,
                "observable": [*seen[:5], False],
                "uncertainty_mm": 0.1,
                "tolerance_mm": 0.5,
                "verdict": "pass",
            },
            {
                "name": "post_2",
                "displacement_mm": [None, None, None],
                "distance_mm": None,
                "observable": [False] * 6,
                "uncertainty_mm": None,
                "tolerance_mm": 0.5,
                "verdict": "fail",
                "finding": "missing",
            },
        ],
        "provenance": {
            "tool": "arview",
            "version": "0.1.0",
            "method": "none",
            "note": "example, written by hand",
        },
    }


@pytest.fixture
def write(tmp_path: Path) -> Callable[[Any], Path]:
    def writer(content: Any) -> Path:
        path = tmp_path / "inspection.json"
        path.write_text(content if isinstance(content, str) else json.dumps(content), encoding="utf-8")
        return path

    return writer


def test_reads_what_is_written(model: Model, write: Callable[[Any], Path], tmp_path: Path) -> None:
    inspection = load_inspection(write(document(model)), model)
    assert inspection.serial == "SN 7"
    assert inspection.created == datetime(2026, 3, 1, 12, tzinfo=UTC)
    post = inspection.find("post_0")
    assert post is not None
    assert post.displacement_mm == (1.0, -0.61, 0.0)
    assert (post.verdict, post.tilt_deg, post.twist_deg) == (Verdict.FAIL, 0.4, None)
    unseen = inspection.find("post_1")
    assert unseen is not None
    assert unseen.displacement_mm[2] is None
    missing = inspection.find("post_2")
    assert missing is not None
    assert missing.finding is Finding.MISSING
    assert inspection.find("post_3") is None

    save_inspection(inspection, tmp_path / "again.json")
    assert load_inspection(tmp_path / "again.json", model) == inspection
    assert [p.name for p in tmp_path.iterdir() if p.name.startswith(".")] == []


def test_age(model: Model, write: Callable[[Any], Path]) -> None:
    inspection = load_inspection(write(document(model)))
    assert inspection.age_s(datetime(2026, 3, 1, 13, tzinfo=UTC)) == 3600.0
    assert inspection.age_s(datetime(2026, 3, 1, 14, tzinfo=timezone(timedelta(hours=1)))) == 3600.0


def _set(path: str, value: Any) -> Callable[[dict[str, Any]], None]:
    def change(content: Any) -> None:
        *steps, last = [int(step) if step.isdigit() else step for step in path.split("/")]
        for step in steps:
            content = content[step]
        if value is KeyError:
            del content[last]
        else:
            content[last] = value

    return change


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (_set("schema_version", "1.4"), "written by a newer arview"),
        (_set("schema_version", "2.0"), "written by a newer arview"),
        (_set("schema_version", "0.9"), "schema_version: is '0.9'"),
        (_set("schema_version", "one"), "schema_version: is 'one'"),
        (_set("schema_version", KeyError), "schema_version: is missing"),
        (_set("part", KeyError), "'part' is a required property"),
        (_set("model_hash", "abc"), "model_hash"),
        (_set("created", "yesterday"), "created"),
        (_set("created", "2026-03-01T12:00:00"), "created: '2026-03-01T12:00:00': expected a time with its zone"),
        (_set("created", "0001-01-01T00:00:00+23:00"), "created"),
        (_set("created", "2026-13-01T12:00:00Z"), "created"),
        (_set("coment", 1), "'coment' was unexpected"),
        (_set("components/0/distance_mm", float("nan")), "components[0].distance_mm: is nan"),
        (_set("components/0/displacement_mm/1", float("inf")), "components[0].displacement_mm[1]: is inf"),
        (_set("components/0/displacement_mm/1", 10**400), "components[0].displacement_mm[1]"),
        (_set("components/0/name", "post_\ud800"), "components[0].name: holds half of a character"),
        (_set("components/0/distance_mm", 1.3), "components[0].distance_mm: is 1.3, but displacement_mm has"),
        (_set("components/0/distance_mm", None), "components[0].distance_mm: is null"),
        (_set("components/0/distance_mm", -1.17), "components[0].distance_mm"),
        (_set("components/0/distance_mm", "1.17"), "components[0].distance_mm"),
        (_set("components/0/displacement_mm", [1.0, 2.0]), "components[0].displacement_mm"),
        (_set("components/0/observable", [True] * 3), "components[0].observable"),
        (
            _set("components/0/observable/3", False),
            "components[0].displacement_mm[0]: is 1.0, but dx is undetermined",
        ),
        (
            _set("components/1/observable/5", True),
            "components[1].displacement_mm[2]: is null, but dz is determined by observable[5]",
        ),
        (_set("components/0/observable", [False] * 3 + [True] * 3), "components[0].rotation"),
        (_set("components/0/uncertainty_mm", None), "components[0].uncertainty_mm: is null"),
        (_set("components/0/tolerance_mm", None), "components[0].tolerance_mm: is null"),
        (_set("components/0/tolerance_mm", 0), "components[0].tolerance_mm"),
        (
            _set("components/0/verdict", "pass"),
            "components[0].verdict: is pass, but distance_mm 1.17 exceeds",
        ),
        (_set("components/0/verdict", "good"), "components[0].verdict: 'good' is not one of"),
        (_set("components/0/verdict", "not_measured"), "components[0].verdict: is not_measured"),
        (_set("components/2/verdict", "undecided"), "components[2].verdict"),
        (_set("components/2/finding", "bent"), "components[2].finding"),
        (_set("components/1/name", "post_0"), "components[1].name: 'post_0' appears twice"),
        (_set("components/0/verdict", KeyError), "components[0]: 'verdict' is a required property"),
        (_set("provenance/tool", KeyError), "provenance: 'tool' is a required property"),
    ],
)
def test_refuses_in_one_line(
    model: Model, write: Callable[[Any], Path], change: Callable[[dict[str, Any]], None], says: str
) -> None:
    content = document(model)
    change(content)
    path = write(content)
    with pytest.raises(InputError) as caught:
        load_inspection(path, model)
    message = str(caught.value)
    assert says in message
    assert message.startswith(str(path))
    assert "\n" not in message
    assert len(message) < len(str(path)) + 300


def test_names_all_faults_at_once(model: Model, write: Callable[[Any], Path]) -> None:
    content = document(model)
    content["model_hash"] = "0" * 64
    content["created"] = "2026-13-01T12:00:00Z"
    content["coment"] = "?"
    first, second, third = content["components"]
    first |= {"distance_mm": 1.3, "uncertainty_mm": None, "verdict": "pass"}
    second |= {"name": "post_0", "observable": [True] * 6}
    third |= {"name": "nut", "verdict": "bad"}
    path = write(content)
    with pytest.raises(InputError) as caught:
        load_inspection(path, model)
    message = str(caught.value)
    assert message.startswith(f"{path}: 10 faults: (1) ")
    assert "\n" not in message
    for fault in (
        "'coment' was unexpected", "components[2].verdict: 'bad' is not one of", "created: '2026-13-01T12:00:00Z'",
        "components[0].distance_mm: is 1.3, but", "components[0].uncertainty_mm: is null",
        "components[0].verdict: is pass, but", "components[1].displacement_mm[2]: is null, but",
        "components[1].name: 'post_0' appears twice", "names 'nut', which model",
        f"model 'part' has {model.source_hash}",
    ):  # fmt: skip
        assert fault in message


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "is not JSON, line 1"),
        ("{", "is not JSON, line 1"),
        ("[]", "does not look like an arview inspection"),
        ("3", "does not look like an arview inspection"),
        ('{"part": 1, "part": 2}', "'part' occurs twice"),
        ("[" + "1" * 5000 + "]", "a number too long"),
        ("[" * 100_000, "nested too deeply"),
        ('{"schema_version": "1.2", "part": ' + "[" * 5000 + "]" * 5000 + "}", "nested too deeply"),
    ],
)
def test_refuses_other_files(write: Callable[[Any], Path], text: str, says: str) -> None:
    with pytest.raises(InputError, match=says):
        load_inspection(write(text))


def test_refuses_what_is_no_text_or_not_there(tmp_path: Path) -> None:
    binary = tmp_path / "binary.json"
    binary.write_bytes(b"\xff\xfe\x00\x81")
    with pytest.raises(InputError, match="not a text file"):
        load_inspection(binary)
    with pytest.raises(InputError, match="No such file"):
        load_inspection(tmp_path / "absent.json")
    with pytest.raises(InputError, match="cannot read"):
        load_inspection(tmp_path)


def test_refuses_another_model(model: Model, write: Callable[[Any], Path]) -> None:
    path = write(document(model))
    moved = make_model("part", tuple(replace(c, vertices_in_model=c.vertices_in_model + 0.5) for c in model.components))
    with pytest.raises(MismatchError, match="another model: model_hash"):
        load_inspection(path, moved)
    with pytest.raises(MismatchError, match="'post_2'"):
        load_inspection(path, model.only(["post_0", "post_1"]))


def test_save_leaves_the_old_file_when_it_fails(model: Model, write: Callable[[Any], Path], tmp_path: Path) -> None:
    inspection = load_inspection(write(document(model)))
    with pytest.raises(OutputError, match="cannot write"):
        save_inspection(inspection, tmp_path / "absent" / "inspection.json")
    (tmp_path / "folder").mkdir()
    with pytest.raises(OutputError, match="cannot write"):
        save_inspection(inspection, tmp_path / "folder")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["folder", "inspection.json"]


def test_records_made_in_code_are_checked_too(model: Model) -> None:
    with pytest.raises(InputError, match="distance_mm"):
        ComponentDeviation("a", (1.0, 0.0, 0.0), 2.0, (True,) * 6, 0.1, 0.5, Verdict.FAIL)
    with pytest.raises(InputError, match="UTC"):
        Inspection("p", "", model.source_hash, datetime(2026, 1, 1), (), Provenance("t", "1", "m"))
