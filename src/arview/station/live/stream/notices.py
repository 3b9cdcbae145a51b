"""Notices: conditions that the users of the page have to know of."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from arview.station.live.protocol import NOTICE_CODES

Level = Literal["info", "warning", "error"]


@dataclass(frozen=True)
class Notice:
    """A message of one line for the page.

    Attributes:
        code: a code of the protocol, which stays the same when the text changes.
        level: severity.
        text: the message.

    Raises:
        ValueError: the protocol does not define the code.
    """

    code: str
    level: Level
    text: str

    def __post_init__(self) -> None:
        if self.code not in NOTICE_CODES:
            raise ValueError(f"notice code {self.code!r} is not in the protocol")


def without_folder(text: str, path: str | Path) -> str:
    """An error message in which a path is reduced to its file name: pages must not show where files are."""
    return text.replace(str(path), Path(path).name)
