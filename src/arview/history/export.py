"""Results of a store as files: a line for each component (CSV), or the whole inspections (JSON lines)."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence

from arview.history.store import HistoryStore, Listed

HEADER = (
    "result", "content_hash", "part", "serial", "station", "measured_utc", "added_utc", "part_verdict", "component",
    "verdict", "finding", "dx_mm", "dy_mm", "dz_mm", "distance_mm", "U_mm", "tolerance_mm", "tilt_deg", "twist_deg",
)  # fmt: skip
_COLUMNS = ("dx_mm", "dy_mm", "dz_mm", "distance_mm", "uncertainty_mm", "tolerance_mm", "tilt_deg", "twist_deg")


def to_csv(store: HistoryStore, found: Sequence[Listed]) -> bytes:
    """UTF-8, RFC 4180; what is undetermined is empty."""
    out = io.StringIO(newline="")
    writer = csv.writer(out)
    writer.writerow(HEADER)
    by_id = {one.id: one for one in found}
    for row in store.components([one.id for one in found]):
        one = by_id[row["result_id"]]
        numbers = ["" if row[key] is None else f"{row[key]:.6f}" for key in _COLUMNS]
        writer.writerow(
            [one.id, one.content_hash, _text(one.part), _text(one.serial), _text(one.station),
             f"{one.measured:%Y-%m-%dT%H:%M:%SZ}", f"{one.added:%Y-%m-%dT%H:%M:%SZ}", one.verdict, _text(row["name"]),
             row["verdict"], row["finding"] or "", *numbers]
        )  # fmt: skip
    return out.getvalue().encode("utf-8")


def to_json_lines(store: HistoryStore, found: Sequence[Listed]) -> bytes:
    """The inspections themselves, one a line, in the order given."""
    return "".join(f"{store.find(one.content_hash)[1]}\n" for one in found).encode("utf-8")


def _text(cell: str) -> str:
    """Not to be taken for a formula by a spreadsheet."""
    return f"'{cell}" if cell[:1] in ("=", "+", "-", "@", "\t") else cell
