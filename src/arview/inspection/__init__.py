"""Inspection: the measured deviations of one built part, and the file ``inspection.json`` that holds them."""

from arview.inspection.details import (
    BudgetLine,
    DatumReport,
    DatumSystem,
    Details,
    DistanceReport,
    DistanceStatistics,
    ForeignReport,
    MethodAgreement,
    MethodResult,
)
from arview.inspection.files import load_inspection, save_inspection
from arview.inspection.record import (
    SCHEMA_VERSION,
    ComponentDeviation,
    Finding,
    Inspection,
    Provenance,
    Verdict,
)

__all__ = [
    "SCHEMA_VERSION",
    "BudgetLine",
    "ComponentDeviation",
    "DatumReport",
    "DatumSystem",
    "Details",
    "DistanceReport",
    "DistanceStatistics",
    "Finding",
    "ForeignReport",
    "Inspection",
    "MethodAgreement",
    "MethodResult",
    "Provenance",
    "Verdict",
    "load_inspection",
    "save_inspection",
]
