"""Rows of the table of an evaluation."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from tqdm import tqdm

Item = TypeVar("Item")


@dataclass(frozen=True)
class ResultRow:
    """One row of the table: what was measured on what, the result, the target, and whether it is reached."""

    measure: str
    on: str
    found: str
    target: str
    is_reached: bool


def watched(items: Iterable[Item], label: str) -> Iterator[Item]:
    """The items, with a progress bar on stderr where that is a terminal."""
    return iter(tqdm(items, desc=label, disable=None, leave=False, file=sys.stderr))


def timing(ms: Iterable[float]) -> str:
    """Median and 95th percentile of times, as text."""
    times = np.array(list(ms))
    if times.size == 0:
        return "no time measured"
    return f"median {np.median(times):.0f} ms, p95 {np.percentile(times, 95):.0f} ms"
