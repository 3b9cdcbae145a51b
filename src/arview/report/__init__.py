"""Reports: an inspection as one HTML file and as PDF, with pictures, charts and a 3D view."""

from typing import TYPE_CHECKING

from arview.core.doors import lazy_door

if TYPE_CHECKING:
    from arview.report.decisions import update_reports as update_reports
    from arview.report.evidence import ReportEvidence as ReportEvidence
    from arview.report.evidence import gather as gather
    from arview.report.make import make_report as make_report

__getattr__, __dir__, __all__ = lazy_door(
    __name__,
    {
        "decisions": ("update_reports",),
        "evidence": (
            "ReportEvidence",
            "gather",
        ),
        "make": ("make_report",),
    },
    needs=("a report", "jinja2", "markupsafe", "matplotlib"),
)
