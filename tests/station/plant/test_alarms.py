"""Alarms by the history: each begins once and ends once, and nearly never without a cause."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from arview.inspection import CharacteristicResult, Verdict, save_inspection
from arview.quality.history import ComponentSeries, HistoryStore, SeriesValue
from arview.station.plant import Plant
from arview.station.plant.alarms import series_conditions
from helpers.inspections import CREATED, deviation, inspection, not_measured
from helpers.photo_scene import bench
from helpers.plant_bench import settings

MODEL = bench()
SETTINGS = (
    'name = "cell-1"\n[[hooks]]\nname = "mes"\nurl = "http://127.0.0.1:9/"\n[alarms]\nlast = 30\nundecided = 0.3\n'
)


def series(values: np.ndarray, uncertainties: np.ndarray | None = None) -> ComponentSeries:
    stds = np.full(len(values), 0.01) if uncertainties is None else uncertainties / 2.0
    found = tuple(
        SeriesValue(number, f"S{number}", "cell-1", CREATED, float(value), float(std))
        for number, (value, std) in enumerate(zip(values, stds, strict=True))
    )
    return ComponentSeries("p", "c", "distance", "mm", found, None, None, (), True)


@pytest.mark.slow
def test_a_shift_a_growing_uncertainty_and_missing_decisions() -> None:
    random = np.random.default_rng(7)
    calm = series(random.normal(0.3, 0.01, 50), random.normal(0.05, 0.004, 50))
    assert set(series_conditions(calm, 0, 50, 0.2).values()) == {""}
    values = random.normal(0.3, 0.01, 50)
    values[-1] = 0.36
    assert series_conditions(series(values), 0, 50, 0.2)["nelson"] == "0.360: beyond the control limits (rule 1)"
    growing = np.linspace(0.05, 0.08, 50) + random.normal(0.0, 0.004, 50)
    assert series_conditions(series(values, growing), 0, 50, 0.2)["uncertainty"].startswith("U grew from 0.0")
    often = "11 of the last 50 results have no decision"
    assert series_conditions(calm, 11, 50, 0.2)["undecided"] == often
    assert series_conditions(calm, 10, 50, 0.2)["undecided"] == ""
    assert set(series_conditions(series(values[-19:]), 19, 19, 0.2).values()) == {""}  # too few to say


@pytest.mark.slow
def test_how_often_there_is_an_alarm_without_a_cause() -> None:
    """Of 50 normal values in control: the rules of Nelson in 2 % of the results, U that grows in less than 0.1 %."""
    random, counts = np.random.default_rng(1), {"nelson": 0, "uncertainty": 0, "undecided": 0}
    draws = 2000
    for _ in range(draws):
        drawn = series(random.normal(0.3, 0.02, 50), random.normal(0.05, 0.005, 50))
        for kind, text in series_conditions(drawn, 0, 50, 0.2).items():
            counts[kind] += bool(text)
    assert 0.005 * draws <= counts["nelson"] <= 0.04 * draws
    assert counts["uncertainty"] <= 0.001 * draws and counts["undecided"] == 0


@pytest.mark.slow
def test_small_causes_are_found() -> None:
    """A shift of two standard deviations within nine results in most cases, U that grows by half always."""
    random = np.random.default_rng(2)
    found = 0
    for _ in range(100):
        values = random.normal(0.3, 0.02, 60)
        values[50:] += 0.04
        drawn = [series(values[start : start + 50]) for start in range(2, 11)]
        found += any(series_conditions(one, 0, 50, 0.2)["nelson"] for one in drawn)
    assert found >= 90
    for _ in range(100):
        u = np.linspace(0.05, 0.075, 50) * random.normal(1.0, 0.05, 50)
        assert series_conditions(series(np.full(50, 0.3), u), 0, 50, 0.2)["uncertainty"]


@pytest.fixture
def store(tmp_path: Path) -> Iterator[HistoryStore]:
    with HistoryStore(tmp_path / "results.sqlite") as opened:
        yield opened


@pytest.mark.slow
def test_each_alarm_begins_once_and_ends_once(store: HistoryStore, tmp_path: Path) -> None:
    """Of 90 inspections the 41st is far out, and from the 51st to the 62nd one component is not measured.

    The plant is opened anew for each, as after restarts.
    """
    random, chosen = np.random.default_rng(3), settings(tmp_path, SETTINGS)
    told: list[tuple[int, str]] = []
    for number in range(90):
        gap = CharacteristicResult("gap", "gap", ("a", "b"), Verdict.PASS, random.normal(1.0, 0.01), 0.02,
                                   limits_mm=(0.5, None))  # fmt: skip
        distance = 0.45 if number == 40 else random.normal(0.2, 0.01)
        block = deviation("block_1", (distance, 0.0, 0.0), np.zeros(3), uncertainty_mm=0.02)
        other = (not_measured if 50 <= number < 62 else _still)("block_2", np.zeros(3))
        made = inspection(MODEL, (block, other), f"S{number}", minutes=number)
        save_inspection(replace(made, characteristics=(gap,)), tmp_path / "inspection.json")
        store.add(tmp_path / "inspection.json", "cell-1")
        plant = Plant(chosen, tmp_path)
        told += [(number, text) for text in plant.check_history(store, "bench")]
        plant._outbox.close()
    plant = Plant(chosen, tmp_path)
    messages = [msgspec.json.decode(one.body) for one in plant._outbox.pending("mes", 1000)]
    by_condition: dict[str, list[bool]] = {}
    for message in messages:
        by_condition.setdefault(message["id"], []).append(message["is_active"])
    for states in by_condition.values():
        assert states == [number % 2 == 0 for number in range(len(states))]  # begun, ended, begun, ended …
    assert by_condition["undecided/bench/block_2"] == [True, False]
    assert (59, "10 of the last 30 results have no decision") in told
    assert (40, "0.450: beyond the control limits (rule 1)") in told
    assert sum(text.startswith("0.450") for _, text in told) == 1
    assert "uncertainty/bench/block_1" not in by_condition
    assert sum(message["is_active"] for message in messages) == len(told)
    assert not [one for one in plant._outbox.alarms() if one.kind == "undecided"]


def _still(name: str, center: np.ndarray) -> object:
    return deviation(name, (0.1, 0.0, 0.0), center, uncertainty_mm=0.02)
