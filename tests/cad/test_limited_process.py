"""Limits of a reading process count what it computes, not how long the machine takes."""

from __future__ import annotations

from pathlib import Path

import pytest

from arview.cad.formats import limited_process
from arview.cad.formats.limited_process import HUNG, TIMED_OUT, ProcessLimits, run_limited


def test_waiting_is_no_computing(tmp_path: Path) -> None:
    script = "import time\ntime.sleep(2.5)\nprint('read')"
    assert run_limited(script, [], tmp_path, 0.0, ProcessLimits(max_cpu_s=1.0)) == (0, "read\n")


def test_too_much_computing_ends(tmp_path: Path) -> None:
    code, _ = run_limited("while True: pass", [], tmp_path, 0.0, ProcessLimits(max_cpu_s=1.0))
    assert code in (TIMED_OUT, -9)


def test_what_does_nothing_is_given_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limited_process, "IDLE_S", 1.0)
    monkeypatch.setattr(limited_process, "_POLL_S", 0.1)
    assert run_limited("import time\ntime.sleep(600)", [], tmp_path, 0.0, ProcessLimits())[0] == HUNG
