"""Training examples that are made in a thread while the network learns from those before."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

Item = TypeVar("Item")


def prefetched(make: Callable[[int], Item], count: int) -> Iterator[Item]:
    """``make(0)`` to ``make(count - 1)`` in order, each made in a thread while the caller uses the one before."""
    with ThreadPoolExecutor(1) as maker:
        following = maker.submit(make, 0)
        for step in range(count):
            made = following.result()
            if step + 1 < count:
                following = maker.submit(make, step + 1)
            yield made
