"""The wheel: it holds every file that the program reads, and works where nothing else of the repository is."""

from __future__ import annotations

import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
DATA = {
    ".js",
    ".html",
    ".css",
    ".svg",
    ".json",
    ".onnx",
    ".npz",
    ".woff2",
    ".vert",
    ".frag",
    ".txt",
    ".md",
    ".xsd",
    ".toml",
}


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("hatchling", reason="hatchling, of the extra dev, builds the wheel")
    folder = tmp_path_factory.mktemp("wheel")
    command = ["-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation", "-w", folder, ROOT]
    subprocess.run([sys.executable, *map(str, command)], check=True)
    (path,) = folder.glob("arview-*.whl")
    return path


@pytest.mark.slow
def test_the_wheel_holds_all_data_files_and_no_others(wheel: Path) -> None:
    source = ROOT / "src"
    tracked = subprocess.run(["git", "ls-files", "src"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    expected = {str(Path(name).relative_to("src")) for name in tracked.split()}
    names = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    data = {name for name in expected if Path(name).suffix in DATA}
    assert len(data) > 40, "the package has data files"
    assert names == expected, source


@pytest.mark.slow
def test_the_installed_wheel_checks_a_part_far_from_the_repository(wheel: Path, tmp_path: Path) -> None:
    subprocess.run(
        [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--target", tmp_path / "site", wheel],
        check=True,
    )
    for name in ("bracket_plate.step", "part.toml"):
        (tmp_path / name).write_bytes((ROOT / "samples/bracket_plate" / name).read_bytes())
    environment = {**os.environ, "PYTHONPATH": str(tmp_path / "site"), "ARVIEW_CACHE": str(tmp_path / "cache")}
    ran = subprocess.run(
        [sys.executable, "-m", "arview", "check", "part.toml"],
        cwd=tmp_path, env=environment, capture_output=True, text=True,
    )  # fmt: skip
    assert ran.returncode == 0, ran.stderr
    assert "11 components" in ran.stdout and "sufficient" in ran.stdout
    place = subprocess.run(
        [sys.executable, "-c", "import arview; print(arview.__file__)"],
        cwd=tmp_path, env=environment, capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert place.stdout.strip().startswith(str(tmp_path))
