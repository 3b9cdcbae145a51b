"""The recorded sequences, the photo sets and the sample clip that the benchmarks run on."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from arview_lab.evaluation import Scene

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tests"))  # the tests' photos with exact truth
SAMPLE = ROOT / "samples" / "bracket_plate"
SHARED = Path(os.environ.get("ARVIEW_DATA", ROOT.parent / "shared" / "data"))
DATA = SHARED / "sequences"
VIDEOS = ("castle", "cube", "teabox", "dragon", "plate")
"""Recorded videos; their frames also serve as backgrounds."""
PHOTO_SEQUENCES = ("crate",)
"""Recorded sequences of single photos, from one of which to the next nothing can be followed."""
SEQUENCES = (*VIDEOS, *PHOTO_SEQUENCES)


@dataclass(frozen=True)
class PhotoSet:
    """Photos of a part with exact truth.

    Attributes:
        name: of the set.
        folder: of the photos.
        part: part file or CAD file.
        truth: JSON file of the true cameras and displacements.
        as_built: mesh of the part as photographed; the file need not exist.
    """

    name: str
    folder: Path
    part: Path
    truth: Path
    as_built: Path


def photo_sets(more: Sequence[Path] = ()) -> list[PhotoSet]:
    """The available photo sets, and folders written by samples/plate/generate.py; missing sets are named on stderr."""
    found = []
    for name, folder, file in (
        ("plate", SHARED / "plate", "plate.glb"),
        ("sample", ROOT / "samples" / "plate", "part.toml"),
    ):
        if (folder / "photos").is_dir():
            found.append(
                PhotoSet(name, folder / "photos", folder / file, folder / "truth.json", folder / "as_built.ply")
            )
        else:
            skip(name, f"{folder / 'photos'} is not here")
    part = ROOT / "samples" / "plate" / "part.toml"
    for folder in more:
        found.append(PhotoSet(folder.name, folder / "photos", part, folder / "truth.json", folder / "as_built.ply"))
    return found


def scenes(names: tuple[str, ...] = VIDEOS) -> dict[str, Scene]:
    """The available sequences by name, by default the videos; missing ones are named on stderr."""
    from arview_lab.evaluation import load_scene

    found = {}
    for name in names:
        folder = DATA / name / "test" / "000001"
        if folder.is_dir():
            found[name] = load_scene(folder)
        else:
            skip(name, f"{folder} is not here")
    return found


def sample_command(output: Path, *options: str) -> list[str]:
    """The command that annotates the sample clip into a folder."""
    arguments = ["--part", "part.toml", "--camera", "camera.json", "--inspection", "inspection.json"]
    arguments = [str(SAMPLE / word) if "." in word else word for word in arguments]
    files = ["-o", str(output / "annotated.mp4"), "--poses", str(output / "poses.jsonl")]
    program = [sys.executable, "-m", "arview.cli"]
    return [*program, "annotate", str(SAMPLE / "clip.mp4"), *arguments, *files, *options]


def skip(what: str, reason: str) -> None:
    """Print on stderr that something is left out."""
    print(f"skipped {what}: {reason}", file=sys.stderr)


def table(head: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> str:
    """A markdown table with aligned columns."""
    widths = [max(len(row[k]) for row in [head, *rows]) for k in range(len(head))]
    lines = [head, tuple("-" * width for width in widths), *rows]
    return "\n".join(
        "| " + " | ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)) + " |" for line in lines
    )
