"""What the decisions say of a part together: beside the measured verdict, never instead of it."""

from __future__ import annotations

import csv
import io
from pathlib import Path

import pytest

from arview.decisions import (
    decide_component,
    decisions_csv,
    decisions_path,
    log_of,
    sign_inspection,
    state_document,
    state_of_record,
    tick_step,
)
from arview.errors import InputError
from arview.inspection import Verdict, load_inspection, save_inspection
from arview.inspection.summary import overall_verdict
from helpers.inspections import bench_inspection, deviation, inspection
from helpers.photo_scene import bench

MODEL = bench()
CENTER = {c.name: c.bounds_in_model.mean(axis=0) for c in MODEL.components}


@pytest.fixture
def job(tmp_path: Path) -> Path:
    """A job folder whose inspection has one failing and one passing component."""
    made = inspection(
        MODEL,
        (
            deviation("block_1", (0.03, -0.02, 0.01), CENTER["block_1"]),
            deviation("block_2", (2.4, -1.8, 0.0), CENTER["block_2"]),
        ),
    )
    save_inspection(made, tmp_path / "inspection.json")
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "0003.jpg").write_bytes(b"x")
    return tmp_path


def test_without_decisions_nothing_is_said(job: Path) -> None:
    state = state_of_record(job)
    assert state.sentence == "" and not state.is_released and state.signature is None
    assert state.undecided == ("block_2",)


def test_a_deviation_is_accepted_and_released(job: Path) -> None:
    decide_component(job, "block_2", True, "agreed with the customer", "see mail", "Ada", "0003.jpg")
    assert state_of_record(job).sentence.startswith("not signed: 1 deviation accepted")
    sign_inspection(job, "Grace")
    state = state_of_record(job)
    assert state.is_released
    assert state.sentence.startswith("released by Grace, 2")
    assert state.sentence.endswith("with 1 deviation accepted (block_2: agreed with the customer)")
    assert overall_verdict(load_inspection(job / "inspection.json")) is Verdict.FAIL  # measured, and it stays so
    assert state_document(state)["accepted"] == ["block_2"]


def test_what_is_open_or_rejected_is_not_released(job: Path) -> None:
    sign_inspection(job, "Grace")
    state = state_of_record(job)
    assert not state.is_released
    assert state.sentence.endswith("not released: open: block_2 is out of tolerance")
    decide_component(job, "block_2", False, "to be moved", by="Ada")
    decide_component(job, "block_1", False, "scratched", by="Ada")
    sign_inspection(job, "Grace")
    state = state_of_record(job)
    assert not state.is_released and not state.undecided
    assert "not OK: block_2: to be moved; block_1: scratched" in state.sentence


def test_a_later_decision_voids_the_signature(job: Path) -> None:
    decide_component(job, "block_2", True, "agreed", by="Ada")
    sign_inspection(job, "Grace")
    decide_component(job, "block_1", True, "", by="Ada")
    state = state_of_record(job)
    assert not state.is_released
    assert state.signature is not None and state.signature.void == "a decision on block_1 came after it"
    assert "is void: a decision on block_1 came after it" in state.sentence


def test_another_inspection_voids_the_signature(job: Path) -> None:
    decide_component(job, "block_2", True, "agreed", by="Ada")
    sign_inspection(job, "Grace")
    other = inspection(MODEL, (deviation("block_2", (2.3, -1.8, 0.0), CENTER["block_2"]),))
    save_inspection(other, job / "inspection.json")
    state = state_of_record(job)
    assert not state.is_released
    assert "the inspection is another than the one that was signed" in state.sentence
    assert [one.component for one in state.earlier] == ["block_2"]


def test_another_formatting_does_not(job: Path) -> None:
    decide_component(job, "block_2", True, "agreed", by="Ada")
    sign_inspection(job, "Grace")
    path = job / "inspection.json"
    path.write_text(path.read_text().replace("  ", " "))
    assert state_of_record(job).is_released


def test_a_changed_log_releases_nothing(job: Path) -> None:
    decide_component(job, "block_2", False, "to be moved", by="Ada")
    decide_component(job, "block_2", True, "moved", by="Ada")
    sign_inspection(job, "Grace")
    path = decisions_path(job)
    path.write_bytes(path.read_bytes().replace(b"to be moved", b"to be mowed"))
    state = state_of_record(job)
    assert not state.is_released and state.sentence.startswith("not valid")
    assert "line 1 was changed" in state.faults[0]


def test_faults_of_what_is_said(job: Path) -> None:
    for arguments, message in (
        (("block_9", True, "r"), "no component 'block_9'; it has: block_1, block_2"),
        (("block_2", True, ""), "reason: is empty"),
        (("block_1", False, ""), "reason: is empty"),
    ):
        with pytest.raises(InputError, match=message):
            decide_component(job, *arguments, by="Ada")
    for photo, message in (("0004.jpg", "there is no 0004.jpg"), ("../x.jpg", "not the name"), (".x", "not the name")):
        with pytest.raises(InputError, match=message):
            decide_component(job, "block_2", True, "r", by="Ada", photo=photo)
    with pytest.raises(InputError, match="no component"):
        tick_step(job, "block_9", 0, True, "Ada")
    assert not decisions_path(job).exists()
    with pytest.raises(InputError, match="no such inspection"):
        sign_inspection(job / "nothing", "Ada")


def test_every_kind_of_finding_is_named(tmp_path: Path) -> None:
    save_inspection(bench_inspection(MODEL), tmp_path / "inspection.json")
    sign_inspection(tmp_path, "Grace")
    sentence = state_of_record(tmp_path).sentence
    for words in (
        "block_2 is out of tolerance", "block_3 is undecided", "block_4 is missing", "plate was not measured",
        "1 foreign object on the part",
    ):  # fmt: skip
        assert words in sentence


def test_an_inspection_of_another_name_has_its_own_log(job: Path) -> None:
    other = job / "second.json"
    other.write_bytes((job / "inspection.json").read_bytes())
    decide_component(other, "block_2", True, "agreed", by="Ada")
    assert decisions_path(other).name == "second.decisions.jsonl"
    assert log_of(job).entries() == () and len(log_of(other).entries()) == 1


def test_the_table_has_a_line_for_each_entry(job: Path) -> None:
    decide_component(job, "block_2", True, "=HYPERLINK(1)", by="Ada", photo="0003.jpg")
    tick_step(job, "block_2", 2, True, "Ada")
    sign_inspection(job, "Grace", "shift 2")
    rows = list(csv.DictReader(io.StringIO(decisions_csv(log_of(job).entries(), "bench", "SN-7"))))
    assert [row["kind"] for row in rows] == ["decision", "tick", "signature"]
    assert rows[0]["decision"] == "OK" and rows[0]["reason"] == "'=HYPERLINK(1)" and rows[0]["photo"] == "0003.jpg"
    assert rows[1]["step"] == "2" and rows[1]["is_done"] == "true" and rows[1]["decision"] == ""
    assert rows[2]["by"] == "Grace" and len(rows[2]["inspection_sha256"]) == 64
    assert {row["serial"] for row in rows} == {"SN-7"}
