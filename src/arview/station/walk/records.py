"""What the files of a job hold: a stored photo with its hint, and the state of the measurement."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from datetime import UTC, datetime
from typing import Any, Literal, get_args

import numpy as np

from arview.core.messages import sentence, with_messages
from arview.errors import InputError
from arview.geometry import Array

PhotoOrigin = Literal["still", "stream", "upload", "station"]
WalkStage = Literal["collecting", "measuring", "done", "failed"]
CloudState = Literal["waiting", "running", "done", "failed"]
_SHA256 = re.compile(r"[0-9a-f]{64}")
_NAME = re.compile(r"\d{4,}\.(jpg|png|heic|tif|bmp)")

_KINDS = (
    (b"\xff\xd8\xff", ".jpg"),
    (b"\x89PNG\r\n\x1a\n", ".png"),
    (b"II*\0", ".tif"),
    (b"MM\0*", ".tif"),
    (b"BM", ".bmp"),
)
_HEIF_BRANDS = (b"heic", b"heix", b"hevc", b"mif1", b"msf1", b"heim", b"heis")


@dataclass(frozen=True)
class StoredPhoto:
    """One photo of a job.

    Attributes:
        name: of its file in ``photos/``.
        sha256: of its content, hexadecimal.
        bytes: size of its file.
        taken: when it was taken, ISO 8601, UTC.
        source: how it was taken.
        hint: where the tracker saw the camera when it was taken, or None: ``cam_from_model`` (16 numbers, row by row,
            or None), ``camera`` (document of the stream's camera, or None) and ``quality`` (0 to 1, or None).
    """

    name: str
    sha256: str
    bytes: int
    taken: str
    source: PhotoOrigin
    hint: dict[str, Any] | None = None

    @property
    def cam_from_model(self) -> Array | None:
        """(4,4) pose that the tracker had; None without one."""
        given = None if self.hint is None else self.hint.get("cam_from_model")
        return None if given is None else np.array(given, dtype=np.float64).reshape(4, 4)


@dataclass(frozen=True)
class WalkState:
    """How far the measurement of a job is.

    Attributes:
        stage: ``collecting`` photos, ``measuring``, ``done`` or ``failed``.
        text: one line for people.
        photos: photos of the job that the worker knows of.
        placed: photos whose place is known.
        step, done, total: the current step, and how many of its parts are done.
        is_rough: the inspection is a provisional one, of the first photos.
        inspection: path of the newest inspection below the job's folder; None without one.
        seconds_after_last_photo: time from the last photo or the end of the walk to the verdict; None before.
        cloud: state of the dense cloud, which follows the verdict.
        updated: when this was written, ISO 8601, UTC.
        verdict: of the whole part; None before it, and in a job of an older version.
    """

    stage: WalkStage = "collecting"
    text: str = sentence("walk.waiting")
    photos: int = 0
    placed: int = 0
    step: str = ""
    done: int = 0
    total: int = 0
    is_rough: bool = False
    inspection: str | None = None
    seconds_after_last_photo: float | None = None
    cloud: CloudState = "waiting"
    updated: str = ""
    verdict: str | None = None

    def document(self) -> dict[str, Any]:
        """The state for ``state.json``."""
        return with_messages(asdict(self))

    @staticmethod
    def of_document(document: Any) -> WalkState:
        """The state in a document; unknown keys are ignored. Raises InputError when it is none."""
        known = {one.name for one in fields(WalkState)}
        if not isinstance(document, dict):
            raise InputError("is no state of a job")
        given = {key: value for key, value in document.items() if key in known}
        if given.get("stage") not in get_args(WalkStage) or given.get("cloud", "waiting") not in get_args(CloudState):
            raise InputError("is no state of a job")
        said = document.get("messages", {}).get(given.get("text"))
        return WalkState(**{**given, "text": sentence(said["key"], **said["values"])} if said else given)


def photo_of_line(document: Any) -> StoredPhoto:
    """The photo of a line of ``photos.jsonl``. Raises InputError when it is none."""
    try:
        photo = StoredPhoto(
            str(document["name"]),
            str(document["sha256"]),
            int(document["bytes"]),
            str(document["taken"]),
            document["source"],
            checked_hint(document.get("hint")),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise InputError("is no photo of a job") from error
    if (
        not _NAME.fullmatch(photo.name)
        or not _SHA256.fullmatch(photo.sha256)
        or photo.source not in get_args(PhotoOrigin)
    ):
        raise InputError("is no photo of a job")
    return photo


def checked_hint(hint: Mapping[str, Any] | None) -> dict[str, Any] | None:
    """The hint with all its keys. Raises InputError when a value cannot be one."""
    if hint is None:
        return None
    pose, camera, quality = (hint.get(key) for key in ("cam_from_model", "camera", "quality"))
    if pose is not None:
        try:
            matrix = np.array(pose, dtype=np.float64).reshape(4, 4)
        except (TypeError, ValueError) as error:
            raise InputError("hint: cam_from_model: expected 16 numbers") from error
        rotation = matrix[:3, :3]
        is_pose = np.isfinite(matrix).all() and np.allclose(matrix[3], [0.0, 0.0, 0.0, 1.0])
        if not is_pose or np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-3 or np.linalg.det(rotation) < 0.0:
            raise InputError("hint: cam_from_model: is not a pose")
        pose = [float(value) for value in matrix.ravel()]
    if camera is not None and not isinstance(camera, dict):
        raise InputError("hint: camera: expected an object")
    if quality is not None:
        if isinstance(quality, bool) or not isinstance(quality, int | float) or not 0.0 <= quality <= 1.0:
            raise InputError("hint: quality: expected a number from 0 to 1")
        quality = float(quality)
    return {"cam_from_model": pose, "camera": camera, "quality": quality}


def suffix_of(content: bytes) -> str:
    """Ending of a photo's file name by its content. Raises InputError when it is no photo."""
    for start, suffix in _KINDS:
        if content.startswith(start):
            return suffix
    if content[4:8] == b"ftyp" and content[8:12] in _HEIF_BRANDS:
        return ".heic"
    raise InputError("is no photo; send JPEG, PNG, HEIC, TIFF or BMP")


def checked_time(taken: str | datetime | None) -> str:
    """A time as ISO 8601 in UTC; now without one. Raises InputError when it is no time."""
    if taken is None:
        return utc_now()
    try:
        time = datetime.fromisoformat(taken) if isinstance(taken, str) else taken
        time = time if time.tzinfo is not None else time.replace(tzinfo=UTC)
        return time.astimezone(UTC).isoformat()
    except (TypeError, ValueError, OverflowError, AttributeError) as error:
        raise InputError(f"taken: {taken!r} is no ISO 8601 time") from error


def utc_now() -> str:
    """The present time, ISO 8601 in UTC."""
    return datetime.now(UTC).isoformat()


def parse_line(line: bytes) -> Any:
    """The document of a line; None where it is damaged."""
    try:
        return json.loads(line)
    except ValueError:
        return None
