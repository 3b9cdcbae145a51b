"""Series over years: characteristics of the drawing, CAD models that are joined, stations, zones of time, studies."""

from __future__ import annotations

import re
import sqlite3
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from zoneinfo import ZoneInfo

import numpy as np
import pytest
from click.testing import CliRunner, Result

from arview.cli import ExitCode, main
from arview.errors import InputError
from arview.inspection import CharacteristicResult, Inspection, Verdict, save_inspection
from arview.quality.history import HistoryStore, control_chart, draw, series_of, study_by_anova
from helpers.inspections import deviation, inspection
from helpers.photo_scene import bench

MODEL = bench()


@pytest.fixture
def store(tmp_path: Path) -> Iterator[HistoryStore]:
    with HistoryStore(tmp_path / "results.sqlite") as opened:
        yield opened


def run(*arguments: Any) -> Result:
    return CliRunner().invoke(main, ["history", *map(str, arguments)])


def built(index: int, dx: float, characteristics: tuple[CharacteristicResult, ...] = (), **more: Any) -> Inspection:
    block = deviation("block_1", (dx, 0.02, -0.01), np.zeros(3), uncertainty_mm=0.02)
    made = inspection(MODEL, (block,), more.pop("serial", f"S{index:03d}"), minutes=60 * index)
    return replace(made, characteristics=characteristics, **more)


def add(store: HistoryStore, made: Inspection, station: str = "cell-1") -> None:
    path = Path(store.name).parent / "added.json"
    save_inspection(made, path)
    assert store.add(path, station).is_new


def position(value: float | None, zone: float = 0.3, bonus: float = 0.0) -> CharacteristicResult:
    verdict = Verdict.NOT_MEASURED if value is None else Verdict.PASS if value <= zone else Verdict.FAIL
    return CharacteristicResult("hole", "position", ("h",), verdict, value, 0.02, zone_mm=zone, bonus_mm=bonus)


def gap(value: float) -> CharacteristicResult:
    return CharacteristicResult("gap", "gap", ("a", "b"), Verdict.PASS, value, 0.02, limits_mm=(0.5, None))


def test_characteristics_are_series_of_their_own(store: HistoryStore) -> None:
    """A zone of 0.3 mm, from the fourth part on 0.2 mm, at the last one with a bonus of 0.1 mm; a gap of 0.5 mm."""
    for index, made in enumerate([position(0.11), position(0.28), position(None), position(0.12, 0.2),
                                  position(0.25, 0.2), position(0.25, 0.3, bonus=0.1)]):  # fmt: skip
        add(store, built(index, 0.1, (made, gap(0.6 + 0.01 * index))))
    hole = series_of(store, "hole", "characteristic")
    assert [one.value for one in hole.values] == [0.11, 0.28, 0.12, 0.25, 0.25]
    assert [one.upper for one in hole.values] == pytest.approx([0.3, 0.3, 0.2, 0.2, 0.2])
    assert [one.is_within for one in hole.values] == [True, True, True, False, True]
    assert (hole.within, hole.unit, hole.is_length, hole.lower) == ((4, 5), "mm", True, None)
    assert hole.left_out == ("1 in which it was undetermined",)
    assert hole.values[0].std == 0.01
    assert [change.place for change in hole.changes()] == [2]
    width = series_of(store, "gap", "characteristic")
    assert (width.lower, width.upper, width.is_length, len(width.values)) == (0.5, None, False, 6)
    assert len(series_of(store, "block_1").values) == 6
    with pytest.raises(InputError, match="has no characteristic 'block_1'"):
        series_of(store, "block_1", "characteristic")
    done = run("chart", "--characteristic", "hole", "--store", store.name)
    assert "4 of 5 within the limits that held for them" in done.output
    assert "bonus of maximum material" in done.output
    shown = run("show", 1, "--store", store.name).output
    assert re.search(r"hole +0.110 +0.020 +0.300 +pass", shown)
    both = run("chart", "--store", store.name, "--component", "x", "--characteristic", "hole")
    assert (both.exit_code, "give --component or --characteristic" in both.output) == (ExitCode.BAD_INPUT, True)
    assert store.check() == (6, [])


def test_cad_models_that_are_the_same_make_one_series(store: HistoryStore) -> None:
    hashes = ["a" * 64, "b" * 64, "c" * 64]
    for index in range(9):
        add(store, built(index, 0.05 + 0.001 * index, model_hash=hashes[index // 3]))
    assert len(series_of(store, "block_1").values) == 3
    assert store.same("aaaaaa", "bbbbbb", "only the\nlogo changed", "qa") == (hashes[0], hashes[1])
    assert len(series_of(store, "block_1").values) == 3  # the newest model is another one
    done = run("same", "bbbb", "cccc", "--reason", "new tessellation", "--store", store.name)
    assert (done.exit_code, done.output) == (0, f"series of {'b' * 12} go on in {'c' * 12}\n")
    series = series_of(store, "block_1")
    assert (len(series.values), series.left_out) == (9, ())
    assert [(change.place, change.word) for change in series.changes()] == [(3, "CAD"), (6, "CAD")]
    for old, new, reason, message in (
        ("aaaa", "bbbb", "x", "are joined already"),
        ("aaaa", "aaaa", "x", "both are the CAD model"),
        ("dddd", "bbbb", "x", "0 CAD models have a hash that begins with 'dddd'"),
        ("", "bbbb", "x", "3 CAD models have a hash"),
        ("aaaa", "cccc", " ", "the reason is empty"),
    ):
        with pytest.raises(InputError, match=message):
            store.same(old, new, reason)
    outside = sqlite3.connect(store.name)
    assert outside.execute("SELECT reason, by FROM arview_same").fetchone() == ("only the logo changed", "qa")
    for statement in ("DELETE FROM arview_same", "UPDATE arview_same SET reason = ''"):
        with pytest.raises(sqlite3.IntegrityError, match="append-only"):
            outside.execute(statement)
    outside.close()


def test_changes_are_drawn_with_a_word(store: HistoryStore) -> None:
    """Another station from the fifth part on, another tolerance and CAD model from the ninth on."""
    for index in range(12):
        hole = position(0.1 + 0.005 * (index % 4), 0.3 if index < 8 else 0.25)
        made = built(index, 0.1, (hole,), model_hash=("a" if index < 8 else "b") * 64)
        add(store, made, "cell-1" if index < 4 else "cell-2")
    store.same("aaaa", "bbbb", "why")
    series = replace(series_of(store, "hole", "characteristic"), zone=ZoneInfo("Asia/Tokyo"))
    assert [(change.place, change.word) for change in series.changes()] == [(8, "limits"), (8, "CAD"), (4, "station")]
    assert series.changes()[2].sentence == "station changed on 2026-03-02 01:30 (S004): cell-1 before, cell-2 since"
    chart = control_chart([one.value for one in series.values], series.is_length)
    words: list[str] = []
    from matplotlib.axes import Axes

    annotate = Axes.annotate
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Axes, "annotate", lambda self, text, *a, **k: words.append(text) or annotate(self, text, *a, **k))
        assert draw(series, chart, None).startswith(b"<?xml")
    assert {"station", "limits, CAD"} <= set(words)


def test_stations_that_take_turns_are_counted(store: HistoryStore) -> None:
    for index in range(20):
        add(store, built(index, 0.1), f"cell-{index % 2}")
    (change,) = series_of(store, "block_1").changes()
    assert change == (None, "station", "station changed 19 times")


def test_times_are_stored_as_utc_and_shown_in_the_zone_that_is_asked_for(store: HistoryStore) -> None:
    """13:30:15 UTC on 1 March is 14:30:15 in Berlin; an hour before summer time begins and an hour after it differ."""
    add(store, built(1, 0.1))
    berlin = ("--store", store.name, "--zone", "Europe/Berlin")
    assert "2026-03-01 14:30:15" in run("list", *berlin).output
    assert "measured 2026-03-01 14:30:15 (Europe/Berlin)" in run("show", 1, *berlin).output
    stored = sqlite3.connect(store.name).execute("SELECT measured FROM arview_results").fetchone()
    assert stored == ("2026-03-01T13:30:15.000000Z",)
    value = series_of(store, "block_1").values[0]
    series = replace(series_of(store, "block_1"), zone=ZoneInfo("Europe/Berlin"))
    for month, hour in ((3, 14), (7, 15)):
        assert series.time(value._replace(measured=value.measured.replace(month=month))).startswith(
            f"2026-{month:02d}-01 {hour}:30"
        )


def test_the_command_takes_the_zone_of_the_machine(store: HistoryStore, monkeypatch: pytest.MonkeyPatch) -> None:
    import time

    add(store, built(1, 0.1))
    monkeypatch.setenv("TZ", "Asia/Tokyo")
    time.tzset()
    try:
        listing = run("list", "--store", store.name).output
        assert "measured (local time)" in listing and "2026-03-01 22:30:15" in listing
        assert "1 result" in run("list", "--store", store.name, "--since", "2026-03-01T22:30").output
        assert "0 results" in run("list", "--store", store.name, "--since", "2026-03-01T22:31").output
    finally:
        monkeypatch.undo()
        time.tzset()


def test_a_chart_of_subgroups(store: HistoryStore, tmp_path: Path) -> None:
    moved = np.random.default_rng(8).normal(0.1, 0.02, 45)
    for index, dx in enumerate(moved):
        add(store, built(index, float(dx)))
    done = run("chart", "--component", "block_1", "--of", "dx", "--subgroup", 5, "--store", store.name,
               "-o", tmp_path / "x.png")  # fmt: skip
    assert done.exit_code == 0, done.output
    ranges = np.ptp(moved.reshape(9, 5), axis=1).mean()
    assert f"mean range of 5 {ranges:.4f}" in done.output
    for name in ("Cp", "Cpk", "Pp", "Ppk"):
        assert re.search(rf"^{name} \d+\.\d\d \(95 %: ", done.output, re.MULTILINE)


def test_a_study_of_repeated_inspections(store: HistoryStore) -> None:
    """Four serials at two stations, three times each, and a reference part ten times."""
    rng = np.random.default_rng(2)
    parts, stations = rng.normal(0.0, 0.1, 4), np.array([0.0, 0.01])
    measured = parts[:, None, None] + stations[None, :, None] + rng.normal(0.0, 0.004, (4, 2, 3))
    index = 0
    for trial in range(3):
        for serial in range(4):
            for station in range(2):
                add(
                    store, built(index, float(measured[serial, station, trial]), serial=f"S{serial}"), f"cell-{station}"
                )
                index += 1
    for repeat in range(10):
        add(store, built(index + repeat, 0.2 + 0.004 * (-1) ** repeat, serial="MASTER"))
    asked = ("grr", "--component", "block_1", "--of", "dx", "--store", store.name)
    done = run(*asked, "--serial", "MASTER", "--reference", 0.2)
    assert done.exit_code == 0, done.output
    assert "4 parts, 2 appraisers, 3 trials" in done.output
    study = study_by_anova(measured)
    rows = study.rows
    line = next(line for line in done.output.splitlines() if line.startswith("GRR"))
    shares = [100.0 * rows["GRR"] / rows["total TV"], 600.0 * rows["GRR"] / 1.0]  # the tolerance is ± 0.5 mm
    assert line.split() == ["GRR", f"{rows['GRR']:.5f}", *(f"{share:.2f}" for share in shares)]
    assert f"ndc {study.categories}, interaction p = " in done.output
    std = 0.004 * np.sqrt(10 / 9)
    assert f"Cg {0.2 / (6 * std):.2f}, Cgk {0.1 / (3 * std):.2f}" in done.output
    assert f"Q_MS {200 * 2 * std:.1f} %" in done.output and "Q_MP" in done.output
    plain = run(*asked, "--tolerance", 0.2).output
    assert f"{600.0 * rows['GRR'] / 0.2:.2f}" in plain and "Q_MS" not in plain
    assert "belong together" in run(*asked, "--serial", "MASTER").output
    few = run("grr", "--component", "block_1", "--since", "2030-01-01", "--store", store.name)
    assert (few.exit_code, "no such results" in few.output) == (ExitCode.BAD_INPUT, True)
