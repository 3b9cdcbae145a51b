"""The entries of a decision log as CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence

from arview.quality.decisions.entry import Decision, stamp

HEADER = (
    "part",
    "serial",
    "entry",
    "time_utc",
    "kind",
    "component",
    "decision",
    "reason",
    "by",
    "note",
    "photo",
    "step",
    "is_done",
    "inspection_sha256",
    "sha256",
    "device",
)
"""Columns. Cells that an entry of its kind does not have are empty."""


def decisions_csv(entries: Sequence[Decision], part: str = "", serial: str = "") -> str:
    """The entries as CSV with the columns of `HEADER`, RFC 4180; lines end with CR LF."""
    out = io.StringIO(newline="")
    writer = csv.writer(out)
    writer.writerow(HEADER)
    for one in entries:
        cells = (
            part,
            serial,
            str(one.number),
            stamp(one.time),
            one.kind,
            one.component,
            decision_word(one),
            one.reason,
            one.by,
            one.note,
            one.photo or "",
            "" if one.step is None else str(one.step),
            "" if one.is_done is None else str(one.is_done).lower(),
            one.inspection_sha256,
            one.sha256,
            one.device,
        )
        writer.writerow([_text(cell) for cell in cells])
    return out.getvalue()


def decided_cells(entries: Sequence[Decision]) -> dict[str, tuple[str, str, str, str]]:
    """Decision, reason, name and time of the latest decision about each component, for a table of components."""
    return {
        one.component: (decision_word(one), _text(one.reason), _text(one.by), stamp(one.time))
        for one in entries
        if one.kind == "decision"
    }


def decision_word(one: Decision) -> str:
    """``OK`` or ``not OK``; empty for what is no decision."""
    return "" if one.is_ok is None else "OK" if one.is_ok else "not OK"


def _text(cell: str) -> str:
    """A cell, with an apostrophe before a text that a spreadsheet would read as a formula."""
    return f"'{cell}" if cell[:1] in ("=", "+", "-", "@", "\t") else cell
