"""Reports: an inspection as one HTML file and as PDF, with pictures, charts and a 3D view."""

from arview.report.evidence import ReportEvidence, gather
from arview.report.make import make_report

__all__ = ["ReportEvidence", "gather", "make_report"]
