"""Stages of a run that write into a folder: finished ones are not done again."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from arview.core.atomic import replacing
from arview.errors import OutputError

_FILE = "stages.json"


class Stages:
    """Which stages of a run are finished in a folder, and from what input.

    A stage's key is made of its options and of the key of the stage before, so that a change of anything
    repeats the stages that depend on it and no others.
    """

    def __init__(self, folder: Path) -> None:
        """Raises OutputError when the folder cannot be made or written to."""
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(f"{folder}: cannot be made ({error.strerror or error})") from error
        self.folder = folder
        self._finished = self._read()

    def is_finished(self, name: str, key: str) -> bool:
        """True when the stage was finished with this key."""
        return self._finished.get(name) == key

    def key(self, name: str) -> str | None:
        """The key that a stage was finished with, or None."""
        return self._finished.get(name)

    def finish(self, name: str, key: str) -> None:
        """Note that a stage is finished. Call it when the stage's files are complete."""
        self._finished[name] = key
        write_json(self.folder / _FILE, self._finished)

    def restart(self, name: str) -> None:
        """Note that a stage's files are no longer to be relied on. Call it before they are touched."""
        if self._finished.pop(name, None) is not None:
            write_json(self.folder / _FILE, self._finished)

    def _read(self) -> dict[str, str]:
        try:
            content = json.loads((self.folder / _FILE).read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return {}
        return content if isinstance(content, dict) else {}


def key_of(*parts: Any) -> str:
    """A short hash of values with a stable ``repr`` (numbers, texts, frozen options)."""
    return hashlib.sha256(repr(parts).encode()).hexdigest()[:16]


def content_key(paths: Iterable[Path]) -> str:
    """A short hash of the names and the content of files, wherever they lie; of unreadable ones, the name alone."""
    digest = hashlib.sha256()
    for path in paths:
        digest.update(path.name.encode())
        try:
            with path.open("rb") as file:
                digest.update(hashlib.file_digest(file, "sha256").digest())
        except OSError:
            digest.update(b"unreadable")
    return digest.hexdigest()[:16]


def write_json(path: Path, content: Any) -> None:
    """Write JSON that appears complete or not at all. Raises OutputError."""
    try:
        with replacing(path) as file:
            file.write((json.dumps(content, indent=1) + "\n").encode())
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror or error})") from error
