"""One entry of a decision log: a decision about a component, the tick of a step, or a signature."""

from __future__ import annotations

import json
import unicodedata
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, Literal

from arview.errors import InputError

Kind = Literal["decision", "tick", "signature"]
KINDS: tuple[Kind, ...] = ("decision", "tick", "signature")
FIRST = "0" * 64
"""What the first entry names in place of the hash of an entry before it."""


NAME = 200
"""Longest names of people, components and photos, characters."""
TEXT = 4000
"""Longest reasons and notes, characters."""


@dataclass(frozen=True)
class Decision:
    """One entry of a decision log. Fields that its kind does not have are empty.

    Attributes:
        number: 1, 2, 3, … in the order of the log.
        kind: decision, tick or signature.
        time: when it was written, UTC.
        by: name of the person.
        component: of a decision and of a tick.
        is_ok: of a decision: whether the person takes the component as it is.
        reason: of a decision: why.
        note: free text of a decision or a signature.
        photo: of a decision: name of a photo that shows it.
        step: of a tick: index of the step of the rework.
        is_done: of a tick.
        inspection_sha256: fingerprint of the values that were signed (`values_fingerprint`) or decided about
            (`component_fingerprint`); in older logs of the inspection's file; empty if unknown.
        device: on which it was made, of those that are paired with the station; empty on the command line.
        rechecks: of a signature: fingerprints of the checks of reworked components that it holds for, in their order.
        previous: SHA-256 of the line before it.
        sha256: SHA-256 of its own line.
    """

    number: int
    kind: Kind
    time: datetime
    by: str
    component: str = ""
    is_ok: bool | None = None
    reason: str = ""
    note: str = ""
    photo: str | None = None
    step: int | None = None
    is_done: bool | None = None
    inspection_sha256: str = ""
    device: str = ""
    rechecks: tuple[str, ...] = ()
    previous: str = FIRST
    sha256: str = ""


_FIELDS: dict[Kind, tuple[str, ...]] = {
    "decision": ("component", "is_ok", "reason", "note", "photo", "inspection_sha256"),
    "tick": ("component", "step", "is_done"),
    "signature": ("note", "inspection_sha256", "rechecks"),
}
_TYPES: dict[str, tuple[type, ...]] = {
    "component": (str,),
    "is_ok": (bool,),
    "reason": (str,),
    "note": (str,),
    "photo": (str, type(None)),
    "step": (int,),
    "is_done": (bool,),
    "inspection_sha256": (str,),
    "rechecks": (list,),
}


def decision_document(entry: Decision) -> dict[str, Any]:
    """The entry as JSON, with the fields of its kind; what the log holds, the page gets and the exports write."""
    values: dict[str, Any] = {
        "entry": entry.number,
        "kind": entry.kind,
        "time": stamp(entry.time),
        "by": entry.by,
    }
    values |= {name: getattr(entry, name) for name in _FIELDS[entry.kind]}
    values |= {name: list(value) for name, value in values.items() if isinstance(value, tuple)}
    values |= {"device": entry.device} if entry.device else {}
    return values | {"previous": entry.previous}


def line_of(entry: Decision) -> bytes:
    """The line of an entry in the log, without its end."""
    return json.dumps(decision_document(entry), ensure_ascii=False, separators=(",", ":")).encode("utf-8")


def entry_of(line: bytes, sha256: str) -> Decision:
    """The entry that a line of the log holds.

    Raises:
        ValueError: the line is no entry.
    """
    document = json.loads(line.decode("utf-8"))
    if not isinstance(document, dict) or document.get("kind") not in KINDS:
        raise ValueError("not an entry")
    kind: Kind = document["kind"]
    if set(document) - {"device"} != {"entry", "kind", "time", "by", "previous", *_FIELDS[kind]}:
        raise ValueError("fields are missing or unknown")
    number, moment = document["entry"], datetime.fromisoformat(document["time"])
    if type(number) is not int or moment.tzinfo is None or not isinstance(document["by"], str):
        raise ValueError("a field has another type")
    if not isinstance(document["previous"], str):
        raise ValueError("a field has another type")
    for name in _FIELDS[kind]:
        if type(document[name]) not in _TYPES[name]:
            raise ValueError(f"{name} has another type")
    values = {name: document[name] for name in _FIELDS[kind]}
    if "rechecks" in values:
        if not all(isinstance(one, str) for one in values["rechecks"]):
            raise ValueError("rechecks has another type")
        values["rechecks"] = tuple(values["rechecks"])
    return Decision(
        number=number,
        kind=kind,
        time=moment.astimezone(UTC),
        by=document["by"],
        previous=document["previous"],
        device=str(document.get("device", "")),
        sha256=sha256,
        **values,
    )


def stamp(moment: datetime) -> str:
    """A time as text, UTC, to the millisecond."""
    return moment.astimezone(UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


def checked_name(value: object, what: str, required: bool = True) -> str:
    """A name of one line, without spaces at its ends.

    Raises:
        InputError: it is no text, empty though required, too long, or holds control characters.
    """
    return _checked(value, what, NAME, required, "")


def checked_text(value: object, what: str, required: bool = False) -> str:
    """A text of one or more lines, without spaces at its ends.

    Raises:
        InputError: as `checked_name`; line ends and tabs are allowed.
    """
    return _checked(value, what, TEXT, required, "\n\t")


def _checked(value: object, what: str, longest: int, required: bool, allowed: str) -> str:
    if not isinstance(value, str):
        raise InputError(f"{what}: expected text, got {type(value).__name__}")
    text = value.replace("\r\n", "\n").strip()
    if required and not text:
        raise InputError(f"{what}: is empty")
    if len(text) > longest:
        raise InputError(f"{what}: has {len(text)} characters; at most {longest} are kept")
    if any(unicodedata.category(one) in ("Cc", "Cs") and one not in allowed for one in text):
        raise InputError(f"{what}: holds a control character")
    return text
