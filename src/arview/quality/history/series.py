"""Series of the measured values of a component over the parts that were built."""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import datetime, tzinfo
from itertools import pairwise
from math import isnan, nan
from typing import Any, Literal, get_args

from arview.errors import InputError
from arview.inspection import MEASURANDS
from arview.quality.history.store import HistoryStore, StoredResult

Quantity = Literal["distance", "dx", "dy", "dz", "tilt", "twist"]


@dataclass(frozen=True)
class SeriesValue:
    """A measured value.

    Attributes:
        result_id: number of the result in the store.
        serial, station, measured: of that result.
        value: the value, mm or degrees.
        std: standard uncertainty of the measurement, mm; None for angles.
        lower, upper: limits from the tolerance that held when it was measured; a distance has an upper one only; None
            without a tolerance.
        model_hash: ``Model.source_hash`` of the CAD model it was measured against.
    """

    result_id: int
    serial: str
    station: str
    measured: datetime
    value: float
    std: float | None
    lower: float | None = None
    upper: float | None = None
    model_hash: str = ""

    @property
    def is_within(self) -> bool | None:
        """Whether the value is within the limits that held then; None without limits."""
        if self.lower is None and self.upper is None:
            return None
        return (self.lower is None or self.value >= self.lower) and (self.upper is None or self.value <= self.upper)


NOT_NEGATIVE = ("distance", "tilt")
"""Quantities that cannot be negative."""


@dataclass(frozen=True)
class ComponentSeries:
    """Values in the order of their measurement.

    Attributes:
        part, component, quantity, unit: what was measured.
        values: the determined values.
        missing: NaN for each part on which the component was missing, with the limits that held.
        lower, upper: the limits that hold now, those of the last value; None without a tolerance.
        left_out: descriptions of the results that are not among the values.
        earlier: number of measurements that were left out because their serials were measured again.
    """

    part: str
    component: str
    quantity: Quantity
    unit: str
    values: tuple[SeriesValue, ...]
    lower: float | None
    upper: float | None
    left_out: tuple[str, ...]
    missing: tuple[SeriesValue, ...] = ()
    earlier: int = 0

    @property
    def within(self) -> tuple[int, int]:
        """How many parts are within the limits that held, and of how many; one without the component is not."""
        counted = [one.is_within for one in (*self.values, *self.missing) if one.is_within is not None]
        return sum(counted), len(counted)

    def with_limits(self, lower: float | None, upper: float | None) -> ComponentSeries:
        """The series with other limits for every value; None keeps those that held."""

        def limited(values: tuple[SeriesValue, ...]) -> tuple[SeriesValue, ...]:
            return tuple(
                replace(one, lower=one.lower if lower is None else lower, upper=one.upper if upper is None else upper)
                for one in values
            )

        return replace(
            self,
            values=limited(self.values),
            missing=limited(self.missing),
            lower=self.lower if lower is None else lower,
            upper=self.upper if upper is None else upper,
        )

    def in_zone(self, zone: tzinfo) -> ComponentSeries:
        """The series with its times in another zone."""
        return replace(self, values=tuple(replace(one, measured=one.measured.astimezone(zone)) for one in self.values))

    def by_limits(self) -> dict[tuple[float | None, float | None], tuple[SeriesValue, ...]]:
        """The values by the limits that held when they were measured, in the order in which these first held."""
        groups: dict[tuple[float | None, float | None], list[SeriesValue]] = {}
        for one in self.values:
            groups.setdefault((one.lower, one.upper), []).append(one)
        return {limits: tuple(values) for limits, values in groups.items()}

    def changes(self) -> list[str]:
        """Sentences that say when the limits or the CAD model changed."""
        sentences = []
        for before, after in pairwise(self.values):
            where = f"{after.measured:%Y-%m-%d %H:%M} ({after.serial or f'no. {after.result_id}'})"
            if (before.lower, before.upper) != (after.lower, after.upper):
                sentences.append(f"limits changed on {where}: {limits_text(before)} before, {limits_text(after)} since")
            if before.model_hash != after.model_hash:
                old, new = before.model_hash[:12], after.model_hash[:12]
                sentences.append(f"CAD model changed on {where}: {old} before, {new} since")
        return sentences

    @property
    def is_length(self) -> bool:
        """Whether the values cannot be negative."""
        return self.quantity in NOT_NEGATIVE


def limits_text(one: SeriesValue) -> str:
    """The limits of a value in words."""
    if one.lower is None and one.upper is None:
        return "none"
    if one.lower is None:
        return f"at most {one.upper:g}"
    return f"at least {one.lower:g}" if one.upper is None else f"{one.lower:g} to {one.upper:g}"


def series_of(
    store: HistoryStore,
    component: str,
    quantity: Quantity = "distance",
    part: str | None = None,
    station: str | None = None,
    since: datetime | None = None,
    counted: Literal["last", "first", "all"] = "last",
    revisions: bool = False,
) -> ComponentSeries:
    """A quantity of a component, for the newest CAD model in the store, or for all with ``revisions``.

    Of a serial number that was measured several times only the last measurement is ``counted``, or only the first,
    which is what the process made before any rework, or all. Each value has the limits that held then. Those
    of dx, dy, dz are ± the tolerance of the distance, which is necessary but not sufficient for the distance.

    Raises:
        InputError: the store has no such results; or it has several parts and ``part`` is not given.
    """
    if quantity not in get_args(Quantity):
        raise InputError(f"{quantity!r}: expected one of {', '.join(get_args(Quantity))}")
    every = store.listed(part=part, station=station, since=since, with_voided=True)
    found = [one for one in every if one.void is None]
    if not found:
        raise InputError(f"{store.name}: no such results")
    parts = sorted({one.part for one in found})
    if len(parts) > 1:
        raise InputError(f"{store.name}: contains several parts ({', '.join(parts)}); name one with --part")
    left_out = [f"{len(every) - len(found)} voided"] if len(found) < len(every) else []
    current = found if revisions else [one for one in found if one.model_hash == found[-1].model_hash]
    if len(current) < len(found):
        left_out.append(f"{len(found) - len(current)} measured against another CAD model than the newest")
    kept = current if counted == "all" else _one_of_each_serial(current if counted == "first" else current[::-1])
    rows = {row["result_id"]: row for row in store.components([one.id for one in current], component)}
    if not any(one.id in rows for one in kept):
        raise InputError(f"{store.name}: {parts[0]!r} has no component {component!r}")
    if len(kept) < len(current):
        ids = {one.id for one in kept}
        other = [one for one in current if one.id not in ids]
        beyond = sum(one.is_within is False for one in _values(other, rows, quantity)[0])
        which = "later" if counted == "first" else "earlier"
        left_out.append(
            f"{len(other)} {which} measurements of the same serials, {beyond or 'none'} of them out of tolerance"
        )
    earlier = len(current) - len(kept)
    kept, others = _of_newest_point(kept, store.details([one.id for one in kept], component), quantity)
    left_out += others
    both, not_inspected, undetermined = _values(kept, rows, quantity)
    values, missing = ([one for one in both if isnan(one.value) is is_missing] for is_missing in (False, True))
    for count, why in ((len(missing), "missing"), (not_inspected, "not inspected"), (undetermined, "undetermined")):
        if count:
            left_out.append(f"{count} in which it was {why}")
    limits = both[-1] if both else None
    return ComponentSeries(
        parts[0],
        component,
        quantity,
        "deg" if quantity in ("tilt", "twist") else "mm",
        tuple(values),
        None if limits is None else limits.lower,
        None if limits is None else limits.upper,
        tuple(left_out),
        tuple(missing),
        earlier,
    )


def _values(
    listed: list[StoredResult], rows: dict[int, dict[str, Any]], quantity: Quantity
) -> tuple[list[SeriesValue], int, int]:
    """The values in results, NaN where the component was missing; how many did not inspect or not determine it."""
    is_angle = quantity in ("tilt", "twist")
    values, not_inspected, undetermined = [], 0, 0
    for one in listed:
        row = rows.get(one.id)
        value = nan if row is None or row["finding"] else row[f"{quantity}_{'deg' if is_angle else 'mm'}"]
        not_inspected += row is None
        undetermined += value is None
        if row is None or value is None:
            continue
        std = None if row["uncertainty_mm"] is None or is_angle else row["uncertainty_mm"] / 2.0
        upper = None if is_angle else row["tolerance_mm"]
        lower = -upper if upper is not None and quantity in ("dx", "dy", "dz") else None
        values.append(
            SeriesValue(one.id, one.serial, one.station, one.measured, float(value), std, lower, upper, one.model_hash)
        )
    return values, not_inspected, undetermined


def _of_newest_point(
    listed: list[StoredResult], details: dict[int, dict[str, Any]], quantity: Quantity
) -> tuple[list[StoredResult], list[str]]:
    """The results stated for the same point, or for angles about the same axis, as the newest, and a text on the rest.

    A result without the component says nothing about it, and is kept.
    """
    stated = {number: _stated_for(one, quantity) for number, one in details.items()}
    newest = next((stated[one.id] for one in reversed(listed) if one.id in stated), "")
    kept = [one for one in listed if stated.get(one.id, newest) == newest]
    others = sorted({stated[one.id] for one in listed if stated.get(one.id, newest) != newest})
    if not others:
        return kept, []
    what = "about another axis" if quantity in ("tilt", "twist") else "for another point"
    return kept, [f"{len(listed) - len(kept)} stated {what} ({'; '.join(others)}) than the newest ({newest})"]


def _stated_for(details: dict[str, Any], quantity: Quantity) -> str:
    """What a value is stated for, in words: the point of a displacement, the axis of an angle."""
    if quantity in ("tilt", "twist"):
        axes = details.get("axes")
        return "axis of an older version" if axes is None else f"({', '.join(f'{x + 0.0:.2f}' for x in axes[2])})"
    kind = details.get("measurand", "box_center")
    if kind == "given":
        return f"{MEASURANDS[kind]} ({', '.join(f'{x + 0.0:.3f}' for x in details['center_mm'])})"
    return MEASURANDS[kind]


def _one_of_each_serial(listed: list[StoredResult]) -> list[StoredResult]:
    """The first result listed for each serial, and all without one, in the order of their measurement."""
    found: dict[str, StoredResult] = {}
    for one in listed:
        found.setdefault(one.serial or f"\0{one.id}", one)
    return sorted(found.values(), key=lambda one: (one.measured, one.id))
