"""What the people's decisions say of a part together, beside what was measured; neither changes the other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from arview.inspection import (
    ComponentDeviation,
    Finding,
    Inspection,
    Verdict,
    component_fingerprint,
    values_fingerprint,
)
from arview.quality.decisions.entry import Decision, decision_document, stamp
from arview.quality.decisions.log import LogContent

_OPEN_WORDS = {
    Verdict.FAIL: "is out of tolerance",
    Verdict.UNDECIDED: "is undecided",
    Verdict.NOT_MEASURED: "was not measured",
}


@dataclass(frozen=True)
class Signature:
    """A signature and whether it still holds.

    Attributes:
        entry: of the log.
        void: why it does not count; empty if it does.
    """

    entry: Decision
    void: str = ""


@dataclass(frozen=True)
class Recheck:
    """Components that were measured again after their rework.

    Attributes:
        sha256: fingerprint of the inspection that holds them.
        created: time of the measurement, UTC.
        components: those that were checked.
        photos_hash: of its photos.
    """

    sha256: str
    created: datetime
    components: tuple[ComponentDeviation, ...]
    photos_hash: str = ""


@dataclass(frozen=True)
class CheckedAgain:
    """A component at the first measurement and at its newest check."""

    before: ComponentDeviation
    after: ComponentDeviation
    created: datetime


@dataclass(frozen=True)
class RecordState:
    """The decisions of people about one inspection.

    Attributes:
        sentence: what they decided together, in words; empty without any entry.
        is_released: signed, with every component that did not pass accepted and none rejected.
        signature: the last one, also if it is void; None if nobody signed.
        accepted: decisions that take a component that did not pass.
        rejected: decisions that do not take a component.
        undecided: components that did not pass and that nobody decided about.
        earlier: decisions about an earlier measurement of the component, which no longer count.
        rechecked: components that were measured again after their rework; what counts is their newest measurement.
        faults: what was changed in the log; with any of them nothing is released.
        notices: remarks on the log that are no faults.
    """

    sentence: str = ""
    is_released: bool = False
    signature: Signature | None = None
    accepted: tuple[Decision, ...] = ()
    rejected: tuple[Decision, ...] = ()
    undecided: tuple[str, ...] = ()
    earlier: tuple[Decision, ...] = ()
    rechecked: tuple[CheckedAgain, ...] = ()
    faults: tuple[str, ...] = ()
    notices: tuple[str, ...] = ()


def record_state(
    inspection: Inspection, sha256: str, content: LogContent, rechecks: Sequence[Recheck] = ()
) -> RecordState:
    """What a log of decisions says of an inspection.

    Args:
        inspection: the inspection.
        sha256: fingerprint of its file, see `fingerprint_of_file`, which older logs name.
        content: of the log.
        rechecks: checks of reworked components, in their order.
    """
    newest = {one.name: one for one in inspection.components}
    measured = dict.fromkeys(newest, 0)
    values = {name: component_fingerprint(inspection, one) for name, one in newest.items()}
    created = dict.fromkeys(newest, inspection.created)
    for place, check in enumerate(rechecks, 1):
        for one in check.components:
            if one.name in newest:
                newest[one.name], measured[one.name], created[one.name] = one, place, check.created
                values[one.name] = component_fingerprint(inspection, one, check.photos_hash)
    places = {one: place for place, one in enumerate([sha256, *(check.sha256 for check in rechecks)])}
    made = {one.component: one for one in content.entries if one.kind == "decision"}
    # A decision is about one measurement: a newer one of its component has to be decided about anew.
    latest = {
        name: one
        for name, one in made.items()
        if one.inspection_sha256 in ("", values.get(name))
        or places.get(one.inspection_sha256, -1) >= measured.get(name, 0)
    }
    passed = {name for name, one in newest.items() if one.verdict in (Verdict.PASS, Verdict.MEASURED)}
    accepted = tuple(one for name, one in latest.items() if one.is_ok and name not in passed)
    rejected = tuple(one for one in latest.values() if not one.is_ok)
    undecided = [one for name, one in newest.items() if name not in passed and name not in latest]
    known = (sha256, values_fingerprint(inspection))
    signature = _signature(content.entries, known, tuple(check.sha256 for check in rechecks))
    holds = signature is not None and not signature.void and not content.faults
    is_released = holds and not rejected and not undecided
    checked = tuple(
        CheckedAgain(one, newest[one.name], created[one.name]) for one in inspection.components if measured[one.name]
    )
    tail = _tail(inspection, accepted, () if is_released else rejected, () if is_released else undecided, checked)
    return RecordState(
        sentence=_sentence(content, signature, is_released, tail),
        is_released=is_released,
        signature=signature,
        accepted=accepted,
        rejected=rejected,
        undecided=tuple(one.name for one in undecided),
        earlier=tuple(one for name, one in made.items() if name not in latest),
        rechecked=checked,
        faults=content.faults,
        notices=content.notices,
    )


def state_document(state: RecordState) -> dict[str, Any]:
    """The state as JSON: what the page shows beside the measured verdict."""
    signed = state.signature
    return {
        "sentence": state.sentence,
        "is_released": state.is_released,
        "signature": None if signed is None else decision_document(signed.entry) | {"void": signed.void},
        "accepted": [one.component for one in state.accepted],
        "rejected": [one.component for one in state.rejected],
        "undecided": list(state.undecided),
        "earlier": [one.component for one in state.earlier],
        "rechecked": [one.after.name for one in state.rechecked],
        "faults": list(state.faults),
        "notices": list(state.notices),
    }


def _signature(entries: Sequence[Decision], known: Sequence[str], rechecks: tuple[str, ...]) -> Signature | None:
    """The last signature, and why it does not hold; ``known`` are the fingerprints of the inspection."""
    places = [place for place, one in enumerate(entries) if one.kind == "signature"]
    if not places:
        return None
    signed = entries[places[-1]]
    later = [one for one in entries[places[-1] + 1 :] if one.kind == "decision"]
    if later:
        word = "decisions" if len(later) > 1 else "a decision"
        names = ", ".join(dict.fromkeys(one.component for one in later))
        return Signature(signed, f"{word} on {names} came after it")
    if signed.inspection_sha256 not in known:
        return Signature(signed, "it was made about earlier values, and they have changed since")
    if signed.rechecks != rechecks:
        return Signature(signed, "components were checked again after it, or their checks have changed")
    return Signature(signed)


def _sentence(content: LogContent, signature: Signature | None, is_released: bool, tail: Sequence[str]) -> str:
    if content.faults:
        return "not valid: the log of decisions was changed after it was written"
    if not content.entries:
        return ""
    parts = ", ".join(tail)
    if signature is None:
        return f"not signed: {parts}" if parts else "not signed"
    who = f"{signature.entry.by}, {stamp(signature.entry.time)[:16].replace('T', ' ')} UTC"
    if signature.void:
        return f"the signature of {who}, is void: {signature.void}"
    if is_released:
        return f"released by {who}, with {parts}" if parts else f"released by {who}"
    return f"signed by {who}, not released: {parts}"


def _tail(
    inspection: Inspection,
    accepted: Sequence[Decision],
    rejected: Sequence[Decision],
    undecided: Sequence[ComponentDeviation],
    checked: Sequence[CheckedAgain],
) -> list[str]:
    """What was put right, accepted, rejected and left open."""
    parts = []
    right = [one.after.name for one in checked if one.after.verdict is Verdict.PASS]
    if right:
        parts.append(f"{', '.join(right)} in tolerance after rework")
    if accepted:
        reasons = "; ".join(f"{one.component}: {one.reason or 'no reason given'}" for one in accepted)
        parts.append(f"{len(accepted)} deviation{'s' * (len(accepted) > 1)} accepted ({reasons})")
    if rejected:
        parts.append("not OK: " + "; ".join(f"{one.component}: {one.reason}" for one in rejected))
    if undecided:
        parts.append("open: " + "; ".join(f"{one.name} {_why_open(one)}" for one in undecided))
    if inspection.foreign_objects:
        count = len(inspection.foreign_objects)
        parts.append(f"{count} foreign object{'s' * (count > 1)} on the part")
    return parts


def _why_open(one: ComponentDeviation) -> str:
    return "is missing" if one.finding is Finding.MISSING else _OPEN_WORDS.get(one.verdict, one.verdict.value)
