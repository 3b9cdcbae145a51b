"""The JSON document of an inspection: from the document to the record; back it is `Inspection.to_dict`."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any

from arview.errors import InputError
from arview.inspection.details import (
    DatumSystem,
    Details,
    DistanceReport,
    ForeignReport,
    Repeatability,
    from_json,
)
from arview.inspection.record import (
    CharacteristicResult,
    ComponentDeviation,
    Finding,
    Inspection,
    MeasuredPresence,
    Provenance,
    Verdict,
)


def from_document(document: dict[str, Any]) -> Inspection:
    """The inspection of a document without faults (see `arview.inspection.validation`)."""
    created = moment(document["created"])
    components = [component_from_entry(entry) for entry in document["components"]]
    source = document["provenance"]
    datums, distances = document.get("datum_system"), document.get("distance_map")
    halves = document.get("repeatability")
    return Inspection(
        part=document["part"],
        serial=document["serial"],
        model_hash=document["model_hash"],
        created=created,
        components=tuple(components),
        provenance=Provenance(
            source["tool"],
            source["version"],
            source["method"],
            note=source.get("note", ""),
            photos_hash=source.get("photos_hash", ""),
            photos=source.get("photos", 0),
            software=tuple(source.get("software", {}).items()),
            options=tuple(source.get("options", {}).items()),
            cpu_s=source.get("cpu_s"),
        ),
        drawing=document.get("drawing", ""),
        characteristics=tuple(from_json(CharacteristicResult, one) for one in document.get("characteristics", ())),
        datum_system=None if datums is None else from_json(DatumSystem, datums),
        warnings=tuple(document.get("warnings", ())),
        foreign_objects=tuple(from_json(ForeignReport, one) for one in document.get("foreign_objects", ())),
        distance_map=None if distances is None else from_json(DistanceReport, distances),
        repeatability=None if halves is None else from_json(Repeatability, halves),
    )


def moment(text: str) -> datetime:
    """The time of a measurement, UTC; the text may have another offset.

    Raises:
        InputError: the text is not a date and time.
    """
    try:
        return datetime.fromisoformat(text).astimezone(UTC)
    except (ValueError, OverflowError) as error:
        raise InputError(f"created: {text!r} is not a date and time ({error})") from None


def component_from_entry(entry: dict[str, Any]) -> ComponentDeviation:
    """The record of a component from its entry in the document.

    Raises:
        RecordError: the fields of the entry contradict each other.
    """
    rotation = entry.get("rotation") or {}
    finding = entry.get("finding")
    dx, dy, dz = (None if value is None else float(value) for value in entry["displacement_mm"])
    return ComponentDeviation(
        name=entry["name"],
        displacement_mm=(dx, dy, dz),
        distance_mm=entry["distance_mm"],
        observable=tuple(entry["observable"]),
        uncertainty_mm=entry["uncertainty_mm"],
        tolerance_mm=entry["tolerance_mm"],
        verdict=Verdict(entry["verdict"]),
        tilt_deg=rotation.get("tilt_deg"),
        twist_deg=rotation.get("twist_deg"),
        finding=None if finding is None else Finding(finding),
        presence=None if entry.get("presence") is None else MeasuredPresence(entry["presence"]),
        details=None if entry.get("details") is None else from_json(Details, entry["details"]),
    )
