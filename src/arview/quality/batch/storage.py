"""Files and folders on shared storage, by URL, through fsspec (s3, gs, abfs, sftp, http, file, …)."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from arview.core.extras import load
from arview.errors import InputError, MissingDependencyError, OutputError

_URL = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+://")


def is_url(text: str) -> bool:
    """Whether a text has the form ``scheme://…``."""
    return _URL.match(text) is not None


def join_location(location: str, name: str) -> str:
    """The path or URL of a name below a folder or URL."""
    return f"{location.rstrip('/')}/{name}"


def download(source: str, folder: Path) -> Path:
    """Copy a file, or a folder with its content, from a URL into a local folder; returns the local path.

    Raises:
        InputError: there is no such file or folder.
        OutputError: the storage cannot be read.
    """
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
    except Exception as error:  # every kind of storage raises its own exceptions
        raise OutputError(f"{source}: cannot be read ({error})") from error
    return target


def read(location: str) -> bytes | None:
    """The content of a file by path or URL; None if it does not exist.

    Raises:
        OutputError: the storage cannot be read.
    """
    system, path = _opened(location)
    try:
        return bytes(system.cat_file(path)) if system.isfile(path) else None
    except Exception as error:
        raise OutputError(f"{location}: cannot be read ({error})") from error


def upload(folder: Path, names: Iterable[str], location: str) -> None:
    """Copy files of a local folder below a URL, in the given order, so that the last one can mark completeness.

    Raises:
        OutputError: the storage cannot be written to.
    """
    system, path = _opened(location)
    try:
        for name in names:
            target = f"{path.rstrip('/')}/{name}"
            system.makedirs(target.rsplit("/", 1)[0], exist_ok=True)
            system.put_file(str(folder / name), target)
    except Exception as error:
        raise OutputError(f"{location}: cannot be written to ({error})") from error


def _opened(location: str) -> tuple[Any, str]:
    """The file system and the path in it of a path or URL."""
    fsspec = load("storage by URL", "fsspec")
    try:
        system, path = fsspec.url_to_fs(location)
    except ImportError as error:  # fsspec says which package a kind of storage needs
        raise MissingDependencyError(f"{location}: {error}") from error
    except ValueError as error:
        raise InputError(f"{location}: {error}") from error
    return system, str(path)
