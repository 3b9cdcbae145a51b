"""Signals: work ends between two steps, in every place of a run, and never with signal 11."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, Never

import pytest
from click.testing import CliRunner

from arview.cli import ExitCode, main
from arview.core.atomic import begin_unfinished, replacing, unfinished_path
from arview.core.progress import check_stop, stops_by_signals

KERNEL = """
import sys, time
from typing import NamedTuple
import numba
from arview.core.progress import check_stop, stops_by_signals

class Pair(NamedTuple):
    a: float
    b: float

@numba.njit
def made(x):
    return Pair(x, x + 1.0)

made(1.0)
print("ready", flush=True)
done = 0
try:
    with stops_by_signals():
        while True:
            check_stop()
            {body}
            done += 1
except KeyboardInterrupt:
    print("stopped", done, flush=True)
    sys.exit(7)
"""


def stopped(body: str, number: signal.Signals, after_s: float, prefix: tuple[str, ...] = ()) -> tuple[int, str]:
    process = subprocess.Popen(
        [*prefix, sys.executable, "-c", KERNEL.format(body=body)],
        stdout=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    time.sleep(after_s)
    process.send_signal(number)
    told, _ = process.communicate(timeout=60)
    return process.returncode, told


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_loop_ends_between_two_steps(number: signal.Signals) -> None:
    code, told = stopped("time.sleep(0.05)", number, 0.3)
    assert code == 7 and told.startswith("stopped ") and int(told.split()[1]) >= 1


def test_compiled_code_that_returns_named_tuples_does_not_crash() -> None:
    for attempt in range(6):
        code, told = stopped("all(made(float(k)).a == k for k in range(200_000))", signal.SIGINT, 0.05 * attempt)
        assert code == 7 and told.startswith("stopped "), attempt


def test_a_step_that_never_looks_is_interrupted() -> None:
    began = time.monotonic()
    code, told = stopped("sum(made(float(k)).a for k in range(10**9))", signal.SIGTERM, 0.1)
    assert (code, told) == (7, "stopped 0\n") and time.monotonic() - began < 40


def test_ignored_signals_stay_ignored() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with stops_by_signals():
            os.kill(os.getpid(), signal.SIGHUP)
            check_stop()
    finally:
        signal.signal(signal.SIGHUP, before)


def test_handlers_are_put_back() -> None:
    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGALRM)]
    with pytest.raises(KeyboardInterrupt), stops_by_signals():
        check_stop()
        os.kill(os.getpid(), signal.SIGTERM)
        check_stop()
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGALRM)] == before
    check_stop()


def test_a_command_says_interrupted(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def interrupted(*_: Any, **__: Any) -> Never:
        os.kill(os.getpid(), signal.SIGHUP)
        check_stop()
        raise AssertionError("the signal was not seen")

    monkeypatch.setattr("arview.cad.load_part", interrupted)
    done = CliRunner().invoke(main, ["check", str(tmp_path / "part.toml")])
    assert done.exit_code == ExitCode.INTERRUPTED and done.stderr == "arview: interrupted\n"


def test_what_a_crash_left_is_removed(tmp_path: Path) -> None:
    gone = subprocess.run([sys.executable, "-c", "import os; print(os.getpid())"], capture_output=True, text=True)
    number = int(gone.stdout)
    target = tmp_path / "film.mp4"
    mine, other = unfinished_path(target, number), unfinished_path(target, os.getppid())
    for path in (mine, other, tmp_path / f".a.json.{number}.x1.tmp", tmp_path / f".b.json.{number}.x2.tmp"):
        path.write_text("half")
    os.utime(tmp_path / f".a.json.{number}.x1.tmp", (1e9, 1e9))
    assert begin_unfinished(target) == unfinished_path(target, os.getpid())
    assert not mine.exists() and other.exists()
    with replacing(tmp_path / "a.json") as file:
        file.write(b"{}")
    # A young one may be written by another machine at this moment.
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(
        [other.name, f".b.json.{number}.x2.tmp", "a.json"]
    )
