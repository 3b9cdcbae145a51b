"""Export of inspections to CSV, QIF, Q-DAS DFQ and GLB."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from arview.core.extras import require
from arview.inspection.export.csv_table import to_csv
from arview.inspection.export.dfq import to_dfq
from arview.inspection.export.glb import to_glb

if TYPE_CHECKING:
    from arview.inspection.export.qif import to_qif

__all__ = ["to_csv", "to_dfq", "to_glb", "to_qif"]


def __getattr__(name: str) -> Any:
    """Load the export to QIF when it is first used (PEP 562). Raises MissingDependencyError without lxml."""
    if name != "to_qif":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    require("QIF", "lxml")
    from arview.inspection.export.qif import to_qif

    globals()[name] = to_qif
    return to_qif
