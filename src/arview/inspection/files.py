"""Reading and writing ``inspection.json``, checked against the shipped JSON Schema."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from datetime import datetime
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

import jsonschema

from arview.cad.model import Model
from arview.core.atomic import replacing
from arview.core.checks import PATH, check_type
from arview.errors import InputError, MismatchError, OutputError
from arview.inspection.details import DatumSystem, Details, DistanceReport, ForeignReport, from_json, to_json
from arview.inspection.record import (
    READABLE_VERSIONS,
    SCHEMA_VERSION,
    ComponentDeviation,
    Finding,
    Inspection,
    Provenance,
    Verdict,
)

_MESSAGE_LIMIT = 200
_NUMBER_LIMIT = 1e9


def load_inspection(path: str | Path, model: Model | None = None) -> Inspection:
    """Read an inspection from a JSON file and, if a model is given, check that it belongs to the model.

    Raises:
        InputError: the file cannot be read, is not JSON, violates the schema, has an unknown version, a value that is
            not finite, or a contradiction; the message names the place in the file (``components[2].distance_mm``).
        MismatchError: the inspection belongs to another model than ``model``.
    """
    check_type(path, PATH, "load_inspection: path")
    path = Path(path)
    document = _read_json(path)
    try:
        _check_finite(document)
        _check_version(document)
        _check_schema(document)
        inspection = _from_document(document)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    if model is not None:
        try:
            inspection.check_model(model)
        except MismatchError as error:
            raise MismatchError(f"{path}: {error}") from None
    return inspection


def save_inspection(inspection: Inspection, path: str | Path) -> None:
    """Write the inspection as JSON, atomically.

    Raises:
        OutputError: the file cannot be written.
    """
    check_type(inspection, Inspection, "save_inspection: inspection")
    path = Path(path)
    text = json.dumps(to_document(inspection), indent=2, ensure_ascii=False, allow_nan=False) + "\n"
    try:
        with replacing(path) as file:
            file.write(text.encode())
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror or error}") from error


def _read_json(path: Path) -> Any:
    try:
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise InputError(f"cannot read inspection {path}: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is not a text file; expected an inspection in JSON") from error
    try:
        return json.loads(text, object_pairs_hook=_object_with_unique_keys)
    except json.JSONDecodeError as error:
        raise InputError(f"{path}: is not JSON, line {error.lineno} column {error.colno}: {error.msg}") from error
    except RecursionError as error:
        raise InputError(f"{path}: is nested too deeply to be an inspection") from error
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    except ValueError as error:
        raise InputError(f"{path}: contains a number too long to read") from error


def _object_with_unique_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    result = dict(pairs)
    if len(result) != len(pairs):
        keys = [key for key, _ in pairs]
        repeated = next(key for key in keys if keys.count(key) > 1)
        raise InputError(f"{repeated!r} occurs twice in one object")
    return result


def _check_finite(document: Any) -> None:
    for place, value in _numbers(document, ""):
        if not abs(value) < _NUMBER_LIMIT:
            shown = value if isinstance(value, float) else "a huge number"
            raise InputError(f"{place}: is {shown}, expected a finite number below 1e9, or null")


def _numbers(node: Any, place: str) -> Iterator[tuple[str, float]]:
    if isinstance(node, dict):
        for key, value in node.items():
            yield from _numbers(value, f"{place}.{key}" if place else key)
    elif isinstance(node, list):
        for index, value in enumerate(node):
            yield from _numbers(value, f"{place}[{index}]")
    elif isinstance(node, int | float):
        yield place, node


def _check_version(document: Any) -> None:
    if not isinstance(document, dict) or "schema_version" not in document:
        raise InputError("schema_version: is missing; this does not look like an arview inspection")
    version = document["schema_version"]
    if version in READABLE_VERSIONS:
        return
    try:
        numbers = tuple(int(part) for part in str(version).split("."))
    except ValueError:
        raise InputError(f"schema_version: is {version!r}, expected {SCHEMA_VERSION!r}") from None
    if numbers > tuple(int(part) for part in SCHEMA_VERSION.split(".")):
        raise InputError(
            f"schema_version: {version!r} was written by a newer arview; this one reads {SCHEMA_VERSION!r}"
        )
    raise InputError(f"schema_version: is {version!r}, expected {SCHEMA_VERSION!r}")


@cache
def _validator(version: str) -> Any:
    file = resources.files("arview.inspection") / "schema" / f"inspection-{version}.json"
    return jsonschema.Draft202012Validator(json.loads(file.read_text(encoding="utf-8")))


def _check_schema(document: Any) -> None:
    errors = sorted(_validator(document["schema_version"]).iter_errors(document), key=lambda error: error.json_path)
    if not errors:
        return
    first = errors[0]
    place = first.json_path.removeprefix("$").removeprefix(".") or "file"
    message = " ".join(first.message.split())
    if len(message) > _MESSAGE_LIMIT:
        message = message[: _MESSAGE_LIMIT - 1] + "…"
    more = f" (and {len(errors) - 1} more)" if len(errors) > 1 else ""
    raise InputError(f"{place}: {message}{more}")


def _from_document(document: dict[str, Any]) -> Inspection:
    try:
        created = datetime.fromisoformat(document["created"])
    except ValueError as error:
        raise InputError(f"created: {document['created']!r} is not a date and time ({error})") from None
    components = []
    for index, entry in enumerate(document["components"]):
        try:
            components.append(_component(entry))
        except InputError as error:
            raise InputError(f"components[{index}].{error} (component {entry['name']!r})") from None
    source = document["provenance"]
    datums, distances = document.get("datum_system"), document.get("distance_map")
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
            source.get("note", ""),
            source.get("photos_hash", ""),
            source.get("photos", 0),
            tuple(source.get("software", {}).items()),
            tuple(source.get("options", {}).items()),
            source.get("cpu_s"),
        ),
        datum_system=None if datums is None else from_json(DatumSystem, datums),
        warnings=tuple(document.get("warnings", ())),
        foreign_objects=tuple(from_json(ForeignReport, one) for one in document.get("foreign_objects", ())),
        distance_map=None if distances is None else from_json(DistanceReport, distances),
    )


def _component(entry: dict[str, Any]) -> ComponentDeviation:
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
        details=None if entry.get("details") is None else from_json(Details, entry["details"]),
    )


def to_document(inspection: Inspection) -> dict[str, Any]:
    """The inspection as the JSON document that `save_inspection` writes."""
    source = inspection.provenance
    software, options = dict(source.software), dict(source.options)
    more: dict[str, Any] = {
        "photos_hash": source.photos_hash, "photos": source.photos, "software": software, "options": options,
        "cpu_s": source.cpu_s,
    }  # fmt: skip
    document: dict[str, Any] = {
        "schema_version": SCHEMA_VERSION,
        "part": inspection.part,
        "serial": inspection.serial,
        "model_hash": inspection.model_hash,
        "created": inspection.created.replace(tzinfo=None).isoformat() + "Z",
        "components": [_to_entry(component) for component in inspection.components],
        "provenance": {
            "tool": source.tool,
            "version": source.version,
            "method": source.method,
            "note": source.note,
            **{key: value for key, value in more.items() if value},
        },
    }
    if inspection.datum_system is not None:
        document["datum_system"] = to_json(inspection.datum_system)
    if inspection.warnings:
        document["warnings"] = list(inspection.warnings)
    if inspection.foreign_objects:
        document["foreign_objects"] = to_json(inspection.foreign_objects)
    if inspection.distance_map is not None:
        document["distance_map"] = to_json(inspection.distance_map)
    return document


def _to_entry(component: ComponentDeviation) -> dict[str, Any]:
    entry: dict[str, Any] = {
        "name": component.name,
        "displacement_mm": list(component.displacement_mm),
        "distance_mm": component.distance_mm,
    }
    if component.tilt_deg is not None or component.twist_deg is not None:
        entry["rotation"] = {"tilt_deg": component.tilt_deg, "twist_deg": component.twist_deg}
    entry |= {
        "observable": list(component.observable),
        "uncertainty_mm": component.uncertainty_mm,
        "tolerance_mm": component.tolerance_mm,
        "verdict": component.verdict.value,
    }
    if component.finding is not None:
        entry["finding"] = component.finding.value
    if component.details is not None:
        entry["details"] = to_json(component.details)
    return entry
