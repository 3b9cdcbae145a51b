"""Reports: an inspection as one HTML file and as PDF, with pictures, charts and a 3D view."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from arview.core.extras import require

if TYPE_CHECKING:
    from arview.report.decisions import update_reports
    from arview.report.evidence import ReportEvidence, gather
    from arview.report.make import make_report

__all__ = [
    "ReportEvidence",
    "gather",
    "make_report",
    "update_reports",
]

_MODULE_OF = {
    "ReportEvidence": "arview.report.evidence",
    "gather": "arview.report.evidence",
    "make_report": "arview.report.make",
    "update_reports": "arview.report.decisions",
}


def __getattr__(name: str) -> Any:
    """Load a name when it is first used (PEP 562). Raises MissingDependencyError without the extra."""
    module = _MODULE_OF.get(name)
    if module is None:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    require("a report", "jinja2", "markupsafe", "matplotlib")
    value = getattr(import_module(module), name)
    globals()[name] = value
    return value
