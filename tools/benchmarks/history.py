"""Time that the results store takes with many results: adding an inspection, a series, its picture, the page.

    python tools/benchmarks/history.py --results 100000                # SQLite, in a temporary folder
    python tools/benchmarks/history.py --results 100000 --postgresql   # a server that is started for it

Every inspection has 12 components and 4 characteristics. The store is filled by inserts of many rows, whose documents
differ in serial and time only; what is timed goes through `HistoryStore` as the commands do, in one process, with the
file system's cache warm. The processor's time tells what the program takes where other programs hold the processor.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from datetime import UTC, timedelta
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import sqlalchemy as sa

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests"))

from arview.inspection import CharacteristicResult, Inspection, Verdict, load_inspection, save_inspection
from arview.quality.history import HistoryStore, capability_by_limits, control_chart, draw, series_of
from arview.quality.history.page import _context
from arview.quality.history.store import stamp
from arview.quality.history.tables import characteristic_row, characteristics, component_row, components, results
from helpers.inspections import CREATED, deviation, inspection
from helpers.photo_scene import bench
from helpers.postgresql import postgresql_server

MODEL = bench()
BATCH = 1000
ADDED = 50


def made(number: int, rng: np.random.Generator) -> Inspection:
    blocks = tuple(
        deviation(f"block_{i:02d}", tuple(rng.normal(0.0, 0.08, 3)), np.zeros(3), uncertainty_mm=0.02)
        for i in range(12)
    )
    holes = tuple(
        CharacteristicResult(
            name, "position", (name,), Verdict.PASS, float(abs(rng.normal(0.1, 0.03))), 0.01, zone_mm=0.3
        )
        for name in ("hole_0", "hole_1", "hole_2", "hole_3")
    )
    one = inspection(MODEL, blocks, f"S{number:06d}")
    return replace(one, characteristics=holes, created=CREATED + timedelta(minutes=5 * number))


def fill(where: str, count: int) -> None:
    """Insert inspections as `HistoryStore.add` does, many at once."""
    rng = np.random.default_rng(0)
    template = [made(i, rng) for i in range(50)]
    texts = [json.dumps(one.to_dict()) for one in template]
    parts = [[component_row(0, part) for part in one.components] for one in template]
    holes = [[characteristic_row(0, part) for part in one.characteristics] for one in template]
    with HistoryStore(where) as store:
        for first in range(0, count, BATCH):
            numbers = range(first + 1, min(first + BATCH, count) + 1)
            times = {number: stamp(CREATED + timedelta(minutes=5 * number)) for number in numbers}
            rows = [
                {
                    "id": number, "content_hash": f"{number:064x}", "part": "bench", "serial": f"S{number:06d}",
                    "station": f"cell-{number % 2}", "model_hash": template[0].model_hash, "measured": times[number],
                    "added": times[number], "verdict": "pass", "tool": "benchmark",
                    "document": texts[number % 50].replace(template[number % 50].serial, f"S{number:06d}"),
                }
                for number in numbers
            ]  # fmt: skip
            of_components, of_characteristics = (
                [row | {"result_id": number} for number in numbers for row in table[number % 50]]
                for table in (parts, holes)
            )
            with store._begin(writes=True) as connection:
                connection.execute(sa.insert(results), rows)
                connection.execute(sa.insert(components), of_components)
                connection.execute(sa.insert(characteristics), of_characteristics)
                if not store.is_sqlite:
                    connection.execute(sa.text("SELECT setval('arview_results_id_seq', :n)"), {"n": numbers[-1]})
        if not store.is_sqlite:
            with store._begin(writes=True) as connection:
                connection.execute(sa.text("ANALYZE"))


def timed(name: str, work: Callable[[], object], repeats: int = 3) -> None:
    times, busy = [], []
    for _ in range(repeats):
        began, began_busy = time.perf_counter(), time.process_time()
        work()
        times.append(time.perf_counter() - began)
        busy.append(time.process_time() - began_busy)
    wall, own = (statistics.median(each) * 1e3 for each in (times, busy))
    print(f"{name:52} median {wall:8.1f} ms, of its processor {own:8.1f} ms", flush=True)


def chart(store: HistoryStore, name: str, quantity: Any, is_drawn: bool) -> None:
    series = series_of(store, name, quantity)
    found = control_chart([one.value for one in series.values], series.is_length)
    if is_drawn:
        draw(series, found, None)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--results", type=int, default=100_000)
    parser.add_argument("--postgresql", action="store_true")
    given = parser.parse_args()
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        where = str(folder / "store.sqlite")
        if given.postgresql:
            where = stack.enter_context(postgresql_server(is_safe=True))
        began = time.perf_counter()
        fill(where, given.results)
        print(f"{given.results} inspections with 16 results each, filled in {time.perf_counter() - began:.0f} s")
        rng = np.random.default_rng(1)
        files = iter(range(ADDED))
        for number in range(ADDED):
            save_inspection(made(given.results + number, rng), folder / f"{number}.json")
        with HistoryStore(where) as store:
            timed("check the file of an inspection", lambda: load_inspection(folder / "0.json"), 10)
            timed(
                "add an inspection, with that check", lambda: store.add(folder / f"{next(files)}.json", "cell-0"), ADDED
            )
            for name, quantity in (("block_03", "dx"), ("block_03", "distance"), ("hole_1", "characteristic")):
                timed(f"series and control limits of {name}, {quantity}", partial(chart, store, name, quantity, False))
                timed("the same with its picture (SVG)", partial(chart, store, name, quantity, True))
            series = series_of(store, "block_03")
            timed("Ppk of a distance", lambda: capability_by_limits(series))
            timed("page, without its charts", lambda: _context(store, "bench", UTC))
            timed("list of the newest 20", lambda: store.listed(limit=20))


if __name__ == "__main__":
    main()
