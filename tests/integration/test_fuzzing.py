"""Fuzzing with a fixed seed: every reader, the applications of the servers, what is written, and command lines."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from helpers.paths import TESTS

FUZZ = TESTS.parent / "tools" / "benchmarks" / "fuzz"
TARGETS = (
    "cad", "camera", "cloud", "commands", "exports", "given", "guideviews", "http", "inspection", "jobs",
    "lengths", "part", "picture", "poses", "positions", "rig", "scale", "step", "step_text", "studio", "video",
)  # fmt: skip


@pytest.mark.slow
@pytest.mark.integration
def test_damaged_inputs_are_read_or_refused(tmp_path: Path) -> None:
    pytest.importorskip("hypothesis", reason="Hypothesis is not installed: pip install hypothesis")
    command = [sys.executable, str(FUZZ), "--seed", "1", "--examples", "40", "--together", "22"]
    done = subprocess.run(
        [*command, "--folder", str(tmp_path)], capture_output=True, text=True, timeout=1800, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    counts = {name: int(count) for name, count in re.findall(r"(\w+) (\d+)(?:,|$)", done.stdout.splitlines()[-2])}
    assert sorted(counts) == sorted(TARGETS)
    assert min(counts.values()) >= 5 and sum(counts.values()) >= 600
    assert ", 0 faults" in done.stdout.splitlines()[-1]
