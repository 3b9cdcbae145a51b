"""The jobs file (TOML): the parts of a batch and the destination of their results."""

from __future__ import annotations

import re
import tomllib
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from arview import reconstruction, workflow
from arview.errors import InputError
from arview.quality.batch.storage import is_url, join_location

JOBS_FILE_EXAMPLE = """\
# Inspections of many parts. Paths are relative to this file, or URLs of fsspec (s3://bucket/…, gs://…, sftp://…).
out = "results"                # contains a folder for each job

[defaults]                     # default values: any field of a job
part = "part.toml"
# tolerance_mm, guard, camera, video_camera, scale_file, masks, sparse, unit, max_frames, seed, device, makes_pdf,
# compares_halves

[[job]]
serial = "PL-0417"             # also the name of its folder, unless a name is given
photos = "photos/PL-0417"

[[job]]
name = "PL-0418_repeat"
serial = "PL-0418"
photos = "photos/PL-0418b"
video = "films/PL-0418.mp4"
"""
"""A complete jobs file, shown by `arview batch --help`."""

LOCATION_FIELDS = ("part", "photos", "video", "camera", "video_camera", "scale_file", "masks", "sparse")
_KINDS = {
    "tolerance_mm": float,
    "guard": float,
    "max_frames": int,
    "seed": int,
    "threads": int,
    "makes_pdf": bool,
    "compares_halves": bool,
}
_NAME = re.compile(r"[\w][\w.+-]*")


@dataclass(frozen=True)
class BatchJob:
    """One inspection of a batch: its name, its inputs, and the folder or URL of its results."""

    name: str
    job: workflow.InspectJob
    out: str


def load_jobs(path: str | Path) -> tuple[BatchJob, ...]:
    """Read the jobs of a file; their names are unique.

    Raises:
        InputError: the file cannot be read, is not TOML, or has an invalid entry, which the message names.
    """
    path = Path(path)
    try:
        content = tomllib.loads(path.read_bytes().decode("utf-8"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: not valid TOML: {error}") from error
    _refuse_unknown(content, ("out", "defaults", "job"), f"{path}")
    out = content.get("out")
    if not isinstance(out, str) or not out:
        raise InputError(f"{path}: out: expected the folder or URL of the results")
    defaults, entries = content.get("defaults", {}), content.get("job", [])
    if not isinstance(defaults, dict) or not isinstance(entries, list) or not entries:
        raise InputError(f"{path}: expected one [defaults] and at least one [[job]]")
    known = ("name", *(field.name for field in fields(workflow.InspectJob)))
    _refuse_unknown(defaults, known[1:], f"{path}: [defaults]")
    jobs: dict[str, BatchJob] = {}
    for number, entry in enumerate(entries, 1):
        place = f"{path}: job {number}"
        if not isinstance(entry, dict):
            raise InputError(f"{place}: expected a [[job]] table")
        _refuse_unknown(entry, known, place)
        values = {**defaults, **entry}
        name = values.pop("name", None) or values.get("serial")
        if not isinstance(name, str) or not _NAME.fullmatch(name):
            raise InputError(f"{place}: name {name!r}: expected a serial or name of letters, digits and . _ + -")
        if name in jobs:
            raise InputError(f"{place}: {name!r} occurs twice; names must be unique")
        jobs[name] = BatchJob(name, _job(values, path.parent, place), join_location(_placed(out, path.parent), name))
    return tuple(jobs.values())


def _job(values: dict[str, Any], base: Path, place: str) -> workflow.InspectJob:
    if "part" not in values:
        raise InputError(f"{place}: part: is missing; give a part file or CAD file")
    if not values.get("photos") and not values.get("video"):
        raise InputError(f"{place}: give photos, a video, or both")
    for key, value in values.items():
        kind = _KINDS.get(key, str)
        is_right = isinstance(value, kind) or (kind is float and type(value) is int)
        if not is_right or (isinstance(value, bool) and kind is not bool):
            raise InputError(
                f"{place}: {key}: {value!r}, expected {'a number' if kind in (int, float) else kind.__name__}"
            )
        is_word = (key.endswith("camera") and value.startswith("fov:")) or (
            key == "masks" and value == reconstruction.AUTO
        )
        if key in LOCATION_FIELDS and not is_word:
            values[key] = _placed(value, base)
    return workflow.InspectJob(**values)


def _placed(text: str, base: Path) -> str:
    """A path relative to the jobs file as an absolute path; a URL is returned unchanged."""
    return text if is_url(text) else str((base / text).resolve())


def _refuse_unknown(table: dict[str, Any], known: tuple[str, ...], place: str) -> None:
    unknown = sorted(set(table) - set(known))
    if unknown:
        raise InputError(f"{place}: unknown {', '.join(unknown)}; expected {', '.join(known)}")
