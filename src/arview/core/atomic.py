"""Files that appear complete or not at all."""

from __future__ import annotations

import glob
import os
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import lru_cache
from pathlib import Path
from typing import BinaryIO

from arview.errors import OutputError


@contextmanager
def replacing(path: Path) -> Iterator[BinaryIO]:
    """Open a binary file for writing that takes the place of ``path`` when the block ends without an error.

    Until then it has a hidden name in the same folder; after an error nothing is left behind. A device or a pipe is
    not replaced but written to.

    Raises:
        OSError: the folder is missing or read-only, or the disk is full. The caller turns it into a message.
    """
    if is_device(path):
        with path.open("wb") as file:
            yield file
        return
    _remove_leftovers(path.parent)
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.{os.getpid()}.", suffix=".tmp")
    try:
        with os.fdopen(handle, "wb") as file:
            yield file
        Path(temporary).chmod(0o644)
        Path(temporary).replace(path)
    finally:
        Path(temporary).unlink(missing_ok=True)


def write_file(path: Path, content: bytes, makes_folder: bool = False) -> None:
    """Write a file that appears complete or not at all.

    Args:
        path: of the file.
        content: of the file.
        makes_folder: make the folder if it is not there.

    Raises:
        OutputError: the file cannot be written.
    """
    try:
        if makes_folder:
            path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as file:
            file.write(content)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror or error})") from error


def is_device(path: Path) -> bool:
    """True for an existing device, pipe or socket: what is neither a file nor a folder."""
    return path.exists() and not path.is_file() and not path.is_dir()


@lru_cache(maxsize=64)
def _remove_leftovers(folder: Path) -> None:
    """Remove files that a crash left behind while they were written in a folder; once in the life of a process."""
    for path in folder.glob(".*.tmp"):
        process = path.name.split(".")[-3]
        with suppress(OSError):
            is_old = time.time() - path.stat().st_mtime > 60.0  # a younger one may be another machine's
            if process.isdecimal() and is_old and not _is_running(int(process)):
                path.unlink()


def begin_unfinished(path: Path) -> Path:
    """Name under which this process writes a film or poses; what others left of the same file by a crash is removed."""
    own = unfinished_path(path, os.getpid())
    for old in path.parent.glob(f".{glob.escape(path.name)}.*.part"):
        process = old.name.split(".")[-2]
        if process.isdecimal() and not _is_running(int(process)):
            with suppress(OSError):
                old.unlink()
    return own


def unfinished_path(path: Path, process: int) -> Path:
    """Name under which a process writes a film or poses until they are complete."""
    return path.with_name(f".{path.name}.{process}.part")


def writing_process(path: Path) -> int | None:
    """Number of another running process that is writing a film or poses; None if there is none, or on Windows."""
    if os.name == "nt" or not path.parent.is_dir():  # there, a signal would end the process
        return None
    start, end = unfinished_path(path, 0).name.rsplit("0", 1)
    for name in os.listdir(path.parent):  # noqa: PTH208 - names only, of a folder that may be large
        number = name[len(start) : -len(end)] if name.startswith(start) and name.endswith(end) else ""
        if number.isdecimal() and int(number) != os.getpid() and _is_running(int(number)):
            return int(number)
    return None


def _is_running(process: int) -> bool:
    try:
        os.kill(process, 0)
    except PermissionError:  # it runs for another user
        return True
    except (OSError, OverflowError):
        return False
    return True
