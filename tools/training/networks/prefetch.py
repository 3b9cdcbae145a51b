"""Training examples that are made while the network learns from those before."""

from __future__ import annotations

import multiprocessing
import os
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

Item = TypeVar("Item")
MAX_PROCESSES = 12
"""Processes that make examples; with more the network waits for the pipe instead."""
MANY_CORES = 8
"""With fewer cores the network itself needs them all, and one thread makes the examples."""
_maker: list[Callable[[int], Any]] = []
"""The function that makes examples, inherited by the processes."""


def prefetched(make: Callable[[int], Item], count: int) -> Iterator[Item]:
    """``make(0)`` to ``make(count - 1)`` in order, each made before it is wanted.

    Args:
        make: makes one; where there are many cores it runs in processes, which must not see what an earlier call did.
        count: number of them.
    """
    cores = os.cpu_count() or 1
    if cores < MANY_CORES:
        yield from _by_a_thread(make, count)
        return
    _maker[:] = [make]
    count_ahead = 2 * min(MAX_PROCESSES, cores - 2)
    with multiprocessing.get_context("fork").Pool(count_ahead // 2) as processes:
        waiting = deque(processes.apply_async(_made, (step,)) for step in range(min(count_ahead, count)))
        for step in range(count):
            if step + count_ahead < count:
                waiting.append(processes.apply_async(_made, (step + count_ahead,)))
            yield waiting.popleft().get()


def _made(step: int) -> Any:
    return _maker[0](step)


def _by_a_thread(make: Callable[[int], Item], count: int) -> Iterator[Item]:
    with ThreadPoolExecutor(1) as maker:
        following = maker.submit(make, 0)
        for step in range(count):
            made = following.result()
            if step + 1 < count:
                following = maker.submit(make, step + 1)
            yield made
