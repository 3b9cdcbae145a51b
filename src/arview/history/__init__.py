"""History: an append-only store of inspections, and statistics of a component over the parts that were built."""

from arview.history.series import ComponentSeries, SeriesValue, series_of
from arview.history.statistics import Capability, ControlChart, capability, capability_by_limits, control_chart
from arview.history.store import AddedResult, HistoryStore, StoredResult

__all__ = [
    "AddedResult",
    "Capability",
    "ComponentSeries",
    "ControlChart",
    "HistoryStore",
    "SeriesValue",
    "StoredResult",
    "capability",
    "capability_by_limits",
    "control_chart",
    "series_of",
]
