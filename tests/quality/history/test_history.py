"""The results store (append-only, idempotent, several writers), series and commands."""

from __future__ import annotations

import json
import shutil
import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sqlalchemy as sa
from click.testing import CliRunner, Result

from arview.cli import ExitCode, main
from arview.errors import InputError, MissingDependencyError, OutputError
from arview.inspection import CharacteristicResult, Inspection, Verdict, load_inspection, save_inspection
from arview.quality.history import (
    Capability,
    HistoryStore,
    capability,
    capability_by_limits,
    connection,
    control_chart,
    series_of,
)
from arview.quality.history import store as store_module
from arview.quality.history.chart import draw
from arview.quality.history.connection import default_station
from arview.quality.history.tables import results
from helpers.inspections import deviation, inspection, missing
from helpers.photo_scene import bench
from helpers.postgresql import postgresql_server, reason_without_server

MODEL = bench()


def saved(folder: Path, name: str, made: Inspection) -> Path:
    save_inspection(made, folder / f"{name}.json")
    return folder / f"{name}.json"


def built(index: int, dx: float, part: str = "bench", serial: str | None = None) -> Inspection:
    """A part of a series: one block moved along x, measured an hour after the previous part."""
    serial = f"S{index:03d}" if serial is None else serial
    block = deviation("block_1", (dx, 0.02, -0.01), np.zeros(3), uncertainty_mm=0.02)
    return inspection(MODEL, (block,), serial, part=part, minutes=60 * index)


@pytest.fixture
def store(tmp_path: Path) -> Iterator[HistoryStore]:
    with HistoryStore(tmp_path / "results.sqlite") as opened:
        yield opened


@pytest.fixture(scope="module")
def postgresql() -> Iterator[str]:
    """The URL of a temporary database."""
    if reason := reason_without_server():
        pytest.skip(reason)
    with postgresql_server() as url:
        yield url


# ---- adding


def test_what_is_added_comes_back(store: HistoryStore, tmp_path: Path) -> None:
    source = saved(tmp_path, "a", built(1, 0.123456789))
    added = store.add(source, "cell-3")
    assert added.is_new
    (one,) = store.listed()
    assert (one.part, one.serial, one.station, one.verdict) == ("bench", "S001", "cell-3", "pass")
    assert one.measured.isoformat() == "2026-03-01T13:30:15+00:00"
    assert (one.model_hash, one.content_hash) == (MODEL.source_hash, added.content_hash)
    (row,) = store.components([one.id])
    assert (row["dx_mm"], row["dy_mm"], row["uncertainty_mm"]) == (0.123456789, 0.02, 0.02)
    listed, document = store.find(one.content_hash[:8])
    assert listed == one
    (tmp_path / "again.json").write_text(document, encoding="utf-8")
    assert load_inspection(tmp_path / "again.json") == load_inspection(source)
    assert store.find(str(one.id))[0] == one
    assert store.check() == (1, [])


def test_the_same_content_is_there_once(store: HistoryStore, tmp_path: Path) -> None:
    source = saved(tmp_path, "a", built(1, 0.1))
    first = store.add(source)
    assert store.add(source).is_new is False
    other = tmp_path / "b.json"  # the same content, written in another way
    other.write_text(json.dumps(json.loads(source.read_text()), sort_keys=True), encoding="utf-8")
    again = store.add(other, "elsewhere")
    assert (again.id, again.content_hash, again.is_new) == (first.id, first.content_hash, False)
    assert len(store.listed()) == 1
    assert store.add(saved(tmp_path, "c", built(1, 0.1001))).is_new


def test_undetermined_and_missing_are_null(store: HistoryStore, tmp_path: Path) -> None:
    open_z = deviation("block_2", (0.1, 0.2, None), np.zeros(3))
    store.add(saved(tmp_path, "a", inspection(MODEL, (open_z, missing("block_3", np.zeros(3))))))
    first, second = store.components([1])
    assert (first["dz_mm"], first["dx_mm"]) == (None, 0.1)
    assert (second["distance_mm"], second["finding"], second["verdict"]) == (None, "missing", "fail")


def test_filters(store: HistoryStore, tmp_path: Path) -> None:
    for index in range(4):
        store.add(
            saved(tmp_path, f"{index}", built(index, 0.9 * (index == 2), "bench" if index else "other")),
            f"c{index % 2}",
        )
    assert [one.serial for one in store.listed()] == ["S000", "S001", "S002", "S003"]
    assert [one.serial for one in store.listed(part="bench", station="c1")] == ["S001", "S003"]
    assert [one.serial for one in store.listed(verdict="fail")] == ["S002"]
    assert [one.serial for one in store.listed(limit=2)] == ["S002", "S003"]
    since = store.listed()[2].measured
    assert [one.serial for one in store.listed(since=since)] == ["S002", "S003"]


# ---- nothing is changed


@pytest.mark.parametrize(
    "statement",
    [
        "UPDATE arview_results SET verdict = 'pass'",
        "DELETE FROM arview_results",
        "UPDATE arview_components SET dx_mm = 0",
        "DELETE FROM arview_components",
        "DELETE FROM arview_store",
    ],
)
def test_the_database_refuses_changes(store: HistoryStore, tmp_path: Path, statement: str) -> None:
    store.add(saved(tmp_path, "a", built(1, 0.7)))
    before = list(store.components([1]))
    outside = sqlite3.connect(tmp_path / "results.sqlite")  # not through arview: any client of the file
    with pytest.raises(sqlite3.IntegrityError, match="append-only"):
        outside.execute(statement)
    outside.close()
    assert list(store.components([1])) == before


def test_insert_or_replace_replaces_nothing(store: HistoryStore, tmp_path: Path) -> None:
    added = store.add(saved(tmp_path, "a", built(1, 0.7)))
    outside = sqlite3.connect(tmp_path / "results.sqlite")
    for number in (added.id, added.id + 7):
        outside.execute(
            "INSERT OR REPLACE INTO arview_results SELECT ?, content_hash, part, serial, 'mine', model_hash, measured,"
            " added, 'pass', tool, document FROM arview_results",
            (number,),
        )
    outside.commit()
    outside.close()
    assert [(one.id, one.station) for one in store.listed()] == [(added.id, default_station())]
    assert store.check() == (1, [])


def test_changes_behind_the_triggers_are_found(store: HistoryStore, tmp_path: Path) -> None:
    store.add(saved(tmp_path, "a", built(1, 0.7)))
    outside = sqlite3.connect(tmp_path / "results.sqlite")
    outside.execute("DROP TRIGGER arview_results_no_update")
    outside.execute("UPDATE arview_results SET document = replace(document, '0.7,', '0.1,')")
    outside.commit()
    outside.close()
    count, faults = store.check()
    assert count == 1
    assert "does not have the hash" in faults[0]
    done = CliRunner().invoke(main, ["history", "check", "--store", str(tmp_path / "results.sqlite")])
    assert done.exit_code == ExitCode.FAIL


# ---- two stations at once

WRITER = """
import sys
from pathlib import Path
from arview.quality.history import HistoryStore
where, station, folder = sys.argv[1:]
with HistoryStore(where) as store:
    for path in sorted(Path(folder).glob("*.json")):
        store.add(path, station)
"""


def many(folder: Path, name: str, count: int) -> Path:
    """Small inspections, each of another serial, written as text: the test is about the store."""
    place = folder / name
    place.mkdir()
    document = json.loads(saved(folder, "pattern", built(0, 0.1)).read_text())
    document["components"][0].pop("details")
    document.pop("datum_system")
    for index in range(count):
        document["serial"] = f"{name}-{index:04d}"
        (place / f"{index:04d}.json").write_text(json.dumps(document))
    return place


def writer(where: str, station: str, folder: Path) -> subprocess.Popen[str]:
    command = [sys.executable, "-c", WRITER, where, station, str(folder)]
    return subprocess.Popen(command, stderr=subprocess.PIPE, text=True)


def together(where: str, tmp_path: Path, count: int, shared: int) -> None:
    """Two processes write ``count`` results each, ``shared`` of them the same; the store does not exist before."""
    first, second = many(tmp_path, "a", count - shared), many(tmp_path, "b", count - shared)
    for index, path in enumerate(sorted(many(tmp_path, "both", shared).glob("*.json"))):
        for folder in (first, second):
            shutil.copy(path, folder / f"{index * 7:04d}_both.json")
    working = [writer(where, "one", first), writer(where, "two", second)]
    for process in working:
        _, errors = process.communicate(timeout=240)
        assert process.returncode == 0, errors
    with HistoryStore(where) as store:
        listed = store.listed()
        names = [one.serial for one in listed]
        expected = {f"{n}-{i:04d}" for n in "ab" for i in range(count - shared)} | {
            f"both-{i:04d}" for i in range(shared)
        }
        assert len(names) == len(set(names))  # none twice
        assert set(names) == expected  # none lost
        assert {one.station for one in listed} == {"one", "two"}
        assert store.check() == (len(expected), [])


@pytest.mark.slow
def test_two_processes_write_a_thousand_results_each(tmp_path: Path) -> None:
    together(str(tmp_path / "results.sqlite"), tmp_path, 1000, 50)


@pytest.mark.slow
def test_a_writer_that_is_killed_leaves_a_whole_store(tmp_path: Path) -> None:
    folder, where = many(tmp_path, "a", 300), str(tmp_path / "results.sqlite")
    process = writer(where, "one", folder)
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline:
        time.sleep(0.02)
        if Path(where).exists() and 20 < _rows(where) < 280:
            break
    process.send_signal(signal.SIGKILL)
    process.communicate()
    with HistoryStore(where) as store:
        assert 20 < len(store.listed()) < 300
        assert store.check()[1] == []  # no result without its components
        for path in sorted(folder.glob("*.json")):
            store.add(path, "one")
        assert len(store.listed()) == 300


def _rows(where: str) -> int:
    reading = sqlite3.connect(f"file:{where}?mode=ro", uri=True)
    try:
        return int(reading.execute("SELECT count(*) FROM arview_results").fetchone()[0])
    except sqlite3.Error:
        return 0
    finally:
        reading.close()


@pytest.mark.slow
def test_a_writer_waits_for_another(tmp_path: Path) -> None:
    where = tmp_path / "results.sqlite"
    HistoryStore(where).close()
    other = sqlite3.connect(where, isolation_level=None)
    other.execute("BEGIN IMMEDIATE")
    process = writer(str(where), "one", many(tmp_path, "a", 1))
    time.sleep(2.0)
    assert process.poll() is None
    other.execute("COMMIT")
    other.close()
    assert process.wait(timeout=60) == 0
    with HistoryStore(where) as store:
        assert len(store.listed()) == 1


def test_a_store_that_is_held_is_said_and_given_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Seconds are tenths here: the writer says after one wait what it waits for, and ends after all with what to do."""
    monkeypatch.setattr("arview.quality.history.connection.BUSY_S", 0.2)
    monkeypatch.setattr("arview.quality.history.store.BUSY_S", 0.2)
    monkeypatch.setattr(store_module, "WAIT_S", 1.5)
    where, path = tmp_path / "results.sqlite", saved(tmp_path, "a", built(0, 0.1))
    HistoryStore(where).close()
    other = sqlite3.connect(where, isolation_level=None)
    for begin in ("BEGIN IMMEDIATE", "BEGIN EXCLUSIVE"):
        other.execute(begin)
        began = time.monotonic()
        done = run("add", path, "--store", where)
        assert 1.5 < time.monotonic() - began < 6.0
        assert done.exit_code != 0
        assert "another program holds the store; waiting for it, 2 s at most" in done.output
        assert "another program has held the store for" in done.output.splitlines()[-1]
        assert done.output.count("another program") == 2
        other.execute("ROLLBACK")
    other.close()
    assert run("add", path, "--store", where).exit_code == 0


def test_a_store_is_made_only_in_a_folder_that_exists(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = saved(tmp_path, "a", built(0, 0.1))
    where = tmp_path / "share" / "of" / "plate.sqlite"
    for arguments, environment in ((["--store", where], {}), ([], {"ARVIEW_STORE": str(where)})):
        for name, value in environment.items():
            monkeypatch.setenv(name, value)
        done = run("add", path, *arguments)
        assert done.exit_code == ExitCode.BAD_INPUT, done.output
        assert f"{where.parent}: no such folder for a store; create it, or mount the share" in done.output
        assert not (tmp_path / "share").exists()
    monkeypatch.delenv("ARVIEW_STORE")
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "home"))
    first, second = run("add", path), run("add", path)
    assert first.exit_code == second.exit_code == 0  # the user's own data folder is made
    assert "history.sqlite: a new store is made" in first.output
    assert "new store" not in second.output


# ---- PostgreSQL


@pytest.mark.slow
def test_postgresql_two_writers(postgresql: str, tmp_path: Path) -> None:
    together(postgresql, tmp_path, 250, 20)


@pytest.mark.slow
def test_postgresql_refuses_changes(postgresql: str, tmp_path: Path) -> None:
    with HistoryStore(postgresql) as store:
        added = store.add(saved(tmp_path, "pg", built(5, 0.3, serial="pg-1")), "cell")
        assert store.add(tmp_path / "pg.json").is_new is False
        assert store.find(added.content_hash[:10])[0].serial == "pg-1"
        assert [row["dx_mm"] for row in store.components([added.id])] == [0.3]
    engine = sa.create_engine(store_module.store_url(postgresql))
    for statement in (
        "UPDATE arview_results SET verdict = 'pass'", "DELETE FROM arview_results", "TRUNCATE arview_results CASCADE",
        "UPDATE arview_components SET dx_mm = 0", "DELETE FROM arview_components",
    ):  # fmt: skip
        with pytest.raises(sa.exc.DBAPIError, match="append-only"), engine.begin() as connection:
            connection.exec_driver_sql(statement)
    engine.dispose()


def test_postgresql_that_is_not_there() -> None:
    with pytest.raises(OutputError) as caught:
        HistoryStore("postgresql://qa:secret@127.0.0.1:1/none?connect_timeout=2")
    assert "secret" not in str(caught.value)
    assert "\n" not in str(caught.value)


# ---- what cannot be a store


def test_wrong_stores(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "text").write_text("no database at all, but long enough to have a header" * 10)
    for where, error, message in (
        (tmp_path / "text", OutputError, "is not a results store"),
        (tmp_path, InputError, "is a folder"),
        ("mysql://x/y", InputError, "mysql is not supported"),
        ("nonsense://", InputError, "not supported"),
    ):
        with pytest.raises(error, match=message):
            HistoryStore(where)
    with pytest.raises(InputError, match="no such store"):
        HistoryStore(tmp_path / "none.sqlite", must_exist=True)
    newer = tmp_path / "newer.sqlite"
    HistoryStore(newer).close()
    outside = sqlite3.connect(newer)
    outside.execute("INSERT INTO arview_store VALUES (99)")
    outside.commit()
    outside.close()
    with pytest.raises(InputError, match="newer arview"):
        HistoryStore(newer)
    monkeypatch.setattr(connection, "file_system", lambda path: "nfs4")
    with pytest.raises(InputError, match=r"network file system \(nfs4\).*PostgreSQL"):
        HistoryStore(tmp_path / "share.sqlite")


def test_without_the_driver(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "psycopg", None)
    with pytest.raises(MissingDependencyError, match=r"pip install .*\[postgres\]'"):
        HistoryStore("postgresql://qa@127.0.0.1:1/none")


def test_the_file_system_of_a_path() -> None:
    assert connection.file_system(Path("/proc/self")) == "proc"


# ---- series, picture, commands


@pytest.fixture
def filled(store: HistoryStore, tmp_path: Path) -> HistoryStore:
    rng = np.random.default_rng(3)
    for index, dx in enumerate(rng.normal(0.05, 0.03, 30)):
        store.add(saved(tmp_path, f"{index}", built(index, float(dx))), f"c{index % 2}")
    return store


def test_a_series(filled: HistoryStore, tmp_path: Path) -> None:
    again = replace(built(40, 0.2), serial="S005")  # measured again, later
    filled.add(saved(tmp_path, "again", again))
    filled.add(saved(tmp_path, "gone", inspection(MODEL, (missing("block_1", np.zeros(3)),), "S900", minutes=9000)))
    series = series_of(filled, "block_1", "dx")
    assert (len(series.values), series.unit) == (30, "mm")
    assert (series.lower, series.upper) == (-0.5, 0.5)
    assert (series.values[-1].serial, series.values[-1].value) == ("S005", 0.2)
    assert series.values[0].std == 0.01
    assert series.left_out == (
        "1 earlier measurements of the same serials, none of them out of tolerance", "1 in which it was missing",
    )  # fmt: skip
    assert len(series_of(filled, "block_1", "dx", counted="all").values) == 31
    distance = series_of(filled, "block_1")
    assert (distance.lower, distance.upper) == (None, 0.5)
    assert series_of(filled, "block_1", "tilt").upper is None
    other = replace(built(999, 0.0), model_hash="0" * 64)
    filled.add(saved(tmp_path, "other", other))
    newest = series_of(filled, "block_1")
    assert newest.left_out == ("32 measured against another CAD model than the newest",)
    assert len(newest.values) == 1
    with pytest.raises(InputError, match="no component 'nut'"):
        series_of(filled, "nut")


def _reworked(store: HistoryStore, folder: Path) -> None:
    """12 parts, every third one 0.8 mm off first (tolerance 0.5 mm) and measured again after rework."""
    for index in range(12):
        store.add(saved(folder, f"a{index}", built(index, 0.8 if index % 3 == 0 else 0.1 + 0.01 * (index % 4))))
    for index in range(0, 12, 3):
        store.add(saved(folder, f"b{index}", built(20 + index, 0.1 + 0.004 * index, serial=f"S{index:03d}")))


def test_rework_is_told_and_the_index_is_of_the_first_measurements(store: HistoryStore, tmp_path: Path) -> None:
    _reworked(store, tmp_path)
    last, first = series_of(store, "block_1", "dx"), series_of(store, "block_1", "dx", counted="first")
    assert last.left_out == ("4 earlier measurements of the same serials, 4 of them out of tolerance",)
    assert (last.within, first.within, last.earlier) == ((12, 12), (8, 12), 4)
    assert first.left_out == ("4 later measurements of the same serials, none of them out of tolerance",)
    done = run("chart", "--component", "block_1", "--of", "dx", "--store", tmp_path / "results.sqlite")
    assert done.exit_code == 0, done.output
    assert "12 of 12 within the limits that held for them\n" in done.output
    assert "8 of 12 within the limits that held for them at their first measurement" in done.output
    index = capability([one.value for one in first.values], -0.5, 0.5).ppk.value
    assert f"Ppk {index:.2f} (95 %" in done.output and index < 0.3
    only = run("chart", "--component", "block_1", "--of", "dx", "--first", "--store", tmp_path / "results.sqlite")
    assert "8 of 12 within" in only.output and "12 of 12" not in only.output
    both = run("chart", "--component", "block_1", "--first", "--repeats", "--store", tmp_path / "results.sqlite")
    assert both.exit_code == ExitCode.BAD_INPUT and "exclude each other" in both.output


def test_a_missing_component_is_not_within_and_gives_no_index(store: HistoryStore, tmp_path: Path) -> None:
    for index in range(12):
        store.add(saved(tmp_path, f"{index}", built(index, 0.1 + 0.01 * (index % 4))))
    for index in range(12, 17):
        gone = missing("block_1", np.zeros(3))
        store.add(saved(tmp_path, f"{index}", inspection(MODEL, (gone,), f"S{index:03d}", minutes=60 * index)))
    other = deviation("block_2", (0.0, 0.0, 0.0), np.zeros(3))
    store.add(saved(tmp_path, "other", inspection(MODEL, (other,), "S900", minutes=6000)))
    series = series_of(store, "block_1")
    assert series.left_out == ("5 in which it was missing", "1 in which it was not inspected")
    assert (len(series.values), len(series.missing), series.within) == (12, 5, (12, 17))
    (reason,) = capability_by_limits(series).values()
    assert "missing on 5 of 17 parts" in str(reason)
    done = run("chart", "--component", "block_1", "--store", tmp_path / "results.sqlite")
    assert "12 of 17 within the limits that held for them; it is missing on 5" in done.output
    assert "pk" not in done.output


def test_times_with_an_offset_and_names_with_line_breaks(store: HistoryStore, tmp_path: Path) -> None:
    document = json.loads(saved(tmp_path, "a", built(0, 0.1, serial="A\nB\x1b[31m")).read_text(encoding="utf-8"))
    document["created"] = "2026-10-01T10:00:00+02:00"
    (tmp_path / "a.json").write_text(json.dumps(document), encoding="utf-8")
    store.add(tmp_path / "a.json")
    listed = run("list", "--store", tmp_path / "results.sqlite")
    assert "2026-10-01 08:00:00" in listed.output and "A B [31m" in listed.output
    assert len(listed.output.splitlines()) == 3
    assert "A B [31m" in run("show", "1", "--store", tmp_path / "results.sqlite").output


def _rejudged(made: Inspection, tolerance_mm: float, model_hash: str | None = None) -> Inspection:
    """The inspection with another tolerance, and the verdict that follows."""
    (one,) = made.components
    moved = (one.displacement_mm[0] or 0.0, 0.02, -0.01)
    block = deviation("block_1", moved, np.zeros(3), tolerance_mm, uncertainty_mm=0.02)
    return replace(made, components=(block,), model_hash=model_hash or made.model_hash)


def _twenty_then_a_tighter_tolerance(store: HistoryStore, folder: Path, later: int = 1) -> list[float]:
    """20 parts about 0.35 mm off that were accepted at 0.5 mm, then ``later`` about 0.1 mm off at 0.3 mm."""
    rng = np.random.default_rng(5)
    moved = [*rng.normal(0.35, 0.03, 20), *rng.normal(0.1, 0.03, later)]
    for index, dx in enumerate(moved):
        made = _rejudged(built(index, float(dx)), 0.5 if index < 20 else 0.3)
        assert made.components[0].verdict.value == "pass"
        store.add(saved(folder, f"t{index}", made))
    return [float(np.hypot(np.hypot(dx, 0.02), 0.01)) for dx in moved]


def test_each_value_is_judged_by_the_limits_that_held_for_it(store: HistoryStore, tmp_path: Path) -> None:
    distances = _twenty_then_a_tighter_tolerance(store, tmp_path)
    series = series_of(store, "block_1")
    assert [one.value for one in series.values] == pytest.approx(distances)
    assert {one.upper for one in series.values[:20]} == {0.5}
    assert (series.values[20].upper, series.upper) == (0.3, 0.3)
    assert all(one.is_within for one in series.values)
    sentence = "limits changed on 2026-03-02 08:30 (S020): at most 0.5 before, at most 0.3 since"
    assert replace(series, zone=UTC).changes() == [(20, "limits", sentence)]
    over_all = capability(distances, None, 0.3)
    assert over_all.ppk.value < 0.0  # what judging old parts by the new limit would say
    found = capability_by_limits(series)
    before, since = found[None, 0.5], found[None, 0.3]
    assert isinstance(before, Capability)
    assert before.ppk.value == pytest.approx((0.5 - np.mean(distances[:20])) / (3.0 * np.std(distances[:20], ddof=1)))
    assert before.ppk.value > 1.0
    assert "need at least 10 values, there is 1" in str(since)
    given = series.with_limits(None, 0.4)
    assert (len(given.by_limits()), given.changes(), given.upper) == (1, [], 0.4)


def test_the_command_says_when_the_limits_changed(tmp_path: Path) -> None:
    where = tmp_path / "results.sqlite"
    with HistoryStore(where) as store:
        _twenty_then_a_tighter_tolerance(store, tmp_path, later=12)
    done = run("chart", "--component", "block_1", "--store", where, "-o", tmp_path / "t.svg")
    assert done.exit_code == 0, done.output
    assert "limits changed on 2026-03-02 08:30 (S020): at most 0.5 before, at most 0.3 since" in done.output
    assert "32 of 32 within the limits that held for them" in done.output
    lines = [line for line in done.output.splitlines() if line.startswith("limits at most")]
    groups = list(dict.fromkeys(line.split(":")[0] for line in lines))
    assert groups == ["limits at most 0.5, 20 values", "limits at most 0.3, 12 values"]
    assert all("k -" not in line for line in lines)
    assert (tmp_path / "t.svg").stat().st_size > 5000


def test_a_series_goes_on_across_cad_revisions_on_wish(store: HistoryStore, tmp_path: Path) -> None:
    for index in range(12):
        made = built(index, 0.05 + 0.001 * index)
        hash_then = made.model_hash if index < 7 else "b" * 64
        store.add(saved(tmp_path, f"r{index}", replace(made, model_hash=hash_then)))
    cut = series_of(store, "block_1")
    assert (len(cut.values), cut.changes()) == (5, [])
    assert cut.left_out == ("7 measured against another CAD model than the newest",)
    whole = series_of(store, "block_1", revisions=True)
    assert (len(whole.values), whole.left_out) == (12, ())
    sentence = f"CAD model changed on 2026-03-01 19:30 (S007): {MODEL.source_hash[:12]} before, {'b' * 12} since"
    assert replace(whole, zone=UTC).changes() == [(7, "CAD", sentence)]
    where = store.name
    done = run("chart", "--component", "block_1", "--store", where)
    assert "(--revisions counts them)" in done.output
    done = run("chart", "--component", "block_1", "--store", where, "--revisions")
    assert done.exit_code == 0, done.output
    assert "12 values" in done.output
    assert "CAD model changed on" in done.output


def test_a_voided_result_stays_but_does_not_count(store: HistoryStore, tmp_path: Path) -> None:
    for index in range(12):
        store.add(saved(tmp_path, f"v{index}", built(index, 0.05 + 0.001 * index)))
    voided = store.void("3", "part was  not seated\n", "qa@bench")
    assert voided.void is not None
    assert (voided.serial, voided.void.reason, voided.void.by) == ("S002", "part was not seated", "qa@bench")
    assert [one.serial for one in store.listed()] == [f"S{i:03d}" for i in range(12) if i != 2]
    assert len(store.listed(limit=11)) == 11
    assert [one.serial for one in store.listed(with_voided=True) if one.void is not None] == ["S002"]
    assert store.find("3")[0] == voided
    series = series_of(store, "block_1")
    assert (len(series.values), series.left_out) == (11, ("1 voided",))
    assert store.check() == (12, [])
    with pytest.raises(InputError, match="result 3 is void already: part was not seated"):
        store.void("3", "again")
    with pytest.raises(InputError, match="the reason is empty"):
        store.void("4", "  ")
    with pytest.raises(InputError, match="no result 99"):
        store.void("99", "why")
    outside = sqlite3.connect(store.name)
    for statement in ("DELETE FROM arview_voids", "UPDATE arview_voids SET reason = ''"):
        with pytest.raises(sqlite3.IntegrityError, match="append-only"):
            outside.execute(statement)
    outside.close()


@pytest.mark.parametrize("version", [1, 3])
def test_a_store_of_an_older_version_is_upgraded_and_keeps_its_results(tmp_path: Path, version: int) -> None:
    """Stores as version 3 made them, and version 1 without voids and decisions."""
    where = tmp_path / "old.sqlite"
    hole = CharacteristicResult("hole", "position", ("hole_1",), Verdict.PASS, 0.12, 0.02, zone_mm=0.3)
    with HistoryStore(where) as store:
        for index in range(3):
            made = replace(built(index, 0.1 + 0.01 * index), characteristics=(hole,))
            store.add(saved(tmp_path, f"{index}", made))
    outside = sqlite3.connect(where)
    triggers = outside.execute("SELECT name FROM sqlite_master WHERE type = 'trigger'").fetchall()
    for (name,) in triggers:
        outside.execute(f"DROP TRIGGER {name}")
    for name in (
        "arview_characteristics",
        "arview_same",
        *(("arview_voids", "arview_decisions") if version == 1 else ()),
    ):
        outside.execute(f"DROP TABLE {name}")
    for name in ("arview_results_of_series", "arview_components_failed", "arview_components_of_series"):
        outside.execute(f"DROP INDEX {name}")
    for name in ("point", "axis"):
        outside.execute(f"ALTER TABLE arview_components DROP COLUMN {name}")
    outside.execute("UPDATE arview_store SET version = ?", (version,))
    outside.commit()
    results_then = outside.execute("SELECT * FROM arview_results").fetchall()
    said: list[str] = []
    with HistoryStore(where, must_exist=True, tell=said.append) as store:
        assert said == [f"{where}: the store of an older arview is upgraded; its results stay as they are"]
        assert [round(one.value, 3) for one in series_of(store, "block_1", "dx").values] == [0.1, 0.11, 0.12]
        assert [one.value for one in series_of(store, "hole", "characteristic").values] == [0.12] * 3
        store.add(saved(tmp_path, "new", built(7, 0.2)))
        assert len(series_of(store, "block_1").values) == 4  # rows with and without the point that they are stated for
        assert store.check() == (4, [])
        assert store.void("1", "why").void is not None
    assert outside.execute("SELECT * FROM arview_results WHERE id < 4").fetchall() == results_then
    assert outside.execute("SELECT max(version) FROM arview_store").fetchone() == (4,)
    assert set(triggers) <= set(outside.execute("SELECT name FROM sqlite_master WHERE type = 'trigger'").fetchall())
    outside.close()
    said.clear()
    HistoryStore(where, must_exist=True, tell=said.append).close()
    assert said == []


def test_the_commands_void_and_take_time_zones(tmp_path: Path) -> None:
    where = tmp_path / "results.sqlite"
    run("add", saved(tmp_path, "a", built(1, 0.1)), saved(tmp_path, "b", built(2, 0.1)), "--store", where)
    listing = run("list", "--store", where, "--zone", "Asia/Tokyo").output
    assert "measured (Asia/Tokyo)" in listing
    assert "2026-03-01 22:30:15" in listing  # 13:30:15 UTC
    since = ("--since", "2026-03-01T23:00", "--zone", "Asia/Tokyo")
    assert run("list", "--store", where, *since).output.splitlines()[-1] == "1 result"
    assert run("list", "--store", where, "--since", "2026-03-01T23:00+09:00").output.splitlines()[-1] == "1 result"
    wrong = run("list", "--store", where, "--zone", "Mars/Olympus")
    assert (wrong.exit_code, "expected a time zone" in wrong.output) == (64, True)
    done = run("void", 1, "--reason", "dropped", "--by", "qa", "--store", where)
    assert done.exit_code == 0, done.output
    assert "by qa: dropped" in run("show", 1, "--store", where).output
    assert run("list", "--store", where).output.splitlines()[-1] == "1 result"
    every = run("list", "--store", where, "--voided").output
    assert "void" in next(line for line in every.splitlines() if "S001" in line)
    again = run("void", 1, "--reason", "x", "--store", where)
    assert (again.exit_code, "void already: dropped" in again.output) == (64, True)


def test_one_of_several_parts_must_be_chosen(filled: HistoryStore, tmp_path: Path) -> None:
    filled.add(saved(tmp_path, "p", built(50, 0.0, part="other")))
    with pytest.raises(InputError, match=r"several parts \(bench, other\)"):
        series_of(filled, "block_1")
    assert len(series_of(filled, "block_1", part="bench").values) == 30


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "magic"), [("svg", b"<?xml"), ("png", b"\x89PNG"), ("pdf", b"%PDF")])
def test_the_picture(filled: HistoryStore, kind: str, magic: bytes) -> None:
    series = series_of(filled, "block_1", "dx")
    values = [one.value for one in series.values]
    picture = draw(series, control_chart(values), capability(values, series.lower, series.upper), kind)
    assert picture.startswith(magic)
    assert draw(series, None, None, kind).startswith(magic)
    with pytest.raises(InputError, match="no determined dx"):
        draw(replace(series, values=()), None, None)


def run(*arguments: Any) -> Result:
    return CliRunner().invoke(main, ["history", *map(str, arguments)])


def test_the_commands(tmp_path: Path) -> None:
    where = tmp_path / "results.sqlite"
    rng = np.random.default_rng(3)
    files = [saved(tmp_path, f"{i:02d}", built(i, float(dx))) for i, dx in enumerate(rng.normal(0.05, 0.03, 12))]
    done = run("add", files[0], "--store", where, "--station", "cell-3")
    assert done.exit_code == 0, done.output
    assert "added as 1" in done.output
    (tmp_path / "bad.json").write_text("{}")
    mixed = run("add", *files, tmp_path / "bad.json", "--store", where)
    assert mixed.exit_code == 64
    assert f"11 added, 1 already there, 1 refused: {where}" in mixed.output
    assert "schema_version" in mixed.output
    listing = run("list", "--store", where, "--limit", 3).output.splitlines()
    assert listing[-1] == "3 results"
    assert "S011" in listing[-2]
    shown = run("show", 1, "--store", where, "-o", tmp_path / "one.json")
    assert "at cell-3" in shown.output
    assert load_inspection(tmp_path / "one.json") == load_inspection(files[0])
    trend = run("chart", "--component", "block_1", "--of", "dx", "--store", where, "-o", tmp_path / "t.svg")
    assert trend.exit_code == 0, trend.output
    assert "12 values" in trend.output
    assert "Cpk" in trend.output
    assert "only 12 values" in trend.output
    assert (tmp_path / "t.svg").stat().st_size > 5000
    exported = run("export", "-o", tmp_path / "all.csv", "--store", where)
    assert exported.exit_code == 0
    lines = (tmp_path / "all.csv").read_text(encoding="utf-8").splitlines()
    assert len(lines) == 13
    assert lines[1].split(",")[3:5] == ["S000", "cell-3"]
    assert run("export", "-o", tmp_path / "all.jsonl", "--store", where).exit_code == 0
    documents = (tmp_path / "all.jsonl").read_text(encoding="utf-8").splitlines()
    assert [json.loads(line)["serial"] for line in documents] == [f"S{i:03d}" for i in range(12)]
    assert run("check", "--store", where).output == "12 results, 0 damaged\n"


def test_commands_that_cannot_be_done(tmp_path: Path) -> None:
    where = tmp_path / "results.sqlite"
    missing_store = run("list", "--store", where)
    assert (missing_store.exit_code, where.exists()) == (64, False)
    run("add", saved(tmp_path, "a", built(1, 0.1)), "--store", where)
    for arguments, message in (
        (["show", "77"], "no result 77"),
        (["show", "zz"], "expected the number"),
        (["chart", "--component", "nut"], "no component 'nut'"),
        (["chart", "--component", "block_1", "-o", tmp_path / "x.gif"], "ends with .svg"),
        (["export", "-o", tmp_path / "x.txt"], "ends with .csv"),
        (["list", "--since", "yesterday"], "expected a date"),
    ):
        refused = run(*arguments, "--store", where)
        assert refused.exit_code == 64
        assert message in refused.output
        assert "Traceback" not in refused.output
    few = run("chart", "--component", "block_1", "--store", where)
    assert few.exit_code == 0
    assert "Cp and Cpk: need at least 10 values, there is 1" in few.output


def test_no_table_holds_what_the_document_does_not(store: HistoryStore) -> None:
    assert {column.name for column in results.columns} >= {
        "content_hash",
        "serial",
        "station",
        "model_hash",
        "document",
    }


def test_values_of_different_points_are_not_joined(store: HistoryStore, tmp_path: Path) -> None:
    """Six parts stated for the middle of the box, then four for the centre of mass: only these make a series."""
    for index in range(10):
        made = built(index, 0.1 + 0.01 * index)
        one = made.components[0]
        assert one.details is not None
        kind = "box_center" if index < 6 else "volume_centroid"
        axes = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)) if index >= 6 else None
        block = replace(one, details=replace(one.details, measurand=kind, axes=axes))
        store.add(saved(tmp_path, f"p{index}", replace(made, components=(block,))))
    found = series_of(store, "block_1", "dx")
    assert [one.value for one in found.values] == pytest.approx([0.16, 0.17, 0.18, 0.19])
    assert (
        "6 stated for another point (centre of the bounding box) than the newest (centre of mass" in found.left_out[-1]
    )
    tilt = series_of(store, "block_1", "tilt")
    assert len(tilt.values) == 4 and "about another axis" in tilt.left_out[-1]
