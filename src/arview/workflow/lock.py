"""One process at a time in a folder."""

from __future__ import annotations

import fcntl
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from arview.errors import InputError, OutputError


@contextmanager
def alone(folder: Path, name: str, waits: bool) -> Iterator[None]:
    """Hold a lock on a folder, which is made when missing; a process that dies leaves it free.

    Args:
        folder: what is locked.
        name: of the lock's file, which stays.
        waits: until the folder is free; else it is an error when it is not.

    Raises:
        InputError: another process works there.
        OutputError: the folder cannot be made or written to.
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
            raise InputError(f"{folder}: another arview works there; wait for it or give another folder") from None
        yield
