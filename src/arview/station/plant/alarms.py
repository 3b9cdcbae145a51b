"""Alarms by the history: signals of the control chart, a growing uncertainty, too many results without a decision."""

from __future__ import annotations

from contextlib import suppress

import numpy as np

from arview.errors import InputError
from arview.quality import history
from arview.station.plant.settings import AlarmTable

KINDS = ("nelson", "uncertainty", "undecided")
"""Kinds of these alarms."""
MIN_VALUES = 20
"""Values that a rule needs; control limits of fewer are rough."""
MIN_INCREASE = 0.2
"""Growth of U over the results looked at, as a share of where it began, that calls for an alarm."""
SIGNIFICANCE = 0.001
"""Level of the one-sided test by Kendall's rank correlation that U grows at all."""

AlarmTexts = dict[tuple[str, str], str]
"""Sentences by kind of alarm and component or characteristic; an empty one where there is no reason for the alarm."""


def history_conditions(store: history.HistoryStore, part: str, station: str, settings: AlarmTable) -> AlarmTexts:
    """The conditions of each component and characteristic in the newest results of a part at a station.

    Control limits are those of the newest results alone: what changed long ago and is normal now raises no alarm.
    """
    newest = store.listed(part, station=station, limit=settings.last)
    shares = history.open_shares(store, part, station, newest[0].measured) if newest else {}
    found: AlarmTexts = {}
    for (name, quantity), counts in shares.items():
        with suppress(InputError):  # it was never measured, or its CAD model is not the newest
            series = history.series_of(store, name, quantity, part, station, newest[0].measured)
            for kind, text in series_conditions(series, *counts, settings.undecided).items():
                found[kind, name] = found.get((kind, name)) or text
    return found


def series_conditions(
    series: history.ComponentSeries, open_count: int, count: int, max_open_share: float
) -> dict[str, str]:
    """The conditions of a series by their kind, see `AlarmTexts`.

    Args:
        series: the newest results.
        open_count, count: results without a decision, and all.
        max_open_share: share of results without a decision above which there is an alarm.
    """
    values = [one.value for one in series.values]
    return {
        "nelson": _signal(values, series.is_length),
        "uncertainty": _increase([2.0 * one.std for one in series.values if one.std is not None]),
        "undecided": f"{open_count} of the last {count} results have no decision"
        if count >= MIN_VALUES and open_count > max_open_share * count
        else "",
    }


def _signal(values: list[float], is_length: bool) -> str:
    """The rule that the newest value breaks."""
    if len(values) < MIN_VALUES:
        return ""
    rule = history.control_chart(values, is_length).signals.get(len(values) - 1)
    return f"{values[-1]:.3f}: {rule}" if rule else ""


def _increase(uncertainties: list[float]) -> str:
    """By how much U has increased; both the trend must be certain and the growth of a straight line large."""
    from scipy import stats

    if len(uncertainties) < MIN_VALUES:
        return ""
    trend = stats.kendalltau(range(len(uncertainties)), uncertainties, alternative="greater")
    end, start = np.polyval(np.polyfit(range(len(uncertainties)), uncertainties, 1), [len(uncertainties) - 1, 0])
    if end < (1.0 + MIN_INCREASE) * start or not trend.pvalue < SIGNIFICANCE:
        return ""
    return f"U grew from {start:.3f} to {end:.3f} mm over the last {len(uncertainties)} results"
