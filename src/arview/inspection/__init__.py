"""Inspection: the measured deviations of one built part, and the file ``inspection.json`` that holds them."""

from arview.inspection.details import (
    MEASURANDS,
    BudgetLine,
    DatumReport,
    DatumSystem,
    Details,
    DistanceReport,
    DistanceStatistics,
    FailedDatum,
    ForeignReport,
    HalvesDifference,
    MethodAgreement,
    MethodResult,
    Repeatability,
)
from arview.inspection.files import load_inspection, save_inspection
from arview.inspection.record import (
    SCHEMA_VERSION,
    ComponentDeviation,
    Finding,
    Inspection,
    MeasuredPresence,
    Provenance,
    Verdict,
)

__all__ = [
    "MEASURANDS",
    "SCHEMA_VERSION",
    "BudgetLine",
    "ComponentDeviation",
    "DatumReport",
    "DatumSystem",
    "Details",
    "DistanceReport",
    "DistanceStatistics",
    "FailedDatum",
    "Finding",
    "ForeignReport",
    "HalvesDifference",
    "Inspection",
    "MeasuredPresence",
    "MethodAgreement",
    "MethodResult",
    "Provenance",
    "Repeatability",
    "Verdict",
    "load_inspection",
    "save_inspection",
]
