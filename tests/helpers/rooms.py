"""Folders of tests for a room and for the rooms that import it: ``python tests/helpers/rooms.py refinement``."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from helpers.paths import TESTS
from helpers.source_tree import imports, modules

WINGS = {"arview.station", "arview.quality"}
"""Packages of rooms. They hold no code themselves."""


ROOMS = (
    ("errors",),
    ("version",),
    ("geometry",),
    ("core",),
    ("pose",),
    ("camera",),
    ("cad",),
    ("rendering", "fiducials", "weights", "web"),
    ("guideviews",),
    ("refinement",),
    ("detection",),
    ("assembly",),
    ("tracking",),
    ("video", "inspection"),
    ("overlay",),
    ("pose_file",),
    ("annotation",),
    ("reconstruction",),
    ("measurement",),
    ("quality.rework", "quality.decisions"),
    ("report", "quality.history", "calibration", "acceptance"),
    ("workflow",),
    ("quality.batch", "station.capture", "station.rig", "station.plant"),
    ("station.walk",),
    ("station.live",),
    ("station.studio",),
    ("cli",),
)
"""From the bottom up. A room imports only rooms of lines above its own; rooms on one line do not import each other."""
LEVEL = {room: level for level, line in enumerate(ROOMS) for room in line}


def room(name: str) -> str:
    """The room of a module: the folder or module below `arview`, in a wing the one below the wing."""
    parts = name.split(".")
    return ".".join(parts[1 : 3 if ".".join(parts[:2]) in WINGS else 2])


def rooms_with(wanted: str) -> list[str]:
    """A room and those that import it, also lazily or for type checking. Raises KeyError for an unknown room."""
    if wanted not in {room(name) for name in modules()}:
        raise KeyError(wanted)
    users = {room(name) for name in modules() if any(room(other) == wanted for other in imports(name))}
    return sorted({wanted, *users} - {""})


def folders(wanted: str) -> list[Path]:
    """The folders of tests of these rooms, as far as they have one."""
    found = [TESTS / Path(*one.split(".")) for one in rooms_with(wanted)]
    return [path for path in found if path.is_dir()]


if __name__ == "__main__":
    try:
        print(*folders(sys.argv[1]))
    except KeyError:
        sys.exit(f"{sys.argv[1]}: no such room; the rooms are {', '.join(sorted({room(name) for name in modules()}))}")
