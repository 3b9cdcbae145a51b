"""The documents agree with the program: length, links, rooms, names, the Python example."""

from __future__ import annotations

import ast
import pkgutil
import re
from pathlib import Path

import pytest

import arview
from helpers.rooms import LEVEL

ROOT = Path(__file__).parents[2]
DOCUMENTS = ("README.md", "ARCHITECTURE.md", "CONTRIBUTING.md", "CHANGELOG.md", "guideviews/README.md",
             *(path.relative_to(ROOT).as_posix() for path in sorted((ROOT / "docs").rglob("*.md"))))  # fmt: skip
LINK = re.compile(r"\]\(([^)#\s]+)(?:#([^)\s]+))?\)")
FILE = re.compile(r"`((?:src|tests|tools|samples|docs)/[\w./-]+\.\w+)`")


GENERATED = {"commands.md", "part-file.md", "inspection-json.md", "api.md", "messages.md"}
"""Pages of the reference that the site makes from the program (`tools/docs/hooks.py`)."""


def text_of(document: str) -> str:
    return (ROOT / document).read_text(encoding="utf-8")


def anchors(text: str) -> set[str]:
    heads = re.findall(r"^#+ (.+)$", text, re.MULTILINE)
    return {re.sub(r"[^\w -]", "", head).strip().lower().replace(" ", "-") for head in heads}


def test_readme_is_short() -> None:
    assert len(text_of("README.md").split()) <= 900


@pytest.mark.parametrize("document", DOCUMENTS)
def test_links_and_files_exist(document: str) -> None:
    text = text_of(document)
    folder = (ROOT / document).parent
    for target, anchor in LINK.findall(text):
        if "://" in target:
            continue
        if document.startswith("docs/") and Path(target).name in GENERATED:
            continue
        assert (folder / target).exists(), target
        if anchor:
            assert anchor in anchors((folder / target).read_text(encoding="utf-8")), (target, anchor)
    for name in FILE.findall(text):
        assert (ROOT / name).exists(), name


def test_architecture_names_every_room() -> None:
    text = text_of("ARCHITECTURE.md")
    assert len(text.split()) <= 1600
    table = text[text.index("## Rooms") : text.index("Rows from top to bottom")]
    rows = re.findall(r"^\| (`.+?) \|", table, re.MULTILINE)
    named = [name for row in rows for name in re.findall(r"`([\w.]+)`", row)]
    assert named == sorted(named, key=LEVEL.__getitem__)
    assert set(named) == set(LEVEL)


def test_python_example_of_readme_uses_public_names() -> None:
    (code,) = re.findall(r"```python\n(.*?)```", text_of("README.md"), re.DOTALL)
    used = {
        node.attr
        for node in ast.walk(ast.parse(code))
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "arview"
    }
    assert len(used) >= 5 and used <= set(arview.__all__)


def test_changelog_begins_with_unreleased() -> None:
    heads = re.findall(r"^## (.+)$", text_of("CHANGELOG.md"), re.MULTILINE)
    assert heads[0] == "Unreleased" and arview.__version__ in heads
    kinds = set(re.findall(r"^### (.+)$", text_of("CHANGELOG.md"), re.MULTILINE))
    assert kinds <= {"Added", "Changed", "Fixed", "Removed"}


@pytest.mark.parametrize("document", [name for name in DOCUMENTS if name.startswith(("docs/", "README"))])
def test_names_of_the_package_in_documents_are_public(document: str) -> None:
    groups = {"readers", "sources", "commands", "exports"}  # of entry points, see docs/reference/plug-ins.md
    modules = {module.name for module in pkgutil.iter_modules(arview.__path__)}
    named = set(re.findall(r"\barview\.([A-Za-z_]+)\b", text_of(document)))
    imported = re.findall(r"^from arview import (.+)$", text_of(document), re.MULTILINE)
    named |= {name.strip() for line in imported for name in line.split(",")}
    assert named - modules - groups - {"__all__"} <= set(arview.__all__)
