"""Known scale bars, camera rigs and other sources of scale, from the command line or a file."""

from __future__ import annotations

import json
import re
import tomllib
from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from arview.errors import InputError
from arview.fiducials import DEFAULT_DICTIONARY, Board, Tags, dictionary_name, parse_board, parse_length_mm
from arview.geometry import Array, check_rigid

BAR_FORM = "ID1:ID2:LENGTH_MM or DICTIONARY:ID1:ID2:LENGTH_MM, e.g. 3:7:500.02"
_KEYS = ("board", "tag", "tag_layout", "scale_bar", "rig")
"""Tables of a scale file."""
MAX_COORDINATE_MM = 1e6
"""Corners farther from the origin are taken for a typing error."""
MAX_TAG_ID = 999_999_999
"""No dictionary has a tag of a larger id."""


@dataclass(frozen=True)
class ScaleBar:
    """The known distance between the centres of two tags.

    Attributes:
        dictionary: OpenCV's name of the marker dictionary.
        first, second: ids of the tags.
        length_mm: the distance.
        std_mm: its standard deviation.
    """

    dictionary: str
    first: int
    second: int
    length_mm: float
    std_mm: float = 0.02


@dataclass(frozen=True)
class TagLayout:
    """Tags whose corners are known in one frame.

    Attributes:
        dictionary: OpenCV's name of the marker dictionary.
        corners_mm: (4,3) corners of each tag, by its id; all tags list them in the same order around the tag.
        std_mm: standard deviation of the distance of the corners farthest from each other.
    """

    dictionary: str
    corners_mm: dict[int, Array]
    std_mm: float = 0.02


@dataclass(frozen=True)
class Rig:
    """What is known about the cameras.

    Attributes:
        centres_mm: (3,) camera centre of a photo, by its name.
        distances_mm: (photo, photo, mm) distances between camera centres.
    """

    centres_mm: dict[str, Array] = field(default_factory=dict)
    distances_mm: tuple[tuple[str, str, float], ...] = ()


@dataclass(frozen=True)
class ScaleSources:
    """Everything of known size that may be in view, and what is known about the cameras."""

    boards: tuple[Board, ...] = ()
    tags: tuple[Tags, ...] = ()
    bars: tuple[ScaleBar, ...] = ()
    rig: Rig | None = None
    layouts: tuple[TagLayout, ...] = ()

    def __post_init__(self) -> None:
        for board in self.boards:
            if not board.is_coded:
                raise InputError(
                    f"{board}: nothing tells its corners apart in several photos; for the scale give a ChArUco board, a"
                    " grid of markers or tags"
                )


def parse_scale_bar(text: str, default_dictionary: str = DEFAULT_DICTIONARY) -> ScaleBar:
    """The scale bar described on the command line, see BAR_FORM. Raises InputError."""
    match = re.fullmatch(r"(?:([A-Za-z][\w-]*|\d+x[\w-]+):)?(\d{1,9}):(\d{1,9}):([\d.]+)", text.strip())
    if not match:
        raise InputError(f"scale bar {text!r}: expected {BAR_FORM}")
    dictionary, first, second, length = match.groups()
    name = dictionary_name(dictionary) if dictionary else default_dictionary
    return _bar(text, name, int(first), int(second), parse_length_mm(text, length))


def load_rig(path: str | Path) -> Rig:
    """Read a rig from a JSON file.

    It holds any of ``{"centres_mm": {photo: [x, y, z]}}``, ``{"cam_from_rig_mm": {photo: 4×4}}`` and
    ``{"distances_mm": [[photo, photo, mm], …]}``.

    Raises:
        InputError: the file cannot be read, is not JSON, holds none of these, or a value is invalid.
    """
    path = Path(path)
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"cannot read rig {path}: {error.strerror or error}") from error
    except ValueError as error:
        raise InputError(f"rig {path}: is not JSON ({error})") from error
    return _rig(content, f"rig {path}")


def load_scale_file(path: str | Path) -> ScaleSources:
    """Read scale sources from a file with ``[[board]]``, ``[[tag]]``, ``[[tag_layout]]``, ``[[scale_bar]]``, ``[rig]``.

    A board has ``spec`` as on the command line; a tag ``dictionary``, ``side_mm`` and optionally ``ids``; a layout
    ``corners_mm`` (four corners x, y, z of each tag, by its id) and optionally ``dictionary`` and ``std_mm``; a bar
    ``ids`` (two), ``length_mm`` and optionally ``dictionary`` and ``std_mm``; the rig what `load_rig` reads. The file
    is TOML, or JSON of the same content if its name ends in .json.

    Raises:
        InputError: the file cannot be read, is not TOML or JSON, or a key or value is invalid.
    """
    path = Path(path)
    kind = "JSON" if path.suffix.lower() == ".json" else "TOML"
    try:
        text = path.read_bytes().decode("utf-8")
        content = json.loads(text) if kind == "JSON" else tomllib.loads(text)
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror or error}") from error
    except (ValueError, RecursionError) as error:  # of both formats, and of bytes that are no text
        raise InputError(f"{path}: not valid {kind}: {error}") from error
    if not isinstance(content, dict):
        raise InputError(f"{path}: expected an object with {', '.join(_KEYS)}")
    _only(content, _KEYS, f"{path}:")
    boards, tags, bars = [], [], []
    for entry in _entries(content, "board", ("spec",), (), path):
        boards.append(parse_board(str(entry["spec"])))
    for entry in _entries(content, "tag", ("dictionary", "side_mm"), ("ids",), path):
        ids = _tag_ids(f"{path}: [[tag]]", entry.get("ids", []))
        tags.append(Tags(dictionary_name(str(entry["dictionary"])), parse_length_mm(f"{path}", entry["side_mm"]), ids))
    for entry in _entries(content, "scale_bar", ("ids", "length_mm"), ("dictionary", "std_mm"), path):
        ids = _tag_ids(f"{path}: [[scale_bar]]", entry["ids"])
        if len(ids) != 2:
            raise InputError(f"{path}: [[scale_bar]] ids = {entry['ids']!r}: expected the ids of two tags")
        name = dictionary_name(str(entry.get("dictionary", DEFAULT_DICTIONARY)))
        std_mm = parse_length_mm(f"{path}", entry.get("std_mm", ScaleBar.std_mm))
        bars.append(_bar(f"{path}", name, ids[0], ids[1], parse_length_mm(f"{path}", entry["length_mm"]), std_mm))
    rig = _rig(content["rig"], f"{path}: [rig]") if "rig" in content else None
    layouts = tuple(
        _layout(entry, f"{path}: [[tag_layout]]")
        for entry in _entries(content, "tag_layout", ("corners_mm",), ("dictionary", "std_mm"), path)
    )
    return ScaleSources(tuple(boards), tuple(tags), tuple(bars), rig, layouts)


def _layout(entry: dict[str, Any], where: str) -> TagLayout:
    """A layout from a table of a file. Raises InputError."""
    listed = entry["corners_mm"]
    if not isinstance(listed, dict) or not listed:
        raise InputError(f"{where} corners_mm: expected four corners [x, y, z] for each id of a tag")
    corners: dict[int, Array] = {}
    for name, value in listed.items():
        if not re.fullmatch(r"\d{1,9}", name):
            raise InputError(f"{where} corners_mm: {name[:20]!r} is not the id of a tag")
        try:
            places = np.array(value, dtype=np.float64)
        except (TypeError, ValueError, OverflowError):
            places = np.zeros(0)
        if places.shape != (4, 3) or not np.abs(places).max() < MAX_COORDINATE_MM:  # also false for NaN
            raise InputError(f"{where} corners_mm: tag {name}: expected four corners [x, y, z] in mm")
        if min(np.linalg.norm(places[a] - places[b]) for a, b in combinations(range(4), 2)) == 0.0:
            raise InputError(f"{where} corners_mm: tag {name}: two of its corners are at the same place")
        corners[int(name)] = places
    std_mm = parse_length_mm(where, entry.get("std_mm", TagLayout.std_mm))
    return TagLayout(dictionary_name(str(entry.get("dictionary", DEFAULT_DICTIONARY))), corners, std_mm)


def _tag_ids(where: str, value: Any) -> tuple[int, ...]:
    """The ids of tags in a file. Raises InputError."""
    if not isinstance(value, list) or not all(type(one) is int and 0 <= one <= MAX_TAG_ID for one in value):
        raise InputError(f"{where} ids = {str(value)[:60]}: expected the ids of tags, whole numbers up to {MAX_TAG_ID}")
    return tuple(value)


def _bar(text: str, dictionary: str, first: int, second: int, length_mm: float, std_mm: float = 0.02) -> ScaleBar:
    """A checked scale bar. Raises InputError when both ends are the same tag."""
    if first == second:
        raise InputError(f"scale bar {text!r}: both ends are tag {first}")
    return ScaleBar(dictionary, first, second, length_mm, std_mm)


def _rig(content: Any, where: str) -> Rig:
    """A rig from the content of a file. Raises InputError."""
    if not isinstance(content, dict):
        raise InputError(f"{where}: expected an object")
    known = ("centres_mm", "cam_from_rig_mm", "distances_mm")
    if not any(key in content for key in known):
        raise InputError(f"{where}: expected one of {', '.join(known)}")
    try:
        centres = {str(k): np.array(v, dtype=np.float64).reshape(3) for k, v in content.get(known[0], {}).items()}
        for name, matrix in content.get(known[1], {}).items():
            pose = check_rigid(matrix, f"{where}: {known[1]} of {name}")
            centres[str(name)] = -pose[:3, :3].T @ pose[:3, 3]
        distances = tuple((str(a), str(b), float(mm)) for a, b, mm in content.get(known[2], ()))
    except (TypeError, ValueError, AttributeError, OverflowError) as error:
        raise InputError(f"{where}: a value is invalid ({error})") from error
    if not all(np.isfinite(c).all() for c in centres.values()) or not all(0 < d[2] < np.inf for d in distances):
        raise InputError(f"{where}: centres must be finite, distances positive")
    return Rig(centres, distances)


def _entries(
    content: dict[str, Any], key: str, needed: tuple[str, ...], optional: tuple[str, ...], path: Path
) -> list[dict[str, Any]]:
    """The tables of an array of tables, with known keys only. Raises InputError."""
    entries = content.get(key, [])
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise InputError(f"{path}: {key}: expected tables [[{key}]]")
    for entry in entries:
        _only(entry, needed + optional, f"{path}: [[{key}]]")
        for name in needed:
            if name not in entry:
                raise InputError(f"{path}: [[{key}]] the key {name!r} is missing")
    return entries


def _only(table: dict[str, Any], allowed: tuple[str, ...], where: str) -> None:
    """Check that a table has no unknown keys. Raises InputError."""
    for key in table:
        if key not in allowed:
            raise InputError(f"{where} unknown key {key!r}; allowed: {', '.join(allowed)}")
