"""Files that appear complete or not at all."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO


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
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "wb") as file:
            yield file
        Path(temporary).chmod(0o644)
        Path(temporary).replace(path)
    finally:
        Path(temporary).unlink(missing_ok=True)


def is_device(path: Path) -> bool:
    """True for an existing device, pipe or socket: what is neither a file nor a folder."""
    return path.exists() and not path.is_file() and not path.is_dir()
