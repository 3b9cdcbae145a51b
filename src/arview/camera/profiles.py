"""Calibrations kept by phone, lens and mode: a folder of camera files, found again by what a photo or video says.

A profile is arview's camera JSON with an object ``lens`` beside the numbers. The folder is ``$ARVIEW_PROFILES``, else
``arview/cameras`` under ``$XDG_CONFIG_HOME`` or ``~/.config``.
"""

from __future__ import annotations

import json
import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from arview.camera.exif import HEIF_SUFFIXES, PHOTO_SUFFIXES, PhotoExif, read_exif
from arview.errors import InputError

_FOCAL_ROUNDING_MM, _EQUIVALENT_ROUNDING_MM, _ZOOM_TOLERANCE = 0.055, 0.5, 0.01
"""What programs round in EXIF data; the 35 mm equivalent is in whole millimetres."""
_MAKE_KEYS = ("com.apple.quicktime.make", "com.android.manufacturer", "make")
_MODEL_KEYS = ("com.apple.quicktime.model", "com.android.model", "model")


@dataclass(frozen=True)
class Profile:
    """One calibration: its name and file, and the lens it is of (see `lens_record`)."""

    name: str
    path: Path
    lens: dict[str, Any]


def profile_folder() -> Path:
    """Where profiles are; it need not exist."""
    if folder := os.environ.get("ARVIEW_PROFILES"):
        return Path(folder)
    config = os.environ.get("XDG_CONFIG_HOME")
    return (Path(config) if config else Path.home() / ".config") / "arview" / "cameras"


def lens_record(exif: PhotoExif, width: int, height: int) -> dict[str, Any]:
    """What tells the lens and mode of a picture of the sensor's size width × height px; unknown entries are absent."""
    entries = {
        "make": exif.make,
        "model": exif.model,
        "focal_length_mm": exif.focal_length_mm,
        "focal_length_35mm_mm": exif.focal_length_35mm_mm,
        "digital_zoom": exif.digital_zoom if exif.digital_zoom != 1.0 else None,
        "width": width,
        "height": height,
    }
    return {key: value for key, value in entries.items() if value}


def profile_name(lens: dict[str, Any]) -> str:
    """A name for the profile of a lens: ``apple-iphone-12-4.2mm-4032x3024``."""
    words = [str(lens.get("make", "")), str(lens.get("model", ""))]
    if words[1].lower().startswith(words[0].lower()):
        words = words[1:]
    if focal := lens.get("focal_length_mm"):
        words.append(f"{focal:.1f}mm")
    if zoom := lens.get("digital_zoom"):
        words.append(f"x{zoom:g}")
    words.append(f"{lens['width']}x{lens['height']}")
    return re.sub(r"[^a-z0-9.]+", "-", " ".join(word for word in words if word).lower()).strip("-")


def profile_path(name: str, folder: Path | None = None) -> Path:
    """The file of a profile of that name, which need not exist. Raises InputError for a name that is no file's."""
    if not re.fullmatch(r"[\w.+-]{1,100}", name) or name.startswith("."):
        raise InputError(f"profile {name!r}: expected letters, digits, '.', '-' and '_'")
    return (folder or profile_folder()) / f"{name}.json"


def list_profiles(folder: Path | None = None) -> list[Profile]:
    """All profiles by name; files there that are none are passed over."""
    folder = folder or profile_folder()
    profiles = []
    for path in sorted(folder.glob("*.json")) if folder.is_dir() else []:
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            continue
        lens = content.get("lens") if isinstance(content, dict) else None
        if isinstance(lens, dict):
            profiles.append(Profile(path.stem, path, lens))
    return profiles


def find_profile(spec: str, source: str | Path | None = None, folder: Path | None = None) -> Path:
    """The camera file of ``profile:NAME``, or of ``profile`` for what the source says of its camera.

    Raises:
        InputError: there is no such profile; the message names those there are.
    """
    folder = folder or profile_folder()
    name = spec.removeprefix("profile").removeprefix(":")
    if name:
        path = profile_path(name, folder)
        if not path.is_file():
            raise InputError(f"camera 'profile:{name}': no such profile; {_which(folder)}")
        return path
    if source is None:
        raise InputError(f"camera 'profile': no file to read make and model from; give profile:NAME; {_which(folder)}")
    return _profile_of_lens(lens_of_source(Path(source)), folder)


def profile_of_photo(exif: PhotoExif, folder: Path | None = None) -> Path:
    """The camera file kept for the lens and mode of a photo. Raises InputError when there is none."""
    return _profile_of_lens(lens_record(exif, *_sensor_size(exif)), folder or profile_folder())


def same_lens(a: dict[str, Any], b: dict[str, Any]) -> bool:
    """Whether two records are of one lens in one mode: make, model and size, and focal lengths where both say one."""

    def close(key: str, tolerance: float) -> bool:
        x, y = a.get(key), b.get(key)
        numbers = isinstance(x, int | float) and isinstance(y, int | float)
        return not numbers or abs(float(x) - float(y)) <= tolerance + 1e-9  # type: ignore[arg-type]

    def text(record: dict[str, Any], key: str) -> str:
        return str(record.get(key, "")).lower()

    zoom_a, zoom_b = float(a.get("digital_zoom", 1.0)), float(b.get("digital_zoom", 1.0))
    return (
        bool(text(a, "model"))
        and text(a, "model") == text(b, "model")
        and text(a, "make") == text(b, "make")
        and (a.get("width"), a.get("height")) == (b.get("width"), b.get("height"))
        and close("focal_length_mm", _FOCAL_ROUNDING_MM)
        and close("focal_length_35mm_mm", _EQUIVALENT_ROUNDING_MM)
        and abs(zoom_a - zoom_b) <= _ZOOM_TOLERANCE * zoom_a
    )


def lens_of_source(source: Path) -> dict[str, Any]:
    """`lens_record` of a photo, of the first photo of a folder, or of a video file. Raises InputError."""
    if source.is_dir():
        photos = sorted(p for p in source.iterdir() if p.suffix.lower() in PHOTO_SUFFIXES | HEIF_SUFFIXES)
        if not photos:
            raise InputError(f"camera 'profile': {source}: no photo there; give profile:NAME")
        source = photos[0]
    if source.suffix.lower() in PHOTO_SUFFIXES | HEIF_SUFFIXES:
        exif = read_exif(source)
        return lens_record(exif, *_sensor_size(exif))
    if not source.is_file():
        raise InputError(f"camera 'profile': {source} is no file that says its camera; give profile:NAME")
    from arview.video import open_source

    with open_source(source) as frames:
        size = (frames.width, frames.height)
        size = size[::-1] if frames.quarter_turns_clockwise % 2 else size
    return lens_record(exif_of_video(source, *size), *size)


def exif_of_video(path: Path, width: int, height: int) -> PhotoExif:
    """Make and model that a phone wrote into a video of the sensor's size; videos hold no focal length."""
    import av

    try:
        with av.open(str(path.absolute())) as container:
            tags = {key.lower(): value for key, value in container.metadata.items()}
            for stream in container.streams.video:
                tags |= {key.lower(): value for key, value in stream.metadata.items() if key.lower() not in tags}
    except (av.FFmpegError, OSError, ValueError):
        tags = {}

    def first(keys: tuple[str, ...]) -> str:
        return next((str(tags[key]).strip() for key in keys if tags.get(key)), "")

    return PhotoExif(width, height, make=first(_MAKE_KEYS), model=first(_MODEL_KEYS))


def _profile_of_lens(lens: dict[str, Any], folder: Path) -> Path:
    found = [profile.path for profile in list_profiles(folder) if same_lens(profile.lens, lens)]
    if not found:
        raise InputError(f"camera 'profile': none for {profile_name(lens)}; {_which(folder)}")
    return found[0]


def _which(folder: Path) -> str:
    known = [profile.name for profile in list_profiles(folder)]
    have = f"there are {', '.join(known[:8])}" if known else f"there are none in {folder}"
    return f"{have}; `arview calibrate … --profile` makes one"


def _sensor_size(exif: PhotoExif) -> tuple[int, int]:
    width, height = exif.upright_size
    return (height, width) if exif.quarter_turns_clockwise % 2 else (width, height)
