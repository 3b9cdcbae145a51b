"""Messages: sentences with a key and values, so that a page can say them in its own language; their text is English."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Union

Value = Union[str, int, "Message", tuple["Message", ...]]
"""A value of a message: a name or number, a message, or a list of messages."""
_PLACE = re.compile(r"\{(\w+)\}")


@dataclass(frozen=True)
class Phrase:
    """A sentence of a catalogue.

    Attributes:
        key: by which pages find it in their language.
        english: the sentence; values stand in braces, ``{count} more photos``.
    """

    key: str
    english: str

    def __call__(self, **values: Value) -> Message:
        """The sentence with its values.

        Raises:
            ValueError: the values are not those of the sentence.
        """
        if set(values) != self.names:
            raise ValueError(f"{self.key}: expected values for {sorted(self.names)}, got {sorted(values)}")
        return Message(self, values)

    @cached_property
    def names(self) -> frozenset[str]:
        """Names of its values."""
        return frozenset(_PLACE.findall(self.english))

    @cached_property
    def pattern(self) -> re.Pattern[str]:
        """What matches the sentence with any values; ``count`` is a number."""
        pieces = _PLACE.split(self.english)
        values = {name: r"\d+" if name == "count" else ".+?" for name in self.names}
        plain = [re.escape(one) if k % 2 == 0 else f"(?P<{one}>{values[one]})" for k, one in enumerate(pieces)]
        return re.compile("".join(plain), re.DOTALL)


@dataclass(frozen=True)
class Message:
    """A sentence with its values.

    Attributes:
        phrase: the sentence.
        values: by name.
    """

    phrase: Phrase
    values: Mapping[str, Value] = field(default_factory=dict)

    @property
    def text(self) -> str:
        """The message in English."""
        return _PLACE.sub(lambda found: _text(self.values[found[1]]), self.phrase.english)

    def document(self) -> dict[str, Any]:
        """Key and values, for a page."""
        return {"key": self.phrase.key, "values": {name: _document(value) for name, value in self.values.items()}}


def recognised(text: str, phrases: Iterable[Phrase]) -> Message | None:
    """The message that an English text is, by the first phrase that matches all of it; None if none does."""
    for phrase in phrases:
        if found := phrase.pattern.fullmatch(text):
            return Message(phrase, found.groupdict())
    return None


def _text(value: Value) -> str:
    if isinstance(value, tuple):
        return ", ".join(one.text for one in value)
    return value.text if isinstance(value, Message) else str(value)


def _document(value: Value) -> Any:
    if isinstance(value, tuple):
        return [one.document() for one in value]
    return value.document() if isinstance(value, Message) else value
