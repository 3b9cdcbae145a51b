"""Clouds as text: XYZ, PTS, CSV and their relatives, with any separator, decimal point or comma.

Blocks of lines are parsed at once. A block in which a line has another number of fields is parsed line by line, so that
a few damaged lines are left out and counted, and a file full of them is refused.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from arview.errors import InputError
from arview.geometry import Array
from arview.measurement.cloud.reading.raw_points import PointCollector, RawPoints

MAX_COLUMNS = 64
"""Numbers in a line of a text file."""
MAX_HEADER_LINES = 200
"""Lines before the first point of a text file."""
MAX_BAD_SHARE = 0.01
"""Share of lines of a text file that may be unreadable."""
MIN_BAD_LINES = 10
"""Unreadable lines that are tolerated in any text file."""
BLOCK_BYTES = 16_000_000
"""Part of a text file that is parsed at a time."""

_SNIFFED_BYTES = 65_536
"""Beginning of a file from which its layout is found."""
_MAX_LINE = 4096
"""Longest line of a text file."""
_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?|[-+]?(nan|inf)", re.IGNORECASE)
_UNIT = re.compile(r"[\[(]\s*(mm|cm|m|inch|in|ft)\s*[\])]", re.IGNORECASE)

Triple = tuple[int, int, int]
"""Columns of x, y and z."""
_MEASURED = ("act", "ist", "mea", "mess", "gemess", "scan", "real")
"""Beginnings of words that name measured places beside the axis, as in ActX or Ist Y."""
_NOMINAL = ("nom", "soll", "nenn", "ref", "cad", "theo", "target", "design", "master")
"""Beginnings of words that name nominal places."""
_DIFFERENCES = ("d", "abw", "err", "res", "tol", "u", "sig", "std", "v")
"""Beginnings of words that name differences and uncertainties, no places."""
_ASKED = "name the measured columns ActX, ActY, ActZ in a header line, or leave the others out"


@dataclass(frozen=True)
class _Layout:
    """How the lines of a file are to be read.

    Attributes:
        table: (256,) translation of bytes that makes every separator a space and every decimal mark a point.
        columns: number of fields of a line.
        point: columns of x y z.
        normal: columns of the normal, or None.
        skipped: number of lines before the first point.
        unit: declared in the header, or None.
        declared: number of points that the header names, as PTS files do; 0 without one.
    """

    table: bytes
    columns: int
    point: Triple
    normal: Triple | None
    skipped: int
    unit: str | None
    declared: int = 0


def read_text(path: Path) -> RawPoints:
    """Read the points of a text file.

    Raises:
        InputError: the file cannot be read, is not text, has no columns of coordinates, several of which none is said
            to be measured, too many damaged lines, or fewer lines than its header names.
    """
    try:
        with path.open("rb") as file:
            start = file.read(_SNIFFED_BYTES)
            if start[:2] in (b"\xff\xfe", b"\xfe\xff"):
                raise InputError(f"{path}: is UTF-16; save it as UTF-8")
            if b"\0" in start:
                raise InputError(f"{path}: is not a text file")
            layout = _layout(path, start.removeprefix(b"\xef\xbb\xbf"))
            file.seek(3 if start[:3] == b"\xef\xbb\xbf" else 0)
            return _read(path, file, layout)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error


def _read(path: Path, file: BinaryIO, layout: _Layout) -> RawPoints:
    """All points of an open file."""
    collector = PointCollector(path)
    lines = bad = 0
    first_bad = ""
    for block in _blocks(path, file, layout):
        values = _parse_block(block, layout.columns)
        if values is None:
            values, wrong, text = _parse_lines(block, layout.columns)
            first_bad = first_bad or text
            bad += wrong
            lines += wrong
        lines += len(values)
        if bad > max(MIN_BAD_LINES, MAX_BAD_SHARE * lines):
            raise InputError(
                f"{path}: {bad} of its first {lines} lines do not hold {layout.columns} numbers, as {first_bad!r}"
            )
        normals = None if layout.normal is None else values[:, layout.normal]
        collector.add(values[:, layout.point], normals)
    if lines < layout.declared:
        raise InputError(f"{path}: is truncated: its header names {layout.declared} points, and it has {lines} lines")
    return collector.result(layout.unit, (f"{bad} unreadable lines were left out",) if bad else ())


def _blocks(path: Path, file: BinaryIO, layout: _Layout) -> Iterator[bytes]:
    """The lines after the header in blocks, with spaces as separators and decimal points."""
    for _ in range(layout.skipped):
        file.readline(_MAX_LINE)
    rest = b""
    while read := file.read(BLOCK_BYTES):
        block = rest + read
        end = block.rfind(b"\n") + 1 or block.rfind(b"\r") + 1
        rest = block[end:]
        if len(rest) > _MAX_LINE:
            raise InputError(f"{path}: has a line of more than {_MAX_LINE} characters; it is not a cloud")
        yield block[:end].translate(layout.table)
    yield rest.translate(layout.table)  # the last line


def _parse_block(block: bytes, columns: int) -> Array | None:
    """(N,columns) numbers of a block, or None if a line does not have as many."""
    if not block.strip():
        return np.zeros((0, columns))
    try:
        values = np.loadtxt(io.BytesIO(block), comments=None, ndmin=2, encoding="latin-1")
    except ValueError:
        return None
    return values if values.shape[1] == columns else None


def _parse_lines(block: bytes, columns: int) -> tuple[Array, int, str]:
    """Numbers of the sound lines, number of the others, and the text of the first of them."""
    rows, bad, text = [], 0, ""
    for line in block.decode("latin-1").splitlines():
        fields = line.split()
        if not fields:
            continue
        try:
            row = [float(field) for field in fields]
        except ValueError:
            row = []
        if len(row) == columns:
            rows.append(row)
        else:
            bad += 1
            text = text or line[:60].strip()
    return np.array(rows, dtype=np.float64).reshape(-1, columns), bad, text


def _layout(path: Path, start: bytes) -> _Layout:
    """Separators, columns and header of a file from its first lines."""
    text = start.decode("latin-1")
    lines = re.split(r"\r\n|\n|\r", text)
    lines = lines[:-1] if len(start) >= _SNIFFED_BYTES else lines
    header: list[str] = []
    for index, line in enumerate(lines[:MAX_HEADER_LINES]):
        rows = [row for row in lines[index : index + 40] if row.strip()]
        marks = _marks(rows)
        if len(_numbers(line, marks)) >= 3:
            break
        header.append(line)
    else:
        raise InputError(f"{path}: no line with three numbers was found in its first {len(header) or 1} lines")
    rows_of = [_numbers(row, marks) for row in rows]
    columns = len(rows_of[0])
    if columns > MAX_COLUMNS:
        raise InputError(f"{path}: {columns} numbers in a line; at most {MAX_COLUMNS} are read")
    table = bytearray(range(256))
    for mark in ";\t|\r":
        table[ord(mark)] = ord("\n") if mark == "\r" else 32
    table[ord(",")] = ord(".") if "," in marks else 32
    if "\r\n" in text or "\r" not in text:
        table[13] = 32
    values = np.array([row for row in rows_of if len(row) == columns])
    names = next(filter(None, (_names(line, columns) for line in reversed(header))), [])
    point, normal = _columns_by_name(path, names, values)
    if normal is None and not names:
        normal = _columns_of_normals(values)
    if point is None:
        _check_one_place(path, values)
    found = next((_UNIT.search(line) for line in reversed(header) if _UNIT.search(line)), None)
    unit = None if found is None else {"in": "inch"}.get(found[1].lower(), found[1].lower())
    words = " ".join(header).split() if path.suffix.lower() == ".pts" else []
    declared = int(words[0]) if len(words) == 1 and words[0].isdecimal() else 0
    return _Layout(bytes(table), columns, point or (0, 1, 2), normal, len(header), unit, declared)


def _marks(rows: list[str]) -> str:
    """The decimal comma, if lines have one, else nothing."""
    joined = "\n".join(rows)
    if "," not in joined:
        return ""
    if ";" in joined or "\t" in joined:
        return ","
    fields = [row.split() for row in rows]
    is_decimal = all(len(row) >= 3 and all(re.fullmatch(r"[-+]?\d+(,\d+)?", f) for f in row) for row in fields)
    return "," if is_decimal else ""


def _numbers(line: str, marks: str) -> list[float]:
    """Numbers of a line, or none if a field is not a number."""
    separators = r"[;\s|]+" if "," in marks else r"[,;\s|]+"
    fields = [f.replace(",", ".") for f in re.split(separators, line.strip()) if f]
    return [float(f) for f in fields] if fields and all(_NUMBER.fullmatch(f) for f in fields) else []


def _names(line: str, columns: int) -> list[str]:
    """Names of columns in a header line, lower case and without units; none where it holds fewer than three.

    Names may have spaces where other marks part them.
    """
    line = re.sub(r"[\[(][^\])]*[\])]", "", line.strip().lstrip("#/ "))
    parted = [name.strip(" \"'").lower() for name in re.split(r"[,;\t|]", line)]
    if len(parted) != columns:
        parted = [name.strip(" \"'").lower() for name in re.split(r"[,;\t|]|\s+", line) if name.strip(" \"'")]
    return parted if len([name for name in parted if name not in ("", "mm", "m", "inch")]) >= 3 else []


def _columns_by_name(path: Path, names: list[str], values: Array) -> tuple[Triple | None, Triple | None]:
    """Columns of the measured x y z and of the normal by their names; None where they name no such three.

    Raises:
        InputError: there are several places for each point, or only nominal ones, and no name says which is measured.
    """
    sets: dict[str, list[int]] = {}
    for index, name in enumerate(names[: values.shape[1]]):
        found = re.fullmatch(r"([xyz])(.*)|(.*?)([xyz])", re.sub(r"[^a-zäöüß0-9]+", "", name))
        if found is not None:
            places = sets.setdefault((found[2] or found[3] or ""), [-1] * 3)
            axis = "xyz".index(found[1] or found[4])
            if places[axis] >= 0:
                raise InputError(f"{path}: the column {name!r} is there twice; {_ASKED}")
            places[axis] = index
    triples = {word: (p[0], p[1], p[2]) for word, p in sets.items() if min(p) >= 0}
    normals = [word for word in ("n", "normal") if word in triples]
    normals = [word for word in normals if np.linalg.norm(values[:, triples[word]], axis=1).max() < 1.1]
    normal = next((triples.pop(word) for word in normals), None)
    nominal = [word for word in triples if word == "n" or word.startswith(_NOMINAL)]
    chosen = [word for word in triples if word.startswith(_MEASURED)] or [word for word in triples if word == ""]
    if not chosen:
        chosen = [word for word in triples if word not in nominal and not word.startswith(_DIFFERENCES)]
    if len(chosen) > 1 or (nominal and chosen and not (chosen[0].startswith(_MEASURED) or chosen == [""])):
        words = ", ".join(names[index] for word in triples for index in triples[word])
        raise InputError(f"{path}: has several places for each point ({words}); {_ASKED}")
    if nominal and not chosen:
        words = ", ".join(names[index] for index in triples[nominal[0]])
        raise InputError(f"{path}: only the nominal places {words} are named; {_ASKED}")
    return (triples[chosen[0]] if chosen else None), normal


def _check_one_place(path: Path, values: Array) -> None:
    """Raise InputError where unnamed columns hold each point twice, as nominal beside measured places do."""
    for first in range(values.shape[1] - 5):
        one = values[:, first : first + 3]
        size = float(np.sqrt(np.mean((one - one.mean(axis=0)) ** 2)))
        for second in range(first + 3, values.shape[1] - 2):
            apart = values[:, second : second + 3] - one
            scatter = float(np.sqrt(np.mean((apart - apart.mean(axis=0)) ** 2)))
            if len(values) > 3 and scatter < 0.2 * size and np.abs(apart.mean(axis=0)).max() < size:
                raise InputError(
                    f"{path}: columns {first + 1} to {first + 3} and {second + 1} to {second + 3} both hold the places"
                    f" of points; {_ASKED}"
                )


def _columns_of_normals(values: NDArray[np.float64]) -> tuple[int, int, int] | None:
    """Three columns after the first three whose rows have unit length, or None."""
    for start in range(3, values.shape[1] - 2):
        length = np.linalg.norm(values[:, start : start + 3], axis=1)
        if np.abs(length - 1.0).max() < 0.02:
            return start, start + 1, start + 2
    return None
