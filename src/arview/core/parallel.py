"""The thread pool that all searches share. Threads help because the kernels release the interpreter lock."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache


def thread_count() -> int:
    """Threads of the pool: one per core, at most four."""
    return max(1, min(4, os.cpu_count() or 1))


@lru_cache(maxsize=1)
def pool() -> ThreadPoolExecutor:
    """The shared pool. No job may wait for another job of the same pool, or both could wait forever."""
    return ThreadPoolExecutor(thread_count(), thread_name_prefix="search")
