"""What the steps of a fit look at, each made while the one before is taken."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

Made = TypeVar("Made")


def made_ahead(make: Callable[[int], Made], count: int) -> Iterator[Made]:
    """What a function makes of 0, 1, … below a count; of one after the other, in a thread of its own."""
    with ThreadPoolExecutor(1) as maker:
        following = maker.submit(make, 0)
        for step in range(count):
            made = following.result()
            if step + 1 < count:
                following = maker.submit(make, step + 1)
            yield made
