"""A list of measured components, as a coordinate measuring machine writes it: positions or deviations with their U."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from arview.acceptance.lengths import K
from arview.core.tables import HeaderError, Table, read_table
from arview.errors import InputError
from arview.geometry import Array

_NAMES = frozenset(
    {
        "name",
        "component",
        "feature",
        "element",
        "label",
        "id",
        "point",
        "characteristic",
        "komponente",
        "bauteil",
        "merkmal",
        "bezeichnung",
        "punkt",
    }
)
POINTS = ("part", "mass", "box")
"""Points of a component that a list may state: that of the part file, centre of mass, middle of the bounding box."""
_UNITS = ("mm", "millimeter", "millimetre")
_UNCERTAINTY = re.compile(
    r"(?:d?([xyz]))?(?:(uc?|std|stddev|stdev|sigma|σ|standarduncertainty|standardunsicherheit)|(?:u95|(?:expanded|"
    r"measurement)*uncertainty|(?:erweiterte)?(?:mess)?unsicherheit))(?:d?([xyz]))?"
)
"""Names of an uncertainty with its axis, as `_uncertainty` reads them; the second group is a standard uncertainty."""
_FACTOR = re.compile(r"\(?\bk\s*=\s*([1-9]\d*(?:[.,]\d+)?)\)?")
"""A coverage factor in the name of a column."""
_EXPECTED = "name with x, y, z or dx, dy, dz, and optionally U"


@dataclass(frozen=True)
class ListedComponent:
    """A line of the list, in the frame of the CAD model's datums.

    Attributes:
        name: of the component.
        place: (3,) measured position of its point, mm, NaN where it is not stated.
        displacement: (3,) measured minus nominal position, mm, NaN where it is not stated.
        uncertainty: (3,) expanded uncertainty (k = 2) along x, y, z, mm; None when it is not stated.
        point: of `POINTS`, the one that x, y, z are the position of.
    """

    name: str
    place: Array
    displacement: Array
    uncertainty: Array | None
    point: str = "part"


def is_position_list(path: str | Path) -> bool:
    """Whether a file is such a list, by the names of its columns."""
    try:
        read_table(path, _is_header, _EXPECTED)
    except HeaderError:
        return False
    return True


def read_position_list(path: str | Path) -> tuple[ListedComponent, ...]:
    """Read a list with the columns name, x, y, z (positions) or dx, dy, dz (deviations), and U or Ux, Uy, Uz.

    U is expanded (k = 2), a small u the standard uncertainty (k = 1), as GUM writes them; a stated factor goes before.

    The columns may have units in brackets and other common names (component, feature, actual x, deviation x, …). A
    column ``measurand`` says of which point x, y, z are the position, see `POINTS`; without it that of the part file.

    Raises:
        InputError: the file cannot be read, has no such columns, another unit than mm, a name twice, an unknown point,
            or no line.
    """
    table = read_table(path, _is_header, _EXPECTED)
    columns = _columns(table.columns)
    for column in table.columns:
        unit = re.search(r"[\[(]\s*([^\])]*?)\s*[\])]", _FACTOR.sub("", column))
        if column in columns.values() and unit and unit[1].lower() not in ("", *_UNITS):
            raise InputError(f"{table.path}: the column {column!r} is in {unit[1]}; expected mm")
    found: dict[str, ListedComponent] = {}
    for line, row in table.rows:
        name = row[columns["name"]]
        if not name:
            raise InputError(f"{table.path}: line {line}: the name is empty")
        if name in found:
            raise InputError(f"{table.path}: line {line}: {name!r} is listed twice")
        point = row[columns["measurand"]].lower() if "measurand" in columns else ""
        if point and point not in POINTS:
            raise InputError(f"{table.path}: line {line}: {point!r} is no point; expected {', '.join(POINTS)}")
        found[name] = ListedComponent(name, *_values(table, columns, line, row.__getitem__), point or "part")
    if not found:
        raise InputError(f"{table.path}: lists no component")
    return tuple(found.values())


def _values(
    table: Table, columns: dict[str, str], line: int, cell: Callable[[str], str]
) -> tuple[Array, Array, Array | None]:
    def number(key: str) -> float:
        column = columns.get(key)
        text = "" if column is None else cell(column)
        if column is None or text in ("", "-", "?"):
            return float("nan")
        return table.number(line, column, text) * (K / (_uncertainty(column) or ("", K))[1])

    place = np.array([number(axis) for axis in "xyz"])
    displacement = np.array([number(f"d{axis}") for axis in "xyz"])
    uncertainty = np.array([number(f"u{axis}") for axis in "xyz"])
    uncertainty = np.where(np.isnan(uncertainty), number("u"), uncertainty)
    stated = uncertainty[~np.isnan(uncertainty)]
    if (stated < 0.0).any():
        raise InputError(f"{table.path}: line {line}: U = {stated.min():g}: expected a number that is not negative")
    return place, displacement, uncertainty if len(stated) else None


def _is_header(cells: Sequence[str]) -> bool:
    found = _columns(cells)
    has_places = all(axis in found for axis in "xyz")
    return "name" in found and (has_places or any(f"d{axis}" in found for axis in "xyz"))


def _columns(cells: Sequence[str]) -> dict[str, str]:
    """The column of each quantity: name, x, y, z, dx, dy, dz, u, ux, uy, uz."""
    found: dict[str, str] = {}
    for cell in cells:
        key = _key(cell)
        if key is not None:
            found.setdefault(key, cell)
    return found


def _key(column: str) -> str | None:
    """The quantity that a column holds by its name, or None."""
    text = re.sub(r"[\[(].*?[\])]", "", column.lower())
    words = [word for word in re.split(r"[^a-zäöüδ0-9]+", text) if word and word not in _UNITS]
    joined = "".join(words)
    if joined in _NAMES:
        return "name"
    if joined == "measurand":
        return joined
    uncertainty = _uncertainty(column)
    if uncertainty is not None:
        return uncertainty[0]
    for axis in "xyz":
        marks = ("d", "δ", "dev", "deviation", "delta", "diff", "abw", "abweichung")
        if any(joined in (mark + axis, axis + mark) for mark in marks):
            return f"d{axis}"
        if any(joined in (mark + axis, axis + mark) for mark in ("", "actual", "act", "measured", "meas", "ist")):
            return axis
    return None


def _uncertainty(column: str) -> tuple[str, float] | None:
    """The key of a column of uncertainties, u, ux, uy or uz, and its coverage factor k; None for another column."""
    stated = _FACTOR.search(column)
    text = re.sub(r"[\[(].*?[\])]", "", _FACTOR.sub("", column))
    joined = "".join(word for word in re.split(r"[^\wäöü]+|_", text) if word.lower() not in _UNITS)
    found = _UNCERTAINTY.fullmatch(joined.lower())
    if found is None:
        return None
    is_standard = found[2] is not None and not (found[2] == "u" and "U" in joined)
    k = float(stated[1].replace(",", ".")) if stated else 1.0 if is_standard else K
    return f"u{found[1] or found[3] or ''}", k
