"""History: an append-only store of inspections, and statistics of a component over the parts that were built."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from arview.core.extras import require

if TYPE_CHECKING:
    from arview.quality.history.series import ComponentSeries, SeriesValue, series_of
    from arview.quality.history.statistics import (
        Capability,
        ControlChart,
        capability,
        capability_by_limits,
        control_chart,
    )
    from arview.quality.history.store import AddedResult, HistoryStore, StoredResult, default_store

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
    "AddedResult": "arview.quality.history.store",
    "Capability": "arview.quality.history.statistics",
    "ComponentSeries": "arview.quality.history.series",
    "ControlChart": "arview.quality.history.statistics",
    "HistoryStore": "arview.quality.history.store",
    "SeriesValue": "arview.quality.history.series",
    "StoredResult": "arview.quality.history.store",
    "capability": "arview.quality.history.statistics",
    "capability_by_limits": "arview.quality.history.statistics",
    "control_chart": "arview.quality.history.statistics",
    "default_store": "arview.quality.history.store",
    "series_of": "arview.quality.history.series",
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
