"""The thread pool that all searches share. Threads help because the kernels release the interpreter lock."""

from __future__ import annotations

import ctypes
import os
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, suppress
from functools import lru_cache

from threadpoolctl import ThreadpoolController

ARENAS, _M_ARENA_MAX = 2, -8
"""Areas from which memory is allocated, and glibc's number for ``mallopt`` of that bound."""


def thread_count() -> int:
    """Threads of the pool: one per core, at most four."""
    return max(1, min(4, os.cpu_count() or 1))


@lru_cache(maxsize=1)
def pool() -> ThreadPoolExecutor:
    """The shared pool. No job may wait for another job of the same pool, or both could wait forever."""
    return ThreadPoolExecutor(thread_count(), thread_name_prefix="search")


def single_threaded_blas() -> AbstractContextManager[object]:
    """Context in which numpy multiplies matrices in the calling thread.

    For small matrices the threads of BLAS take longer to wait for each other than to multiply, and they keep the cores
    busy meanwhile.
    """
    return _blas().limit(limits=1)


@lru_cache(maxsize=1)
def _blas() -> ThreadpoolController:
    """The loaded BLAS libraries; to find them takes milliseconds."""
    return ThreadpoolController().select(user_api="blas")


def bound_arenas() -> None:
    """Let all threads, and those of child processes, allocate from a few arenas.

    glibc makes up to eight for each core, and memory that was freed in one of them is not used by the others.
    """
    if "MALLOC_ARENA_MAX" in os.environ:
        return
    os.environ["MALLOC_ARENA_MAX"] = str(ARENAS)
    with suppress(OSError, AttributeError, TypeError):  # another C library
        ctypes.CDLL(None).mallopt(_M_ARENA_MAX, ARENAS)
