"""Cameras of COLMAP's ``cameras.txt`` and ``cameras.bin``."""

from __future__ import annotations

import re
import struct

from arview.camera.entry import CameraEntry
from arview.camera.lens import LensDistortion, LensModel
from arview.camera.model import COLMAP_HALF_PX
from arview.camera.terms import simplest
from arview.errors import InputError

# Indices of fx, fy, cx, cy and of the terms of the lens, in the parameters of each model.
_MODELS: dict[str, tuple[tuple[int, ...], tuple[int, ...], LensModel]] = {
    "SIMPLE_PINHOLE": ((0, 0, 1, 2), (), LensModel.RATIONAL),
    "PINHOLE": ((0, 1, 2, 3), (), LensModel.RATIONAL),
    "SIMPLE_RADIAL": ((0, 0, 1, 2), (3,), LensModel.RATIONAL),
    "RADIAL": ((0, 0, 1, 2), (3, 4), LensModel.RATIONAL),
    "OPENCV": ((0, 1, 2, 3), (4, 5, 6, 7), LensModel.RATIONAL),
    "FULL_OPENCV": ((0, 1, 2, 3), (4, 5, 6, 7, 8, 9, 10, 11), LensModel.RATIONAL),
    "SIMPLE_FISHEYE": ((0, 0, 1, 2), (), LensModel.FISHEYE),
    "FISHEYE": ((0, 1, 2, 3), (), LensModel.FISHEYE),
    "SIMPLE_RADIAL_FISHEYE": ((0, 0, 1, 2), (3,), LensModel.FISHEYE),
    "RADIAL_FISHEYE": ((0, 0, 1, 2), (3, 4), LensModel.FISHEYE),
    "OPENCV_FISHEYE": ((0, 1, 2, 3), (4, 5, 6, 7), LensModel.FISHEYE),
    "THIN_PRISM_FISHEYE": ((0, 1, 2, 3), (4, 5, 6, 7, 8, 9, 10, 11), LensModel.THIN_PRISM_FISHEYE),
    "FOV": ((0, 1, 2, 3), (4,), LensModel.FOV),
    "SIMPLE_DIVISION": ((0, 0, 1, 2), (3,), LensModel.DIVISION),
    "DIVISION": ((0, 1, 2, 3), (4,), LensModel.DIVISION),
}
_BINARY_MODELS = {
    0: ("SIMPLE_PINHOLE", 3),
    1: ("PINHOLE", 4),
    2: ("SIMPLE_RADIAL", 4),
    3: ("RADIAL", 5),
    4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8),
    6: ("FULL_OPENCV", 12),
    7: ("FOV", 5),
    8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5),
    10: ("THIN_PRISM_FISHEYE", 12),
    11: ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
}
"""Names and numbers of parameters of the models in a binary file."""
_MIN_CAMERA_BYTES = 48
_COLMAP_LINE = re.compile(r"^\d+\s+[A-Z][A-Z_0-9]+\s+\d+\s+\d+\s")


def is_colmap(text: str) -> bool:
    """Whether the first line with content is a camera of COLMAP."""
    lines = _data_lines(text)
    return bool(lines) and _COLMAP_LINE.match(lines[0]) is not None


def entries_from_colmap(text: str, name: str = "") -> list[CameraEntry]:
    """The cameras of a file; where one has the wanted name, its id, the others are not read.

    Raises:
        InputError: a line is not one of a camera, its model is not supported, or an id occurs twice.
    """
    lines = _data_lines(text)
    wanted = [line for line in lines if name and line.split()[0] == name]
    entries = [_entry(line) for line in wanted or lines]
    labels = [entry.label for entry in entries]
    twice = (
        next((label for label in labels if labels.count(label) > 1), None) if len(set(labels)) < len(labels) else None
    )
    if twice is not None:
        raise InputError(f"holds camera {twice} twice; keep one of them")
    return entries


def colmap_text_of_binary(data: bytes) -> str | None:
    """The text of a ``cameras.bin``, all of whose bytes are cameras; None for other data.

    A camera is its id, its model, width and height, and the parameters of the model.
    """
    if len(data) < 8:
        return None
    (count,) = struct.unpack_from("<Q", data)
    lines, start = [], 8
    for _ in range(min(count, len(data) // _MIN_CAMERA_BYTES)):
        if start + 24 > len(data):
            return None
        number, model, width, height = struct.unpack_from("<iiQQ", data, start)
        name, parameters = _BINARY_MODELS.get(model, ("", 0))
        start += 24 + 8 * parameters
        if not name or start > len(data):
            return None
        values = struct.unpack_from(f"<{parameters}d", data, start - 8 * parameters)
        lines.append(f"{number} {name} {width} {height} {' '.join(map(repr, values))}")
    return "\n".join(lines) if count == len(lines) and start == len(data) and lines else None


def _data_lines(text: str) -> list[str]:
    return [line.strip() for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]


def _entry(line: str) -> CameraEntry:
    fields = line.split()
    label, model = fields[0][:20], fields[1][:40] if len(fields) > 1 else ""
    if model not in _MODELS:
        raise InputError(f"camera {label}: lens model {model} is not supported; use one of {', '.join(_MODELS)}")
    try:
        width, height = int(fields[2]), int(fields[3])
        params = [float(value) for value in fields[4:]]
    except (ValueError, IndexError) as error:
        raise InputError(
            f"camera {label}: '{line[:60]}' is not ID MODEL WIDTH HEIGHT PARAMS; export it again"
        ) from error
    places, lens_places, kind = _MODELS[model]
    expected = max(*places, *lens_places) + 1
    if len(params) != expected:
        raise InputError(f"camera {label}: {model} needs {expected} parameters, the file gives {len(params)}")
    fx, fy, cx, cy = (params[place] for place in places)
    dist, lens = simplest(LensDistortion(kind, tuple(params[place] for place in lens_places)))
    return CameraEntry(
        fx,
        fy,
        cx - COLMAP_HALF_PX,
        cy=cy - COLMAP_HALF_PX,
        dist=dist,
        lens=lens,
        width=width,
        height=height,
        label=label,
    )
