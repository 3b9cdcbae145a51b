"""Camera profiles: a folder of calibrations by phone, lens and mode, found by the metadata of a photo or video.

A profile is a camera file in arview's JSON with an object ``lens`` beside the intrinsics. The folder is
``$ARVIEW_PROFILES``, else ``arview/cameras`` under ``$XDG_CONFIG_HOME`` or ``~/.config``.
"""

from __future__ import annotations

import json
import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from arview.camera.exif import PhotoExif, photos_of, read_exif
from arview.errors import InputError

_FOCAL_ROUNDING_MM, _EQUIVALENT_ROUNDING_MM, _ZOOM_TOLERANCE = 0.055, 0.5, 0.01
"""Differences of EXIF values that rounding explains; the 35 mm equivalent is written in whole millimetres."""
_MAKE_KEYS = ("com.apple.quicktime.make", "com.android.manufacturer", "make")
_MODEL_KEYS = ("com.apple.quicktime.model", "com.android.model", "model")
"""Keys of a video's metadata that name the make and the model of the camera."""


@dataclass(frozen=True)
class Profile:
    """A stored calibration: its name, its file and its lens, see `lens_record`."""

    name: str
    path: Path
    lens: dict[str, Any]


def profile_folder() -> Path:
    """The folder of the profiles, which need not exist."""
    if folder := os.environ.get("ARVIEW_PROFILES"):
        return Path(folder)
    config = os.environ.get("XDG_CONFIG_HOME")
    return (Path(config) if config else Path.home() / ".config") / "arview" / "cameras"


def lens_record(exif: PhotoExif, width: int, height: int) -> dict[str, Any]:
    """What identifies the lens and mode of a picture: make, model, focal lengths, zoom and size.

    Args:
        exif: metadata of the picture.
        width, height: size of the picture as the sensor stored it, px.

    Returns:
        the entries that are known.
    """
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
    """The default name of the profile of a lens, for example ``apple-iphone-12-4.2mm-4032x3024``."""
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
    """The file of a profile, which need not exist.

    Raises:
        InputError: the name holds other characters than letters, digits, '.', '-', '+' and '_'.
    """
    if not re.fullmatch(r"[\w.+-]{1,100}", name) or name.startswith("."):
        raise InputError(f"profile {name!r}: expected letters, digits, '.', '-' and '_'")
    return (folder or profile_folder()) / f"{name}.json"


def list_profiles(folder: Path | None = None) -> list[Profile]:
    """All profiles of a folder, by name; other files are ignored."""
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
    """The camera file of ``profile:NAME``, or, for ``profile``, of the lens that the metadata of a source names.

    Raises:
        InputError: there is no such profile; the message lists the profiles.
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
    """The camera file of the lens and mode of a photo.

    Raises:
        InputError: there is no profile of it.
    """
    return _profile_of_lens(lens_record(exif, *_sensor_size(exif)), folder or profile_folder())


def same_lens(a: dict[str, Any], b: dict[str, Any]) -> bool:
    """Whether two records are of the same lens in the same mode.

    Make, model, size and zoom must agree, and focal lengths where both records have them.
    """

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
    """The lens record of a photo, of the first photo of a folder, or of a video file.

    Raises:
        InputError: the source is none of these, or cannot be read.
    """
    if photos := photos_of(source):
        exif = read_exif(photos[0])
        return lens_record(exif, *_sensor_size(exif))
    if source.is_dir():
        raise InputError(f"camera 'profile': {source}: the folder holds no photo; give profile:NAME")
    if not source.is_file():
        raise InputError(f"camera 'profile': {source} is not a file with metadata of its camera; give profile:NAME")
    size = _stored_size(source)
    return lens_record(exif_of_video(source, *size), *size)


def _stored_size(path: Path) -> tuple[int, int]:
    """Width and height in px of a video's first frame as stored, before the turn of the display matrix.

    Raises:
        InputError: the file is not a video, or holds no frame that can be decoded.
    """
    import av

    try:
        with av.open(str(path.absolute())) as container:
            frame = next(container.decode(video=0), None)
    except (av.FFmpegError, OSError, ValueError, IndexError) as error:
        raise InputError(f"camera 'profile': {path} cannot be read as a video; give profile:NAME") from error
    if frame is None:
        raise InputError(f"camera 'profile': {path} holds no frame that can be decoded; give profile:NAME")
    return frame.width, frame.height


def exif_of_video(path: Path, width: int, height: int) -> PhotoExif:
    """The make and model in the metadata of a video; videos hold no focal length.

    Args:
        path: of the video; a file that cannot be read has no metadata.
        width, height: size of its frames as stored, px.
    """
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
    """The camera file of the first profile of a lens; raises InputError when there is none."""
    found = [profile.path for profile in list_profiles(folder) if same_lens(profile.lens, lens)]
    if not found:
        raise InputError(f"camera 'profile': none for {profile_name(lens)}; {_which(folder)}")
    return found[0]


def _which(folder: Path) -> str:
    """The end of an error message: which profiles there are, and how to make one."""
    known = [profile.name for profile in list_profiles(folder)]
    have = f"there are {', '.join(known[:8])}" if known else f"there are none in {folder}"
    return f"{have}; `arview calibrate … --profile` makes one"


def _sensor_size(exif: PhotoExif) -> tuple[int, int]:
    """Width and height in px of a photo as the sensor stored it."""
    width, height = exif.upright_size
    return (height, width) if exif.quarter_turns_clockwise % 2 else (width, height)
