"""Ctrl-C in compiled code, which makes a SystemError of it: the files are finished, and it is no bug."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Never

import pytest
from click.testing import CliRunner

from arview.cli import ExitCode, main
from arview.errors import InputError, is_interruption


def interrupted_in_compiled_code(*_: Any, **__: Any) -> Never:
    try:
        raise KeyboardInterrupt
    except KeyboardInterrupt as error:
        raise SystemError("<function f> returned a result with an exception set") from error


def test_it_is_told_from_other_errors() -> None:
    with pytest.raises(SystemError) as caught:
        interrupted_in_compiled_code()
    assert is_interruption(caught.value) and is_interruption(KeyboardInterrupt())
    assert not is_interruption(SystemError("x")) and not is_interruption(InputError("x")) and not is_interruption(None)


def test_a_command_says_interrupted(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("arview.cad.load_part", interrupted_in_compiled_code)
    done = CliRunner().invoke(main, ["check", str(tmp_path / "part.toml")])
    assert done.exit_code == ExitCode.INTERRUPTED and done.stderr == "arview: interrupted\n"

    def broken(*_: Any, **__: Any) -> Never:
        raise SystemError("another")

    monkeypatch.setattr("arview.cad.load_part", broken)
    done = CliRunner().invoke(main, ["check", str(tmp_path / "part.toml")])
    assert done.exit_code == ExitCode.BUG and "SystemError: another" in done.stderr
