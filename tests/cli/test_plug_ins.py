"""Commands of other packages: found by entry points, loaded when they are needed, and one line if they cannot be."""

from __future__ import annotations

import importlib.metadata
import os
import re
import subprocess
import sys
from importlib.metadata import EntryPoint
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result

import arview
from arview.cli import main
from arview.core.plug_ins import find_plug_ins, load_plug_in
from arview.errors import InputError
from helpers.paths import ROOT, SAMPLES

GROUP = "arview.commands"
MODULES = {
    "plug_in_good": """
import click
from arview.errors import CannotMeasureError

@click.command(short_help="Say hello.")
@click.option("--fail", is_flag=True)
def hello(fail):
    if fail:
        raise CannotMeasureError("nothing is there")
    click.echo("hello")
""",
    "plug_in_broken": "import a_library_that_is_not_here\n",
    "plug_in_exits": "raise SystemExit('not on this machine')\n",
    "plug_in_other": "command = 7\n",
}
ENTRIES = {
    "hello": "plug_in_good:hello",
    "broken": "plug_in_broken:command",
    "exits": "plug_in_exits:command",
    "number": "plug_in_other:command",
    "nothing": "plug_in_good:goodbye",
    "check": "plug_in_good:hello",
}


@pytest.fixture
def plug_ins(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Entry points whose modules are good, broken, or no commands."""
    for name, text in MODULES.items():
        (tmp_path / f"{name}.py").write_text(text)
        monkeypatch.delitem(sys.modules, name, raising=False)
    monkeypatch.syspath_prepend(str(tmp_path))
    entries = [EntryPoint(name, value, GROUP) for name, value in ENTRIES.items()]
    monkeypatch.setattr(importlib.metadata, "entry_points", lambda group: entries if group == GROUP else [])


def run(*arguments: str) -> Result:
    return CliRunner().invoke(main, arguments)


def test_a_command_is_loaded_when_it_is_needed(plug_ins: None) -> None:
    assert run("check", "--help").exit_code == 0
    assert "plug_in_good" not in sys.modules
    result = run("hello")
    assert (result.exit_code, result.stdout) == (0, "hello\n")
    assert "plug_in_good" in sys.modules and "plug_in_broken" not in sys.modules


def test_its_errors_end_as_those_of_other_commands(plug_ins: None) -> None:
    result = run("hello", "--fail")
    assert (result.exit_code, result.stderr) == (3, "arview: could not measure: nothing is there\n")


def test_the_help_lists_good_and_broken_commands(plug_ins: None) -> None:
    result = run("--help")
    assert result.exit_code == 0 and result.stderr == ""
    lines = result.stdout.splitlines()
    assert any(re.fullmatch(r"  hello +Say hello\.", line) for line in lines)
    assert sum("Cannot be loaded; run it to see why." in line for line in lines) == 4


@pytest.mark.parametrize("more", [(), ("--help",), ("x", "--option=3")])
@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("broken", "broken of the package plug_in_broken cannot be loaded (ModuleNotFoundError: No module named"),
        ("exits", "exits of the package plug_in_exits cannot be loaded (SystemExit: not on this machine)"),
        (
            "number",
            "number of the package plug_in_other cannot be used: plug_in_other:command is no click.core.Command",
        ),
        ("nothing", "nothing of the package plug_in_good cannot be loaded (AttributeError: "),
    ],
)
def test_what_cannot_be_loaded_is_one_line(plug_ins: None, name: str, text: str, more: tuple[str, ...]) -> None:
    result = run(name, *more)
    assert result.exit_code == 64 and result.stdout == ""
    (line,) = result.stderr.splitlines()
    assert line.startswith(f"arview: error: {text}")


def test_own_commands_are_not_replaced(plug_ins: None) -> None:
    assert "CAD file" in run("check", "--help").stdout
    assert run("--help").stdout.count("\n  check ") == 1


def test_a_command_that_no_package_has_is_refused(plug_ins: None) -> None:
    result = run("helo")
    assert result.exit_code == 64 and "No such command 'helo'" in result.stderr


def test_the_first_of_two_packages_has_the_name(monkeypatch: pytest.MonkeyPatch) -> None:
    entries = [EntryPoint("hello", f"{module}:hello", GROUP) for module in ("b_package", "a_package")]
    monkeypatch.setattr(importlib.metadata, "entry_points", lambda group: entries)
    assert find_plug_ins(GROUP) == {"hello": entries[1]}
    with pytest.raises(InputError, match="hello of the package a_package cannot be loaded"):
        load_plug_in(find_plug_ins(GROUP)["hello"])


def page_files() -> dict[str, str]:
    """The files that the page shows, by name."""
    page = (ROOT / "docs" / "reference" / "plug-ins.md").read_text(encoding="utf-8")
    return dict(re.findall(r"^```\w+ title=\"([^\"]+)\"\n(.*?)^```$", page, re.MULTILINE | re.DOTALL))


@pytest.fixture
def page_plug_ins(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The reader, the source and the export of the page, as if their packages were installed."""
    for name, text in page_files().items():
        if name.endswith(".py"):
            (tmp_path / name).write_text(text)
            monkeypatch.delitem(sys.modules, name.removesuffix(".py"), raising=False)
    monkeypatch.syspath_prepend(str(tmp_path))
    entries = {
        "arview.readers": EntryPoint("blocks", "arview_blocks:read_blocks", "arview.readers"),
        "arview.sources": EntryPoint("noise", "arview_noise:NoiseSource", "arview.sources"),
        "arview.exports": EntryPoint("names", "arview_names:failed_names", "arview.exports"),
    }
    monkeypatch.setattr(importlib.metadata, "entry_points", lambda group: [entries[group]] if group in entries else [])


def test_a_reader_of_another_package(page_plug_ins: None, tmp_path: Path) -> None:
    path = tmp_path / "two.blocks"
    path.write_text("plate 100 60 5 0 0 0\npost 10 10 40 20 0 22.5\n")
    model = arview.load_model(path)
    assert [one.name for one in model.components] == ["plate", "post"]
    assert np.allclose(model.components[1].bounds_in_model, [[15, -5, 2.5], [25, 5, 42.5]])
    path.write_text("plate 100 sixty 5 0 0 0\n")
    with pytest.raises(InputError, match=r"two\.blocks: arview_blocks cannot read it \(ValueError: "):
        arview.load_model(path)
    with pytest.raises(InputError, match=r"CAD of type .bricks is not read"):
        other = tmp_path / "two.bricks"
        other.write_text("x")
        arview.load_model(other)


def test_a_source_of_another_package(page_plug_ins: None) -> None:
    with arview.open_source("noise:3") as source:
        frames = list(source)
    assert [frame.index for frame in frames] == [0, 1, 2] and frames[0].image.shape == (48, 64, 3)


def test_an_export_of_another_package(page_plug_ins: None, tmp_path: Path) -> None:
    inspection = SAMPLES / "bracket_plate" / "inspection.json"
    result = run("export", str(inspection), "--to", "names", "-o", str(tmp_path / "failed.txt"))
    assert result.exit_code == 0, result.output
    failed = [one.name for one in arview.load_inspection(inspection).components if one.verdict == "fail"]
    assert failed and (tmp_path / "failed.txt").read_text().split() == failed
    assert "expected some of csv" in run("export", str(inspection), "--to", "nomes").stderr


@pytest.mark.slow
def test_the_example_of_the_documentation_works(tmp_path: Path) -> None:
    pytest.importorskip("hatchling", reason="hatchling, of arview[dev], builds the example")
    files = {name: page_files()[name] for name in ("pyproject.toml", "arview_components.py")}
    source, site = tmp_path / "source", tmp_path / "site"
    source.mkdir()
    for name, text in files.items():
        (source / name).write_text(text)
    install = ["-m", "pip", "install", "--quiet", "--no-deps", "--no-build-isolation", "--target", site, source]
    subprocess.run([sys.executable, *map(str, install)], check=True)
    paths = [str(site), *filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep))]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}
    for arguments, text in (
        (["components", str(SAMPLES / "bracket_plate" / "part.toml")], " mm\n"),
        (["--help"], "List the components of a part."),
    ):
        ran = subprocess.run(
            [sys.executable, "-m", "arview", *arguments], env=environment, capture_output=True, text=True, timeout=120
        )
        assert ran.returncode == 0, ran.stderr
        assert text in ran.stdout
