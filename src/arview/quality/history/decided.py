"""Decisions by people in the results store: rows of a log, their check, and what they say of a stored result."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from typing import Any

from arview.inspection import Verdict, from_document
from arview.quality import decisions


def new_rows(
    result_id: int, entries: Sequence[decisions.Decision], known: Mapping[int, str]
) -> tuple[list[dict[str, Any]], list[str]]:
    """Rows of the entries of a log that a store does not have, and what contradicts the entries that it has.

    Args:
        result_id: number of the result.
        entries: of the log.
        known: hashes of the stored entries by their numbers.
    """
    hashes = {one.number: one.sha256 for one in entries}
    faults = [
        f"decision {number} of the log {'is not the one' if number in hashes else 'is gone, but it is'} in the store:"
        " the log was written anew"
        for number, sha256 in sorted(known.items())
        if hashes.get(number) != sha256
    ]
    return [_row(result_id, one) for one in entries if one.number not in known], faults[:1]


def _row(result_id: int, one: decisions.Decision) -> dict[str, Any]:
    return {
        "result_id": result_id,
        "number": one.number,
        "kind": one.kind,
        "time": decisions.stamp(one.time),
        "by": one.by,
        "component": one.component,
        "is_ok": None if one.is_ok is None else int(one.is_ok),
        "reason": one.reason,
        "note": one.note,
        "photo": one.photo,
        "step": one.step,
        "is_done": None if one.is_done is None else int(one.is_done),
        "inspection_sha256": one.inspection_sha256,
        "rechecks": " ".join(one.rechecks),
        "previous": one.previous,
        "sha256": one.sha256,
    }


def decision_of_row(row: Any) -> decisions.Decision:
    """The entry that a row of the store holds."""
    return decisions.Decision(
        number=int(row.number),
        kind=row.kind,
        time=datetime.fromisoformat(row.time),
        by=row.by,
        component=row.component,
        is_ok=None if row.is_ok is None else bool(row.is_ok),
        reason=row.reason,
        note=row.note,
        photo=row.photo,
        step=row.step,
        is_done=None if row.is_done is None else bool(row.is_done),
        inspection_sha256=row.inspection_sha256,
        rechecks=tuple(row.rechecks.split()),
        previous=row.previous,
        sha256=row.sha256,
    )


def decided_faults(entries: Sequence[decisions.Decision]) -> list[str]:
    """What was changed in the stored entries of one log after they were added."""
    before, faults = decisions.FIRST, []
    for number, one in enumerate(entries, 1):
        if one.number != number or one.previous != before:
            faults.append(f"decision {number} was removed or changed")
            break
        if hashlib.sha256(decisions.line_of(one)).hexdigest() != one.sha256:
            faults.append(f"decision {number} was changed")
            break
        before = one.sha256
    return faults


def stored_state(
    document: str, content_hash: str, entries: Sequence[decisions.Decision], find: Callable[[str], str | None]
) -> decisions.RecordState:
    """What the decisions say of a stored result.

    Args:
        document: its inspection, as JSON.
        content_hash: its hash.
        entries: about it.
        find: the document of another result by its hash, for the checks of reworked components that were signed.
    """
    content = decisions.LogContent(entries=tuple(entries), faults=tuple(decided_faults(entries)))
    signed = [one for one in entries if one.kind == "signature"]
    rechecks = [_recheck(sha256, find(sha256)) for sha256 in (signed[-1].rechecks if signed else ())]
    return decisions.record_state(from_document(json.loads(document)), content_hash, content, rechecks)


def _recheck(sha256: str, document: str | None) -> decisions.Recheck:
    """A check of reworked components; without any if the store does not have it."""
    if document is None:
        return decisions.Recheck(sha256, datetime.fromtimestamp(0.0, UTC), ())
    inspection = from_document(json.loads(document))
    measured = tuple(one for one in inspection.components if one.verdict is not Verdict.NOT_MEASURED)
    return decisions.Recheck(sha256, inspection.created, measured, inspection.provenance.photos_hash)
