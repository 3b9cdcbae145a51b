"""History: an append-only store of inspections, and statistics of a component over the parts that were built."""

from typing import TYPE_CHECKING

from arview.core.doors import lazy_door

if TYPE_CHECKING:
    from arview.quality.history.chart import FORMATS as FORMATS
    from arview.quality.history.chart import draw as draw
    from arview.quality.history.connection import default_store as default_store
    from arview.quality.history.export import to_csv as to_csv
    from arview.quality.history.export import to_json_lines as to_json_lines
    from arview.quality.history.gauge import GaugeStudy as GaugeStudy
    from arview.quality.history.gauge import crossed as crossed
    from arview.quality.history.gauge import study_by_anova as study_by_anova
    from arview.quality.history.gauge import study_by_ranges as study_by_ranges
    from arview.quality.history.gauge import type_one as type_one
    from arview.quality.history.gauge import vda5 as vda5
    from arview.quality.history.page import application as application
    from arview.quality.history.series import ComponentSeries as ComponentSeries
    from arview.quality.history.series import SeriesValue as SeriesValue
    from arview.quality.history.series import limits_text as limits_text
    from arview.quality.history.series import open_shares as open_shares
    from arview.quality.history.series import series_of as series_of
    from arview.quality.history.statistics import Capability as Capability
    from arview.quality.history.statistics import ControlChart as ControlChart
    from arview.quality.history.statistics import capability as capability
    from arview.quality.history.statistics import capability_by_limits as capability_by_limits
    from arview.quality.history.statistics import control_chart as control_chart
    from arview.quality.history.store import AddedResult as AddedResult
    from arview.quality.history.store import HistoryStore as HistoryStore
    from arview.quality.history.store import StoredResult as StoredResult

__getattr__, __dir__, __all__ = lazy_door(
    __name__,
    {
        "chart": (
            "FORMATS",
            "draw",
        ),
        "connection": ("default_store",),
        "export": (
            "to_csv",
            "to_json_lines",
        ),
        "gauge": (
            "GaugeStudy",
            "crossed",
            "study_by_anova",
            "study_by_ranges",
            "type_one",
            "vda5",
        ),
        "page": ("application",),
        "series": (
            "ComponentSeries",
            "SeriesValue",
            "limits_text",
            "open_shares",
            "series_of",
        ),
        "statistics": (
            "Capability",
            "ControlChart",
            "capability",
            "capability_by_limits",
            "control_chart",
        ),
        "store": (
            "AddedResult",
            "HistoryStore",
            "StoredResult",
        ),
    },
    needs=("the results store", "sqlalchemy"),
)
