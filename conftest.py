"""What all tests share: threads of parallel workers, markers by folder, the order in which workers take files.

It lies here because it also holds for the tests of `tools/lab`.
"""

from __future__ import annotations

import os
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
"""Their tests wait for servers, cameras and browsers: one worker takes them all, one after another."""
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
    """Mark tests by their folder, and give each file to one worker: what it sets up is made once.

    Workers take the files in this order, so that the longest start first.
    """
    for item in items:
        if marker := MARKER_OF_ROOM.get(room(item)):
            item.add_marker(marker)
        if not SHARED.is_dir() and item.get_closest_marker("shared"):
            item.add_marker(pytest.mark.skip(reason=f"{SHARED} is not here"))
        if IS_WORKER:
            timed = room(item) in TIMED_ROOMS
            item.add_marker(pytest.mark.xdist_group("timed" if timed else str(item.path.relative_to(ROOT))))
    if IS_WORKER:
        weights = _weights(items)
        items.sort(key=lambda item: -weights[item.path])


def _weights(items: Sequence[pytest.Item]) -> dict[Path, float]:
    """How long each file is likely to take: slow tests count for many others, and timed rooms come first of all."""
    weights: dict[Path, float] = {}
    for item in items:
        own = 30.0 if item.get_closest_marker("slow") else 1.0
        weights[item.path] = weights.get(item.path, 0.0) + own + (1e6 if room(item) in TIMED_ROOMS else 0.0)
    return weights
