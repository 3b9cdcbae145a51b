"""Locks that give one process at a time access to a folder."""

from __future__ import annotations

import fcntl
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from arview.errors import InputError, OutputError


@contextmanager
def exclusive_access(folder: Path, name: str, waits: bool) -> Iterator[None]:
    """Hold a lock on a folder, which is created if needed; the lock of a process that dies is released.

    Args:
        folder: the folder to lock.
        name: name of the lock file, which is not removed.
        waits: wait until the folder is free instead of raising an error.

    Raises:
        InputError: another process holds the lock.
        OutputError: the folder cannot be created or written to.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        file = (folder / name).open("w")
    except OSError as error:
        raise OutputError(f"{folder}: cannot be written to ({error.strerror or error})") from error
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX if waits else fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise InputError(
                f"{folder}: another arview process is using this folder; wait for it or give another folder"
            ) from None
        yield
