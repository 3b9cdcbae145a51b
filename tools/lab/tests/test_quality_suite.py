"""The suite of quality: separation and calibration of poses whose quality is known."""

from __future__ import annotations

import importlib
from typing import Any

import numpy as np
import pytest

from helpers.paths import TOOLS


@pytest.fixture
def suite(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(str(TOOLS / "benchmarks"))
    return importlib.import_module("suites.quality")


def samples(suite: Any, qualities: list[float], right: list[bool]) -> list[Any]:
    return [suite.PoseSample("x", "tracked", q, r, 0.0) for q, r in zip(qualities, right, strict=True)]


def test_separation_is_the_probability_that_a_right_pose_is_better(suite: Any) -> None:
    assert suite.separation(samples(suite, [0.9, 0.8, 0.1, 0.2], [True, True, False, False])) == 1.0
    assert suite.separation(samples(suite, [0.1, 0.2, 0.9, 0.8], [True, True, False, False])) == 0.0
    assert suite.separation(samples(suite, [0.5, 0.5], [True, False])) == 0.5
    assert suite.separation(samples(suite, [0.6, 0.4, 0.5], [True, True, False])) == 0.5
    assert suite.separation(samples(suite, [0.6], [True])) is None


def test_reliability_compares_quality_with_the_share_of_right_poses(suite: Any) -> None:
    rng = np.random.default_rng(0)
    qualities = rng.random(5000)
    honest = samples(suite, qualities.tolist(), (rng.random(5000) < qualities).tolist())
    table = suite.reliability(honest)
    assert len(table) == 10
    assert sum(row["count"] for row in table) == 5000
    assert max(abs(row["quality"] - row["right"]) for row in table) < 0.06
    boasting = samples(suite, (0.5 + 0.5 * qualities).tolist(), (rng.random(5000) < qualities).tolist())
    assert suite.reliability(boasting)[0]["quality"] - suite.reliability(boasting)[0]["right"] > 0.4
