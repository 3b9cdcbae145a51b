"""Types of command-line options for argparse."""

from __future__ import annotations

from argparse import ArgumentTypeError


def positive(text: str) -> int:
    """An integer of at least 1."""
    return _from(text, 1)


def seed(text: str) -> int:
    """An integer of at least 0."""
    return _from(text, 0)


def _from(text: str, minimum: int) -> int:
    value = int(text)
    if value < minimum:
        raise ArgumentTypeError(f"{value} is below {minimum}")
    return value


def share(text: str) -> float:
    """A number from 0 to 1."""
    value = float(text)
    if not 0.0 <= value <= 1.0:
        raise ArgumentTypeError(f"{value} is not between 0 and 1")
    return value
