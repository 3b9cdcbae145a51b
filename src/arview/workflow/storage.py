"""Folders and files on shared storage, by URL: all that fsspec knows (s3, gs, abfs, sftp, http, file, …)."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from arview.errors import InputError, MissingDependencyError, OutputError

_URL = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+://")


def is_url(text: str) -> bool:
    """True for ``scheme://…``."""
    return _URL.match(text) is not None


def joined(place: str, name: str) -> str:
    """A name below a folder or URL."""
    return f"{place.rstrip('/')}/{name}"


def fetched(source: str, folder: Path) -> Path:
    """A file, or a folder with all below it, from a URL into a local folder; raises InputError when it is not there."""
    system, path = _opened(source)
    target = folder / path.rstrip("/").rsplit("/", 1)[-1]
    try:
        if not system.exists(path):
            raise InputError(f"{source}: no such file or folder")
        folder.mkdir(parents=True, exist_ok=True)
        if system.isdir(path):
            target.mkdir(exist_ok=True)
            system.get(path.rstrip("/") + "/", f"{target}/", recursive=True)
        else:
            system.get_file(path, str(target))
    except InputError:
        raise
    except Exception as error:  # every kind of storage has errors of its own
        raise OutputError(f"{source}: cannot be read ({error})") from error
    return target


def read(place: str) -> bytes | None:
    """The content of a file by path or URL; None when there is none."""
    system, path = _opened(place)
    try:
        return bytes(system.cat_file(path)) if system.isfile(path) else None
    except Exception as error:
        raise OutputError(f"{place}: cannot be read ({error})") from error


def sent(folder: Path, names: Iterable[str], place: str) -> None:
    """Put files of a local folder below a URL, in this order: the last one says that the others are there."""
    system, path = _opened(place)
    try:
        for name in names:
            target = f"{path.rstrip('/')}/{name}"
            system.makedirs(target.rsplit("/", 1)[0], exist_ok=True)
            system.put_file(str(folder / name), target)
    except Exception as error:
        raise OutputError(f"{place}: cannot be written to ({error})") from error


def _opened(place: str) -> tuple[Any, str]:
    """File system and path of a URL or a path."""
    try:
        import fsspec
    except ImportError as error:
        raise MissingDependencyError("storage by URL needs fsspec: pip install 'arview[batch]'") from error
    try:
        system, path = fsspec.url_to_fs(place)
    except ImportError as error:  # fsspec says which package a kind of storage needs
        raise MissingDependencyError(f"{place}: {error}") from error
    except ValueError as error:
        raise InputError(f"{place}: {error}") from error
    return system, str(path)
