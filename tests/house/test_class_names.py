"""One name for one thing: no two classes share a name, and no alias has the name of a class; `tools/lab` included."""

from __future__ import annotations

import ast
from collections import defaultdict

from helpers.source_tree import lab_files, label, source_files, tree

SHARED: frozenset[str] = frozenset()
"""Names that several classes may have, because each is private to its file."""


def test_no_two_classes_share_a_name() -> None:
    classes, aliases = defaultdict(list), defaultdict(list)
    for path in [*source_files(), *lab_files()]:
        for node in ast.walk(tree(path)):
            if isinstance(node, ast.ClassDef):
                classes[node.name].append(label(path))
        for node in tree(path).body:
            if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
                aliases[node.targets[0].id].append(label(path))
    assert len(classes) > 300 and len(aliases) > 300
    double = {name for name, paths in classes.items() if len(paths) > 1 or name in aliases}
    # What is told how far a piece of work has come was once an alias in eleven files.
    double |= {"Progress"} if len(aliases["Progress"]) > 1 else set()
    assert double == SHARED
    assert len(SHARED) <= 6
