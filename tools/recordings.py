"""The recorded sequences and the sample clip that bench and evaluate run on."""

from __future__ import annotations

import os
import sys
from pathlib import Path

from arview.evaluation import Scene, load_scene

ROOT = Path(__file__).resolve().parent.parent
SAMPLE = ROOT / "samples" / "bracket_plate"
DATA = Path(os.environ.get("ARVIEW_DATA", ROOT.parent / "shared" / "data")) / "sequences"
SEQUENCES = ("castle", "cube", "teabox", "dragon", "plate")


def scenes(names: tuple[str, ...] = SEQUENCES) -> dict[str, Scene]:
    """The sequences that are here; the others are named on stderr."""
    found = {}
    for name in names:
        folder = DATA / name / "test" / "000001"
        if folder.is_dir():
            found[name] = load_scene(folder)
        else:
            skip(name, f"{folder} is not here")
    return found


def sample_command(output: Path, *options: str) -> list[str]:
    """Command that annotates the sample clip into a folder."""
    arguments = ["--part", "part.toml", "--camera", "camera.json", "--inspection", "inspection.json"]
    arguments = [str(SAMPLE / word) if "." in word else word for word in arguments]
    files = ["-o", str(output / "annotated.mp4"), "--poses", str(output / "poses.jsonl")]
    program = [sys.executable, "-m", "arview.cli"]
    return [*program, "annotate", str(SAMPLE / "clip.mp4"), *arguments, *files, *options]


def skip(what: str, reason: str) -> None:
    """Say on stderr that something is left out."""
    print(f"skipped {what}: {reason}", file=sys.stderr)


def table(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    """A markdown table with aligned columns."""
    widths = [max(len(row[k]) for row in [head, *rows]) for k in range(len(head))]
    lines = [head, tuple("-" * width for width in widths), *rows]
    return "\n".join(
        "| " + " | ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)) + " |" for line in lines
    )
