"""A TOML table that is read key by key, with error messages that name the file, the table and the key."""

from __future__ import annotations

import difflib
import re
import unicodedata
from pathlib import Path
from typing import Any

import numpy as np

from arview.cad.part import Vector
from arview.errors import InputError


class TomlTable:
    """A TOML table that is read key by key.

    Every reading method marks its key as allowed and raises InputError, naming file, table and key, when the value has
    the wrong type or range; `finish` raises it for keys that were never read.
    """

    def __init__(self, path: Path, name: str, content: dict[str, Any]) -> None:
        self.path = path
        self.name = name
        self.content = content
        self.allowed: list[str] = []

    def known(self, key: str) -> bool:
        """Mark a key as allowed; True when the table has it."""
        if key not in self.allowed:
            self.allowed.append(key)
        return key in self.content

    def take(self, key: str) -> Any:
        """The value of a required key."""
        if not self.known(key):
            raise InputError(f"{self.path}: {self._where()}the key {key!r} is missing")
        return self.content[key]

    def fail(self, key: str, value: object, expected: str) -> None:
        """Raise the InputError for a value that is not as expected."""
        raise InputError(f"{self.path}: {self._where()}{key} = {value!r}: expected {expected}")

    def finish(self) -> None:
        """Raise InputError for the first key that was not read."""
        for key in self.content:
            if key not in self.allowed:
                close = difflib.get_close_matches(key, self.allowed, n=1)
                hint = f" (did you mean {close[0]!r}?)" if close else ""
                allowed = ", ".join(self.allowed)
                raise InputError(f"{self.path}: {self._where()}unknown key {key!r}{hint}; allowed: {allowed}")

    def table(self, key: str, required: bool = False) -> TomlTable:
        """A table inside this one; an empty one when the key is absent and not required."""
        value = self.take(key) if required or self.known(key) else {}
        if not isinstance(value, dict):
            self.fail(key, value, "a table")
        return TomlTable(self.path, f"{self.name}.{key}".lstrip("."), value)

    def tables(self, key: str) -> list[TomlTable]:
        """The tables of an array of tables; none when the key is absent."""
        value = self.content[key] if self.known(key) else []
        if not isinstance(value, list) or not all(isinstance(item, dict) for item in value):
            self.fail(key, value, f"tables [[{key}]]")
        return [TomlTable(self.path, f"{self.name}.{key}".lstrip("."), item) for item in value]

    def text(self, key: str, default: str | None = None) -> str:
        """A string; required unless there is a default."""
        if default is not None and not self.known(key):
            return default
        value = self.take(key)
        if not isinstance(value, str):
            self.fail(key, value, "text in quotes")
        if any(unicodedata.category(letter) == "Cc" and letter not in "\n\t" for letter in value):
            self.fail(key, value, "text without control characters")
        return str(value)

    def line(self, key: str, default: str) -> str:
        """A string of one line, such as a name that is drawn and printed."""
        value = self.text(key, default)
        if any(unicodedata.category(letter) in ("Cc", "Zl", "Zp") for letter in value):
            self.fail(key, value, "text of one line")
        return value

    def texts(self, key: str, default: tuple[str, ...] = ()) -> tuple[str, ...]:
        """A list of strings that are not empty; the default when the key is absent."""
        if not self.known(key):
            return default
        value = self.content[key]
        if not isinstance(value, list) or not value or not all(isinstance(one, str) and one.strip() for one in value):
            self.fail(key, value, "a list of texts in quotes")
        return tuple(value)

    def choice(
        self, key: str, options: tuple[str, ...], default: str | None = None, required: bool = False
    ) -> str | None:
        """One of some strings."""
        if not required and not self.known(key):
            return default
        value = self.take(key)
        if value not in options:
            self.fail(key, value, "one of " + ", ".join(f'"{option}"' for option in options))
        return str(value)

    def choices(self, key: str, options: tuple[str, ...]) -> tuple[str, ...]:
        """A list of some of the options, returned in their order; all of them by default."""
        value = self.content[key] if self.known(key) else list(options)
        if not isinstance(value, list) or not value or any(item not in options for item in value):
            self.fail(key, value, "a list of some of " + ", ".join(f'"{option}"' for option in options))
        return tuple(option for option in options if option in value)

    def positive(self, key: str, default: float | None = None, required: bool = False) -> float | None:
        """A number above zero."""
        if not required and not self.known(key):
            return default
        value = self.take(key)
        if not _is_number(value) or value <= 0:
            self.fail(key, value, "a positive number")
        return float(value)

    def number(self, key: str) -> float | None:
        """A number; None when the key is absent."""
        if not self.known(key):
            return None
        if not _is_number(self.content[key]):
            self.fail(key, self.content[key], "a number")
        return float(self.content[key])

    def flag(self, key: str) -> bool:
        """True or false; false when the key is absent."""
        value = self.content[key] if self.known(key) else False
        if not isinstance(value, bool):
            self.fail(key, value, "true or false")
        return bool(value)

    def angle(self, key: str, max_deg: float = 360.0) -> float:
        """A required number whose magnitude does not exceed a limit."""
        value = self.take(key)
        if not _is_number(value) or abs(value) > max_deg:
            self.fail(key, value, f"a number from -{max_deg:g} to {max_deg:g}")
        return float(value)

    def interval(self, key: str) -> tuple[float, float]:
        """A required pair of numbers, low and high."""
        value = self.take(key)
        if not isinstance(value, list) or len(value) != 2 or not all(_is_number(item) for item in value):
            self.fail(key, value, "two numbers [low, high]")
        return float(value[0]), float(value[1])

    def vector(self, key: str, default: Vector | None = None) -> Vector:
        """Three numbers; required unless there is a default."""
        if default is not None and not self.known(key):
            return default
        return _vector(self, key, self.take(key))

    def direction(self, key: str) -> Vector:
        """A required vector, scaled to unit length."""
        value = np.array(self.vector(key))
        length = float(np.linalg.norm(value))
        if length < 1e-9:
            self.fail(key, value.tolist(), "a direction other than zero")
        x, y, z = (value / length).tolist()
        return x, y, z

    def color(self, key: str) -> Vector | None:
        """An sRGB colour "#rrggbb" as three numbers from 0 to 1; None when the key is absent."""
        if not self.known(key):
            return None
        value = self.content[key]
        if not isinstance(value, str) or not re.fullmatch(r"#[0-9a-fA-F]{6}", value):
            self.fail(key, value, 'a colour like "#8a8f98"')
        red, green, blue = (int(value[i : i + 2], 16) / 255.0 for i in (1, 3, 5))
        return red, green, blue

    def _where(self) -> str:
        return f"[{self.name}] " if self.name else ""


def vectors(table: TomlTable, key: str) -> tuple[Vector, ...]:
    """A list of vectors; none when the key is absent."""
    value = table.take(key) if table.known(key) else []
    if not isinstance(value, list):
        table.fail(key, value, "a list of [x, y, z]")
    return tuple(_vector(table, key, item) for item in value)


def _vector(table: TomlTable, key: str, value: Any) -> Vector:
    if not isinstance(value, list) or len(value) != 3 or not all(_is_number(item) for item in value):
        table.fail(key, value, "three numbers [x, y, z]")
    x, y, z = value
    return float(x), float(y), float(z)


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and bool(np.isfinite(value))
