"""Reading and writing ``inspection.json``, checked against the shipped JSON Schema."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from arview.cad import Model
from arview.core.checks import PATH, check_type
from arview.core.durable import replace_durably
from arview.errors import InputError, MismatchError, OutputError
from arview.inspection.document import from_document
from arview.inspection.record import Inspection, model_faults
from arview.inspection.validation import document_faults, summary_of


def load_inspection(path: str | Path, model: Model | None = None) -> Inspection:
    """Read an inspection from a JSON file and, if a model is given, check that it belongs to the model.

    Raises:
        InputError: the file cannot be read, is not JSON, violates the schema, has an unknown version, a value that is
            not finite, or a contradiction; the message lists all faults with their places in the file
            (``components[2].distance_mm``).
        MismatchError: the inspection belongs to another model than ``model``.
    """
    check_type(path, PATH, "load_inspection: path")
    path = Path(path)
    document = _read_json(path)
    try:
        faults = document_faults(document)
    except RecursionError as error:
        raise InputError(f"{path}: is nested too deeply to be an inspection") from error
    if faults and model is not None:
        faults += _model_faults(document, model)
    if faults:
        raise InputError(f"{path}: {summary_of(faults)}")
    try:
        inspection = from_document(document)
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
    text = json.dumps(inspection.to_dict(), indent=2, ensure_ascii=False, allow_nan=False) + "\n"
    try:
        replace_durably(path, text.encode())
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


def _model_faults(document: Any, model: Model) -> list[str]:
    """What of a document with other faults does not belong to the model either."""
    if not isinstance(document, dict):
        return []
    entries = document.get("components")
    named = [one.get("name") for one in entries if isinstance(one, dict)] if isinstance(entries, list) else []
    names = [name for name in named if isinstance(name, str)]
    return model_faults(document.get("model_hash"), names, model)
