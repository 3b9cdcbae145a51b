"""Checks of arguments at the public functions, so that a mix-up is reported where it happens."""

from __future__ import annotations

from pathlib import Path

PATH = (str, Path)


def check_type(value: object, expected: type | tuple[type, ...], where: str) -> None:
    """Check that an argument has an expected type.

    Args:
        value: the argument.
        expected: the type, or the types of which it must be one.
        where: the function and the argument, e.g. ``"Detector: views"``.

    Raises:
        TypeError: with the type that was expected and the one that was passed.
    """
    if isinstance(value, expected):
        return
    types = expected if isinstance(expected, tuple) else (expected,)
    names = " or ".join("None" if one is type(None) else one.__name__ for one in types)
    raise TypeError(f"{where}: expected {names}, got {_described(value)}")


def _described(value: object) -> str:
    """The type of a value, with the value itself where it is short."""
    if value is None:
        return "None"
    name = type(value).__name__
    return f"{name} ({value!r})" if isinstance(value, str | int | float | bool) and len(repr(value)) <= 60 else name
