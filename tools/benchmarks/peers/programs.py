"""Peers that are C++ libraries: a small program is compiled where it is needed, and writes the poses it finds."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from arview.geometry import Array

SINGLE = {"OMP_NUM_THREADS": "1", "OMP_WAIT_POLICY": "passive"}
"""Environment of a measured program: idle threads that spin would count as its time."""


class MissingPeerError(Exception):
    """A peer is not here; the message says how to get it."""


@dataclass(frozen=True)
class Track:
    """What a tracker did on a film.

    Attributes:
        cpu_ms: (N,) CPU time of each frame, of all threads, ms; frames after a loss without a new search are missing.
        poses: (4,4) ``cam_from_model`` of each of these frames, mm, or None.
    """

    cpu_ms: list[float]
    poses: list[Array | None]


def needed(tools: Sequence[str], how: str) -> None:
    """Raise MissingPeerError with the way to get them when command-line tools are missing."""
    absent = [tool for tool in tools if shutil.which(tool) is None]
    if absent:
        raise MissingPeerError(f"{', '.join(absent)} not found; {how}")


def done(command: Sequence[str | Path], what: str, environment: dict[str, str] | None = None) -> str:
    """Standard output of a command; RuntimeError with the end of what it said when it fails."""
    words = [str(word) for word in command]
    result = subprocess.run(
        words, capture_output=True, text=True, errors="replace", check=False, env={**os.environ, **(environment or {})}
    )
    if result.returncode:
        said = (result.stderr.strip() or result.stdout.strip())[-1500:]
        raise RuntimeError(f"{what}: exit code {result.returncode}: {said}")
    return result.stdout


def is_newer(made: Path, *sources: Path) -> bool:
    """True when a made file exists and is newer than its sources."""
    return made.is_file() and all(made.stat().st_mtime > source.stat().st_mtime for source in sources)


def read_track(path: Path, center_mm: Array) -> Track:
    """Read what a program wrote: a line a frame, CPU ms and the 3×4 pose of the centred model in metres, row by row."""
    rows = np.loadtxt(path, ndmin=2) if path.stat().st_size else np.zeros((0, 13))
    poses: list[Array | None] = []
    for row in rows:
        pose = np.eye(4)
        pose[:3] = row[1:].reshape(3, 4)
        pose[:3, 3] = 1e3 * pose[:3, 3] - pose[:3, :3] @ center_mm
        poses.append(pose if np.isfinite(pose).all() else None)
    return Track([float(value) for value in rows[:, 0]], poses)
