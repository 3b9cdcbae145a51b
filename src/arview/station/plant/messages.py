"""The messages between the station and its plant, all in one place: what MQTT, the hooks and OPC UA carry as JSON.

Each message has a ``type`` and the ``version`` of its form. A key that is not listed here is an error. Lengths are in
millimetres, times are UTC.
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from typing import Annotated, Literal

import msgspec

from arview.errors import InputError
from arview.inspection import (
    CharacteristicResult,
    ComponentDeviation,
    Inspection,
    Verdict,
    content_hash,
    overall_verdict,
    verdict_sentence,
)

MAX_BYTES = 16_384
"""Largest size of a message that is received; a trigger has a few hundred bytes."""
MAX_TEXT = 200
"""Longest text in a trigger, characters: serial numbers of 2D codes are shorter."""

ShortText = Annotated[str, msgspec.Meta(max_length=MAX_TEXT)]
StateName = Literal["preoperational", "ready", "busy", "halted", "error", "offline"]


class PlantMessage(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="type"):
    """What all messages have.

    Attributes:
        version: of the form of the message; it changes when a key changes its meaning or is removed.
    """

    version: Literal["1"] = "1"


class MeasuredValue(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The value of a component or of a characteristic of the drawing.

    Attributes:
        name: of the component or characteristic, as in the part file.
        kind: displacement for a component, else the kind of the characteristic: position, flatness, distance, …
        verdict: of the decision rule.
        value_mm: the distance of the component from its place, or the value of the characteristic; null if it was not
            measured.
        uncertainty_mm: expanded uncertainty U (k = 2) of the value.
        lower_mm: smallest value allowed; null if it is not limited.
        upper_mm: largest value allowed: tolerance, zone or limit.
        reason: why there is no value, or "missing" for a component that is absent.
    """

    name: str
    kind: str
    verdict: Verdict
    value_mm: float | None = None
    uncertainty_mm: float | None = None
    lower_mm: float | None = None
    upper_mm: float | None = None
    reason: str = ""


class Result(PlantMessage, frozen=True, kw_only=True, tag="result"):
    """The result of an inspection.

    Attributes:
        key: fingerprint of the inspection, that of the history and the report. A consumer that has it already ignores
            the message.
        station: name of the station.
        part: name of the part.
        serial: serial number of the part; empty if unknown.
        order: of the trigger.
        recipe: of the trigger.
        trigger: id of the trigger; empty for an inspection that a person started.
        verdict: of the whole part.
        summary: how many components are what, in a sentence.
        created: time of the measurement.
        components: each inspected component.
        characteristics: requirements of the drawing.
        warnings: doubts about the inspection as a whole.
    """

    key: str
    station: str
    part: str
    serial: str
    order: str
    recipe: str
    trigger: str
    verdict: Verdict
    summary: str
    created: datetime
    components: tuple[MeasuredValue, ...]
    characteristics: tuple[MeasuredValue, ...]
    warnings: tuple[str, ...]


class Trigger(PlantMessage, frozen=True, kw_only=True, tag="trigger"):
    """The order of the line to inspect the part that is in the station now.

    Attributes:
        id: given by the line; a trigger whose id was taken already is not carried out again. It comes back in the
            result.
        serial: serial number of the part.
        order: production order, passed on into the result.
        recipe: name of what is to be inspected, passed on into the result.
        part: name of the part.
    """

    id: Annotated[str, msgspec.Meta(min_length=1, max_length=MAX_TEXT)]
    serial: ShortText = ""
    order: ShortText = ""
    recipe: ShortText = ""
    part: ShortText = ""

    def __post_init__(self) -> None:
        for name in ("id", "serial", "order", "recipe", "part"):
            if not getattr(self, name).isprintable():
                raise ValueError(f"Expected printable text of one line - at `$.{name}`")


class Alarm(PlantMessage, frozen=True, kw_only=True, tag="alarm"):
    """A condition that somebody should look at. It is told once when it begins and once when it has ended.

    Attributes:
        key: id of this message.
        id: of the condition, the same when it begins and when it has ended.
        station: name of the station.
        kind: nelson (a rule of the control chart), uncertainty (U grows), undecided (no decision too often), or what
            reports it, such as camera_moved.
        severity: warning or error.
        part: name of the part; empty if the condition is not of a part.
        component: component, characteristic or camera that has it.
        text: the condition in a sentence.
        since: when it began.
        until: when it ended; null while it lasts.
        is_active: whether it lasts.
    """

    key: str
    id: str
    station: str
    kind: str
    severity: Literal["warning", "error"]
    part: str
    component: str
    text: str
    since: datetime
    until: datetime | None = None
    is_active: bool = True


class StationState(PlantMessage, frozen=True, kw_only=True, tag="state"):
    """The state of the station. MQTT retains it; the broker says offline when the station is gone.

    Attributes:
        station: name of the station.
        state: preoperational (loading), ready, busy (inspecting), halted (stopped by a person), error or offline.
        text: the reason, in a sentence; may be empty.
        since: when the state began.
        cycle: inspections since the station was started.
        software: version of arview.
    """

    station: str
    state: StateName
    text: str
    since: datetime
    cycle: int
    software: str


class RefusedMessage(PlantMessage, frozen=True, kw_only=True, tag="refused"):
    """Why a received message was not carried out.

    Attributes:
        station: name of the station.
        topic: where it was received.
        reason: which key was wrong, and what was expected.
        content: its beginning.
    """

    station: str
    topic: str
    reason: str
    content: str


def result_of(inspection: Inspection, station: str, trigger: Trigger | None = None) -> Result:
    """The result of an inspection that a trigger asked for, if any."""
    asked = Trigger(id="-") if trigger is None else trigger
    warnings = inspection.warnings
    if asked.serial and inspection.serial and asked.serial != inspection.serial:
        warnings = (*warnings, f"the trigger names serial {asked.serial}, measured was {inspection.serial}")
    return Result(
        key=content_hash(inspection.to_dict()),
        station=station,
        part=inspection.part,
        serial=inspection.serial or asked.serial,
        order=asked.order,
        recipe=asked.recipe,
        trigger="" if trigger is None else trigger.id,
        verdict=overall_verdict(inspection),
        summary=verdict_sentence(inspection),
        created=inspection.created,
        components=_values(inspection.components),
        characteristics=_values(inspection.characteristics),
        warnings=warnings,
    )


def _values(measured: Sequence[ComponentDeviation | CharacteristicResult]) -> tuple[MeasuredValue, ...]:
    return tuple(
        MeasuredValue(
            name=one.name,
            kind="displacement",
            verdict=one.verdict,
            value_mm=one.distance_mm,
            uncertainty_mm=one.uncertainty_mm,
            upper_mm=one.tolerance_mm,
            reason=one.finding.value if one.finding is not None else "",
        )
        if isinstance(one, ComponentDeviation)
        else MeasuredValue(
            name=one.name,
            kind=one.kind,
            verdict=one.verdict,
            value_mm=one.value_mm,
            uncertainty_mm=one.uncertainty_mm,
            lower_mm=one.range_mm[0],
            upper_mm=one.range_mm[1],
            reason=one.reason,
        )
        for one in measured
    )


def read_trigger(content: bytes) -> Trigger:
    """The trigger in a received message.

    Raises:
        InputError: it is not a trigger; the text names the key, and what was expected.
    """
    if len(content) > MAX_BYTES:
        raise InputError(f"trigger: has {len(content)} bytes; expected at most {MAX_BYTES}")
    try:
        return msgspec.json.decode(content, type=Trigger)
    except (ValueError, RecursionError) as error:
        keys = ", ".join(Trigger.__struct_fields__)
        raise InputError(f"trigger: {' '.join(str(error).split())[:300]}; allowed keys: {keys}") from None
