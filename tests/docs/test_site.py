"""The documentation: the site builds without a warning, and every command and every Python example on its pages runs.

Blocks marked ``sh`` and ``python`` are run in their order, each page in a folder of its own with `samples` in it. Files
that a page shows with a title are written there. Blocks marked ``console`` need a phone, minutes or a network.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import pytest

from arview.video import VideoSink, open_source

ROOT = Path(__file__).parents[2]
PAGES = sorted((ROOT / "docs").rglob("*.md"))
BLOCK = re.compile(r"^```(\w+)(?: title=\"([^\"]+)\")?\n(.*?)^```$", re.MULTILINE | re.DOTALL)
CLIP, START, END = ROOT / "samples" / "bracket_plate" / "clip.mp4", 20, 35
"""A clip that the examples track, and its frames that they are given: the part is in full view in them."""
LINK = re.compile(r"\]\(([^)#:]+)(?:#[^)]*)?\)")


class Block(NamedTuple):
    """A block of code on a page."""

    language: str
    title: str
    text: str


def blocks(page: Path) -> list[Block]:
    return [Block(*found) for found in BLOCK.findall(page.read_text())]


def link_samples(folder: Path) -> None:
    """The samples in a folder, with a few frames of the clip alone."""
    for path in sorted((ROOT / "samples").rglob("*")):
        link = folder / path.relative_to(ROOT)
        if path.is_dir():
            link.mkdir(parents=True, exist_ok=True)
        elif path == CLIP:
            write_excerpt(path, link)
        else:
            link.parent.mkdir(parents=True, exist_ok=True)
            link.symlink_to(path)


def write_excerpt(source: Path, target: Path) -> None:
    """Write the frames of a clip in which the part is in view."""
    clip = open_source(source, start=START, end=END)
    with VideoSink(target, clip.width, clip.height, clip.fps) as sink:
        for frame in clip:
            sink.write(frame.image, frame.time_s)


def runs(page: Path) -> bool:
    return any(block.language in ("sh", "python") for block in blocks(page))


def test_pages_that_teach_have_examples_that_run() -> None:
    assert {page.stem for page in PAGES if runs(page)} >= {
        "own-part", "photos-to-verdict", "station-camera", "batch-and-history", "python",
    }  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("page", [page for page in PAGES if runs(page)], ids=lambda page: page.stem)
def test_examples_run(page: Path, tmp_path: Path) -> None:
    link_samples(tmp_path)
    program = Path(sys.executable).parent
    environment = {**os.environ, "PATH": f"{program}:{os.environ['PATH']}"}
    python: list[str] = []
    for block in blocks(page):
        if block.title and "/" not in block.title and " " not in block.title:
            (tmp_path / block.title).write_text(block.text)
        elif block.language == "sh":
            ran = subprocess.run(
                ["bash", "-euc", block.text], cwd=tmp_path, env=environment, capture_output=True, text=True
            )
            assert ran.returncode == 0, f"{block.text}\n{ran.stdout}\n{ran.stderr}"
            assert "Traceback" not in ran.stderr
        elif block.language == "python":
            python.append(block.text)
    if python:
        ran = subprocess.run(
            [sys.executable, "-c", "\n".join(python)], cwd=tmp_path, env=environment, capture_output=True, text=True
        )
        assert ran.returncode == 0, ran.stderr
        assert "tracked" in ran.stdout


@pytest.mark.slow
def test_the_site_builds_without_a_warning(tmp_path: Path) -> None:
    pytest.importorskip("mkdocs", reason="the extra docs is not installed")
    built = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "-f", ROOT / "tools/docs/mkdocs.yml", "-d", tmp_path],
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1"}, capture_output=True, text=True,
    )  # fmt: skip
    assert built.returncode == 0, built.stderr
    assert "arview annotate" in (tmp_path / "reference/commands.html").read_text()
    assert "TrackingSession" in (tmp_path / "reference/api.html").read_text()
    for page in PAGES:
        html = (tmp_path / page.relative_to(ROOT / "docs")).with_suffix(".html")
        pictures = re.findall(r'<img alt="[^"]*" src="([^"]+)"', html.read_text())
        assert all((html.parent / picture).is_file() for picture in pictures), html


@pytest.mark.parametrize("page", [*PAGES, *sorted(ROOT.glob("*.md"))], ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_to_files_of_the_repository(page: Path) -> None:
    made = {"commands.md", "part-file.md", "inspection-json.md", "api.md", "messages.md"}
    for link in LINK.findall(page.read_text()):
        assert Path(link).name in made or (page.parent / link).exists(), f"{page.name}: {link}"
