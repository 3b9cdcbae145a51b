"""What the decisions say of a part together: beside the measured verdict, never instead of it."""

from __future__ import annotations

import csv
import io
import json
import shutil
from dataclasses import replace
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from arview.cli import main
from arview.errors import InputError
from arview.inspection import Verdict, load_inspection, save_inspection
from arview.inspection.fingerprint import component_fingerprint, fingerprint_of_file, values_fingerprint
from arview.inspection.summary import overall_verdict
from arview.quality.decisions import (
    acting_device,
    decide_component,
    decisions_csv,
    decisions_path,
    log_of,
    sign_inspection,
    state_document,
    state_of_record,
    tick_step,
)
from arview.quality.decisions.folder import photo_path
from helpers.inspections import bench_inspection, deviation, inspection, not_measured, one_failing
from helpers.photo_scene import bench

MODEL = bench()
CENTER = {c.name: c.bounds_in_model.mean(axis=0) for c in MODEL.components}


@pytest.fixture
def job(tmp_path: Path) -> Path:
    """A job folder whose inspection has one failing and one passing component."""
    made = one_failing(MODEL)
    save_inspection(made, tmp_path / "inspection.json")
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "0003.jpg").write_bytes(b"x")
    return tmp_path


DECIDE = ("decisions", "decide")


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
    sign_inspection(job, "Grace", "as a concession")
    state = state_of_record(job)
    assert not state.is_released
    assert state.sentence.endswith("not released: open: block_2 is out of tolerance")
    decide_component(job, "block_2", False, "to be moved", by="Ada")
    decide_component(job, "block_1", False, "scratched", by="Ada")
    sign_inspection(job, "Grace", "as a concession")
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
    assert "it was made about earlier values" in state.sentence
    assert [one.component for one in state.earlier] == ["block_2"]


def _written_again(job: Path, **changes: Any) -> None:
    """The record as the cloud and the comparison of halves write it again after the verdict."""
    path = job / "inspection.json"
    made = load_inspection(path)
    provenance = replace(made.provenance, method="sweep, edges, cloud in 24 photos", cpu_s=31.0)
    later = replace(made, created=made.created + timedelta(minutes=2), provenance=provenance, warnings=("a remark",))
    save_inspection(replace(later, **changes), path)


def test_decisions_and_signature_at_the_verdict_hold_when_the_cloud_changes_no_value(job: Path) -> None:
    decide_component(job, "block_2", True, "agreed", by="Ada")
    sign_inspection(job, "Grace")
    before = fingerprint_of_file(job / "inspection.json")
    _written_again(job)
    assert fingerprint_of_file(job / "inspection.json") != before
    state = state_of_record(job)
    assert state.is_released and not state.earlier


def test_a_value_that_the_cloud_changes_is_told_where_it_changed(job: Path) -> None:
    """The other component's decision stays, since nothing of it changed; the signature was about both."""
    decide_component(job, "block_1", True, "", by="Ada")
    decide_component(job, "block_2", True, "agreed", by="Ada")
    sign_inspection(job, "Grace")
    made = load_inspection(job / "inspection.json")
    moved = deviation("block_2", (2.3, -1.8, 0.0), CENTER["block_2"])
    _written_again(job, components=tuple(moved if one.name == "block_2" else one for one in made.components))
    state = state_of_record(job)
    assert [one.component for one in state.earlier] == ["block_2"] and state.undecided == ("block_2",)
    assert state.signature is not None and "earlier values" in state.signature.void and not state.is_released


def test_a_foreign_object_that_the_cloud_finds_voids_the_signature(job: Path) -> None:
    decide_component(job, "block_2", True, "agreed", by="Ada")
    sign_inspection(job, "Grace")
    _written_again(job, foreign_objects=bench_inspection(MODEL).foreign_objects)
    state = state_of_record(job)
    assert state.signature is not None and state.signature.void and not state.earlier


def test_a_log_that_names_the_file_is_still_read(job: Path) -> None:
    """Older logs hold the fingerprint of the file: they hold as long as the file is that one."""
    file = fingerprint_of_file(job / "inspection.json")
    log_of(job).decide("block_2", True, "agreed", by="Ada", inspection_sha256=file)
    log_of(job).sign("Grace", inspection_sha256=file)
    assert state_of_record(job).is_released
    _written_again(job)
    state = state_of_record(job)
    assert not state.is_released and [one.component for one in state.earlier] == ["block_2"]


def test_the_fingerprint_is_of_values_to_a_tenth_of_a_micrometre(job: Path) -> None:
    made = load_inspection(job / "inspection.json")
    hashes = set()
    for step in (0.0, 1e-9, 0.002):
        x, y, z = 2.1 + step, -1.8, 0.0
        one = deviation("block_2", (x, y, z), CENTER["block_2"])
        hashes.add(values_fingerprint(replace(made, components=(*made.components[:1], one))))
    assert len(hashes) == 2


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
    sign_inspection(tmp_path, "Grace", "as a concession")
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


def recheck(job: Path, number: int, moved: tuple[float, float, float]) -> Path:
    """A check of block_2 after its rework, as a job of its own in the job folder."""
    folder = job / "recheck" / f"{number:02d}"
    (folder / "photos").mkdir(parents=True)
    (folder / "photos" / "0001.jpg").write_bytes(b"x")
    (folder / "job.json").write_text('{"format": "arview job", "components": ["block_2"]}')
    made = inspection(
        MODEL,
        (not_measured("block_1", CENTER["block_1"]), deviation("block_2", moved, CENTER["block_2"])),
        minutes=10 * number,
    )
    save_inspection(made, folder / "inspection.json")
    return folder


def test_a_component_in_tolerance_after_rework_is_released(job: Path) -> None:
    decide_component(job, "block_2", False, "to be moved", by="Ada")
    recheck(job, 1, (0.1, 0.0, 0.0))
    sign_inspection(job, "Grace")
    state = state_of_record(job)
    assert state.is_released and not state.rejected and not state.undecided
    assert state.sentence.endswith("UTC, with block_2 in tolerance after rework")
    assert [one.reason for one in state.earlier] == ["to be moved"]  # about the first measurement: it no longer counts
    (checked,) = state.rechecked
    assert (checked.before.verdict, checked.after.verdict) == (Verdict.FAIL, Verdict.PASS)
    assert state_document(state)["rechecked"] == ["block_2"]


def test_a_check_after_the_signature_voids_it(job: Path) -> None:
    decide_component(job, "block_2", True, "agreed", by="Ada")
    sign_inspection(job, "Grace")
    assert state_of_record(job).is_released
    recheck(job, 1, (0.1, 0.0, 0.0))
    state = state_of_record(job)
    assert not state.is_released and "checked again after it" in state.sentence
    sign_inspection(job, "Grace")
    assert state_of_record(job).is_released


def test_a_check_that_fails_is_decided_about_anew(job: Path) -> None:
    decide_component(job, "block_2", True, "agreed", by="Ada")
    recheck(job, 1, (0.1, 0.0, 0.0))
    recheck(job, 2, (1.1, 0.0, 0.0))
    sign_inspection(job, "Grace", "as a concession")
    state = state_of_record(job)
    assert not state.is_released and state.undecided == ("block_2",)
    with pytest.raises(InputError, match="reason: is empty"):
        decide_component(job, "block_2", True, "", by="Ada")
    decide_component(job, "block_2", True, "as good as it gets", by="Ada")
    sign_inspection(job, "Grace", "as a concession")
    state = state_of_record(job)
    assert state.is_released and "1 deviation accepted (block_2: as good as it gets)" in state.sentence
    newest = load_inspection(job / "recheck" / "02" / "inspection.json").find("block_2")
    assert newest is not None
    about = log_of(job).latest()["block_2"].inspection_sha256
    assert about == component_fingerprint(load_inspection(job / "inspection.json"), newest)


def test_a_check_has_the_record_of_the_first_measurement(job: Path) -> None:
    folder = recheck(job, 1, (1.1, 0.0, 0.0))
    made = decide_component(folder, "block_2", True, "fine", by="Ada", photo="0001.jpg")
    assert made.photo == "recheck/01/0001.jpg"
    assert photo_path(job, made.photo) == job / "recheck" / "01" / "photos" / "0001.jpg"
    tick_step(folder, "block_2", 0, True, "Ada")
    sign_inspection(folder, "Grace")
    assert decisions_path(folder) == decisions_path(job) and not (folder / "decisions.jsonl").exists()
    assert len(log_of(job).entries()) == 3
    assert state_of_record(folder) == state_of_record(job) and state_of_record(job).is_released
    for name in ("recheck/../x/y", "recheck/.a/b", "../x", "a/b", "recheck/01/..", "recheck/01/.x"):
        assert photo_path(job, name) is None


def test_a_changed_check_voids_the_signature(job: Path) -> None:
    folder = recheck(job, 1, (0.1, 0.0, 0.0))
    sign_inspection(job, "Grace")
    assert state_of_record(job).is_released
    made = inspection(MODEL, (deviation("block_2", (0.05, 0.0, 0.0), CENTER["block_2"]),))
    save_inspection(made, folder / "inspection.json")
    assert not state_of_record(job).is_released


def test_a_photo_is_checked_where_the_job_has_no_folder_of_photos(job: Path) -> None:
    shutil.rmtree(job / "photos")
    with pytest.raises(InputError, match=r"photo: there is no 0003\.jpg in .*photos; name a photo of the job"):
        decide_component(job, "block_2", True, "r", by="Ada", photo="0003.jpg")
    (job / "photos.json").write_text(json.dumps({"photos": [{"name": "0003.jpg"}]}))
    assert decide_component(job, "block_2", True, "r", by="Ada", photo="0003.jpg").photo == "0003.jpg"
    with pytest.raises(InputError, match=r"there is no 0004\.jpg"):
        decide_component(job, "block_2", True, "r", by="Ada", photo="0004.jpg")


def test_ok_and_not_ok_exclude_each_other(job: Path) -> None:
    both = CliRunner().invoke(
        main, ["decisions", "decide", str(job), "block_2", "--ok", "--not-ok", "--reason", "r", "--by", "Ada"]
    )
    assert both.exit_code == 64 and "give either --ok or --not-ok, not both" in both.stderr
    assert not log_of(job).content().entries
    one = CliRunner().invoke(
        main, ["decisions", "decide", str(job), "block_2", "--not-ok", "--reason", "r", "--by", "Ada"]
    )
    assert one.exit_code == 0 and [entry.is_ok for entry in log_of(job).content().entries] == [False]


def test_a_failed_component_is_signed_with_a_reason_only(job: Path) -> None:
    with pytest.raises(InputError, match=r"block_2.*out of tolerance, and nobody has decided"):
        sign_inspection(job, "Grace")
    assert log_of(job).entries() == ()
    assert sign_inspection(job, "Grace", "agreed with the customer, no. 17").note.startswith("agreed")


def test_the_device_is_in_the_entry_and_in_the_hash(job: Path) -> None:
    token = acting_device.set("iPhone Safari")
    try:
        decide_component(job, "block_2", True, "agreed", by="Ada")
    finally:
        acting_device.reset(token)
    decide_component(job, "block_2", False, "bent", by="Ada")
    assert [one.device for one in log_of(job).entries()] == ["iPhone Safari", ""] and not log_of(job).faults()
    path = log_of(job).path
    path.write_bytes(path.read_bytes().replace(b"iPhone", b"iPad  "))
    assert log_of(job).faults()


def test_a_list_whose_signature_is_void_is_not_signed(job: Path) -> None:
    unsigned = CliRunner().invoke(main, ["decisions", "list", str(job)])
    assert unsigned.exit_code == 2 and "not signed" in unsigned.output
    sign_inspection(job, "Grace", "as a concession")
    assert CliRunner().invoke(main, ["decisions", "list", str(job)]).exit_code == 0
    loaded = load_inspection(job / "inspection.json")
    changed = replace(loaded.components[0], verdict=Verdict.UNDECIDED)
    save_inspection(replace(loaded, components=(changed, *loaded.components[1:])), job / "inspection.json")
    void = CliRunner().invoke(main, ["decisions", "list", str(job)])
    assert void.exit_code == 2 and "void" in void.output
