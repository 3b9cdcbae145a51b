"""What all tests share: threads of parallel workers, markers by folder, the order in which workers take files.

It lies here because it also holds for the tests of `tools/lab`.
"""

from __future__ import annotations

import json
import os
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import pytest

from helpers.paths import SHARED

IS_WORKER = "PYTEST_XDIST_WORKER" in os.environ
if IS_WORKER:
    # One process for each core: libraries that start a thread for each core themselves would take them from the others.
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")

ROOT = Path(__file__).parent
TESTS = ROOT / "tests"
TIMED_ROOMS = ("station.live", "browser")
"""Their tests wait for servers, cameras and browsers, and come first."""
DURATIONS = TESTS / "durations.json"
"""Seconds that each test file took, by which the longest start first; ARVIEW_RECORD_DURATIONS=1 writes them anew."""
MARKER_OF_ROOM = {"browser": "browser", "integration": "integration"}


def room(item: pytest.Item) -> str:
    """The room that a test is of, by its folder in ``tests/``; none for the tests of `tools/lab`."""
    parts = item.path.relative_to(TESTS).parts[:-1] if item.path.is_relative_to(TESTS) else ()
    return ".".join(parts[: 2 if parts[:1] in (("station",), ("quality",)) else 1])


def pytest_configure() -> None:
    """OpenCV has a call of its own for what the environment says to the others."""
    if IS_WORKER:
        import cv2

        cv2.setNumThreads(1)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark tests by their folder. Workers take whole files in this order, so that the longest start first."""
    for item in items:
        if marker := MARKER_OF_ROOM.get(room(item)):
            item.add_marker(marker)
        if not SHARED.is_dir() and item.get_closest_marker("shared"):
            item.add_marker(pytest.mark.skip(reason=f"{SHARED} is not here"))
    if IS_WORKER:
        weights = _weights(items)
        items.sort(key=lambda item: -weights[item.path])


def _weights(items: Sequence[pytest.Item]) -> dict[Path, float]:
    """How long each file is likely to take, in seconds, by the last records; timed rooms come first of all."""
    known: dict[str, float] = json.loads(DURATIONS.read_text(encoding="utf-8")) if DURATIONS.is_file() else {}
    weights: dict[Path, float] = {}
    for item in items:
        name = str(item.path.relative_to(ROOT))
        own = 0.0 if name in known else 10.0 if item.get_closest_marker("slow") else 0.3
        weights.setdefault(item.path, known.get(name, 0.0) + (1e6 if room(item) in TIMED_ROOMS else 0.0))
        weights[item.path] += own
    return weights


_seconds: Counter[str] = Counter()


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Add up the time of each file."""
    _seconds[report.location[0]] += report.duration


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Record the times of a whole run, see `DURATIONS`."""
    if os.environ.get("ARVIEW_RECORD_DURATIONS") and not IS_WORKER:
        rows = {name: round(seconds, 1) for name, seconds in sorted(_seconds.items()) if seconds >= 0.5}
        DURATIONS.write_text(json.dumps(rows, indent=0) + "\n", encoding="utf-8")
