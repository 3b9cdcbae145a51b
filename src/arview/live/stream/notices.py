"""Notice: something that whoever looks at the page has to know."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from arview.live.protocol import NOTICE_CODES

Level = Literal["info", "warning", "error"]


@dataclass(frozen=True)
class Notice:
    """One line for the page, with a code that stays the same when the words change.

    Raises:
        ValueError: a code that the protocol does not know.
    """

    code: str
    level: Level
    text: str

    def __post_init__(self) -> None:
        if self.code not in NOTICE_CODES:
            raise ValueError(f"notice code {self.code!r} is not in the protocol")


def without_folder(text: str, path: str | Path) -> str:
    """An error text for the page, which must not tell where files are."""
    return text.replace(str(path), Path(path).name)
