"""Reading camera files into a `Camera` that is scaled to the frames.

The format is recognised by the content of the file, not by its name: arview's JSON, BOP ``camera.json`` and
``scene_camera.json``, OpenCV FileStorage (YAML, XML, JSON), ROS ``camera_info`` YAML, COLMAP ``cameras.txt``.
``fov:DEG``, ``exif``, ``profile`` and ``profile:NAME`` name cameras without a file.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from arview.camera.exif import HEIF_SUFFIXES, PHOTO_SUFFIXES, focal_length_px, read_exif
from arview.camera.model import COLMAP_HALF_PX, Camera
from arview.camera.profiles import find_profile
from arview.core.checks import PATH, check_type
from arview.errors import ArviewError, InputError, MismatchError, OutputError

MATRIX_KEYS = ("camera_matrix", "cameraMatrix", "intrinsic_matrix", "cam_K", "K", "k", "mtx")
DIST_KEYS = ("distortion_coefficients", "distCoeffs", "dist_coeffs", "distortion", "dist", "D", "d")
WIDTH_KEYS = ("width", "image_width", "imageWidth")
HEIGHT_KEYS = ("height", "image_height", "imageHeight")
SIZE_KEYS = ("image_size", "imageSize", "size")
MODEL_KEYS = ("distortion_model", "camera_model")
PLAIN_MODELS = ("", "plumb_bob", "rational_polynomial", "pinhole", "radtan", "opencv", "none")

FORMATS = "arview or BOP JSON, OpenCV YAML/XML, ROS camera_info YAML or COLMAP cameras.txt"
_NUMBER = re.compile(r"[-+]?\.?(?:nan|inf)\b|[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?", re.IGNORECASE)


@dataclass(frozen=True)
class _Entry:
    """One camera of a file; the size is None where the file does not give it."""

    fx: float
    fy: float
    cx: float
    cy: float
    dist: tuple[float, ...] = ()
    width: int | None = None
    height: int | None = None
    label: str = field(default="", compare=False)


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
        spec: path of a camera file (see the module for the formats); ``fov:DEG``, the field of view in degrees along
            the longer side of the frame; ``exif``, the focal length in the first photo of ``source``; ``profile:NAME``,
            a calibration stored by `arview calibrate --profile`; or ``profile``, the one of the lens of ``source``.
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
    path = find_profile(text, source) if text == "profile" or text.startswith("profile:") else Path(text)
    entry = _only_entry(_read_entries(path), path)
    turns = quarter_turns_clockwise % 4
    if turns == 0 or width is None or height is None:
        return _fit_to_frames(entry, path, width, height)
    upright = (width, height) if turns == 2 else (height, width)
    file_size = (entry.width, entry.height)
    if turns != 2 and None not in file_size and _scale_matches(file_size, (width, height)):
        return _fit_to_frames(entry, path, width, height)
    return _fit_to_frames(entry, path, *upright).rotated(turns)


def save_camera(camera: Camera, path: str | Path) -> None:
    """Write a camera in arview's own JSON: width, height, fx, fy, cx, cy in px and dist = k1 k2 p1 p2 k3.

    Raises:
        OutputError: the file cannot be written.
    """
    record = {
        "width": camera.width,
        "height": camera.height,
        "fx": camera.fx,
        "fy": camera.fy,
        "cx": camera.cx,
        "cy": camera.cy,
        "dist": [float(value) for value in camera.dist],
    }
    try:
        Path(path).write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")
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


def _fit_to_frames(entry: _Entry, path: Path, width: int | None, height: int | None) -> Camera:
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


def _checked_camera(entry: _Entry, width: int, height: int, path: Path) -> Camera:
    """The camera of an entry; raises InputError, with the file name, for values that no camera has."""
    try:
        camera = Camera(width, height, entry.fx, entry.fy, entry.cx, entry.cy, np.array(entry.dist))
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


def _only_entry(entries: Sequence[_Entry], path: Path) -> _Entry:
    """The only camera of a file; raises InputError when it holds several that differ."""
    first = entries[0]
    if any(entry != first for entry in entries):
        labels = ", ".join(entry.label for entry in entries[:6])
        more = ", …" if len(entries) > 6 else ""
        raise InputError(
            f"{path}: holds {len(entries)} different cameras ({labels}{more}); keep only one of them in the file"
        )
    return first


# --- Formats -------------------------------------------------------------------------------------------


def _read_entries(path: Path) -> list[_Entry]:
    if path.is_dir():
        raise InputError(f"{path}: is a folder; give the camera file itself ({FORMATS})")
    try:
        text = path.read_text(encoding="utf-8-sig")
    except FileNotFoundError as error:
        raise InputError(
            f"{path}: camera file not found; give a camera file, fov:DEG (for example fov:65) or exif"
        ) from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is not a text file; expected {FORMATS}") from error
    except OSError as error:
        raise InputError(f"{path}: cannot read the camera file: {error.strerror or error}") from error
    stripped = text.lstrip()
    if not stripped:
        raise InputError(f"{path}: the camera file is empty; expected {FORMATS}")
    try:
        if stripped.startswith(("{", "[")):
            return _entries_from_json(stripped)
        if stripped.startswith("<"):
            return [_entry_from_xml(stripped)]
        if _is_colmap(stripped):
            return _entries_from_colmap(stripped)
        return [_entry_from_yaml(stripped)]
    except ArviewError as error:
        raise type(error)(f"{path}: {error}") from error


def _entry(get: Callable[[str], list[float] | None], model: str = "", label: str = "") -> _Entry:
    """An entry from a function that returns the numbers of a key, tried with all spellings that the formats use."""

    def first(keys: Iterable[str], count: int | None = None) -> list[float] | None:
        for key in keys:
            numbers = get(key)
            if numbers is not None and (count is None or len(numbers) == count):
                return numbers
        return None

    if model.lower() not in PLAIN_MODELS:
        raise InputError(f"lens model '{model}' is not supported; calibrate with the pinhole model and k1 k2 p1 p2 k3")
    matrix = first(MATRIX_KEYS, 9)
    if matrix is not None:
        fx, fy, cx, cy = matrix[0], matrix[4], matrix[2], matrix[5]
        if matrix[3] != 0 or matrix[6:] != [0, 0, 1]:
            raise InputError(
                f"the camera matrix {matrix} is not fx 0 cx / 0 fy cy / 0 0 1 in row-major order; correct it"
            )
        if abs(matrix[1]) > 1e-3 * abs(matrix[0]):
            raise InputError(f"the camera matrix has skew {matrix[1]:g}, which is not supported; calibrate again")
    else:
        values = {name: first((name,), 1) for name in ("fx", "fy", "cx", "cy")}
        missing = [name for name, value in values.items() if value is None]
        if missing:
            known = "no camera matrix and no" if len(missing) == 4 else "no"
            raise InputError(f"{known} {', '.join(missing)} in the camera file; expected {FORMATS}")
        fx, fy, cx, cy = (value[0] for value in values.values() if value is not None)
    width, height = first(WIDTH_KEYS, 1), first(HEIGHT_KEYS, 1)
    size = first(SIZE_KEYS, 2)
    if size is not None and width is None and height is None:
        width, height = size[:1], size[1:]
    return _Entry(
        fx,
        fy,
        cx,
        cy,
        dist=_padded_dist(first(DIST_KEYS) or []),
        width=_pixel_count(width, "width"),
        height=_pixel_count(height, "height"),
        label=label,
    )


def _padded_dist(dist: Sequence[float]) -> tuple[float, ...]:
    """Distortion terms, filled up with zeros to five, so that equal cameras compare equal."""
    return tuple(dist) + (0.0,) * (5 - len(dist))


def _pixel_count(numbers: list[float] | None, name: str) -> int | None:
    if numbers is None:
        return None
    if not (math.isfinite(numbers[0]) and numbers[0] == int(numbers[0]) and numbers[0] > 0):
        raise InputError(f"{name} is {numbers[0]:g}; expected a positive whole number of px")
    return int(numbers[0])


def _flat_numbers(value: Any, key: str) -> list[float]:
    """The numbers of a JSON value: a number, a list, a list of rows, or a FileStorage matrix with ``data``."""
    if isinstance(value, dict) and "data" in value:
        value = value["data"]
    if isinstance(value, bool) or value is None or isinstance(value, dict):
        raise InputError(f"{key} is {json.dumps(value)[:60]}; expected numbers")
    if isinstance(value, list):
        return [number for item in value for number in _flat_numbers(item, key)]
    try:
        return [float(value)]
    except ValueError as error:
        raise InputError(f"{key} is '{str(value)[:60]}'; expected numbers") from error


def _entries_from_json(text: str) -> list[_Entry]:
    try:
        data = json.loads(text)
    except json.JSONDecodeError as error:
        raise InputError(f"is not valid JSON (line {error.lineno}: {error.msg}); correct or export it again") from error
    if not isinstance(data, dict):
        raise InputError(f"the JSON is a {type(data).__name__}, expected an object with fx, fy, cx, cy")
    frames = {key: value for key, value in data.items() if isinstance(value, dict) and "cam_K" in value}
    if frames:
        return [_entry_from_object(value, label=f"frame {key}") for key, value in frames.items()]
    return [_entry_from_object(data)]


def _entry_from_object(data: dict[str, Any], label: str = "") -> _Entry:
    model = next((str(data[key]) for key in MODEL_KEYS if key in data), "")
    return _entry(lambda key: _flat_numbers(data[key], key) if key in data else None, model, label)


def _entry_from_xml(text: str) -> _Entry:
    if "<!ENTITY" in text:
        raise InputError("the XML defines entities, which a camera file never needs; export it again")
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise InputError(f"is not valid XML ({error}); export it again") from error

    def get(key: str) -> list[float] | None:
        node = root.find(f".//{key}")
        if node is None:
            return None
        data = node.find("data")
        return _numbers((node if data is None else data).text or "")

    model = next((root.findtext(f".//{key}") or "" for key in MODEL_KEYS), "")
    return _entry(get, model.strip())


def _numbers(content: str) -> list[float]:
    """The numbers in a text; YAML and OpenCV write NaN and infinity as ``.nan`` and ``.inf``."""
    return [float(re.sub(r"\.(?=[a-zA-Z])", "", number)) for number in _NUMBER.findall(content)]


def _entry_from_yaml(text: str) -> _Entry:
    """The entry of a YAML file of OpenCV or ROS.

    Both are block maps whose values are scalars, lists or matrices with a ``data`` list: the value of a key is its line
    and the deeper lines below it. A general YAML reader is not needed.
    """
    if not re.search(r"^[ \t]*[\w\"']+[ \t]*:", text, re.MULTILINE):
        raise InputError(f"is not a camera file; expected {FORMATS}")

    def block(key: str, inside: str) -> str | None:
        match = re.search(rf"^([ \t]*)[\"']?{key}[\"']?[ \t]*:(.*(?:\n(?:\1[ \t]+|\1- ).*)*)", inside, re.MULTILINE)
        return match.group(2) if match else None

    def get(key: str) -> list[float] | None:
        value = block(key, text)
        if value is None:
            return None
        data = block("data", value)
        if data is None and (flow := re.search(r"\bdata\s*:\s*(\[[^\]]*\])", value)):
            data = flow.group(1)
        return _numbers(re.sub(r"#.*", "", value if data is None else data))

    model = next((value for key in MODEL_KEYS if (value := block(key, text)) is not None), "")
    return _entry(get, model.strip().strip("\"'"))


# --- COLMAP --------------------------------------------------------------------------------------------

# Indices of fx, fy, cx, cy and of k1, k2, p1, p2, then k3 … k6, in the parameters of each model.
_COLMAP_MODELS: dict[str, tuple[tuple[int, ...], tuple[int, ...]]] = {
    "SIMPLE_PINHOLE": ((0, 0, 1, 2), ()),
    "PINHOLE": ((0, 1, 2, 3), ()),
    "SIMPLE_RADIAL": ((0, 0, 1, 2), (3,)),
    "RADIAL": ((0, 0, 1, 2), (3, 4)),
    "OPENCV": ((0, 1, 2, 3), (4, 5, 6, 7)),
    "FULL_OPENCV": ((0, 1, 2, 3), (4, 5, 6, 7, 8, 9, 10, 11)),
}
_COLMAP_LINE = re.compile(r"^\d+\s+[A-Z][A-Z_0-9]+\s+\d+\s+\d+\s")


def _data_lines(text: str) -> list[str]:
    return [line.strip() for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]


def _is_colmap(text: str) -> bool:
    lines = _data_lines(text)
    return bool(lines) and _COLMAP_LINE.match(lines[0]) is not None


def _entries_from_colmap(text: str) -> list[_Entry]:
    return [_entry_from_colmap(line) for line in _data_lines(text)]


def _entry_from_colmap(line: str) -> _Entry:
    fields = line.split()
    label, model = f"camera {fields[0]}", fields[1] if len(fields) > 1 else ""
    if model not in _COLMAP_MODELS:
        raise InputError(f"{label}: lens model {model} is not supported; use one of {', '.join(_COLMAP_MODELS)}")
    try:
        width, height = int(fields[2]), int(fields[3])
        params = [float(value) for value in fields[4:]]
    except (ValueError, IndexError) as error:
        raise InputError(f"{label}: '{line[:60]}' is not ID MODEL WIDTH HEIGHT PARAMS; export it again") from error
    places, dist_places = _COLMAP_MODELS[model]
    expected = max(*places, *dist_places) + 1
    if len(params) != expected:
        raise InputError(f"{label}: {model} needs {expected} parameters, the file gives {len(params)}")
    fx, fy, cx, cy = (params[place] for place in places)
    dist = _padded_dist([params[place] for place in dist_places])
    return _Entry(fx, fy, cx - COLMAP_HALF_PX, cy - COLMAP_HALF_PX, dist, width, height, label)


# --- EXIF ----------------------------------------------------------------------------------------------


def _camera_from_exif(source: str | Path | None, width: int | None, height: int | None) -> Camera:
    """The camera of photos by the focal length in the EXIF data of the first one."""
    if source is None:
        raise InputError("camera 'exif': no photo to read it from; give a photo, a folder or a glob of photos")
    photo = _first_photo(Path(source))
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


def _first_photo(source: Path) -> Path:
    if source.is_file():
        candidates = [source]
    elif source.is_dir():
        candidates = sorted(source.iterdir())
    else:
        candidates = sorted(source.parent.glob(source.name)) if source.parent.is_dir() else []
    photos = [path for path in candidates if path.suffix.lower() in PHOTO_SUFFIXES | HEIF_SUFFIXES]
    if not photos:
        raise InputError(
            f"{source}: no photo with EXIF data there (a video holds no focal length); give a camera file or fov:DEG"
        )
    return photos[0]
