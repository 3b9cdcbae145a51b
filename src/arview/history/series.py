"""Series of the measured values of a component over the parts that were built."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from typing import Literal, get_args

from arview.errors import InputError
from arview.history.store import HistoryStore, StoredResult

Quantity = Literal["distance", "dx", "dy", "dz", "tilt", "twist"]


@dataclass(frozen=True)
class SeriesValue:
    """A measured value.

    Attributes:
        result_id: number of the result in the store.
        serial, station, measured: of that result.
        value: the value, mm or degrees.
        std: standard uncertainty of the measurement, mm; None for angles.
    """

    result_id: int
    serial: str
    station: str
    measured: datetime
    value: float
    std: float | None


NOT_NEGATIVE = ("distance", "tilt")
"""Quantities that cannot be negative."""


@dataclass(frozen=True)
class ComponentSeries:
    """Values in the order of their measurement.

    Attributes:
        part, component, quantity, unit: what was measured.
        values: the determined values.
        lower, upper: limits from the tolerance; a distance has an upper one only; None without a tolerance.
        left_out: descriptions of the results that are not among the values.
    """

    part: str
    component: str
    quantity: Quantity
    unit: str
    values: tuple[SeriesValue, ...]
    lower: float | None
    upper: float | None
    left_out: tuple[str, ...]

    @property
    def is_length(self) -> bool:
        """Whether the values cannot be negative."""
        return self.quantity in NOT_NEGATIVE


def series_of(
    store: HistoryStore, component: str, quantity: Quantity = "distance", part: str | None = None,
    station: str | None = None, since: datetime | None = None, repeats: bool = False,
) -> ComponentSeries:  # fmt: skip
    """A quantity of a component, for the newest CAD model in the store.

    Of a serial number that was measured several times only the last measurement counts, unless ``repeats``. The limits
    of dx, dy, dz are ± the tolerance of the distance, which is necessary but not sufficient for the distance.

    Raises:
        InputError: the store has no such results; or it has several parts and ``part`` is not given.
    """
    if quantity not in get_args(Quantity):
        raise InputError(f"{quantity!r}: expected one of {', '.join(get_args(Quantity))}")
    found = store.listed(part=part, station=station, since=since)
    if not found:
        raise InputError(f"{store.name}: no such results")
    parts = sorted({one.part for one in found})
    if len(parts) > 1:
        raise InputError(f"{store.name}: contains several parts ({', '.join(parts)}); name one with --part")
    left_out: list[str] = []
    current = [one for one in found if one.model_hash == found[-1].model_hash]
    if len(current) < len(found):
        left_out.append(f"{len(found) - len(current)} measured against another CAD model than the newest")
    kept = current if repeats else _last_of_each_serial(current)
    if len(kept) < len(current):
        left_out.append(f"{len(current) - len(kept)} earlier measurements of the same serials")
    rows = {row["result_id"]: row for row in store.components([one.id for one in kept], component)}
    if not rows:
        raise InputError(f"{store.name}: {parts[0]!r} has no component {component!r}")
    column = f"{quantity}_{'deg' if quantity in ('tilt', 'twist') else 'mm'}"
    values, absent, undetermined, tolerance = [], 0, 0, None
    for one in kept:
        row = rows.get(one.id)
        if row is None or row["finding"] is not None:
            absent += 1
            continue
        tolerance = row["tolerance_mm"] if row["tolerance_mm"] is not None else tolerance
        if row[column] is None:
            undetermined += 1
            continue
        std = row["uncertainty_mm"] / 2.0 if row["uncertainty_mm"] is not None and column.endswith("mm") else None
        values.append(SeriesValue(one.id, one.serial, one.station, one.measured, float(row[column]), std))
    if absent:
        left_out.append(f"{absent} in which it was missing or not inspected")
    if undetermined:
        left_out.append(f"{undetermined} in which it was undetermined")
    is_length = column.endswith("mm")
    upper = tolerance if is_length else None
    lower = -tolerance if tolerance is not None and quantity in ("dx", "dy", "dz") else None
    return ComponentSeries(
        parts[0], component, quantity, "mm" if is_length else "deg", tuple(values), lower, upper, tuple(left_out)
    )


def _last_of_each_serial(listed: list[StoredResult]) -> list[StoredResult]:
    last = {one.serial: one.id for one in listed if one.serial}
    return [one for one in listed if not one.serial or last[one.serial] == one.id]
