"""Export of stored results: a line for each component (CSV), or complete inspections (JSON lines)."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from typing import Any

from arview.inspection import decimals_beside_limit, decimals_of, exact, fixed
from arview.quality import decisions
from arview.quality.history.store import HistoryStore, StoredResult

HEADER = (
    "result",
    "content_hash",
    "part",
    "serial",
    "station",
    "measured_utc",
    "added_utc",
    "part_verdict",
    "component",
    "verdict",
    "finding",
    "dx_mm",
    "dy_mm",
    "dz_mm",
    "distance_mm",
    "U_mm",
    "tolerance_mm",
    "tilt_deg",
    "twist_deg",
    "decision",
    "decision_reason",
    "decision_by",
    "decision_utc",
    "record",
)


def to_csv(store: HistoryStore, found: Sequence[StoredResult]) -> bytes:
    """The components of results as CSV, UTF-8, RFC 4180; cells of undetermined values are empty.

    Measured values are rounded to what their U allows; the JSON lines keep every digit. The last columns hold the
    latest decision of a person about the component, and what was decided about the whole part.
    """
    out = io.StringIO(newline="")
    writer = csv.writer(out)
    writer.writerow(HEADER)
    by_id = {one.id: one for one in found}
    decided = store.decided(list(by_id))
    records = {number: record_sentence(store, by_id[number], entries) for number, entries in decided.items()}
    latest = {
        (number, entry.component): entry
        for number, entries in decided.items()
        for entry in entries
        if entry.kind == "decision"
    }
    for row in store.components([one.id for one in found]):
        one = by_id[row["result_id"]]
        writer.writerow(
            [
                one.id,
                one.content_hash,
                _text(one.part),
                _text(one.serial),
                _text(one.station),
                f"{one.measured:%Y-%m-%dT%H:%M:%SZ}",
                f"{one.added:%Y-%m-%dT%H:%M:%SZ}",
                one.verdict,
                _text(row["name"]),
                row["verdict"],
                row["finding"] or "",
                *_numbers(row),
                *_decided(latest.get((one.id, row["name"]))),
                _text(records.get(one.id, "")),
            ]
        )
    return out.getvalue().encode("utf-8")


def _numbers(row: dict[str, Any]) -> list[str]:
    u, tolerance, distance = row["uncertainty_mm"], row["tolerance_mm"], row["distance_mm"]
    decimals = {key: decimals_of(u) for key in ("dx_mm", "dy_mm", "dz_mm", "uncertainty_mm")}
    decimals["distance_mm"] = decimals_beside_limit(distance or 0.0, u, tolerance)
    decimals |= {"tilt_deg": decimals_of(None), "twist_deg": decimals_of(None)}
    cells = {key: "" if row[key] is None else fixed(row[key], digits) for key, digits in decimals.items()}
    cells["tolerance_mm"] = "" if tolerance is None else exact(tolerance)
    keys = ("dx_mm", "dy_mm", "dz_mm", "distance_mm", "uncertainty_mm", "tolerance_mm", "tilt_deg", "twist_deg")
    return [cells[key] for key in keys]


def _decided(one: decisions.Decision | None) -> list[str]:
    if one is None:
        return ["", "", "", ""]
    return [decisions.decision_word(one), _text(one.reason), _text(one.by), f"{one.time:%Y-%m-%dT%H:%M:%SZ}"]


def record_sentence(store: HistoryStore, one: StoredResult, entries: Sequence[decisions.Decision]) -> str:
    """What people decided about a stored result, in words."""
    return store.state(one, entries).sentence


def to_json_lines(store: HistoryStore, found: Sequence[StoredResult]) -> bytes:
    """The inspections as JSON, one per line, in the given order."""
    return "".join(f"{store.find(one.content_hash)[1]}\n" for one in found).encode("utf-8")


def _text(cell: str) -> str:
    """A cell, with an apostrophe before a text that a spreadsheet would read as a formula."""
    return f"'{cell}" if cell[:1] in ("=", "+", "-", "@", "\t") else cell
