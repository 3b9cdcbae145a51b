"""Real photos: backgrounds of rendered parts, and pictures without a part for false alarms."""

from __future__ import annotations

import importlib.util
import os
from pathlib import Path

from arview.errors import InputError
from arview_lab.semisynthetic import photos_in
from recordings import DATA, VIDEOS

PHOTOS_PER_RECORDING = 8
"""Frames of each recording that serve as backgrounds."""
MIN_PHOTOS = 20
"""Smallest number of photos to train networks on: they would memorise fewer."""
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
"""Photos in Python packages."""
DEBIAN = Path("/usr/share/backgrounds/mate/nature")
"""Folder of the photos in Debian's package mate-backgrounds."""
UNREALISTIC = ("castle",)
"""Recordings of flat computer graphics, which do not look like photos."""
ALSO_SHOWN_BY = {"cube": ("castle",)}
"""Recordings that also show another part: there is a box in the picture of the castle."""


def background_photos(folder: Path | None, without: str = "") -> tuple[Path, ...]:
    """Photos for backgrounds: those of a folder, or some frames of each recording and the photos of this machine.

    Args:
        folder: of photos, or None.
        without: a recorded part that the photos must not show.
    """
    if folder is not None:
        return tuple(photos_in(folder))
    recorded = recorded_frames(without, *UNREALISTIC)
    spread = [frames[:: max(1, len(frames) // PHOTOS_PER_RECORDING)] for frames in recorded]
    return tuple(path for frames in spread for path in frames) + machine_photos()


def all_photos(folder: Path | None, without: str = "") -> tuple[Path, ...]:
    """All available photos that do not show a recorded part, or those of a folder."""
    if folder is not None:
        return tuple(photos_in(folder))
    return tuple(path for frames in recorded_frames(without) for path in frames) + machine_photos()


def fitting_photos(folder: Path | None) -> tuple[Path, ...]:
    """Photos of a folder, or of this machine, to train networks on.

    Recordings are not used: the parts in them would be learned as background.

    Raises:
        InputError: fewer than `MIN_PHOTOS` photos.
    """
    photos = machine_photos() if folder is None else tuple(photos_in(folder))
    if len(photos) < MIN_PHOTOS:
        where = "this machine" if folder is None else str(folder)
        raise InputError(
            f"{where}: {len(photos)} background photos, {MIN_PHOTOS} are needed; give a larger folder with --photos"
        )
    return photos


def recorded_frames(*without: str) -> list[list[Path]]:
    """Frames of each recording and the photos of the plate, in order, without those that show certain parts."""
    left_out = {other for name in without for other in (name, *ALSO_SHOWN_BY.get(name, ()))}
    folders = [DATA / name / "test" / "000001" for name in VIDEOS if name not in left_out]
    if "plate" not in left_out:
        folders.append(DATA.parent / "plate" / "photos")
    return [photos_in(folder) for folder in folders if folder.is_dir()]


def machine_photos() -> tuple[Path, ...]:
    """Photos in ``$ARVIEW_BACKGROUNDS``, in Python packages and in the folder of Debian."""
    found: list[Path] = []
    listed = os.environ.get("ARVIEW_BACKGROUNDS")
    if listed:
        found += photos_in(Path(listed))
    for package, names in PACKAGES.items():
        spec = importlib.util.find_spec(package)
        if spec is not None and spec.origin is not None:
            found += [path for name in names if (path := Path(spec.origin).parent / name).is_file()]
    if DEBIAN.is_dir():
        found += photos_in(DEBIAN)
    return tuple(found)
