"""Tables as spreadsheets and coordinate measuring machines write them: `,`, `;` or tabs, decimal point or comma."""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from arview.errors import InputError

_DELIMITERS = (";", "\t", ",")
_HEADER_LINES = 60
"""Lines in which the header is looked for: measuring machines write a preamble before it."""
_MAX_CHARACTERS = 20_000_000
_MAX_NUMBER = 1e9


class HeaderError(InputError):
    """No line names the columns that are needed."""


@dataclass(frozen=True)
class Table:
    """A table with named columns.

    Attributes:
        path: its file, for messages.
        columns: names of the columns as they stand in the file.
        rows: line number in the file, and cells by the name of their column; lines without content are left out.
        has_decimal_comma: whether its numbers have a decimal comma.
    """

    path: Path
    columns: tuple[str, ...]
    rows: tuple[tuple[int, Mapping[str, str]], ...]
    has_decimal_comma: bool

    def plain(self, cell: str) -> str:
        """The cell, with a decimal point and a plain minus if it is a number."""
        if not _is_number(cell):
            return cell
        return (cell.replace(",", ".") if self.has_decimal_comma else cell).replace("\u2212", "-")

    def number(self, line: int, column: str, cell: str) -> float:
        """The number in a cell.

        Raises:
            InputError: the cell holds no number below 1e9, or the decimals of one that a comma cut in two.
        """
        try:
            value = float(self.plain(cell).replace("\u00a0", "").replace(" ", "")) if _is_number(cell) else math.nan
        except ValueError:
            value = math.nan
        if not abs(value) < _MAX_NUMBER:
            raise InputError(f"{self.path}: line {line}: {column} = {cell!r}: expected a number")
        if re.fullmatch(r"[-+\u2212]?0\d+", cell):
            raise InputError(
                f"{self.path}: line {line}: {column} = {cell!r} begins with 0 like the decimals after a comma;"
                " separate the columns by ; where numbers have a decimal comma"
            )
        return value


def text_of(path: Path) -> str:
    """The text of a file: UTF-8, UTF-16 with its mark, or Windows-1252.

    Raises:
        InputError: the file cannot be read or holds no text.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    if len(data) > _MAX_CHARACTERS:
        raise InputError(f"{path}: {len(data) / 1e6:.0f} MB are too many for a list")
    for encoding in ("utf-16",) if data[:2] in (b"\xff\xfe", b"\xfe\xff") else ("utf-8-sig", "cp1252"):
        try:
            text = data.decode(encoding)
        except UnicodeDecodeError:
            continue
        if "\0" not in text:
            return text
    raise InputError(f"{path}: is not a text file")


def read_table(path: str | Path, is_header: Callable[[Sequence[str]], bool], expected: str) -> Table:
    """Read a table whose header is the first line for which ``is_header`` holds; lines before it are a preamble.

    Args:
        path: the file.
        is_header: whether cells are the names of the columns.
        expected: the columns that are needed, for the message.

    Raises:
        InputError: the file cannot be read, has no such header, a line with more fields than that, or mixes decimal
            points and commas.
    """
    path = Path(path)
    text = text_of(path)
    lines = text.splitlines()
    for number, line in enumerate(lines[:_HEADER_LINES]):
        for delimiter in _DELIMITERS:
            try:
                cells = [cell.strip() for cell in next(csv.reader([line], delimiter=delimiter), [])]
            except csv.Error as error:
                raise InputError(f"{path}: line {number + 1}: {error}") from error
            if len(cells) > 1 and is_header(cells):
                return _table(path, lines, number, delimiter, tuple(cells))
    raise HeaderError(f"{path}: no line names the columns {expected}, separated by ; or , or tabs")


def _table(path: Path, lines: Sequence[str], header: int, delimiter: str, columns: tuple[str, ...]) -> Table:
    names = [name for name in columns if name]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise InputError(f"{path}: the column {twice!r} is there twice")
    reader = csv.reader(io.StringIO("\n".join(lines[header + 1 :])), delimiter=delimiter)
    rows: list[tuple[int, Mapping[str, str]]] = []
    try:
        for cells in reader:
            if any(cell.strip() for cell in cells[len(columns) :]):
                commas = "; separate the columns by ; where numbers have a decimal comma" if delimiter == "," else ""
                raise InputError(
                    f"{path}: line {header + 1 + reader.line_num} has {len(cells)} fields, the header {len(columns)}"
                    f" columns{commas}"
                )
            if any(cell.strip() for cell in cells):
                filled = [*(cell.strip() for cell in cells), *[""] * (len(columns) - len(cells))]
                rows.append((header + 1 + reader.line_num, dict(zip(columns, filled, strict=False))))
    except csv.Error as error:
        raise InputError(f"{path}: line {header + 1 + reader.line_num}: {error}") from error
    return Table(path, columns, tuple(rows), delimiter != "," and _has_decimal_comma(path, rows))


def _is_number(cell: str) -> bool:
    return any(c.isdigit() for c in cell) and not set(cell) - set("+-\u2212.,0123456789eE \u00a0")


def _has_decimal_comma(path: Path, rows: Sequence[tuple[int, Mapping[str, str]]]) -> bool:
    """Whether numbers have a decimal comma.

    Raises:
        InputError: some have a comma and others a point, so that 1.234 could be either.
    """
    comma = point = None
    for line, row in rows:
        for cell in row.values():
            if not _is_number(cell):
                continue
            if "," in cell:
                comma = comma or (line, cell)
            elif "." in cell:
                point = point or (line, cell)
    if comma is not None and point is not None:
        raise InputError(
            f"{path}: line {comma[0]} has a decimal comma ({comma[1]}), line {point[0]} a point ({point[1]}); write all"
            " numbers in one way"
        )
    return comma is not None
