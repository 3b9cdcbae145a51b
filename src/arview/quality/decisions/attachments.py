"""Photos that were taken for a decision: they belong to its record, and are never measured.

They lie in the folder ``decisions`` beside the inspection of the first measurement. The name of each is the hash of its
content, so that the hash chain of the log, which holds the name, also covers the picture.
"""

from __future__ import annotations

import hashlib
import re
from pathlib import Path

from arview.core.durable import replace_durably
from arview.errors import InputError, OutputError
from arview.quality.decisions.entry import Decision

_FOLDER = "decisions"
_NAME = re.compile(rf"{_FOLDER}/[0-9a-f]{{64}}\.(?:jpg|png|heic)")
_KINDS = ((0, b"\xff\xd8\xff", ".jpg"), (0, b"\x89PNG\r\n\x1a\n", ".png"), (4, b"ftyp", ".heic"))


def is_attachment(name: str) -> bool:
    """Whether the name of a photo is that of one taken for a decision."""
    return _NAME.fullmatch(name) is not None


def attach_photo(folder: Path, content: bytes) -> str:
    """Keep a photo for a decision; it is on the disk when this returns.

    Args:
        folder: of the inspection of the first measurement.
        content: of the file.

    Returns:
        Its name, for `decide_component`; the same content twice has the same name.

    Raises:
        InputError: it is no JPEG, PNG or HEIC.
        OutputError: it cannot be written.
    """
    suffix = next((end for at, start, end in _KINDS if content[at:].startswith(start)), None)
    if suffix is None:
        raise InputError("is no photo; send JPEG, PNG or HEIC")
    name = f"{_FOLDER}/{hashlib.sha256(content).hexdigest()}{suffix}"
    if photo_fault(folder, name):
        try:
            (folder / _FOLDER).mkdir(parents=True, exist_ok=True)
            replace_durably(folder / name, content)
        except OSError as error:
            raise OutputError(f"{folder / name}: cannot be written ({error.strerror or error})") from error
    return name


def attached_photos(folder: Path) -> list[str]:
    """Names of the photos that were taken for decisions, those of no decision included; the oldest first."""
    found = [(path.stat().st_mtime_ns, f"{_FOLDER}/{path.name}") for path in (folder / _FOLDER).glob("*.*")]
    return [name for _, name in sorted(found) if is_attachment(name)]


def photo_fault(folder: Path, name: str) -> str:
    """What is wrong with a photo that was taken for a decision; empty if its content is what its name says."""
    try:
        content = (folder / name).read_bytes()
    except OSError:
        return "is missing"
    return "" if hashlib.sha256(content).hexdigest() == Path(name).stem else "was changed"


def attachment_faults(folder: Path, entries: tuple[Decision, ...]) -> tuple[str, ...]:
    """What is wrong with the photos that decisions name."""
    return tuple(
        f"the photo of the decision about {one.component} (entry {one.number}) {fault}"
        for one in entries
        if one.photo and is_attachment(one.photo) and (fault := photo_fault(folder, one.photo))
    )
