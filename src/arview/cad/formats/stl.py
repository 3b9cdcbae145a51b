"""Reader of STL, binary and text: one component, or one for each solid of a text file that holds several."""

from __future__ import annotations

import re
from array import array
from pathlib import Path

import numpy as np

from arview.cad.formats.raw import RawComponent, RawModel, check_triangle_count
from arview.cad.formats.text_encoding import decode_text, text_encoding, with_decimal_points
from arview.errors import InputError
from arview.geometry import Array

_HEADER, _RECORD = 84, 50
_RECORD_TYPE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_SOLID = re.compile(rb"^[ \t]*solid\b([^\r\n]*)", re.MULTILINE | re.IGNORECASE)
_END = re.compile(rb"\bendsolid\b", re.IGNORECASE)
_FACET, _END_FACET = re.compile(rb"\bfacet\b", re.IGNORECASE), re.compile(rb"\bendfacet\b", re.IGNORECASE)
_LOOP = re.compile(rb"\bouter\s+loop\b(.*?)\bendloop\b", re.IGNORECASE | re.DOTALL)
_VERTEX = re.compile(rb"\bvertex\s+(\S+)\s+(\S+)\s+(\S+)", re.IGNORECASE)


def read_stl(path: Path) -> RawModel:
    """Triangles of an STL file, in no unit.

    A file is binary when its number of triangles fits its size, whatever its first word is: many programs begin binary
    files with ``solid``.

    Raises:
        InputError: truncated, broken, or more triangles than are read.
    """
    data = path.read_bytes()
    count = int.from_bytes(data[80:_HEADER], "little") if len(data) >= _HEADER else -1
    needed = _HEADER + _RECORD * count
    if len(data) == needed:
        return _binary(data, count, path)
    if data[:512].lstrip()[:5].lower() == b"solid" and (_FACET.search(data) or _END.search(data)):
        return _text(data, path)
    if count > 0 and needed < len(data) and not any(data[needed:]):
        return _binary(data, count, path)  # padded
    what = f"{len(data)} of {needed} bytes are there" if len(data) < needed else f"{len(data)} bytes, not {needed}"
    if count < 0:
        what = f"{len(data)} bytes are no STL"
    raise InputError(f"{path}: broken or truncated STL ({what}); export it again")


def _binary(data: bytes, count: int, path: Path) -> RawModel:
    check_triangle_count(count, path)
    corners = np.frombuffer(data, dtype=_RECORD_TYPE, count=count, offset=_HEADER)["corners"]
    raw = RawModel()
    if count:
        faces = np.arange(3 * count, dtype=np.int64).reshape(-1, 3)
        raw.add(RawComponent((), corners.reshape(-1, 3).astype(np.float64), faces), path)
    return raw


def _text(data: bytes, path: Path) -> RawModel:
    data, notes = with_decimal_points(data, rb"vertex\b")
    facets, ends = (sum(1 for _ in pattern.finditer(data)) for pattern in (_FACET, _END_FACET))
    check_triangle_count(facets, path)
    solids = list(_SOLID.finditer(data))
    last_end = max((end.start() for end in _END.finditer(data)), default=-1)
    if facets != ends or last_end < solids[-1].start():
        raise InputError(f"{path}: broken or truncated STL (its last solid or facet does not end); export it again")
    names = [solid[1].strip() for solid in solids]
    encoding = text_encoding(b"\n".join(names))
    bounds = [*(solid.start() for solid in solids), len(data)]
    meshes = [_corners(data, solid.end(), end, path) for solid, end in zip(solids, bounds[1:], strict=True)]
    found = [(decode_text(name, encoding), mesh) for name, mesh in zip(names, meshes, strict=True) if len(mesh)]
    raw = RawModel(notes=notes)
    for name, corners in found:
        faces = np.arange(len(corners), dtype=np.int64).reshape(-1, 3)
        raw.add(RawComponent((name,) if name and len(found) > 1 else (), corners, faces), path)
    return raw


def _corners(data: bytes, start: int, end: int, path: Path) -> Array:
    """(3F,3) corners of the triangles between two places of a text file."""
    # An array of numbers, because a list of words would take ten times the memory.
    numbers, facets = array("d"), 0
    for loop in _LOOP.finditer(data, start, end):
        corners = _VERTEX.findall(loop[1])
        if len(corners) != 3:
            raise InputError(f"{path}: broken STL (a facet has {len(corners)} corners, expected 3); export it again")
        try:
            numbers.extend(float(word) for corner in corners for word in corner)
        except ValueError as error:
            line = loop[1].decode("latin-1").split()
            raise InputError(f"{path}: broken STL (no numbers: {' '.join(line)[:60]!r}); export it again") from error
        facets += 1
    if facets != sum(1 for _ in _END_FACET.finditer(data, start, end)):
        raise InputError(f"{path}: broken STL (a facet has no loop, or several); export it again")
    return np.frombuffer(numbers, dtype=np.float64).reshape(-1, 3) if numbers else np.zeros((0, 3))
