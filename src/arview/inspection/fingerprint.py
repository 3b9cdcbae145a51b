"""The fingerprint of an inspection: one hash of its content in report, results store and every export."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

from arview.errors import InputError
from arview.inspection.document import to_document
from arview.inspection.record import Inspection


def content_hash(document: Any) -> str:
    """SHA-256 of a JSON document independent of its formatting: of its UTF-8 text with sorted keys and no spaces."""
    text = json.dumps(document, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def fingerprint(inspection: Inspection) -> str:
    """The fingerprint of the file that `save_inspection` writes for this inspection."""
    return content_hash(to_document(inspection))


def fingerprint_of_file(path: str | Path) -> str:
    """The fingerprint of a file, whatever its formatting.

    Raises:
        InputError: the file cannot be read or is not JSON.
    """
    try:
        return content_hash(json.loads(Path(path).read_text(encoding="utf-8-sig")))
    except OSError as error:
        raise InputError(f"cannot read inspection {path}: {error.strerror or error}") from error
    except ValueError as error:
        raise InputError(f"{path}: is not an inspection in JSON ({error})") from error
