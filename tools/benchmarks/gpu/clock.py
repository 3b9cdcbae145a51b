"""Time of a call, and a row of the table."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

T = TypeVar("T")


@dataclass(frozen=True)
class Row:
    """One comparison: times in seconds, and how far the results agree."""

    what: str
    subject: str
    device: str
    own_s: float
    other_s: float
    result: str
    is_within: bool


def timed(call: Callable[[], T], is_wall: bool) -> tuple[float, T]:
    """Seconds of a call, on the wall or of the processor, and what it gives. It is called once before."""
    call()
    clock = time.perf_counter if is_wall else time.process_time
    began_s = clock()
    given = call()
    return clock() - began_s, given
