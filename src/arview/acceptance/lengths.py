"""Reading of measured positions and known lengths.

Measured positions come from an ``inspection.json`` (centres of the components) or from a CSV file of points. Known
lengths come from the calibration certificate of an artefact as TOML or CSV, or from the ``truth.json`` of a rendered
sample, whose lengths are exact.
"""

from __future__ import annotations

import json
import math
import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from arview.core.tables import HeaderError, read_table
from arview.errors import InputError
from arview.geometry import Array, apply, check_rigid

K = 2.0
"""Coverage factor of all expanded uncertainties U."""
_ARTEFACT_KEYS = ("name", "certificate", "length")
_LENGTH_KEYS = ("between", "mm", "U_mm")


@dataclass(frozen=True)
class Mark:
    """A measured position, (3,) mm, and its covariance, (3,3) mm²; None when it is not stated."""

    place: Array
    covariance: Array | None


@dataclass(frozen=True)
class MeasuredMarks:
    """Measured positions.

    Attributes:
        label: name of the file.
        marks: measured positions by name.
        nominal: centres of the components in the CAD model by name, for the truth of a rendered sample; may be empty.
        scale_std: relative standard uncertainty of the scale, which all lengths share.
        absent: reasons why components have no position, by name.
    """

    label: str
    marks: dict[str, Mark]
    nominal: dict[str, Array]
    scale_std: float
    absent: dict[str, str]


@dataclass(frozen=True)
class KnownLength:
    """A known length between two marks with its expanded uncertainty (k = 2), mm."""

    first: str
    second: str
    mm: float
    uncertainty_mm: float = 0.0


def read_measured(path: str | Path) -> MeasuredMarks:
    """Read measured positions from an ``inspection.json``, or a CSV file with columns name, x, y, z, optionally U_mm.

    A column u_mm holds the standard uncertainty instead (k = 1).

    Raises:
        InputError: the file cannot be read, is of another kind, or has fewer than two measured positions.
    """
    path = Path(path)
    if path.is_dir():
        path = path / "inspection.json"
    text = _text_of(path)
    measured = _of_inspection(path) if text.lstrip().startswith("{") else _of_points(path, text)
    if len(measured.marks) < 2:
        why = "; ".join(f"{name}: {reason}" for name, reason in list(measured.absent.items())[:3])
        raise InputError(
            f"{path}: {len(measured.marks)} positions were measured, a length needs two" + (f" ({why})" if why else "")
        )
    return measured


def read_known(path: str | Path, measured: MeasuredMarks) -> list[KnownLength]:
    """Read known lengths from a TOML or CSV file, or from a ``truth.json``: then between all measured components.

    A TOML file has tables ``[[length]]`` with ``between = ["a", "b"]``, ``mm`` and optionally ``U_mm`` (k = 2); a CSV
    file has the columns from, to, mm and optionally U_mm.

    Raises:
        InputError: the file cannot be read, is of another kind, has a length twice, or has no length.
    """
    path = Path(path)
    text = _text_of(path)
    if text.lstrip().startswith("{"):
        lengths = _of_truth(path, text, measured)
    elif path.suffix.lower() == ".csv":
        lengths = [
            _length(
                f"{path}: line {number}",
                (row.get("from"), row.get("to")),
                row.get("mm"),
                _expanded(f"{path}: line {number}", row),
            )
            for number, row in _rows(path, text, ("from", "to", "mm"))
        ]
    else:
        lengths = _of_artefact(path, text)
    if not lengths:
        raise InputError(f"{path}: contains no length; expected [[length]] with between, mm and U_mm")
    seen: set[frozenset[str]] = set()
    for one in lengths:
        pair = frozenset((one.first, one.second))
        if pair in seen:
            raise InputError(f"{path}: the length from {one.first} to {one.second} occurs twice")
        seen.add(pair)
    return lengths


def covariance_of_lengths(measured: MeasuredMarks, pairs: Sequence[tuple[str, str]]) -> Array | None:
    """Covariance of measured lengths, (N,N) mm²; None when a position has no covariance.

    Errors of positions are assumed independent. Lengths that share a position are correlated, and an error of the
    scale affects all of them.
    """
    names = sorted({name for pair in pairs for name in pair})
    column = {name: 3 * k for k, name in enumerate(names)}
    jacobian = np.zeros((len(pairs), 3 * len(names)))
    whole = np.zeros((3 * len(names), 3 * len(names)))
    lengths = np.zeros(len(pairs))
    for name in names:
        covariance = measured.marks[name].covariance
        if covariance is None:
            return None
        whole[column[name] : column[name] + 3, column[name] : column[name] + 3] = covariance
    for row, (first, second) in enumerate(pairs):
        between = measured.marks[second].place - measured.marks[first].place
        lengths[row] = np.linalg.norm(between)
        along = between / lengths[row]
        jacobian[row, column[second] : column[second] + 3] = along
        jacobian[row, column[first] : column[first] + 3] = -along
    return np.asarray(jacobian @ whole @ jacobian.T + measured.scale_std**2 * np.outer(lengths, lengths))


# --- measured --------------------------------------------------------------------------------------------


def _of_inspection(path: Path) -> MeasuredMarks:
    from arview.inspection import load_inspection

    inspection = load_inspection(path)
    marks: dict[str, Mark] = {}
    nominal: dict[str, Array] = {}
    absent: dict[str, str] = {}
    for one in inspection.components:
        if one.details is None:
            absent[one.name] = "the inspection has no details; measure with this version of arview"
            continue
        nominal[one.name] = np.array(one.details.center_mm)
        known = [value for value in one.displacement_mm if value is not None]
        if len(known) < 3:
            absent[one.name] = "was not measured" if not known else "is undetermined in a direction"
            continue
        covariance = None if one.details.covariance is None else np.array(one.details.covariance)[3:, 3:]
        marks[one.name] = Mark(nominal[one.name] + np.array(known), covariance)
    # Each covariance contains the scale error as a shift; here it is the common factor of all lengths.
    system = inspection.datum_system
    scale_std = (system.scale_std or 0.0) if system is not None else 0.0
    return MeasuredMarks(str(path), marks, nominal, scale_std, absent)


def _of_points(path: Path, text: str) -> MeasuredMarks:
    marks: dict[str, Mark] = {}
    for number, row in _rows(path, text, ("name", "x", "y", "z")):
        where = f"{path}: line {number}"
        name = str(row["name"] or "").strip()
        if not name or name in marks:
            raise InputError(f"{where}: the name {name!r} is {'not unique' if name else 'empty'}")
        place = np.array([_number(where, row[key], key) for key in "xyz"])
        u = _expanded(where, row)
        std = None if u in (None, "") else _number(where, u, "U_mm", minimum=0.0) / K
        marks[name] = Mark(place, None if std is None else std**2 * np.eye(3))
    return MeasuredMarks(str(path), marks, {}, 0.0, {})


# --- known -----------------------------------------------------------------------------------------------


def _of_truth(path: Path, text: str, measured: MeasuredMarks) -> list[KnownLength]:
    try:
        truth = json.loads(text).get("truth")
    except ValueError as error:
        raise InputError(f"{path}: is not valid JSON ({error})") from error
    if not isinstance(truth, dict):
        raise InputError(f"{path}: has no 'truth'; give the truth.json of a sample, or a TOML file with [[length]]")
    places: dict[str, Array] = {}
    for name in measured.marks:
        if name not in truth or name not in measured.nominal:
            continue
        places[name] = apply(_true_move(path, name, truth[name]), measured.nominal[name])
    if len(places) < 2:
        raise InputError(f"{path}: fewer than two of its components were measured in {measured.label}")
    return [KnownLength(a, b, float(np.linalg.norm(places[b] - places[a]))) for a, b in combinations(sorted(places), 2)]


def _true_move(path: Path, name: str, entry: Any) -> Array:
    where = f"{path}: truth.{name}"
    try:
        if "measured_from_nominal" in entry:
            return check_rigid(entry["measured_from_nominal"], where)
        shift = np.array(entry["displacement_mm"], dtype=np.float64).reshape(3)
    except (TypeError, KeyError, ValueError) as error:
        raise InputError(f"{where}: expected measured_from_nominal or displacement_mm") from error
    move = np.eye(4)
    move[:3, 3] = shift
    return check_rigid(move, where)


def _of_artefact(path: Path, text: str) -> list[KnownLength]:
    try:
        content = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{path}: is neither TOML nor JSON, and not named .csv ({error})") from error
    _only(content, _ARTEFACT_KEYS, f"{path}:")
    entries = content.get("length", [])
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise InputError(f"{path}: length: expected tables [[length]]")
    lengths = []
    for number, entry in enumerate(entries, 1):
        where = f"{path}: [[length]] {number}"
        _only(entry, _LENGTH_KEYS, where)
        ends = entry.get("between")
        if not isinstance(ends, list) or len(ends) != 2:
            raise InputError(f"{where}: between = {ends!r}: expected two names of marks")
        lengths.append(_length(where, (ends[0], ends[1]), entry.get("mm"), entry.get("U_mm")))
    return lengths


def _length(where: str, ends: tuple[Any, Any], mm: Any, uncertainty: Any) -> KnownLength:
    first, second = (str(end if end is not None else "").strip() for end in ends)
    if not first or not second or first == second:
        raise InputError(f"{where}: from {first!r} to {second!r}: expected two different marks")
    value = _number(where, mm, "mm", minimum=1e-6)
    return KnownLength(
        first, second, value, 0.0 if uncertainty in (None, "") else _number(where, uncertainty, "U_mm", minimum=0.0)
    )


# --- reading ---------------------------------------------------------------------------------------------


def _text_of(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is not a text file") from error


def _rows(path: Path, text: str, needed: Sequence[str]) -> list[tuple[int, Mapping[str, Any]]]:
    """The rows of a table with the needed columns, separated by ``,``, ``;`` or tabs, with decimal point or comma."""
    try:
        table = read_table(path, lambda cells: set(needed) <= set(cells), ", ".join(needed))
    except HeaderError:
        first = next(iter(text.splitlines()), "")
        cells = {cell.strip() for cell in re.split("[,;\t]", first)}
        missing = next((name for name in needed if name not in cells or len(cells) == 1), needed[0])
        raise InputError(
            f"{path}: the column {missing!r} is missing; the first line must contain the column names"
        ) from None
    return [(line, {name: table.plain(cell) for name, cell in row.items()}) for line, row in table.rows]


def _expanded(where: str, row: Mapping[str, Any]) -> Any:
    """The cell of U_mm or U (k = 2), or K times that of u_mm or u, which GUM writes for the standard uncertainty."""
    known = {name: row[name] for name in ("U_mm", "U", "u_mm", "u") if row.get(name) not in (None, "")}
    if not known:
        return None
    name, cell = next(iter(known.items()))
    return cell if name.startswith("U") else K * _number(where, cell, name, minimum=0.0)


def _number(where: str, value: Any, key: str, minimum: float = -math.inf) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = math.nan
    if not math.isfinite(number) or isinstance(value, bool) or number < minimum or abs(number) > 1e7:
        raise InputError(
            f"{where}: {key} = {value!r}: expected a {'number' if minimum < 0 else 'positive number'} in mm"
        )
    return number


def _only(table: Mapping[str, Any], allowed: Sequence[str], where: str) -> None:
    for key in table:
        if key not in allowed:
            raise InputError(f"{where} unknown key {key!r}; allowed: {', '.join(allowed)}")
