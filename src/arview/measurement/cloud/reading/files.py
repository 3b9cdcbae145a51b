"""Reading a cloud by its format: PLY by NumPy, PCD by Open3D, LAS and LAZ by laspy, E57 by pye57, text by `text`.

Meshes are read as CAD is, and their faces sampled: decimated ones have few vertices, most of them on edges.

Headers are checked against the size of the file first, so that a damaged one cannot make a library allocate memory
without end.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from arview.cad import face_areas, load_model, sample_surface
from arview.core.extras import load, require
from arview.errors import ArviewError, InputError
from arview.measurement.cloud.open3d_library import load_open3d
from arview.measurement.cloud.reading.ptx import read_ptx
from arview.measurement.cloud.reading.raw_points import PointCollector, RawPoints, check_count
from arview.measurement.cloud.reading.text import BLOCK_BYTES, read_text

MAX_HEADER_BYTES = 65_536
"""Length of the header of a PLY or PCD file."""
CHUNK_POINTS = 2_000_000
"""Points of a LAS file that are decoded at a time."""
MESH_POINTS = 400_000
"""Points at which the faces of a mesh are sampled; one with more vertices is as dense as a cloud, and taken as one."""

_TYPES = {
    **{name: name for name in ("int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "uint64")},
    "char": "int8",
    "uchar": "uint8",
    "short": "int16",
    "ushort": "uint16",
    "int": "int32",
    "uint": "uint32",
    "float": "float32",
    "float32": "float32",
    "double": "float64",
    "float64": "float64",
}
"""NumPy's types by the names of the types of PLY properties."""
_BYTE_ORDERS: dict[str, Literal["=", "<", ">"]] = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}


def read_points(path: str | Path) -> RawPoints:
    """Read a cloud in its own unit.

    Args:
        path: PLY, PCD, XYZ, PTS, PTX, CSV, TXT, ASC, LAS, LAZ, E57, STL or OBJ; known by its first bytes,
            else by its suffix.

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
    """The vertices of a PLY file, which must be its first element, or samples of its faces."""
    header = _header(path, b"end_header")
    kind, count, has_faces, elements, types = "", 0, False, [""], {}
    for words in (line.split() for line in header.splitlines()):
        if words[:1] == ["format"] and len(words) > 1:
            kind = words[1]
        elif words[:1] == ["element"] and len(words) == 3:
            elements.append(words[1])
            count = _integer(path, words[2]) if words[1] == "vertex" else count
            has_faces |= words[1] == "face" and _integer(path, words[2]) > 0
        elif words[:1] == ["property"] and elements[-1] == "vertex":
            if len(words) != 3 or words[1] not in _TYPES or words[2] in types:
                raise InputError(f"{path}: is not a PLY file with points (property {' '.join(words[1:])!r})")
            types[words[2]] = _TYPES[words[1]]
    if elements[1:2] != ["vertex"] or not set("xyz") <= set(types) or kind not in _BYTE_ORDERS:
        raise InputError(f"{path}: is not a PLY file with points")
    record = np.dtype(list(types.items())).newbyteorder(_BYTE_ORDERS[kind])
    _check_size(path, count, len(header), 2 * len(types) if kind == "ascii" else record.itemsize)
    if has_faces and count < MESH_POINTS:
        return _read_mesh(path)
    columns: Any = np.zeros(count, dtype=record)
    if kind != "ascii":
        columns = np.fromfile(path, dtype=record, count=count, offset=len(header))
    elif count:
        with path.open("rb") as file:
            file.seek(len(header))
            try:
                values = np.loadtxt(file, max_rows=count, ndmin=2, comments=None, encoding="latin-1")
            except ValueError as error:
                raise InputError(f"{path}: is truncated or damaged ({str(error).split(';')[0]})") from error
        if values.shape != (count, len(types)):
            raise InputError(f"{path}: is truncated: its header names {count} points, and it has {len(values)} lines")
        columns = {name: values[:, index].astype(types[name]) for index, name in enumerate(types)}
    normal = ("nx", "ny", "nz")
    normals = np.stack([columns[name] for name in normal], axis=1) if set(normal) <= set(types) else None
    collector = PointCollector(path)
    collector.add(np.stack([columns[axis] for axis in "xyz"], axis=1), normals)
    return collector.result()


def _read_mesh(path: Path) -> RawPoints:
    """Samples of the triangles of a mesh, evenly by area, with their normals."""
    try:
        model, factor = load_model(path, "mm"), 1.0
    except InputError:  # small numbers are lengths in m
        model, factor = load_model(path, "m"), 1e-3
    areas = [face_areas(one.vertices_in_model, one.faces.astype(np.int64)).sum() for one in model.components]
    spacing = float(np.sqrt(sum(areas) / MESH_POINTS))
    collector = PointCollector(path)
    for one in model.components:
        samples = sample_surface(one, spacing, MESH_POINTS)
        collector.add(factor * samples.points, samples.normals)
    raw = collector.result()
    return replace(raw, notes=(*raw.notes, f"the faces of the mesh were sampled at {len(raw)} points"))


def _check_size(path: Path, count: int, header_bytes: int, least: int) -> None:
    """Raise InputError for too many points, or a file that is too short for those that its header names."""
    check_count(path, count)
    size = path.stat().st_size - header_bytes
    if count * least > size:
        raise InputError(f"{path}: is truncated: its header names {count} points, {size} bytes follow")


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
    _check_size(path, count, len(header), least)
    if kind == "ascii":  # Open3D would fill up with zeros
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
        raise InputError(f"{path}: is not a PCD file with points ({reason})") from error
    if len(points) != count:
        raise InputError(f"{path}: is truncated: its header names {count} points, {len(points)} could be read")
    collector = PointCollector(path)
    collector.add(points, normals)
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
        collector, file = PointCollector(path), pye57.E57(str(path))
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
    ".ptx": read_ptx,
    **dict.fromkeys((".stl", ".obj"), _read_mesh),
}
"""Readers by suffix."""
SUFFIXES = tuple(READERS)
