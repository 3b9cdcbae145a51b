"""What was read from photo files, kept in memory while a measurement takes several steps over the same photos."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from threading import Lock
from typing import Any, TypeVar

import numpy as np

Kept = TypeVar("Kept")


@dataclass
class PhotoStore:
    """Results by file; a file that has changed is another one.

    Attributes:
        limit_bytes: of all pictures together; what does not fit is read again each time.
    """

    limit_bytes: int
    size_bytes: int = 0
    results: dict[tuple[Any, ...], Any] = field(default_factory=dict)
    lock: Lock = field(default_factory=Lock)


_stores: list[PhotoStore] = []


@contextmanager
def keeping_photos(limit_bytes: int = 800_000_000) -> Iterator[PhotoStore]:
    """Within this context, in all threads, a photo that was read or checked is not decoded again."""
    store = PhotoStore(limit_bytes)
    _stores.append(store)
    try:
        yield store
    finally:
        _stores.remove(store)


def kept(kind: str, path: Path, make: Callable[[], Kept]) -> Kept:
    """The result of ``make`` for a file, or the one that it had before. Pictures are read-only."""
    store = _stores[-1] if _stores else None
    if store is None:
        return make()
    try:
        state = path.stat()
    except OSError:
        return make()
    key = (kind, str(path), state.st_mtime_ns, state.st_size)
    if key in store.results:
        found: Kept = store.results[key]
        return found
    result = make()
    size = result.nbytes if isinstance(result, np.ndarray) else 0
    with store.lock:
        if store.size_bytes + size <= store.limit_bytes and key not in store.results:
            if isinstance(result, np.ndarray):
                result.setflags(write=False)
            store.results[key] = result
            store.size_bytes += size
    return result
