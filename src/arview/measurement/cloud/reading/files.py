"""Reading a cloud by its format: PLY and PCD by Open3D, LAS and LAZ by laspy, E57 by pye57, text by `text`.

Headers are checked against the size of the file first, so that a damaged one cannot make a library allocate memory
without end.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from arview.core.extras import load, require
from arview.errors import ArviewError, InputError
from arview.measurement.cloud.open3d_library import load_open3d
from arview.measurement.cloud.reading.raw_points import PointCollector, RawPoints, check_count
from arview.measurement.cloud.reading.text import BLOCK_BYTES, read_text

MAX_HEADER_BYTES = 65_536
"""Length of the header of a PLY or PCD file."""
CHUNK_POINTS = 2_000_000
"""Points of a LAS file that are decoded at a time."""

_SIZES = {
    **dict.fromkeys(("char", "uchar", "int8", "uint8"), 1),
    **dict.fromkeys(("short", "ushort", "int16", "uint16"), 2),
    **dict.fromkeys(("int", "uint", "float", "int32", "uint32", "float32"), 4),
    **dict.fromkeys(("double", "float64", "int64", "uint64"), 8),
}
"""Bytes of the types of PLY properties."""


def read_points(path: str | Path) -> RawPoints:
    """Read a cloud in its own unit.

    Args:
        path: PLY, PCD, XYZ, PTS, CSV, TXT, ASC, LAS, LAZ or E57; known by its first bytes, else by its suffix.

    Raises:
        InputError: the file cannot be read, is of another format, is damaged, or holds no points.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such file; give a cloud ({', '.join(SUFFIXES)})")
    try:
        with path.open("rb") as file:
            start = file.read(16)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
    if not start:
        raise InputError(f"{path}: is empty")
    by_suffix = READERS.get(path.suffix.lower())
    read = next((read for signature, read in SIGNATURES.items() if start.startswith(signature)), by_suffix)
    if read is None:
        raise InputError(f"{path}: is no known format of a cloud; expected {', '.join(SUFFIXES)}")
    if read is by_suffix and read in SIGNATURES.values() and not start.startswith(tuple(SIGNATURES)):
        raise InputError(f"{path}: is not a {path.suffix[1:].upper()} file with points")
    return read(path)


def _read_ply(path: Path) -> RawPoints:
    """A PLY file by Open3D, after its header was checked."""
    header = _header(path, b"end_header")
    size = path.stat().st_size - len(header)
    kind, count, element, record, names = "", -1, "", 0, []
    for words in (line.split() for line in header.splitlines()):
        if words[:1] == ["format"] and len(words) > 1:
            kind = words[1]
        elif words[:1] == ["element"] and len(words) == 3:
            element = words[1]
            count = _integer(path, words[2]) if element == "vertex" else count
        elif words[:1] == ["property"] and element == "vertex":
            if len(words) != 3 or words[1] not in _SIZES:
                raise InputError(f"{path}: is not a PLY file with points (property {' '.join(words[1:])!r})")
            record += _SIZES[words[1]]
            names.append(words[2])
    if count < 0 or not {"x", "y", "z"} <= set(names) or not kind:
        raise InputError(f"{path}: is not a PLY file with points")
    return _by_open3d(path, count, size, 2 * len(names) if kind == "ascii" else record, kind == "ascii")


def _read_pcd(path: Path) -> RawPoints:
    """A PCD file by Open3D, after its header was checked."""
    header = _header(path, b"DATA ")
    fields = {words[0].upper(): words[1:] for words in map(str.split, header.splitlines()) if words}
    if "FIELDS" not in fields or not {"x", "y", "z"} <= set(fields["FIELDS"]):
        raise InputError(f"{path}: is not a PCD file with the fields x y z")
    count = _integer(path, (fields.get("POINTS") or [""])[0])
    sizes = [_integer(path, word) for word in fields.get("SIZE", [])]
    repeats = [_integer(path, word) for word in fields.get("COUNT", ["1"] * len(sizes))]
    if len(sizes) != len(fields["FIELDS"]) or len(repeats) != len(sizes):
        raise InputError(f"{path}: its PCD header is damaged")
    kind, size = (fields.get("DATA") or [""])[0], path.stat().st_size - len(header)
    record = sum(a * b for a, b in zip(sizes, repeats, strict=True))
    least = {"ascii": 2 * sum(repeats), "binary": record}.get(kind, 0)
    if kind == "binary_compressed":
        with path.open("rb") as file:
            file.seek(len(header))
            packed, whole = (int(v) for v in np.frombuffer(file.read(8).ljust(8, b"\0"), dtype="<u4"))
        if whole != count * record or packed > size:
            raise InputError(f"{path}: is truncated or damaged")
    elif kind not in ("ascii", "binary"):
        raise InputError(f"{path}: PCD data {kind!r}, expected ascii, binary or binary_compressed")
    return _by_open3d(path, count, size, least, kind == "ascii")


def _by_open3d(path: Path, count: int, size: int, least: int, is_text: bool) -> RawPoints:
    """Points and normals of a PLY or PCD file as Open3D reads them.

    Args:
        path: of the file.
        count: number of points that its header names.
        size: bytes after the header.
        least: fewest bytes of a point.
        is_text: whether each point is a line; of missing lines Open3D would make zeros.
    """
    check_count(path, count)
    if count * least > size:
        raise InputError(f"{path}: is truncated: its header names {count} points, {size} bytes follow")
    if is_text:
        with path.open("rb") as file:
            lines = sum(block.count(b"\n") for block in iter(lambda: file.read(BLOCK_BYTES), b""))
        if lines < count:
            raise InputError(f"{path}: is truncated: its header names {count} points, and it has {lines} lines")
    o3d = load_open3d()
    try:
        with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
            cloud = o3d.t.io.read_point_cloud(str(path), format="auto", remove_nan_points=False)
        points = cloud.point.positions.numpy()
        normals = cloud.point.normals.numpy() if "normals" in cloud.point else None
    except Exception as error:  # a damaged file may make the reader raise anything
        reason = str(error).split("\n")[0].split("): ")[-1][:200]
        raise InputError(f"{path}: is not a {path.suffix[1:].upper()} file with points ({reason})") from error
    if len(points) != count:
        raise InputError(f"{path}: is truncated: its header names {count} points, {len(points)} could be read")
    collector = PointCollector(path)
    for start in range(0, len(points), CHUNK_POINTS):
        part = slice(start, start + CHUNK_POINTS)
        collector.add(points[part], None if normals is None else normals[part])
    del cloud, points, normals
    return collector.result()


def _read_las(path: Path) -> RawPoints:
    """A LAS or LAZ file by laspy."""
    with _library("laspy", "lazrs", path=path, kind="LAS") as (laspy, _):
        with laspy.open(path) as reader:
            check_count(path, int(reader.header.point_count))
            collector = PointCollector(path)
            for points in reader.chunk_iterator(CHUNK_POINTS):
                collector.add(np.stack([np.asarray(points.x), np.asarray(points.y), np.asarray(points.z)], axis=1))
        return collector.result()


def _read_e57(path: Path) -> RawPoints:
    """All scans of an E57 file by pye57, in their common frame."""
    with _library("pye57", path=path, kind="E57") as (pye57,):
        collector = PointCollector(path)
        file = pye57.E57(str(path))
        try:
            count = sum(int(file.get_header(index).point_count) for index in range(file.scan_count))
            check_count(path, count)
            if count > 8 * path.stat().st_size:
                raise InputError(f"{path}: is truncated: its header names {count} points")
            for index in range(file.scan_count):
                scan = file.read_scan(index, ignore_missing_fields=True)
                collector.add(np.stack([scan[f"cartesian{axis}"] for axis in "XYZ"], axis=1))
        finally:
            file.close()
        return collector.result()


@contextmanager
def _library(*names: str, path: Path, kind: str) -> Iterator[tuple[Any, ...]]:
    """Libraries by name; whatever they raise becomes an InputError about the file."""
    purpose = f"{path}: reading {kind}"
    require(purpose, *names)
    try:
        yield tuple(load(purpose, name) for name in names)
    except ArviewError:
        raise
    except Exception as error:  # a damaged file may make the reader raise anything
        reason = str(error).split("\n")[0][:200]
        raise InputError(f"{path}: is not a {kind} file with points, or damaged ({reason})") from error


def _header(path: Path, last: bytes) -> str:
    """Text up to the line that begins with ``last``. Raises InputError when there is none."""
    try:
        with path.open("rb") as file:
            start = file.read(MAX_HEADER_BYTES)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
    place = start.find(b"\n" + last)
    end = start.find(b"\n", place + 1) if place >= 0 else -1
    if place < 0 or end < 0:
        raise InputError(f"{path}: is not a {path.suffix[1:].upper()} file with points")
    return start[: end + 1].decode("latin-1")


def _integer(path: Path, word: str) -> int:
    """A number of a header. Raises InputError."""
    if not word.isdecimal() or len(word) > 12:
        raise InputError(f"{path}: its header is damaged ({word[:30]!r} is no number of points)")
    return int(word)


SIGNATURES: dict[bytes, Callable[[Path], RawPoints]] = {b"ply": _read_ply, b"LASF": _read_las, b"ASTM-E57": _read_e57}
"""Readers by the first bytes of a file, which decide before its suffix does."""
READERS: dict[str, Callable[[Path], RawPoints]] = {
    ".ply": _read_ply,
    ".pcd": _read_pcd,
    **dict.fromkeys((".xyz", ".pts", ".csv", ".txt", ".asc"), read_text),
    **dict.fromkeys((".las", ".laz"), _read_las),
    ".e57": _read_e57,
}
"""Readers by suffix."""
SUFFIXES = tuple(READERS)
