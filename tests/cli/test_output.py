"""Outputs that end early: a closed pipe, a full device, devices as files."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from arview.cli import ExitCode

PROGRAM = [sys.executable, "-m", "arview"]
FULL = Path("/dev/full")
needs_full = pytest.mark.skipif(not FULL.exists(), reason="no /dev/full here")
buffering = pytest.mark.parametrize("unbuffered", ["", "1"])


def environment(unbuffered: str) -> dict[str, str]:
    return {**os.environ, "PYTHONUNBUFFERED": unbuffered}


@pytest.mark.slow
@buffering
@pytest.mark.parametrize("arguments", [["--help"], ["annotate", "--help"], ["study", "rice", "--quick"]])
def test_a_closed_pipe_ends_quietly(tmp_path: Path, unbuffered: str, arguments: list[str]) -> None:
    reading, writing = os.pipe()
    os.close(reading)
    try:
        done = subprocess.run(
            [*PROGRAM, *arguments],
            stdout=writing,
            stderr=subprocess.PIPE,
            text=True,
            env=environment(unbuffered),
            cwd=tmp_path,
            timeout=120,
        )
    finally:
        os.close(writing)
    assert done.returncode == ExitCode.CLOSED_PIPE, done.stderr
    assert done.stderr == ""


@pytest.mark.slow
@needs_full
@buffering
@pytest.mark.parametrize("arguments", [["--help"], ["study", "rice", "--quick"]])
def test_a_full_standard_output_is_one_line(tmp_path: Path, unbuffered: str, arguments: list[str]) -> None:
    with FULL.open("w") as full:
        done = subprocess.run(
            [*PROGRAM, *arguments],
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            env=environment(unbuffered),
            cwd=tmp_path,
            timeout=120,
        )
    assert done.returncode == ExitCode.BAD_INPUT
    assert done.stderr == "arview: error: standard output: cannot be written (No space left on device)\n"


@pytest.mark.slow
@needs_full
def test_a_full_standard_error_changes_nothing_else(tmp_path: Path) -> None:
    with FULL.open("w") as full:
        for arguments in (["check", "none.step"], ["check", "--bogus"]):
            done = subprocess.run(
                [*PROGRAM, *arguments], stdout=subprocess.PIPE, stderr=full, text=True, cwd=tmp_path, timeout=60
            )
            assert done.returncode == ExitCode.BAD_INPUT and done.stdout == ""


@pytest.mark.slow
@needs_full
def test_a_full_device_as_output_file_is_named(tmp_path: Path) -> None:
    board = [*PROGRAM, "calibrate", "board", "-o"]
    done = subprocess.run([*board, str(FULL)], capture_output=True, text=True, cwd=tmp_path, timeout=60)
    assert done.returncode == ExitCode.BAD_INPUT
    assert done.stderr == "arview: error: /dev/full: cannot be written (No space left on device)\n"
    assert not FULL.is_file()
    done = subprocess.run([*board, "/dev/null"], capture_output=True, text=True, cwd=tmp_path, timeout=60)
    assert done.returncode == ExitCode.DONE, done.stderr
    assert not Path("/dev/null").is_file()


@pytest.mark.slow
def test_a_broken_pipe_of_something_else_is_a_bug(tmp_path: Path) -> None:
    code = (
        "import arview.cad\n"
        "from arview.cli import main\n"
        "def broken(path, unit): raise BrokenPipeError(32, 'Broken pipe')\n"
        "arview.cad.load_part = broken\n"
        "main(['check', 'part.toml'], prog_name='arview')\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path, timeout=60)
    assert done.returncode == ExitCode.BUG
    assert done.stderr.startswith("arview: internal error: BrokenPipeError") and done.stderr.count("\n") == 1
