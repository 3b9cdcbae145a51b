"""Reading camera files into a `Camera` that is scaled to the frames.

The format is recognised by the content of the file, not by its name: arview's JSON, BOP ``camera.json`` and
``scene_camera.json``, OpenCV FileStorage (YAML, XML, JSON), ROS ``camera_info``, Kalibr camchain, COLMAP
``cameras.txt`` and ``cameras.bin``, Metashape's cameras or calibration as XML, RealSense intrinsics as JSON,
nerfstudio ``transforms.json``, calibrations of DepthAI, MATLAB, OpenSfM and PhotonVision as JSON. Of several cameras
in a file that differ, one is asked for as ``FILE:NAME``.
``fov:DEG``, ``exif``, ``profile`` and ``profile:NAME`` name cameras without a file.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from arview.camera.colmap_text import colmap_text_of_binary, entries_from_colmap, is_colmap
from arview.camera.entry import CameraEntry
from arview.camera.exif import focal_length_px, photos_of, read_exif
from arview.camera.formats import FORMATS, entries_from_trees
from arview.camera.metashape import entries_from_metashape, is_metashape
from arview.camera.model import Camera
from arview.camera.profiles import find_profile
from arview.camera.tree import MAX_BYTES, parse_trees
from arview.camera.write import camera_record
from arview.core.checks import PATH, check_type
from arview.errors import ArviewError, InputError, MismatchError, OutputError

MAX_MESSAGE = 400
"""Letters of a message about the content of a file."""
READERS: tuple[tuple[Callable[[str], bool], Callable[[str, str], list[CameraEntry]]], ...] = (
    (is_colmap, entries_from_colmap),
    (is_metashape, entries_from_metashape),
)
"""Whether a text is of a format, and its reader, which takes the text and the name of the camera that is wanted. What
none of them knows is read as a tree of JSON, YAML, XML or INI, by the names in `arview.camera.keys`."""


def load_camera(
    spec: str | Path,
    width: int | None = None,
    height: int | None = None,
    *,
    source: str | Path | None = None,
    quarter_turns_clockwise: int = 0,
) -> Camera:
    """The camera for frames of width × height px, from a file, a field of view, EXIF data or a profile.

    Args:
        spec: path of a camera file (see the module for the formats), ``FILE:NAME`` for one of several cameras in it;
            ``fov:DEG``, the field of view in degrees along the longer side of the frame; ``exif``, the focal length in
            the first photo of ``source``; ``profile:NAME``, a calibration stored by `arview calibrate --profile`; or
            ``profile``, the one of the lens of ``source``.
        width: width of the upright frames, px; None takes the size in the file.
        height: height of the upright frames, px; given together with ``width``.
        source: photo, folder or glob of photos, for ``exif`` and ``profile``; or video, for ``profile``.
        quarter_turns_clockwise: turns that the video source has applied to its frames. The camera is turned alike,
            unless the file gives the size of the turned frames.

    Raises:
        InputError: the file is missing, cannot be read, has no known format or holds impossible values.
        MismatchError: the file is for frames of another aspect ratio.
    """
    check_type(spec, PATH, "load_camera: spec")
    text = str(spec)
    if text.startswith("fov:"):
        return _camera_from_fov(text, width, height)
    if text == "exif":
        return _camera_from_exif(source, width, height)
    if text == "profile" or text.startswith("profile:"):
        path, name = find_profile(text, source), ""
    else:
        path, name = split_spec(text)
    entry = _entry_of(_read_entries(path, name), path, name)
    turns = quarter_turns_clockwise % 4
    if turns == 0 or width is None or height is None:
        return _fit_to_frames(entry, path, width, height)
    upright = (width, height) if turns == 2 else (height, width)
    file_size = (entry.width, entry.height)
    if turns != 2 and None not in file_size and _scale_matches(file_size, (width, height)):
        return _fit_to_frames(entry, path, width, height)
    return _fit_to_frames(entry, path, *upright).rotated(turns)


def load_cameras(path: str | Path) -> dict[str, Camera]:
    """All cameras of a file, at the sizes that it gives, by their names in it.

    Raises:
        InputError: the file is missing, cannot be read, has no known format or holds impossible values.
    """
    path = Path(path)
    return {entry.label: _fit_to_frames(entry, path, None, None) for entry in _read_entries(path, "")}


def save_camera(camera: Camera, path: str | Path) -> None:
    """Write a camera in arview's own JSON: width, height, fx, fy, cx, cy in px and dist = k1 k2 p1 p2 k3.

    Of another lens model, ``lens_model`` is its name and ``dist`` are its terms.

    Raises:
        OutputError: the file cannot be written.
    """
    try:
        Path(path).write_text(json.dumps(camera_record(camera), indent=2) + "\n", encoding="utf-8")
    except OSError as error:
        raise OutputError(f"{path}: cannot write the camera file: {error.strerror or error}") from error


def guess_camera(width: int, height: int) -> Camera:
    """An undistorted camera for uncalibrated frames, with a focal length of 1.2 × the longer side."""
    return _centred_camera(1.2 * max(width, height), width, height)


def _centred_camera(focal_px: float, width: int, height: int) -> Camera:
    return Camera(width, height, focal_px, focal_px, 0.5 * (width - 1), 0.5 * (height - 1))


def _camera_from_fov(spec: str, width: int | None, height: int | None) -> Camera:
    try:
        fov_deg = float(spec.removeprefix("fov:"))
    except ValueError:
        fov_deg = math.nan
    if not 1.0 <= fov_deg <= 170.0:
        raise InputError(f"camera '{spec}': expected fov:DEG with 1 to 170 degrees, for example fov:65")
    if width is None or height is None:
        raise InputError(f"camera '{spec}': the size of the frames is needed with a field of view")
    focal_px = 0.5 * max(width, height) / math.tan(math.radians(0.5 * fov_deg))
    return _centred_camera(focal_px, width, height)


# --- Fitting a file's camera to the frames -------------------------------------------------------------


def _scale_matches(file_size: tuple[Any, Any], frame_size: tuple[int, int]) -> bool:
    """True when one factor maps the size in the file to that of the frames within a pixel of rounding."""
    scale = max(frame_size) / max(file_size)
    return all(abs(a * scale - b) <= 1.0 for a, b in zip(file_size, frame_size, strict=True))


def _fit_to_frames(entry: CameraEntry, path: Path, width: int | None, height: int | None) -> Camera:
    """The camera of an entry at the size of the frames, after checks of its plausibility."""
    if width is None or height is None:
        if entry.width is None or entry.height is None:
            raise InputError(f"{path}: no image size in the camera file; add width and height in px")
        return _checked_camera(entry, entry.width, entry.height, path)
    if entry.width is None or entry.height is None:
        camera = _checked_camera(entry, width, height, path)
        off_centre = max(abs(camera.cx / width - 0.5), abs(camera.cy / height - 0.5))
        if off_centre > 0.25:
            raise MismatchError(
                f"{path}: principal point ({camera.cx:g}, {camera.cy:g}) is far from the centre of the "
                f"{width}×{height} frames and the file gives no image size; add width and height to it"
            )
        return camera
    camera = _checked_camera(entry, entry.width, entry.height, path)
    file_size, frame_size = (entry.width, entry.height), (width, height)
    if entry.whole_size not in (None, file_size) and entry.whole_size == frame_size:
        raise MismatchError(
            f"{path}: the file says that the frames are {entry.width}×{entry.height} px by roi or binning, but they "
            f"are {width}×{height} px, the whole picture; set roi and binning to none if they are not in use"
        )
    if file_size == frame_size:
        return camera
    if _scale_matches(file_size, frame_size):
        return camera.scaled(width, height)
    sizes = f"camera is for {entry.width}×{entry.height} px, the frames are {width}×{height} px"
    if _scale_matches((entry.height, entry.width), frame_size):
        raise MismatchError(
            f"{path}: {sizes}: portrait against landscape; turn the frames or give a camera calibrated "
            "in the same orientation"
        )
    raise MismatchError(f"{path}: {sizes}: another aspect ratio; give a camera calibrated for these frames")


def _checked_camera(entry: CameraEntry, width: int, height: int, path: Path) -> Camera:
    """The camera of an entry; raises InputError, with the file name, for values that no camera has."""
    try:
        camera = Camera(
            width, height, entry.fx, fy=entry.fy, cx=entry.cx, cy=entry.cy, dist=np.array(entry.dist), lens=entry.lens
        )
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    w, h = width, height
    if not (-0.5 * w <= camera.cx <= 1.5 * w and -0.5 * h <= camera.cy <= 1.5 * h):
        raise InputError(
            f"{path}: principal point ({camera.cx:g}, {camera.cy:g}) is far outside the {w}×{h} image; "
            "check the order and the unit (px) of the values"
        )
    if min(camera.fx, camera.fy) < 0.05 * max(w, h):
        raise InputError(
            f"{path}: focal length {min(camera.fx, camera.fy):g} px is too short for a {w}×{h} image; "
            "is it in mm? It must be in px"
        )
    return camera


def _entry_of(entries: Sequence[CameraEntry], path: Path, name: str) -> CameraEntry:
    """The camera of a name, or the only camera of a file; raises InputError when there are several that differ."""
    labels = [entry.label for entry in entries]
    shown = ", ".join(labels[:6]) + (", …" if len(labels) > 6 else "")
    if name:
        found = [entry for entry in entries if name in (entry.label, entry.label.rsplit("/", 1)[-1])]
        exact = [entry for entry in found if entry.label == name]
        if len(exact or found) != 1:
            have = f"it holds {shown}" if any(labels) else "its only camera has no name; leave the name out"
            raise InputError(f"{path}: no camera, or more than one, is called {name!r}; {have}")
        return (exact or found)[0]
    first = entries[0]
    if any(entry != first for entry in entries):
        raise InputError(
            f"{path}: holds {len(entries)} different cameras ({shown}); name one of them, "
            f"as in {path.name}:{labels[-1]}"
        )
    return first


# --- Files ---------------------------------------------------------------------------------------------


def split_spec(spec: str | Path) -> tuple[Path, str]:
    """The file of ``FILE:NAME`` and the name of the camera in it, empty without one."""
    text = str(spec)
    if not Path(text).exists():
        for place in sorted((i for i, letter in enumerate(text) if letter in ":#"), reverse=True):
            if place and Path(text[:place]).is_file():
                return Path(text[:place]), text[place + 1 :]
    return Path(text), ""


def _entries_from_tree(text: str, name: str) -> list[CameraEntry]:
    return entries_from_trees(parse_trees(text), name)


def _read_entries(path: Path, name: str) -> list[CameraEntry]:
    if path.is_dir():
        raise InputError(f"{path}: is a folder; give the camera file itself ({FORMATS})")
    try:
        if path.stat().st_size > MAX_BYTES:
            raise InputError(f"{path}: is larger than {MAX_BYTES / 1e6:.0f} MB; expected {FORMATS}")
        data = path.read_bytes()
        text = colmap_text_of_binary(data) or data.decode("utf-8-sig")
    except FileNotFoundError as error:
        raise InputError(
            f"{path}: camera file not found; give a camera file, fov:DEG (for example fov:65) or exif"
        ) from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is not a text file; expected {FORMATS}") from error
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else None
        raise InputError(f"{path}: cannot read the camera file: {reason or error}") from error
    if re.search(r"[\x00-\x08\x0e-\x1f]", text):
        raise InputError(f"{path}: is not a text file; expected {FORMATS}")
    stripped = text.lstrip()
    if not stripped:
        raise InputError(f"{path}: the camera file is empty; expected {FORMATS}")
    try:
        read = next((read for is_format, read in READERS if is_format(stripped)), _entries_from_tree)
        return [entry.as_recorded() for entry in read(stripped, name)]
    except ArviewError as error:
        # Texts of the file in a message may be long, or have several lines.
        text = " ".join(str(error).split())
        raise type(error)(f"{path}: {text if len(text) <= MAX_MESSAGE else text[:MAX_MESSAGE] + '…'}") from error


# --- EXIF ----------------------------------------------------------------------------------------------


def _camera_from_exif(source: str | Path | None, width: int | None, height: int | None) -> Camera:
    """The camera of photos by the focal length in the EXIF data of the first one."""
    if source is None:
        raise InputError("camera 'exif': no photo to read it from; give a photo, a folder or a glob of photos")
    photo = next(iter(photos_of(Path(source))), None)
    if photo is None:
        raise InputError(
            f"{source}: no photo with EXIF data there (a video holds no focal length); give a camera file or fov:DEG"
        )
    exif = read_exif(photo)
    if width is None or height is None:
        width, height = exif.upright_size
    focal_px = focal_length_px(exif, width, height)
    if focal_px is not None:
        return _centred_camera(focal_px, width, height)
    if not exif.focal_length_mm:
        raise InputError(f"{photo}: no focal length in its EXIF data; give a camera file or fov:DEG")
    raise InputError(
        f"{photo}: the EXIF data give {exif.focal_length_mm:g} mm but no 35 mm equivalent, and the sensor of "
        f"'{exif.model}' is not known; give a camera file or fov:DEG"
    )
