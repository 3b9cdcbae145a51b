"""History: an append-only store of inspections, and statistics of a component over the parts that were built."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from arview.core.extras import require

if TYPE_CHECKING:
    from arview.history.series import ComponentSeries, SeriesValue, series_of
    from arview.history.statistics import Capability, ControlChart, capability, capability_by_limits, control_chart
    from arview.history.store import AddedResult, HistoryStore, StoredResult, default_store

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
    "default_store",
    "series_of",
]

_MODULE_OF = {
    "AddedResult": "arview.history.store",
    "Capability": "arview.history.statistics",
    "ComponentSeries": "arview.history.series",
    "ControlChart": "arview.history.statistics",
    "HistoryStore": "arview.history.store",
    "SeriesValue": "arview.history.series",
    "StoredResult": "arview.history.store",
    "capability": "arview.history.statistics",
    "capability_by_limits": "arview.history.statistics",
    "control_chart": "arview.history.statistics",
    "default_store": "arview.history.store",
    "series_of": "arview.history.series",
}


def __getattr__(name: str) -> Any:
    """Load a name when it is first used (PEP 562). Raises MissingDependencyError without the extra."""
    module = _MODULE_OF.get(name)
    if module is None:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    require("the results store", "sqlalchemy")
    value = getattr(import_module(module), name)
    globals()[name] = value
    return value
