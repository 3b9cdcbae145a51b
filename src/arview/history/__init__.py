"""History: a store of inspections that only grows, and what it says of a component over time."""

from arview.history.series import Series, Value, series_of
from arview.history.statistics import Capability, ControlChart, capability, control_chart
from arview.history.store import Added, HistoryStore, Listed

__all__ = [
    "Added",
    "Capability",
    "ControlChart",
    "HistoryStore",
    "Listed",
    "Series",
    "Value",
    "capability",
    "control_chart",
    "series_of",
]
