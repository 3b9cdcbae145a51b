"""The tables [[steps]] of a part file: order, defaults, and mistakes in one clear line."""

from __future__ import annotations

from pathlib import Path

import pytest

from arview.cad import load_part
from arview.cad.model import Step
from arview.errors import InputError
from arview.station.studio.part_text import PartText
from helpers.cad_files import box, obj_text

HEAD = '[part]\ncad = "parts.obj"\nunit = "mm"\n[components.fixture]\nrole = "ignore"\n'


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with parts.obj: a plate, three posts on it and a fixture beside it."""
    text = ""
    for count, name in enumerate(["plate", "post_1", "post_2", "post_3", "fixture"]):
        text += obj_text(name, *box((40 * count, 0, 0), (40 * count + 10, 10, 20)), 8 * count)
    (tmp_path / "parts.obj").write_text(text)
    return tmp_path


def steps(folder: Path, text: str) -> tuple[Step, ...]:
    (folder / "part.toml").write_text(HEAD + text)
    return load_part(folder / "part.toml").model.steps


def test_steps_follow_one_another_unless_they_say_after_what(folder: Path) -> None:
    text = """
[[steps]]
mount = ["post_1"]
[[steps]]
name = "both posts"
mount = ["post_2", "post_3"]
"""
    assert steps(folder, text) == (
        Step("post_1", ("post_1",)),
        Step("both posts", ("post_2", "post_3"), ("post_1",)),
    )
    free = '[[steps]]\nmount = ["post_1"]\n[[steps]]\nmount = ["post_2"]\nafter = []\n'
    assert [step.after for step in steps(folder, free)] == [(), ()]
    joined = f'{free}[[steps]]\nmount = ["post_3"]\nafter = ["post_1", "post_2"]\n'
    assert steps(folder, joined)[2].after == ("post_1", "post_2")
    assert steps(folder, "") == ()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('mount = ["post_4"]', r"\[steps\] no component 'post_4' in the CAD; did you mean 'post_"),
        ('mount = ["fixture"]', r"\[steps\] no component 'fixture'"),
        ('mount = ["post_1"]', r"mount = 'post_1': expected components that are mounted once"),
        ('mount = ["post_2", "post_2"]', r"mount = 'post_2': expected components that are mounted once"),
        ('mount = "post_2"', r"mount = 'post_2': expected a list of texts"),
        ("mount = []", r"mount = \[\]: expected a list of texts"),
        ('name = "second"', r"\[steps\] the key 'mount' is missing"),
        ('mount = ["post_2"]\nname = "first"', r"name = 'first': expected a name that no other step has"),
        ('mount = ["post_2"]\nname = "two\\nlines"', r"expected text of one line"),
        ('mount = ["post_2"]\nafter = ["third"]', r"after = 'third': expected names of steps above this one, of first"),
        ('mount = ["post_2"]\nbefore = ["first"]', r"unknown key 'before'.*allowed: mount, name, after"),
    ],
)
def test_mistakes_are_named(folder: Path, text: str, message: str) -> None:
    with pytest.raises(InputError, match=message) as error:
        steps(folder, f'[[steps]]\nname = "first"\nmount = ["post_1"]\n[[steps]]\n{text}\n')
    assert "part.toml" in str(error.value) and "\n" not in str(error.value)


def test_no_array_of_tables(folder: Path) -> None:
    with pytest.raises(InputError, match=r"expected tables \[\[steps\]\]"):
        steps(folder, '[steps]\nmount = ["post_1"]\n')


def test_the_studio_keeps_them(folder: Path) -> None:
    before = steps(folder, '[[steps]]\nmount = ["post_1"] # first\n')
    text = PartText.read(folder / "part.toml").with_value(("components", "post_1", "role"), "inspect")
    assert "# first" in text
    (folder / "part.toml").write_text(text)
    assert load_part(folder / "part.toml").model.steps == before
