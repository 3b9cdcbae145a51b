"""Editing the text of a part file: comments stay, edits are undone, what is not TOML is refused."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest

from arview.errors import InputError
from arview.station.studio.part_text import PartText

TEXT = """# welded plate
[part]
cad = "plate.step"   # made on Monday

[components.base]
role = "base"        # carries the others

[components.post_1]
role = "inspect"
position_tolerance_mm = 0.5  # drawing 12, zone 1
"""


def test_a_value_is_changed_and_every_comment_stays() -> None:
    text = PartText(TEXT).with_value(("components", "post_1", "position_tolerance_mm"), 0.8)
    assert text == TEXT.replace("0.5", "0.8")


def test_a_table_is_made_where_there_is_none_and_removed_when_it_is_empty() -> None:
    text = PartText(TEXT)
    made = text.with_value(("components", "nut_1", "role"), "ignore")
    assert tomllib.loads(made)["components"]["nut_1"] == {"role": "ignore"}
    assert made.startswith(TEXT.rstrip("\n"))
    gone = PartText(made).with_value(("components", "nut_1", "role"), None)
    assert tomllib.loads(gone) == tomllib.loads(TEXT)


def test_names_with_slashes_and_dots_are_quoted() -> None:
    made = PartText(TEXT).with_value(("components", "sub_1/post.2", "role"), "ignore")
    assert tomllib.loads(made)["components"]["sub_1/post.2"]["role"] == "ignore"


def test_symmetries_are_a_list_of_tables() -> None:
    made = PartText(TEXT).with_list("symmetry", [{"axis": [0.0, 0.0, 1.0], "order": 2}])
    assert tomllib.loads(made)["symmetry"] == [{"axis": [0.0, 0.0, 1.0], "order": 2}]
    assert tomllib.loads(PartText(made).with_list("symmetry", [])) == tomllib.loads(TEXT)


def test_edits_are_undone_and_done_again() -> None:
    text = PartText(TEXT, TEXT)
    text.change(text.with_value(("part", "serial"), "A1"))
    text.change(text.with_value(("part", "serial"), "A2"))
    assert text.undo() and tomllib.loads(text.text)["part"]["serial"] == "A1"
    assert text.undo() and text.text == TEXT and text.is_saved
    assert not text.undo()
    assert text.redo() and text.redo() and tomllib.loads(text.text)["part"]["serial"] == "A2"
    assert not text.redo() and not text.is_saved
    text.undo()
    text.change(text.with_value(("part", "serial"), "A3"))
    assert not text.can_redo


def test_saving_writes_the_text(tmp_path: Path) -> None:
    text = PartText.for_cad("plate.step", "mm")
    text.save(tmp_path / "part.toml")
    assert tomllib.loads((tmp_path / "part.toml").read_text()) == {"part": {"cad": "plate.step", "unit": "mm"}}
    assert text.is_saved


def test_what_is_not_toml_is_refused() -> None:
    with pytest.raises(InputError, match="not valid TOML"):
        PartText("[part").with_value(("part", "serial"), "A1")
    with pytest.raises(InputError, match=r"\[part.cad\] is not a table"):
        PartText(TEXT).with_value(("part", "cad", "x"), 1)
