"""Real photos that stand behind rendered parts, or that must not be taken for one."""

from __future__ import annotations

import importlib.util
import os
from pathlib import Path

from arview.errors import InputError
from arview.evaluation.semisynthetic import photos_in
from recordings import DATA, SEQUENCES

EACH_RECORDING = 8
FEWEST = 20
"""Photos that networks are fitted on."""
PACKAGES = {
    "skimage": (
        "data/astronaut.png",
        "data/chelsea.png",
        "data/coffee.png",
        "data/motorcycle_left.png",
        "data/rocket.jpg",
    ),
    "sklearn": ("datasets/images/china.jpg", "datasets/images/flower.jpg"),
}
"""Photos that Python packages bring along."""
DEBIAN = Path("/usr/share/backgrounds/mate/nature")
"""Photos of Debian's package mate-backgrounds."""
FLAT = ("castle",)
"""Recordings that look like no photo: flat computer graphics."""
SHOW_TOO = {"cube": ("castle",)}
"""Recordings that show a part besides its own: there is a box in the castle's picture."""


def background_photos(folder: Path | None, without: str = "") -> tuple[Path, ...]:
    """Photos for backgrounds: of a folder, or a few of each recording and what the machine has.

    ``without`` names a recorded part that they must not show.
    """
    if folder is not None:
        return tuple(photos_in(folder))
    recorded = recorded_frames(without, *FLAT)
    spread = [frames[:: max(1, len(frames) // EACH_RECORDING)] for frames in recorded]
    return tuple(path for frames in spread for path in frames) + machine_photos()


def all_photos(folder: Path | None, without: str = "") -> tuple[Path, ...]:
    """Every photo there is that does not show a recorded part."""
    if folder is not None:
        return tuple(photos_in(folder))
    return tuple(path for frames in recorded_frames(without) for path in frames) + machine_photos()


def fitting_photos(folder: Path | None) -> tuple[Path, ...]:
    """Photos of a folder or the machine's to fit networks on; no recordings, for what stands in them is looked for.

    Raises:
        InputError: fewer than `FEWEST`: networks would know each of them.
    """
    photos = machine_photos() if folder is None else tuple(photos_in(folder))
    if len(photos) < FEWEST:
        where = "this machine" if folder is None else str(folder)
        raise InputError(
            f"{where}: {len(photos)} background photos, {FEWEST} are needed; give a folder of more by --photos"
        )
    return photos


def recorded_frames(*without: str) -> list[list[Path]]:
    """Frames of each recording, and the photos of the plate, in order; none of those that show certain parts."""
    left_out = {other for name in without for other in (name, *SHOW_TOO.get(name, ()))}
    folders = [DATA / name / "test" / "000001" for name in SEQUENCES if name not in left_out]
    if "plate" not in left_out:
        folders.append(DATA.parent / "plate" / "photos")
    return [photos_in(folder) for folder in folders if folder.is_dir()]


def machine_photos() -> tuple[Path, ...]:
    """Photos in ``$ARVIEW_BACKGROUNDS``, in Python packages and in Debian's folder."""
    found: list[Path] = []
    own = os.environ.get("ARVIEW_BACKGROUNDS")
    if own:
        found += photos_in(Path(own))
    for package, names in PACKAGES.items():
        spec = importlib.util.find_spec(package)
        if spec is not None and spec.origin is not None:
            found += [path for name in names if (path := Path(spec.origin).parent / name).is_file()]
    if DEBIAN.is_dir():
        found += photos_in(DEBIAN)
    return tuple(found)
