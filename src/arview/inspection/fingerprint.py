"""Fingerprints of an inspection: of its content in report, store and exports, of its values in people's decisions."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

from arview.errors import InputError
from arview.inspection.record import ComponentDeviation, Inspection

_DECIMALS = 4
"""Decimals of values (mm, degrees) in their fingerprint: 0.1 µm, so that it does not hang on the order of sums."""


def content_hash(document: Any) -> str:
    """SHA-256 of a JSON document independent of its formatting: of its UTF-8 text with sorted keys and no spaces."""
    text = json.dumps(document, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def fingerprint(inspection: Inspection) -> str:
    """The fingerprint of the file that `save_inspection` writes for this inspection."""
    return content_hash(inspection.to_dict())


def values_fingerprint(inspection: Inspection) -> str:
    """SHA-256 of what was measured of which photos: values, verdicts and foreign objects, as canonical JSON.

    It stays the same when the record is written again with other remarks, or with a cloud that changes no value.
    """
    foreign = [
        (list(map(_rounded, one.center_mm)), list(map(_rounded, one.size_mm))) for one in inspection.foreign_objects
    ]
    return content_hash(
        {
            **_origin(inspection, inspection.provenance.photos_hash),
            "components": [_values(one) for one in inspection.components],
            "foreign_objects": foreign,
        }
    )


def component_fingerprint(inspection: Inspection, component: ComponentDeviation, photos_hash: str | None = None) -> str:
    """SHA-256 of the values and the verdict of one component, as `values_fingerprint`.

    Args:
        inspection: names the specimen.
        component: of it, or of a check of it after its rework.
        photos_hash: of the photos of that check; None: those of the inspection.
    """
    photos = inspection.provenance.photos_hash if photos_hash is None else photos_hash
    return content_hash({**_origin(inspection, photos), "components": [_values(component)]})


def _origin(inspection: Inspection, photos_hash: str) -> dict[str, Any]:
    return {
        "part": inspection.part,
        "serial": inspection.serial,
        "model_hash": inspection.model_hash,
        "photos_hash": photos_hash,
    }


def _values(one: ComponentDeviation) -> dict[str, Any]:
    details = one.details
    own = () if details is None else (details.own_displacement_mm or ())
    return {
        "name": one.name,
        "displacement_mm": [_rounded(value) for value in one.displacement_mm],
        "own_displacement_mm": [_rounded(value) for value in own],
        "distance_mm": _rounded(one.distance_mm),
        "rotation_deg": [_rounded(one.tilt_deg), _rounded(one.twist_deg)],
        "uncertainty_mm": _rounded(one.uncertainty_mm),
        "tolerance_mm": _rounded(one.tolerance_mm),
        "verdict": one.verdict.value,
        "finding": None if one.finding is None else one.finding.value,
    }


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(float(value), _DECIMALS) + 0.0


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
