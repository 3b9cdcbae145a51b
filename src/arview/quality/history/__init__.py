"""History: an append-only store of inspections, and statistics of a component over the parts that were built."""

from arview.quality.history.series import ComponentSeries, SeriesValue, series_of
from arview.quality.history.statistics import Capability, ControlChart, capability, capability_by_limits, control_chart
from arview.quality.history.store import AddedResult, HistoryStore, StoredResult

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
