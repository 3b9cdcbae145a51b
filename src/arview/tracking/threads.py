"""The threads that all searches share: their numba kernels release the interpreter."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache


@lru_cache(maxsize=1)
def pool() -> ThreadPoolExecutor:
    """Shared threads, one per core up to four; no job may wait for another job of theirs."""
    return ThreadPoolExecutor(max(1, min(4, os.cpu_count() or 1)), thread_name_prefix="search")
