"""Inspection: the measured deviations of one built part, and the file ``inspection.json`` that holds them."""

from typing import TYPE_CHECKING

from arview.core.doors import lazy_door

if TYPE_CHECKING:
    from arview.inspection.details import MEASURANDS as MEASURANDS
    from arview.inspection.details import BudgetLine as BudgetLine
    from arview.inspection.details import DatumReport as DatumReport
    from arview.inspection.details import DatumSystem as DatumSystem
    from arview.inspection.details import Details as Details
    from arview.inspection.details import DistanceReport as DistanceReport
    from arview.inspection.details import DistanceStatistics as DistanceStatistics
    from arview.inspection.details import FailedDatum as FailedDatum
    from arview.inspection.details import ForeignReport as ForeignReport
    from arview.inspection.details import HalvesDifference as HalvesDifference
    from arview.inspection.details import MethodAgreement as MethodAgreement
    from arview.inspection.details import MethodResult as MethodResult
    from arview.inspection.details import Repeatability as Repeatability
    from arview.inspection.details import Vector3 as Vector3
    from arview.inspection.document import from_document as from_document
    from arview.inspection.export import to_csv as to_csv
    from arview.inspection.export import to_dfq as to_dfq
    from arview.inspection.export import to_glb as to_glb
    from arview.inspection.export import to_qif as to_qif
    from arview.inspection.files import load_inspection as load_inspection
    from arview.inspection.files import save_inspection as save_inspection
    from arview.inspection.fingerprint import component_fingerprint as component_fingerprint
    from arview.inspection.fingerprint import content_hash as content_hash
    from arview.inspection.fingerprint import fingerprint_of_file as fingerprint_of_file
    from arview.inspection.fingerprint import values_fingerprint as values_fingerprint
    from arview.inspection.record import SCHEMA_VERSION as SCHEMA_VERSION
    from arview.inspection.record import CharacteristicResult as CharacteristicResult
    from arview.inspection.record import ComponentDeviation as ComponentDeviation
    from arview.inspection.record import Finding as Finding
    from arview.inspection.record import Inspection as Inspection
    from arview.inspection.record import MeasuredPresence as MeasuredPresence
    from arview.inspection.record import Provenance as Provenance
    from arview.inspection.record import Verdict as Verdict
    from arview.inspection.rounding import decimals_beside_limit as decimals_beside_limit
    from arview.inspection.rounding import decimals_of as decimals_of
    from arview.inspection.rounding import exact as exact
    from arview.inspection.rounding import fixed as fixed
    from arview.inspection.summary import overall_verdict as overall_verdict
    from arview.inspection.summary import verdict_sentence as verdict_sentence

__getattr__, __dir__, __all__ = lazy_door(
    __name__,
    {
        "details": (
            "BudgetLine",
            "DatumReport",
            "DatumSystem",
            "Details",
            "DistanceReport",
            "DistanceStatistics",
            "FailedDatum",
            "ForeignReport",
            "HalvesDifference",
            "MEASURANDS",
            "MethodAgreement",
            "MethodResult",
            "Repeatability",
            "Vector3",
        ),
        "document": ("from_document",),
        "export": (
            "to_csv",
            "to_dfq",
            "to_glb",
            "to_qif",
        ),
        "files": (
            "load_inspection",
            "save_inspection",
        ),
        "fingerprint": (
            "component_fingerprint",
            "content_hash",
            "fingerprint_of_file",
            "values_fingerprint",
        ),
        "record": (
            "CharacteristicResult",
            "ComponentDeviation",
            "Finding",
            "Inspection",
            "MeasuredPresence",
            "Provenance",
            "SCHEMA_VERSION",
            "Verdict",
        ),
        "rounding": (
            "decimals_beside_limit",
            "decimals_of",
            "exact",
            "fixed",
        ),
        "summary": (
            "overall_verdict",
            "verdict_sentence",
        ),
    },
)
