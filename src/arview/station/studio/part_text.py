"""The text of a part file while it is edited: comments stay, every edit can be undone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import tomlkit
from tomlkit.exceptions import TOMLKitError
from tomlkit.items import AoT, InlineTable, Table

from arview.core.atomic import write_file
from arview.errors import InputError

Plain = bool | int | float | str | Sequence[Any] | Mapping[str, Any]
"""Values that a part file holds."""
MAX_UNDO = 200
"""Edits that can be undone."""


class PartText:
    """A part file as text, with its edits.

    Attributes:
        text: the text as it is now.
        revision: number of edits so far, undone ones and their undoing counted too.
        saved_text: the text as it is in the file; None while there is no file.
    """

    def __init__(self, text: str, saved_text: str | None = None) -> None:
        self.text, self.saved_text, self.revision = text, saved_text, 0
        self._before: list[str] = []
        self._after: list[str] = []

    @classmethod
    def read(cls, path: Path) -> PartText:
        """The text of a part file.

        Raises:
            InputError: the file cannot be read.
        """
        try:
            text = path.read_bytes().decode("utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise InputError(f"{path}: cannot be read ({error})") from error
        return cls(text, text)

    @classmethod
    def for_cad(cls, cad: str, unit: str | None) -> PartText:
        """The text of a new part file for a CAD file."""
        document = tomlkit.document()
        document.add(tomlkit.comment("A part file of arview. Lengths in mm, angles in degrees."))
        head = tomlkit.table()
        head["cad"] = cad
        if unit is not None:
            head["unit"] = unit
        document["part"] = head
        return cls(tomlkit.dumps(document))

    @property
    def can_undo(self) -> bool:
        """There is an edit to undo."""
        return bool(self._before)

    @property
    def can_redo(self) -> bool:
        """There is an undone edit."""
        return bool(self._after)

    @property
    def is_saved(self) -> bool:
        """The file holds this text."""
        return self.text == self.saved_text

    def value(self, keys: Sequence[str]) -> Any:
        """The value at some keys as plain Python, or None where there is none.

        Raises:
            InputError: the text is not TOML.
        """
        found: Any = self._document().unwrap()
        for key in keys:
            found = found.get(key) if isinstance(found, dict) else None
        return found

    def with_value(self, keys: Sequence[str], value: Plain | None) -> str:
        """The text with the value at some keys, like ("components", "post_1", "role"); None removes it.

        A value that is there keeps its comment; a table that becomes empty is removed.

        Raises:
            InputError: the text is not TOML, or a key on the way is no table.
        """
        document = self._document()
        tables: list[Any] = [document]
        for key in keys[:-1]:
            parent = tables[-1]
            if key not in parent:
                if value is None:
                    return self.text
                parent[key] = tomlkit.table(
                    is_super_table=len(tables) == 1 and key in ("components", "datums", "features", "guides")
                )
            if not isinstance(parent[key], Table | InlineTable):
                raise InputError(f"[{'.'.join(keys[: len(tables)])}] is not a table")
            tables.append(parent[key])
        if value is not None:
            _put(tables[-1], keys[-1], value)
        elif keys[-1] in tables[-1]:
            del tables[-1][keys[-1]]
            for depth in range(len(tables) - 1, 0, -1):
                if not tables[depth]:
                    del tables[depth - 1][keys[depth - 1]]
        return tomlkit.dumps(document)

    def with_list(self, key: str, rows: Sequence[Mapping[str, Plain]]) -> str:
        """The text with a list of tables, such as [[symmetry]], in place of the one that is there."""
        document = self._document()
        if key in document:
            del document[key]
        if rows:
            tables = AoT([])
            for row in rows:
                table = tomlkit.table()
                for name, value in row.items():
                    table[name] = value
                tables.append(table)
            document[key] = tables
        return tomlkit.dumps(document)

    def change(self, text: str) -> None:
        """Take a new text; the present one can be brought back."""
        if text == self.text:
            return
        self._before = [*self._before[-(MAX_UNDO - 1) :], self.text]
        self._after = []
        self.text = text
        self.revision += 1

    def undo(self) -> bool:
        """Bring back the text before the last edit; False when there is none."""
        return self._step(self._before, self._after)

    def redo(self) -> bool:
        """Bring back the last undone edit; False when there is none."""
        return self._step(self._after, self._before)

    def save(self, path: Path) -> None:
        """Write the text, atomically.

        Raises:
            OutputError: the file cannot be written.
        """
        write_file(path, self.text.encode())
        self.saved_text = self.text

    def _step(self, taken: list[str], kept: list[str]) -> bool:
        if not taken:
            return False
        kept.append(self.text)
        self.text = taken.pop()
        self.revision += 1
        return True

    def _document(self) -> tomlkit.TOMLDocument:
        try:
            return tomlkit.parse(self.text)
        except TOMLKitError as error:
            raise InputError(f"not valid TOML: {error}") from error


def _put(table: Any, key: str, value: Plain) -> None:
    """Set a value; the comment behind a value that is there stays."""
    if key in table and hasattr(table[key], "trivia") and not isinstance(table[key], Table):
        item = tomlkit.item(value)
        item.trivia.comment, item.trivia.comment_ws = table[key].trivia.comment, table[key].trivia.comment_ws
        table[key] = item
    else:
        table[key] = value
