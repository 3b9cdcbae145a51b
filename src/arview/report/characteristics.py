"""The section of a report with the characteristics of the drawing."""

from __future__ import annotations

from typing import Any

from arview.inspection import CharacteristicResult, Inspection, Verdict, decimals_of
from arview.report.formatting import NONE, VERDICT_WORD, number


def by_excess(inspection: Inspection) -> list[CharacteristicResult]:
    """The characteristics, those that matter most first: failed, not measured, undecided, then by what is left."""
    order = (Verdict.FAIL, Verdict.NOT_MEASURED, Verdict.UNDECIDED, Verdict.MEASURED, Verdict.PASS)
    return sorted(inspection.characteristics, key=lambda one: (order.index(one.verdict), -one.excess_mm))


def characteristic_row(one: CharacteristicResult) -> dict[str, Any]:
    """A row of the table of characteristics."""
    return {
        "name": one.name,
        "kind": one.kind,
        "of": ", ".join(one.of),
        "source": one.source,
        "datums": " | ".join(one.datums),
        "value": one.value_text.replace("-", "−") if one.value_mm is not None else NONE,
        "uncertainty": number(one.uncertainty_mm, decimals_of(one.uncertainty_mm)),
        "allowed": one.allowed_text.replace("-", "−"),
        "bonus": number(one.bonus_mm) if one.bonus_mm else NONE,
        "remark": "; ".join((*([one.reason] if one.reason else []), *one.notes, one.source)).strip("; "),
        "verdict": one.verdict.value,
        "word": VERDICT_WORD[one.verdict],
        "bar": _bar(one),
    }


def _bar(one: CharacteristicResult) -> dict[str, float] | None:
    """What is allowed, the value and its interval, as shares of a bar in percent; None without a value."""
    if one.value_mm is None or one.uncertainty_mm is None:
        return None
    low, high = one.range_mm
    places = [one.value_mm - one.uncertainty_mm, one.value_mm + one.uncertainty_mm, one.value_mm]
    places += [place for place in (low, high, 0.0 if one.zone_mm is not None else None) if place is not None]
    start, length = min(places), max(max(places) - min(places), 1e-9)
    shares = {place: 6.0 + 88.0 * (place - start) / length for place in places}
    return {
        "low": 0.0 if low is None else shares[low],
        "high": 100.0 if high is None else shares[high],
        "from": shares[places[0]],
        "to": shares[places[1]],
        "at": shares[places[2]],
    }
