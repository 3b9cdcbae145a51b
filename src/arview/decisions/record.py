"""What the people's decisions say of a part together, beside what was measured; neither changes the other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from arview.decisions.entry import Decision, decision_document, stamp
from arview.decisions.log import LogContent
from arview.inspection import ComponentDeviation, Finding, Inspection, Verdict

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
class RecordState:
    """The decisions of people about one inspection.

    Attributes:
        sentence: what they decided together, in words; empty without any entry.
        is_released: signed, with every component that did not pass accepted and none rejected.
        signature: the last one, also if it is void; None if nobody signed.
        accepted: decisions that take a component that did not pass.
        rejected: decisions that do not take a component.
        undecided: components that did not pass and that nobody decided about.
        earlier: decisions that were made about an earlier inspection.
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
    faults: tuple[str, ...] = ()
    notices: tuple[str, ...] = ()


def record_state(inspection: Inspection, sha256: str, content: LogContent) -> RecordState:
    """What a log of decisions says of an inspection.

    Args:
        inspection: the inspection.
        sha256: its fingerprint, see `fingerprint_of_file`.
        content: of the log.
    """
    latest = {one.component: one for one in content.entries if one.kind == "decision"}
    passed = {one.name for one in inspection.components if one.verdict in (Verdict.PASS, Verdict.MEASURED)}
    accepted = tuple(one for name, one in latest.items() if one.is_ok and name not in passed)
    rejected = tuple(one for one in latest.values() if not one.is_ok)
    undecided = [one for one in inspection.components if one.name not in passed and one.name not in latest]
    signature = _signature(content.entries, sha256)
    holds = signature is not None and not signature.void and not content.faults
    is_released = holds and not rejected and not undecided
    return RecordState(
        sentence=_sentence(inspection, content, signature, accepted, rejected, undecided, is_released),
        is_released=is_released,
        signature=signature,
        accepted=accepted,
        rejected=rejected,
        undecided=tuple(one.name for one in undecided),
        earlier=tuple(one for one in latest.values() if one.inspection_sha256 not in ("", sha256)),
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
        "faults": list(state.faults),
        "notices": list(state.notices),
    }


def _signature(entries: Sequence[Decision], sha256: str) -> Signature | None:
    """The last signature, and why it does not hold."""
    places = [place for place, one in enumerate(entries) if one.kind == "signature"]
    if not places:
        return None
    signed = entries[places[-1]]
    later = [one for one in entries[places[-1] + 1 :] if one.kind == "decision"]
    if later:
        word = "decisions" if len(later) > 1 else "a decision"
        names = ", ".join(dict.fromkeys(one.component for one in later))
        return Signature(signed, f"{word} on {names} came after it")
    if signed.inspection_sha256 != sha256:
        return Signature(signed, "the inspection is another than the one that was signed")
    return Signature(signed)


def _sentence(
    inspection: Inspection, content: LogContent, signature: Signature | None, accepted: Sequence[Decision],
    rejected: Sequence[Decision], undecided: Sequence[ComponentDeviation], is_released: bool,
) -> str:  # fmt: skip
    if content.faults:
        return "not valid: the log of decisions was changed after it was written"
    if not content.entries:
        return ""
    if signature is None:
        return f"not signed{_tail(': ', inspection, accepted, rejected, undecided)}"
    who = f"{signature.entry.by}, {stamp(signature.entry.time)[:16].replace('T', ' ')} UTC"
    if signature.void:
        return f"the signature of {who}, is void: {signature.void}"
    if is_released:
        return f"released by {who}{_tail(', with ' if accepted else ', ', inspection, accepted, (), ())}"
    return f"signed by {who}, not released{_tail(': ', inspection, accepted, rejected, undecided)}"


def _tail(
    lead: str, inspection: Inspection, accepted: Sequence[Decision], rejected: Sequence[Decision],
    undecided: Sequence[ComponentDeviation],
) -> str:  # fmt: skip
    """What was accepted, rejected and left open, after a lead; empty if there is nothing to say."""
    parts = []
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
    return f"{lead}{', '.join(parts)}" if parts else ""


def _why_open(one: ComponentDeviation) -> str:
    return "is missing" if one.finding is Finding.MISSING else _OPEN_WORDS.get(one.verdict, one.verdict.value)
