"""Stages of a run that write into a folder: finished stages are not repeated."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

from arview.core.atomic import replacing
from arview.errors import OutputError

_FILE = "stages.json"


class Stages:
    """The finished stages of a run in a folder, with a key for the input of each.

    The key of a stage is made from its options and the key of the stage before, so that a change repeats the stages
    that depend on it and no others.
    """

    def __init__(self, folder: Path) -> None:
        """Raises OutputError if the folder cannot be made."""
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(f"{folder}: cannot be made ({error.strerror or error})") from error
        self.folder = folder
        self._finished = self._read()

    def is_finished(self, name: str, key: str) -> bool:
        """True if the stage was finished with this key."""
        return self._finished.get(name) == key

    def key(self, name: str) -> str | None:
        """The key with which a stage was finished, or None."""
        return self._finished.get(name)

    def finish(self, name: str, key: str) -> None:
        """Record that a stage is finished. To be called when its files are complete."""
        self._finished[name] = key
        write_json(self.folder / _FILE, self._finished)

    def restart(self, name: str) -> None:
        """Record that the files of a stage are invalid. To be called before they are changed."""
        if self._finished.pop(name, None) is not None:
            write_json(self.folder / _FILE, self._finished)

    def _read(self) -> dict[str, str]:
        try:
            content = json.loads((self.folder / _FILE).read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return {}
        return content if isinstance(content, dict) else {}


def key_of(*parts: Any) -> str:
    """A short hash of numbers, texts, and tuples, lists, dictionaries and dataclasses of them."""
    return hashlib.sha256(_full_repr(parts).encode()).hexdigest()[:16]


def _full_repr(value: Any) -> str:
    """Like ``repr``, but of a dataclass always all its fields, also where the class has a shorter ``__repr__``."""
    if is_dataclass(value) and not isinstance(value, type):
        shown = [f"{one.name}={_full_repr(getattr(value, one.name))}" for one in fields(value) if one.repr]
        return f"{type(value).__qualname__}({', '.join(shown)})"
    if type(value) is tuple:
        return f"({', '.join(map(_full_repr, value))}{',' * (len(value) == 1)})"
    if type(value) is list:
        return f"[{', '.join(map(_full_repr, value))}]"
    if type(value) is dict:
        return "{" + ", ".join(f"{_full_repr(key)}: {_full_repr(one)}" for key, one in value.items()) + "}"
    return repr(value)


def content_key(paths: Iterable[Path]) -> str:
    """A short hash of the names and contents of files, whatever their folders; an unreadable file counts by name."""
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
