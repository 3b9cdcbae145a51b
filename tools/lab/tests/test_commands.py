"""The command evaluate, and how the laboratory's commands come into the program."""

from __future__ import annotations

import json
from importlib.metadata import entry_points
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

import arview.guideviews.cache
import arview_lab.evaluation.run
from arview.cli import main
from helpers.bop_scene import write_scene
from helpers.fake_session import FakeSession


@pytest.fixture
def scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A dataset of one scene below the current folder, and a session that stays where it begins."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(arview.guideviews.cache, "cache_folder", lambda: tmp_path / "cache")
    monkeypatch.setattr(arview_lab.evaluation.run, "TrackingSession", FakeSession)
    write_scene(tmp_path / "set" / "brick")
    return tmp_path


def run(*arguments: str) -> Result:
    return CliRunner().invoke(main, arguments)


def test_the_package_names_its_commands() -> None:
    found = {entry.name for entry in entry_points(group="arview.commands") if entry.module.startswith("arview_lab.")}
    assert found == {"evaluate", "study"}
    listed = run("--help").output
    assert "evaluate " in listed and "study " in listed


def test_evaluate_prints_errors_and_writes_them(scene: Path) -> None:
    result = run("evaluate", "set/brick", "--json", "out.json", "--renderer", "zbuffer", "--per-frame")
    assert result.exit_code == 0, result.output
    # The session stays where it began and the truth moves 1 mm a frame.
    assert "3 frames (3 tracked), 3 evaluated" in result.stdout
    (found,) = json.loads((scene / "out.json").read_text())["scenes"]
    assert [frame["error"]["translation_mm"] for frame in found["frames"]] == pytest.approx([0, 1, 2], abs=1e-9)
    assert found["summary"]["errors"]["translation_mm"]["max"] == pytest.approx(2.0)
    result = run("evaluate", "set/brick", "--init", "guide:middle", "--renderer", "zbuffer")
    assert result.exit_code == 0, result.output
    assert "from guide:middle" in result.stdout


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("set/brick", "--init", "guide:nowhere", "--renderer", "zbuffer"), ("nowhere", "middle")),
        (("none", "--json", "x.json"), ("no such folder",)),
    ],
)
def test_bad_input_of_evaluate_is_one_line(scene: Path, arguments: tuple[str, ...], words: tuple[str, ...]) -> None:
    result = run("evaluate", *arguments)
    assert result.exit_code == 64 and result.stdout == ""
    (line,) = result.stderr.splitlines()
    assert line.startswith("arview: error: ")
    assert all(word in line for word in words)
