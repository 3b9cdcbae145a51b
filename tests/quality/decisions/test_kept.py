"""Decisions in what is kept of an inspection: report, exports, results store, and the commands."""

from __future__ import annotations

import base64
import csv
import hashlib
import io
import json
import re
import sqlite3
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import sqlalchemy as sa
from click.testing import CliRunner, Result
from PIL import Image as PilImage

from arview.cad.part import ComponentSettings, Part
from arview.cli import ExitCode, main
from arview.errors import OutputError
from arview.inspection import load_inspection, save_inspection
from arview.quality.decisions import attach_photo, decide_component, log_of, sign_inspection, tick_step
from arview.quality.history import HistoryStore
from arview.quality.history.tables import STORE_VERSION, about, decisions
from arview.report import make_report
from arview.report.decisions import update_report
from helpers.inspections import deviation, inspection, one_failing
from helpers.photo_scene import bench

MODEL = bench()
CENTER = {c.name: c.bounds_in_model.mean(axis=0) for c in MODEL.components}
PATH = Path("bench.toml")
PART = Part(
    "bench", PATH, Path("bench.step"), MODEL,
    tuple(ComponentSettings(c.name, "base" if c.name in ("bench", "plate") else "inspect", 0.5)
          for c in MODEL.components),
)  # fmt: skip


@pytest.fixture
def job(tmp_path: Path) -> Path:
    made = one_failing(MODEL)
    folder = tmp_path / "job"
    folder.mkdir()
    save_inspection(made, folder / "inspection.json")
    return folder


def run(*arguments: str | Path) -> Result:
    return CliRunner().invoke(main, [str(one) for one in arguments], prog_name="arview")


def accept(job: Path) -> None:
    decide_component(job, "block_2", True, "agreed <b>", by="Ada")
    tick_step(job, "block_2", 0, True, "Ada")
    sign_inspection(job, "Grace", "shift 2")


# ---- the report


def test_the_report_shows_decisions_beside_the_measured_verdict(job: Path) -> None:
    accept(job)
    make_report(job / "inspection.json", job / "report.html")
    page = (job / "report.html").read_text()
    assert '<div class="verdict fail">' in page  # as measured
    assert "released by Grace, 2" in page and "with 1 deviation accepted (block_2: agreed &lt;b&gt;)" in page
    assert '<p class="record released">' in page and 'id="decisions"' in page
    assert "Rework of block_2: step 1 done (Ada)." in page


def test_the_report_embeds_the_photo_of_a_decision_and_names_its_hash(job: Path) -> None:
    colors = np.zeros((300, 400, 3), dtype=np.uint8)
    colors[:, :200], colors[:, 200:] = (220, 30, 20), (20, 40, 210)
    kept = io.BytesIO()
    PilImage.fromarray(colors).save(kept, "JPEG", quality=95)
    name = attach_photo(job, kept.getvalue())
    assert name == f"decisions/{hashlib.sha256(kept.getvalue()).hexdigest()}.jpg"
    decide_component(job, "block_2", False, "bent", by="Ada", photo=name)
    sign_inspection(job, "Grace", "")
    make_report(job / "inspection.json", job / "report.html")
    page = (job / "report.html").read_text()
    pictures = re.findall(rf'<img src="data:image/\w+;base64,([^"]+)"[^>]* alt="{re.escape(name)}">', page)
    assert len(pictures) == 1 and f'<span class="muted">{name}</span>' in page
    shown = np.asarray(PilImage.open(io.BytesIO(base64.b64decode(pictures[0]))).convert("RGB")).astype(int)
    height, width, _ = shown.shape
    assert width > 100 and abs(width / height - 4 / 3) < 0.02
    assert np.abs(shown[height // 2, width // 4] - (220, 30, 20)).max() < 12
    assert np.abs(shown[height // 2, 3 * width // 4] - (20, 40, 210)).max() < 12
    # Another picture under that name is told, and nothing is valid any longer.
    PilImage.fromarray(colors[:, ::-1]).save(job / name, "JPEG")
    make_report(job / "inspection.json", job / "report.html")
    assert "the photo of the decision about block_2 (entry 1) was changed" in (job / "report.html").read_text()


def test_a_report_without_decisions_says_nothing_of_them(job: Path) -> None:
    make_report(job / "inspection.json", job / "report.html")
    page = (job / "report.html").read_text()
    assert "Decided by people" not in page and 'id="decisions"' not in page


def test_decisions_are_put_into_a_report_that_is_there(job: Path) -> None:
    page = job / "report.html"
    make_report(job / "inspection.json", page)
    accept(job)
    assert update_report(page, job / "inspection.json")
    updated = page.read_text()
    make_report(job / "inspection.json", page)
    again = page.read_text()
    assert updated.split("Written by")[0] == again.split("Written by")[0]  # as if it were written anew
    decide_component(job, "block_1", False, "scratched", by="Ada")
    assert update_report(page, job / "inspection.json")
    assert "is void: a decision on block_1 came after it" in page.read_text()
    assert page.read_text().count('id="decisions"') == 1


def test_texts_cannot_break_out_of_their_place(job: Path) -> None:
    page = job / "report.html"
    make_report(job / "inspection.json", page)
    evil = "<!-- arview decisions end --><script>alert(1)</script>"
    decide_component(job, "block_2", True, evil, by="Ada")
    for _ in range(2):
        assert update_report(page, job / "inspection.json")
        assert "<script>alert" not in page.read_text()
        assert page.read_text().count("<!-- arview decisions end -->") == 1


def test_a_report_of_another_inspection_is_left_alone(job: Path, tmp_path: Path) -> None:
    page = job / "report.html"
    assert not update_report(page, job / "inspection.json")  # there is none
    make_report(job / "inspection.json", page)
    before = page.read_bytes()
    other = inspection(MODEL, (deviation("block_2", (2.3, -1.8, 0.0), CENTER["block_2"]),))
    save_inspection(other, job / "inspection.json")
    assert not update_report(page, job / "inspection.json")
    assert page.read_bytes() == before


def test_a_changed_log_is_told_in_the_report(job: Path) -> None:
    accept(job)
    log = log_of(job).path
    log.write_bytes(log.read_bytes().replace(b"agreed", b"Agreed"))
    make_report(job / "inspection.json", job / "report.html")
    page = (job / "report.html").read_text()
    assert "line 1 was changed" in page and "not valid: the log of decisions was changed" in page
    assert "released" not in page.split('<dl class="facts">')[0].split("</style>")[1]


@pytest.mark.slow
def test_the_report_tells_the_rework_with_its_drawing(job: Path) -> None:
    make_report(job / "inspection.json", job / "report.html", part=PART)
    page = (job / "report.html").read_text()
    section = page.split('<section id="rework">')[1].split("</section>")[0]
    assert section.count('<article class="rework">') == 1  # block_1 is in tolerance
    assert "<svg" in section and 'width="180mm"' in section and "style=" not in section
    plain = section.replace("<b>", "").replace("</b>", "")
    assert "block_2, adjust" in plain
    # Each instruction stands once: the moves are a step.
    assert plain.count('<span class="box"></span>Move ') == 1
    assert "block_2, adjust: Move" not in plain
    assert section.count('<span class="box">') == 4


def test_components_that_were_checked_again_are_beside_their_first_measurement(job: Path, tmp_path: Path) -> None:
    make_report(job / "inspection.json", job / "report.html")
    folder = job / "recheck" / "01"
    folder.mkdir(parents=True)
    block = deviation("block_2", (0.1, 0.0, 0.0), CENTER["block_2"])
    save_inspection(inspection(MODEL, (block,), minutes=10), folder / "inspection.json")
    assert run("decisions", "sign", folder, "--by", "Grace", "--store", tmp_path / "results.sqlite").exit_code == 0
    page = (job / "report.html").read_text()
    section = page.split('<section id="decisions">')[1].split("</section>")[0]
    assert "Checked again after rework" in section
    assert "Fail, 3.000 ± 0.060 mm of 0.5" in section and "Pass, 0.100 ± 0.060 mm of 0.5" in section
    assert "Released by Grace" in section and "block_2 in tolerance after rework" in section
    listed = run("history", "list", "--store", tmp_path / "results.sqlite").output
    assert listed.count("released") == 1 and "2 results" in listed
    shown = run("history", "show", "2", "--store", tmp_path / "results.sqlite").output
    assert "block_2 in tolerance after rework" in shown


# ---- exports


def test_the_exports_hold_them(job: Path) -> None:
    accept(job)
    done = run("export", job / "inspection.json", "--to", "csv,decisions")
    assert done.exit_code == 0, done.output
    rows = {row["component"]: row for row in csv.DictReader(io.StringIO((job / "inspection.csv").read_text()))}
    assert (rows["block_2"]["verdict"], rows["block_2"]["decision"]) == ("fail", "OK")
    assert rows["block_2"]["decision_by"] == "Ada" and rows["block_1"]["decision"] == ""
    entries = list(csv.DictReader(io.StringIO((job / "decisions.csv").read_text())))
    assert [row["kind"] for row in entries] == ["decision", "tick", "signature"]


# ---- the results store


def test_the_store_keeps_them_and_only_new_ones(job: Path, tmp_path: Path) -> None:
    path = job / "inspection.json"
    with HistoryStore(tmp_path / "results.sqlite") as store:
        assert store.add(path).decisions == 0
        accept(job)
        added = store.add(path)
        assert (added.is_new, added.decisions, added.decision_faults) == (False, 3, ())
        assert store.add(path).decisions == 0
        assert store.decisions(added.id) == log_of(job).entries()
        decide_component(job, "block_1", True, "fine", by="Ada")
        assert store.add(path).decisions == 1
        assert store.check() == (1, [])


def test_the_store_refuses_changed_logs_and_those_written_anew(job: Path, tmp_path: Path) -> None:
    path = job / "inspection.json"
    accept(job)
    with HistoryStore(tmp_path / "results.sqlite") as store:
        store.add(path)
        for file in job.glob("decisions*"):
            file.unlink()
        decide_component(job, "block_2", True, "another story", by="Eve")
        added = store.add(path)
        assert added.decisions == 0
        assert added.decision_faults == ("decision 1 of the log is not the one in the store: the log was written anew",)
        log = log_of(job).path
        log.write_bytes(log.read_bytes().replace(b"story", b"Story"))
        assert "line 1 was changed" in store.add(path).decision_faults[0]
        assert [one.by for one in store.decisions(added.id)] == ["Ada", "Ada", "Grace"]


def test_the_database_refuses_changes_and_the_check_finds_them(job: Path, tmp_path: Path) -> None:
    accept(job)
    where = tmp_path / "results.sqlite"
    with HistoryStore(where) as store:
        store.add(job / "inspection.json")
    database = sqlite3.connect(where)
    for statement in ("UPDATE arview_decisions SET reason = 'x'", "DELETE FROM arview_decisions"):
        with pytest.raises(sqlite3.IntegrityError, match="append-only"):
            database.execute(statement)
    database.execute("DROP TRIGGER arview_decisions_no_update")
    database.execute("UPDATE arview_decisions SET reason = 'x' WHERE number = 1")
    database.commit()
    with HistoryStore(where, must_exist=True) as store:
        assert store.check() == (1, ["result 1: decision 1 was changed"])


def test_a_store_of_version_2_gets_the_table_when_it_is_opened(job: Path, tmp_path: Path) -> None:
    where = tmp_path / "results.sqlite"
    path = job / "inspection.json"
    with HistoryStore(where) as store:
        store.add(path)
    database = sqlite3.connect(where)
    database.execute("DROP TABLE arview_decisions")
    database.execute("DROP TRIGGER arview_store_no_delete")
    database.execute("DELETE FROM arview_store")
    database.execute("DROP TRIGGER arview_store_no_replace")
    database.execute("INSERT INTO arview_store VALUES (2)")
    database.commit()
    database.close()
    with HistoryStore(where, must_exist=True) as store:
        assert store.decisions(1) == () and len(store.listed()) == 1 and store.check() == (1, [])
    accept(job)
    with HistoryStore(where) as store:
        assert store.add(path).decisions == 3 and len(store.decisions(1)) == 3
        with store._engine.connect() as connection:
            assert connection.scalar(sa.select(sa.func.max(about.c.version))) == STORE_VERSION
            assert connection.scalar(sa.select(sa.func.count()).select_from(decisions)) == 3


def test_the_history_commands_show_them(job: Path, tmp_path: Path) -> None:
    accept(job)
    where = tmp_path / "results.sqlite"
    done = run("history", "add", job / "inspection.json", "--store", where)
    assert done.exit_code == 0 and "3 new decisions" in done.output, done.output
    assert "released" in run("history", "list", "--store", where).output
    shown = run("history", "show", "1", "--store", where).output
    assert "decided  released by Grace" in shown and "agreed <b>" in shown
    listed = run("history", "decisions", "--store", where).output
    assert "1.1" in listed and "3 entries" in listed
    target = tmp_path / "all.csv"
    assert run("history", "decisions", "--store", where, "-o", target).exit_code == 0
    assert [row["entry"] for row in csv.DictReader(io.StringIO(target.read_text()))] == ["1", "2", "3"]
    table = tmp_path / "plate.csv"
    assert run("history", "export", "--store", where, "-o", table).exit_code == 0
    rows = {row["component"]: row for row in csv.DictReader(io.StringIO(table.read_text()))}
    assert rows["block_2"]["decision"] == "OK" and rows["block_2"]["verdict"] == "fail"
    assert rows["block_1"]["record"].startswith("released by Grace")


# ---- the commands


def test_decide_and_sign(job: Path, tmp_path: Path) -> None:
    make_report(job / "inspection.json", job / "report.html")
    done = run("decisions", "decide", job, "block_2", "--not-ok", "--reason", "to be moved", "--by", "Ada")
    assert done.exit_code == 0 and "entry 1: block_2 not OK, Ada" in done.output, done.output
    done = run("decisions", "sign", job, "--by", "Grace")
    assert done.exit_code == ExitCode.FAIL and "not released: not OK: block_2: to be moved" in done.output
    run("decisions", "decide", job, "block_2", "--ok", "--reason", "moved by hand", "--by", "Ada")
    where = tmp_path / "results.sqlite"
    done = run("decisions", "sign", job / "inspection.json", "--by", "Grace", "--store", where)
    assert done.exit_code == 0 and "4 new entries" in done.output, done.output
    assert "released by Grace" in (job / "report.html").read_text()
    listed = run("decisions", "list", job, "-o", tmp_path / "out.csv")
    assert listed.exit_code == 0 and listed.output.count("Ada: decision block_2") == 2
    assert len((tmp_path / "out.csv").read_text().splitlines()) == 5


def test_a_store_that_cannot_be_used_is_told_before_signing(job: Path, tmp_path: Path) -> None:
    (tmp_path / "garbage.sqlite").write_bytes(bytes(range(256)) * 20)
    done = run("decisions", "sign", job, "--by", "Grace", "--store", tmp_path / "garbage.sqlite")
    assert done.exit_code == ExitCode.BAD_INPUT and "is not a results store" in done.output, done.output
    assert not (job / "decisions.jsonl").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("decisions", "decide", "{job}", "block_2", "--by", "Ada"), "give --ok or --not-ok"),
        (("decisions", "decide", "{job}", "block_9", "--ok", "--reason", "r", "--by", "Ada"), "no component 'block_9'"),
        (("decisions", "decide", "{job}", "block_2", "--ok", "--by", "Ada"), "reason: is empty"),
        (("decisions", "decide", "{job}", "block_2", "--ok", "--reason", "r", "--by", " "), "by: is empty"),
        (("decisions", "decide", "nothing", "block_2", "--ok", "--reason", "r", "--by", "Ada"), "no such inspection"),
        (("decisions", "sign", "nothing", "--by", "Ada"), "no such inspection"),
        (("decisions", "list", "nothing"), "no such inspection"),
        (("rework", "nothing", "--part", "nothing"), "no such file"),
    ],
)
def test_mistakes_are_one_line(job: Path, arguments: tuple[str, ...], message: str) -> None:
    done = run(*(one.replace("{job}", str(job)) for one in arguments))
    assert done.exit_code == ExitCode.BAD_INPUT
    assert message in done.output and "Traceback" not in done.output


def test_a_changed_log_fails_the_check(job: Path) -> None:
    accept(job)
    log = log_of(job).path
    log.write_bytes(log.read_bytes().replace(b"agreed", b"Agreed"))
    done = run("decisions", "list", job)
    assert done.exit_code == ExitCode.FAIL and "line 1 was changed" in done.output
    done = run("decisions", "sign", job, "--by", "Grace")
    assert done.exit_code == ExitCode.BAD_INPUT and "line 1 was changed" in done.output


def test_rework_prints_and_draws(job: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import arview.cad

    monkeypatch.setattr(arview.cad, "load_part", lambda path, unit=None: PART)
    done = run("rework", job / "inspection.json", "--part", "bench.toml", "-o", tmp_path / "drawings")
    assert done.exit_code == ExitCode.FAIL, done.output
    assert "block_2 (adjust): move" in done.output and "1. Free block_2" in done.output
    assert [one.name for one in (tmp_path / "drawings").iterdir()] == ["block_2.svg"]
    document = json.loads(run("rework", job / "inspection.json", "--part", "bench.toml", "--json").output)
    assert document[0]["component"] == "block_2" and len(document[0]["moves"]) >= 1
    block = deviation("block_1", (0.03, 0.0, 0.0), CENTER["block_1"])
    fine = replace(load_inspection(job / "inspection.json"), components=(block,))
    save_inspection(fine, job / "inspection.json")
    done = run("rework", job / "inspection.json", "--part", "bench.toml")
    assert done.exit_code == 0 and "no rework" in done.output


def test_a_full_disk_confirms_nothing(job: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import os

    def refuse(handle: int) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(os, "fsync", refuse)
        with pytest.raises(OutputError, match="was not kept"):
            decide_component(job, "block_2", True, "agreed", by="Ada")
    assert log_of(job).entries() == ()
    accept(job)
    assert [one.number for one in log_of(job).entries()] == [1, 2, 3] and log_of(job).faults() == ()
