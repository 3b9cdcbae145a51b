"""What works without any extra, and what is said where one is missing."""

from __future__ import annotations

import json
import re
import shlex
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from importlib.metadata import packages_distributions
from pathlib import Path
from typing import Any

import pytest

from arview.cad.formats.draco import decode_draco
from arview.core import extras
from arview.errors import MissingDependencyError
from helpers.paths import ROOT, SAMPLES

SAMPLE = SAMPLES / "bracket_plate"
PART, INSPECTION = str(SAMPLE / "part.toml"), str(SAMPLE / "inspection.json")
PHOTOS = str(SAMPLES / "plate" / "photos")
OPTIONAL = {module for modules in extras.MODULES.values() for module in modules}
MAX_REQUIRED = 18

# Runs commands, given as JSON, where no optional module can be found, and prints their exit codes and outputs as JSON.
BARE = """
import json, sys
class Hidden:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in hidden:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
hidden, commands = json.loads(sys.argv[1])
sys.meta_path.insert(0, Hidden())
from click.testing import CliRunner
from arview.cli import main
results = []
for command in commands:
    result = CliRunner().invoke(main, command)
    results.append([result.exit_code, result.stdout, result.stderr])
print(json.dumps(results))
"""


def run_bare(*commands: list[str]) -> Iterator[tuple[int, str, str]]:
    """Exit code, output and error of commands without optional libraries."""
    given = json.dumps([sorted(OPTIONAL), commands])
    ran = subprocess.run([sys.executable, "-c", BARE, given], capture_output=True, text=True, check=True)
    yield from (tuple(one) for one in json.loads(ran.stdout.splitlines()[-1]))  # type: ignore[misc]


def project() -> Any:
    return tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def name_of(requirement: str) -> str:
    return re.split(r"[^A-Za-z0-9_-]", requirement)[0].lower().replace("_", "-")


def test_few_libraries_are_required() -> None:
    required = {name_of(one) for one in project()["dependencies"]}
    assert {"numpy", "scipy", "cascadio", "trimesh"} <= required
    assert len(required) <= MAX_REQUIRED
    for extra in extras.MODULES:
        assert not required & {name_of(one) for one in project()["optional-dependencies"][extra]}, extra


def test_the_table_says_which_extra_brings_a_module() -> None:
    optional = project()["optional-dependencies"]
    packages = packages_distributions()
    known = 0
    for extra, modules in extras.MODULES.items():
        listed = {name_of(one) for one in optional[extra]}
        for module in modules:
            if module in ("markupsafe", "dask") or module not in packages:  # which jinja2 and distributed bring
                continue
            brought = {one.lower().replace("_", "-") for one in packages[module]}
            assert brought & (listed | ({"open3d"} if module == "open3d" else set())), (extra, module)
            known += 1
    assert known > 15
    assert set(extras.MODULES) <= set(optional)
    for name in ("cloud", "formats", "measure", "quality", "report", "station"):
        assert name in optional["all"][0]


def test_every_help_is_shown_without_extras() -> None:
    from arview.cli import main

    commands = [["--help"], *([name, "--help"] for name in main.commands)]
    results = list(run_bare(*commands))
    assert len(results) > 15
    for command, (code, output, error) in zip(commands, results, strict=True):
        assert code == 0 and "Usage" in output, (command, error)


@pytest.mark.slow
def test_a_part_is_checked_found_and_annotated_without_extras(tmp_path: Path) -> None:
    camera, film = str(SAMPLE / "camera.json"), tmp_path / "out.mp4"
    annotate = ["annotate", str(SAMPLE / "clip.mp4"), "--part", PART, "--camera", camera, "--inspection", INSPECTION]
    checked, annotated, listed, exported = run_bare(
        ["check", PART],
        [*annotate, "--end", "12", "-o", str(film)],
        ["decisions", "list", INSPECTION],
        ["export", INSPECTION, "--to", "csv", "-o", str(tmp_path / "out.csv")],
    )
    assert checked[0] == 0 and "11 components" in checked[1], checked
    assert annotated[0] == 0 and "tracked" in annotated[1] + annotated[2], annotated
    assert film.stat().st_size > 10_000
    assert listed[0] == 2 and "not signed" in listed[1] and not listed[2], listed  # nobody has decided anything
    assert exported[0] == 0 and "post_1" in (tmp_path / "out.csv").read_text(), exported


def test_a_command_without_its_extra_says_so_in_a_line(tmp_path: Path) -> None:
    heic = tmp_path / "a.heic"
    heic.write_bytes(b"\0\0\0\x18ftypheic\0\0\0\0mif1heic")
    cloud = tmp_path / "a.xyz"
    cloud.write_text("0 0 0\n1 2 3\n")
    out = str(tmp_path / "out")
    cases = [
        ("pycolmap", "measure", ["reconstruct", PHOTOS, "-o", out]),
        ("pycolmap", "measure", ["inspect", "--part", PART, "--photos", PHOTOS, "-o", out]),
        ("Open3D", "cloud", ["measure", "--cloud", str(cloud), "--part", PART, "-o", f"{out}.json"]),
        ("Jinja2", "report", ["report", INSPECTION, "-o", f"{out}.html"]),
        ("WeasyPrint", "report", ["export", INSPECTION, "--to", "pdf", "-o", f"{out}.pdf"]),
        ("lxml", "report", ["export", INSPECTION, "--to", "qif", "-o", f"{out}.qif"]),
        ("pydyf", "report", ["calibrate", "board", "-o", f"{out}.pdf"]),
        ("Starlette", "station", ["live", "--part", PART]),
        ("tomlkit", "station", ["studio", PART, "--no-browser"]),
        ("SQLAlchemy", "quality", ["history", "list"]),
        ("pillow-heif", "formats", ["annotate", str(heic), "--part", PART, "-o", f"{out}.mp4"]),
    ]
    results = list(run_bare(*(command for _, _, command in cases)))
    for (name, extra, command), (code, _, error) in zip(cases, results, strict=True):
        lines = error.strip().splitlines()
        assert len(lines) == 1 and code == 64, (command, error)
        assert re.search(rf"needs .*{name}.* not installed; run: .*pip install .*\[.*{extra}.*\]", lines[0]), lines
    assert not Path(out).exists(), "no work was begun"


@pytest.mark.parametrize(
    ("module", "extra"), [(module, extra) for extra, modules in extras.MODULES.items() for module in modules]
)
def test_each_module_is_named_with_its_extra(module: str, extra: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    for ask in (extras.require, extras.load):
        with pytest.raises(MissingDependencyError, match=rf"^this needs .*pip install .*\[{extra}\]'$"):
            ask("this", module)


def test_draco_without_its_reader(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "DracoPy", None)
    with pytest.raises(MissingDependencyError, match=r"a.glb: Draco compression needs DracoPy.*\[formats\]"):
        decode_draco([(b"DRACO", {"POSITION": 0})], Path("a.glb"))


def test_a_library_that_cannot_be_loaded_says_why(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "pycolmap.py").write_text("raise OSError('libGL.so.1: cannot open shared object file')\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "pycolmap", raising=False)
    with pytest.raises(MissingDependencyError, match=r"pycolmap, which is installed but cannot be loaded \(libGL"):
        extras.load("this", "pycolmap")


class Installed:
    """A distribution with a record of where it came from."""

    def __init__(self, record: dict[str, Any] | None) -> None:
        self.record = record

    def read_text(self, name: str) -> str | None:
        assert name == "direct_url.json"
        return None if self.record is None else json.dumps(self.record)


@pytest.fixture()
def away(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The program as if it lay in a folder of installed packages."""
    monkeypatch.setattr(extras, "__file__", str(tmp_path / "lib/site-packages/arview/core/extras.py"))
    return tmp_path


def test_the_command_of_a_source_tree_keeps_it_editable() -> None:
    assert extras.install_command("measure").endswith(f"pip install -e '{ROOT}[measure]'")


def test_the_command_names_the_copy_that_arview_came_from(away: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    copy = away / "a copy"
    copy.mkdir()
    (copy / "pyproject.toml").write_text('[project]\nname = "arview"\n')
    wheel = away / "arview-0.1.0-py3-none-any.whl"
    wheel.touch()
    git = {"url": "https://example.org/arview.git", "vcs_info": {"vcs": "git", "commit_id": "abc"}}
    cases: list[tuple[dict[str, Any] | None, str]] = [
        ({"url": copy.as_uri(), "dir_info": {}}, f"pip install '{copy}[measure,report]'"),
        ({"url": wheel.as_uri(), "archive_info": {}}, f"pip install '{wheel}[measure,report]'"),
        (git, "pip install 'arview[measure,report] @ git+https://example.org/arview.git@abc'"),
        ({"url": (away / "gone").as_uri(), "dir_info": {}}, "pip install '.[measure,report]'"),
        (None, "pip install '.[measure,report]'"),
    ]
    for record, expected in cases:
        monkeypatch.setattr(extras, "distribution", lambda name, found=record: Installed(found))
        command = extras.install_command("measure", "report")
        assert command.endswith(expected)
        assert command.startswith("in the folder of arview: ") == ("'." in expected)


def test_pip_is_that_of_this_python(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(extras.shutil, "which", lambda name: "/usr/bin/pip")
    monkeypatch.setattr(extras.sys, "executable", "/opt/some where/bin/python")
    assert shlex.split(extras.install_command("gpu"))[:4] == ["/opt/some where/bin/python", "-m", "pip", "install"]
    monkeypatch.setattr(extras.shutil, "which", lambda name: "/opt/some where/bin/pip")
    assert extras.install_command("gpu").startswith("pip install ")
