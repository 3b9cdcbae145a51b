"""Series of the measured values of a component, or of a characteristic of the drawing, over the parts built."""

from __future__ import annotations

import gc
import json
from collections import namedtuple
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import datetime, tzinfo
from itertools import pairwise
from math import isnan, nan
from operator import attrgetter
from typing import Any, Literal, NamedTuple, get_args

import sqlalchemy as sa

from arview.errors import InputError
from arview.quality.history.store import HistoryStore, stamp
from arview.quality.history.tables import (
    characteristics,
    components,
    results,
    same,
    stated_axis,
    stated_point,
    voids,
)

Quantity = Literal["distance", "dx", "dy", "dz", "tilt", "twist", "characteristic"]
"""A quantity of a component, or the value of a characteristic."""
WITH_LIMITS = ("size", "distance", "gap", "flush")
"""Kinds of characteristics that have limits; the others have a zone, whose width cannot be negative."""
NOT_NEGATIVE = ("distance", "tilt")
"""Quantities that cannot be negative."""
MAX_MARKS = 12
"""Changes of a kind that are stated and drawn singly; stations that take turns change with every part."""


_Row = namedtuple(
    "_Row",
    "id serial station model_hash measured is_void is_there value std lower upper bonus finding stated has_zone",
)
"""A result with its value; reading the values of a row of SQLAlchemy takes ten times as long."""


class SeriesValue(NamedTuple):
    """A measured value.

    Attributes:
        result_id: number of the result in the store.
        serial, station, measured: of that result, UTC.
        value: the value, mm or degrees.
        std: standard uncertainty of the measurement, mm; None for angles.
        lower, upper: limits that held when it was measured, without a bonus; a distance or zone has an upper one only;
            None without a tolerance.
        model_hash: ``Model.source_hash`` of the CAD model it was measured against.
        bonus: by how much the upper limit was wider for this part, mm, by its maximum material.
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
    bonus: float = 0.0

    @property
    def is_within(self) -> bool | None:
        """Whether the value is within the limits that held then; None without limits."""
        if self.lower is None and self.upper is None:
            return None
        above = self.upper is not None and not self.value <= self.upper + self.bonus
        return not above and (self.lower is None or self.value >= self.lower)


class Change(NamedTuple):
    """A change in a series: before which value (None: too many to name), what in a word, and a sentence on it."""

    place: int | None
    word: str
    sentence: str


@dataclass(frozen=True)
class ComponentSeries:
    """Values in the order of their measurement.

    Attributes:
        part, component, quantity, unit: what was measured; ``component`` may name a characteristic.
        values: the determined values.
        lower, upper: the limits that hold now, those of the last value; None without a tolerance.
        left_out: descriptions of the results that are not among the values.
        is_length: whether the values cannot be negative.
        missing: NaN for each part on which the component was missing, with the limits that held.
        earlier: number of measurements that were left out because their serials were measured again.
        zone: time zone of its sentences and pictures; None: that of this machine.
    """

    part: str
    component: str
    quantity: Quantity
    unit: str
    values: tuple[SeriesValue, ...]
    lower: float | None
    upper: float | None
    left_out: tuple[str, ...]
    is_length: bool
    missing: tuple[SeriesValue, ...] = ()
    earlier: int = 0
    zone: tzinfo | None = None

    @property
    def within(self) -> tuple[int, int]:
        """How many parts are within the limits that held, and of how many; one without the component is not."""
        counted = [one.is_within for one in (*self.values, *self.missing) if one.is_within is not None]
        return sum(counted), len(counted)

    def with_limits(self, lower: float | None, upper: float | None) -> ComponentSeries:
        """The series with other limits for every value; None keeps those that held."""
        given: dict[str, Any] = {
            name: limit for name, limit in (("lower", lower), ("upper", upper)) if limit is not None
        }
        if not given:
            return self
        values, missing = (tuple(one._replace(**given) for one in group) for group in (self.values, self.missing))
        return replace(self, values=values, missing=missing, **given)

    def by_limits(self) -> dict[tuple[float | None, float | None], tuple[SeriesValue, ...]]:
        """The values by the limits that held when they were measured, in the order in which these first held."""
        groups: dict[tuple[float | None, float | None], list[SeriesValue]] = {}
        for one in self.values:
            groups.setdefault((one.lower, one.upper), []).append(one)
        return {limits: tuple(values) for limits, values in groups.items()}

    def changes(self) -> list[Change]:
        """Where the limits, the CAD model or the station changed, in this order."""
        found = []
        for word, name, key_of, text_of in (
            ("limits", "limits", attrgetter("lower", "upper"), limits_text),
            ("CAD", "CAD model", attrgetter("model_hash"), lambda one: one.model_hash[:12]),
            ("station", "station", attrgetter("station"), attrgetter("station")),
        ):
            places = [i for i, (old, new) in enumerate(pairwise(map(key_of, self.values)), 1) if old != new]
            if len(places) > MAX_MARKS:
                found.append(Change(None, word, f"{name} changed {len(places)} times"))
                continue
            for place in places:
                before, after = self.values[place - 1 : place + 1]
                texts = f"{text_of(before)} before, {text_of(after)} since"
                found.append(Change(place, word, f"{name} changed on {self.time(after)}: {texts}"))
        return found

    def time(self, one: SeriesValue) -> str:
        """When a value was measured, in the zone of the series, and on which part."""
        return f"{one.measured.astimezone(self.zone):%Y-%m-%d %H:%M} ({one.serial or f'no. {one.result_id}'})"


def limits_text(one: SeriesValue) -> str:
    """The limits of a value in words."""
    if one.lower is None and one.upper is None:
        return "none"
    if one.lower is None:
        return f"at most {one.upper:g}"
    return f"at least {one.lower:g}" if one.upper is None else f"{one.lower:g} to {one.upper:g}"


@contextmanager
def _garbage_kept() -> Iterator[None]:
    """No collection of garbage meanwhile: it would go through 100,000 new rows again and again, half of the time."""
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


@_garbage_kept()
def series_of(
    store: HistoryStore,
    name: str,
    quantity: Quantity = "distance",
    part: str | None = None,
    station: str | None = None,
    since: datetime | None = None,
    counted: Literal["last", "first", "all"] = "last",
    revisions: bool = False,
) -> ComponentSeries:
    """A quantity of the component ``name``, or the characteristic of that name.

    Counted are the results of the newest CAD model and of those that are stated to be the same (`HistoryStore.same`),
    or of all with ``revisions``. Of a serial number that was measured several times only the last measurement is
    ``counted``, or only the first, which is what the process made before any rework, or all. Each value has the limits
    that held then. Those of dx, dy, dz are ± the tolerance of the distance, which is necessary but not sufficient for
    the distance.

    Raises:
        InputError: the store has no such results; or it has several parts and ``part`` is not given.
    """
    if quantity not in get_args(Quantity):
        raise InputError(f"{quantity!r}: expected one of {', '.join(get_args(Quantity))}")
    part = part or _only_part(store)
    every = _rows(store, part, name, quantity, station, since)
    found = [row for row in every if not row.is_void]
    if not found:
        raise InputError(f"{store.name}: no such results")
    what = "characteristic" if quantity == "characteristic" else "component"
    left_out = [f"{len(every) - len(found)} voided"] if len(found) < len(every) else []
    hashes = _revisions_of(store, found[-1].model_hash)
    current = found if revisions else [row for row in found if row.model_hash in hashes]
    if len(current) < len(found):
        left_out.append(f"{len(found) - len(current)} measured against another CAD model than the newest")
    kept = current
    if counted != "all":
        kept = _one_of_each_serial(current) if counted == "first" else _one_of_each_serial(current[::-1])[::-1]
    if not any(row.is_there for row in kept):
        raise InputError(f"{store.name}: {part!r} has no {what} {name!r}")
    earlier = len(current) - len(kept)
    if earlier:
        ids = {row.id for row in kept}
        beyond = sum(one.is_within is False for one in _values([row for row in current if row.id not in ids]))
        which = "later" if counted == "first" else "earlier"
        left_out.append(
            f"{earlier} {which} measurements of the same serials, {beyond or 'none'} of them out of tolerance"
        )
    kept, others = _of_newest_point(store, kept, name, quantity)
    both = _values(kept)
    values, missing = ([one for one in both if isnan(one.value) is is_missing] for is_missing in (False, True))
    not_there = sum(not row.is_there for row in kept)
    counts = (
        (len(missing), "missing"),
        (not_there, "not inspected"),
        (len(kept) - len(both) - not_there, "undetermined"),
    )
    return ComponentSeries(
        part=part,
        component=name,
        quantity=quantity,
        unit="deg" if quantity in ("tilt", "twist") else "mm",
        values=tuple(values),
        lower=both[-1].lower if both else None,
        upper=both[-1].upper if both else None,
        left_out=(*left_out, *others, *(f"{count} in which it was {why}" for count, why in counts if count)),
        is_length=quantity in NOT_NEGATIVE or any(row.has_zone for row in kept),
        missing=tuple(missing),
        earlier=earlier,
    )


def open_shares(
    store: HistoryStore, part: str, station: str, since: datetime
) -> dict[tuple[str, Quantity], tuple[int, int]]:
    """How many results have no decision (undecided, not measured) since then, and how many there are.

    They are by the name of the component or characteristic and the quantity of its series.
    """
    found: dict[tuple[str, Quantity], tuple[int, int]] = {}
    counted = (results.c.part == part, results.c.station == station, results.c.measured >= stamp(since))
    names: tuple[Quantity, ...] = ("distance", "characteristic")
    for table, quantity in zip((components, characteristics), names, strict=True):
        is_open = sa.case((table.c.verdict.in_(("undecided", "not_measured")), 1), else_=0)
        query = sa.select(table.c.name, sa.func.sum(is_open), sa.func.count()).join(results).where(*counted)
        query = query.where(results.c.id.not_in(sa.select(voids.c.result_id))).group_by(table.c.name)
        found |= {(row[0], quantity): (int(row[1]), int(row[2])) for row in store.rows(query)}
    return found


def _only_part(store: HistoryStore) -> str:
    parts = sorted(str(row.part) for row in store.rows(sa.select(results.c.part).distinct()))
    if len(parts) > 1:
        raise InputError(f"{store.name}: contains several parts ({', '.join(parts)}); name one with --part")
    return parts[0] if parts else ""


def _rows(
    store: HistoryStore, part: str, name: str, quantity: Quantity, station: str | None, since: datetime | None
) -> list[_Row]:
    """The results of a part in their order, each with the value of a component or characteristic if it has it.

    Results and values are read apart, each along an index that holds them; a join would look up every value.
    """
    columns = results.c.id, results.c.serial, results.c.station, results.c.model_hash, results.c.measured
    query = sa.select(*columns).where(results.c.part == part).order_by(results.c.measured, results.c.id)
    if station is not None:
        query = query.where(results.c.station == station)
    if since is not None:
        query = query.where(results.c.measured >= stamp(since))
    voided = {row[0] for row in store.rows(sa.select(voids.c.result_id))}
    found = {row[0]: tuple(row)[1:] for row in store.rows(_values_query(name, quantity))}
    absent = (None,) * len(_Row._fields[7:])
    return [
        _Row._make((*row, row[0] in voided, row[0] in found, *found.get(row[0], absent))) for row in store.rows(query)
    ]


def _values_query(name: str, quantity: Quantity) -> sa.Select[Any]:
    """Numbers of results, with the fields of `_Row` that a component or characteristic has in them."""
    is_angle = quantity in ("tilt", "twist")
    table = characteristics if quantity == "characteristic" else components
    taken: dict[str, Any] = {"std": sa.null() if is_angle else table.c.uncertainty_mm / 2.0}
    if quantity == "characteristic":
        has_zone = sa.case((characteristics.c.kind.not_in(WITH_LIMITS), 1), else_=0)
        taken |= {"value": table.c.value_mm, "lower": table.c.lower_mm, "upper": table.c.upper_mm}
        taken |= {"bonus": table.c.bonus_mm, "finding": sa.null(), "stated": sa.literal(""), "has_zone": has_zone}
    else:
        taken |= {"value": table.c[f"{quantity}_{'deg' if is_angle else 'mm'}"], "finding": table.c.finding}
        taken |= {"upper": sa.null() if is_angle else table.c.tolerance_mm}
        taken |= {"lower": -table.c.tolerance_mm if quantity in ("dx", "dy", "dz") else sa.null()}
        taken |= {"bonus": sa.literal(0.0), "has_zone": sa.literal(0)}
        taken |= {"stated": table.c.axis if is_angle else table.c.point}
    return sa.select(table.c.result_id, *(taken[label] for label in _Row._fields[7:])).where(table.c.name == name)


def _revisions_of(store: HistoryStore, model_hash: str) -> set[str]:
    """A CAD model and those that are stated to be the same, directly or by others."""
    pairs = [{row.old_hash, row.new_hash} for row in store.rows(sa.select(same.c.old_hash, same.c.new_hash))]
    found, before = {model_hash}, set[str]()
    while found != before:
        before = set(found)
        found = found.union(*(pair for pair in pairs if pair & found))
    return found


def _values(rows: Sequence[_Row]) -> list[SeriesValue]:
    """The values in rows that have one, NaN where the component was missing."""
    moment, make = datetime.fromisoformat, SeriesValue._make
    return [
        make(
            (
                *(row.id, row.serial, row.station, moment(row.measured), nan if row.finding else row.value),
                *(row.std, row.lower, row.upper, row.model_hash, row.bonus),
            )
        )
        for row in rows
        if row.value is not None or row.finding
    ]


def _of_newest_point(
    store: HistoryStore, rows: list[Any], name: str, quantity: Quantity
) -> tuple[list[Any], list[str]]:
    """The rows stated for the same point, or for angles about the same axis, as the newest, and a text on the rest.

    A result without the component says nothing about it, and is kept. Rows of an older store have this in the document.
    """
    is_angle = quantity in ("tilt", "twist")
    stated = {row.id: row.stated for row in rows if row.is_there}
    if None in stated.values():
        of_details: Callable[[dict[str, Any]], str] = stated_axis if is_angle else stated_point
        older = sa.select(results.c.id, results.c.document).join(components).where(components.c.name == name)
        for row in store.rows(older.where(components.c.point.is_(None))):
            entry = next(one for one in json.loads(row.document)["components"] if one["name"] == name)
            stated[row.id] = of_details(entry.get("details") or {})
    newest = next((stated[row.id] for row in reversed(rows) if row.id in stated), "")
    kept = [row for row in rows if stated.get(row.id, newest) == newest]
    others = sorted({stated[row.id] for row in rows if stated.get(row.id, newest) != newest})
    if not others:
        return kept, []
    what = "about another axis" if is_angle else "for another point"
    return kept, [f"{len(rows) - len(kept)} stated {what} ({'; '.join(others)}) than the newest ({newest})"]


def _one_of_each_serial(rows: Sequence[_Row]) -> list[_Row]:
    """The first row for each serial, and all without one, in their order."""
    found: dict[str, _Row] = {}
    for row in rows:
        found.setdefault(row.serial or f"\0{row.id}", row)
    return list(found.values())
