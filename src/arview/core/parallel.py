"""The threads that all searches share: their numba kernels release the interpreter."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache


def thread_count() -> int:
    """One per core up to four."""
    return max(1, min(4, os.cpu_count() or 1))


@lru_cache(maxsize=1)
def pool() -> ThreadPoolExecutor:
    """Shared threads; no job may wait for another job of theirs."""
    return ThreadPoolExecutor(thread_count(), thread_name_prefix="search")
