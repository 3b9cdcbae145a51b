"""Files whose content is on the disk when a function returns, so that a crash cannot take back what was confirmed."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path
from typing import IO

from arview.core.atomic import replacing


def replace_durably(path: Path, content: bytes) -> None:
    """Write a file that appears complete, and is on the disk, or not at all; see `replacing`.

    Raises:
        OSError: it cannot be written.
    """
    with replacing(path) as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    for folder in (path.parent, path.absolute().parent.parent):  # the folder may be new
        with suppress(PermissionError):
            _sync_folder(folder)


def append_durably(file: IO[bytes], length: int, content: bytes) -> None:
    """Write behind the first ``length`` bytes of a log; what could not be brought to the disk is taken back.

    Args:
        file: opened for appending, without a buffer.
        length: of the log before, bytes.
        content: what is added.

    Raises:
        OSError: it cannot be written.
    """
    try:
        rest = memoryview(content)
        while len(rest):
            rest = rest[os.write(file.fileno(), rest) :]
        os.fsync(file.fileno())
        if length == 0:
            _sync_folder(Path(file.name).parent)
    except OSError:
        with suppress(OSError):
            os.ftruncate(file.fileno(), length)
        raise


def set_aside(path: Path, torn: bytes) -> None:
    """Keep a line of a log that a crash cut off, as a line of another file.

    Raises:
        OSError: it cannot be written.
    """
    with path.open("ab", buffering=0) as file:
        append_durably(file, os.fstat(file.fileno()).st_size, torn + b"\n")


def _sync_folder(folder: Path) -> None:
    """Bring the names of a folder's files to the disk.

    Raises:
        OSError: there is no such folder, or it cannot be read.
    """
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
