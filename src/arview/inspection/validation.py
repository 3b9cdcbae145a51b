"""Faults of an inspection file, all at once, so that one written by hand is mended in one go."""

from __future__ import annotations

import json
from collections.abc import Iterator
from functools import cache
from importlib import resources
from typing import Any

import jsonschema

from arview.errors import InputError
from arview.inspection.document import component_from_entry, moment
from arview.inspection.record import READABLE_VERSIONS, SCHEMA_VERSION, RecordError

_MESSAGE_LIMIT = 200
_NUMBER_LIMIT = 1e9


def document_faults(document: Any) -> list[str]:
    """All faults of a document, each with its place in the file (``components[2].distance_mm``); none if valid.

    A document of an unknown version, with numbers that are not finite or texts that are not Unicode, is not looked at
    further.
    """
    try:
        _check_version(document)
    except InputError as error:
        return [str(error)]
    if faults := list(_not_finite(document)):
        return faults
    errors = sorted(_validator(document["schema_version"]).iter_errors(document), key=lambda error: error.json_path)
    # Components whose entry complies with the schema are checked further, and so is the time.
    broken = {error.absolute_path[1] for error in errors if _is_of_component(error)}
    names = {error.absolute_path[0] for error in errors if error.absolute_path}
    faults = [_message(error) for error in errors]
    if "created" not in names and isinstance(document.get("created"), str):
        try:
            moment(document["created"])
        except InputError as error:
            faults.append(str(error))
    entries = document.get("components")
    if isinstance(entries, list):
        faults += _component_faults(entries, broken)
    return faults


def summary_of(faults: list[str]) -> str:
    """All faults in one line; a single one stands alone."""
    if len(faults) == 1:
        return faults[0]
    return f"{len(faults)} faults: " + "; ".join(f"({number}) {fault}" for number, fault in enumerate(faults, 1))


def _component_faults(entries: list[Any], broken: set[Any]) -> Iterator[str]:
    seen: set[str] = set()
    for index, entry in enumerate(entries):
        if index in broken:
            continue
        try:
            component_from_entry(entry)
        except RecordError as error:
            for fault in error.faults:
                yield f"components[{index}].{fault} (component {entry['name']!r})"
        if entry["name"] in seen:
            yield f"components[{index}].name: {entry['name']!r} appears twice"
        seen.add(entry["name"])


def _is_of_component(error: Any) -> bool:
    return len(error.absolute_path) > 1 and error.absolute_path[0] == "components"


def _message(error: Any) -> str:
    place = error.json_path.removeprefix("$").removeprefix(".") or "file"
    message = " ".join(error.message.split())
    if place == "created" and error.validator == "pattern":
        message = f"{error.instance!r}: expected a time with its zone, such as 2026-10-01T08:00:00Z or …T10:00:00+02:00"
    if len(message) > _MESSAGE_LIMIT:
        message = message[: _MESSAGE_LIMIT - 1] + "…"
    return f"{place}: {message}"


def _not_finite(document: Any) -> Iterator[str]:
    """Faults of numbers that are not finite, and of texts that are not Unicode."""
    for place, value in _leaves(document, ""):
        if isinstance(value, str):
            if any("\ud800" <= character <= "\udfff" for character in value):
                yield f"{place}: holds half of a character (a lone surrogate)"
            continue
        if not abs(value) < _NUMBER_LIMIT:
            shown = value if isinstance(value, float) else "a huge number"
            yield f"{place}: is {shown}, expected a finite number below 1e9, or null"


def _leaves(node: Any, place: str) -> Iterator[tuple[str, float | str]]:
    if isinstance(node, dict):
        for key, value in node.items():
            yield from _leaves(value, f"{place}.{key}" if place else key)
    elif isinstance(node, list):
        for index, value in enumerate(node):
            yield from _leaves(value, f"{place}[{index}]")
    elif isinstance(node, int | float | str):
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
