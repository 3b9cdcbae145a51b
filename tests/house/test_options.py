"""No option that nothing sets: what no command, public function, tool or sample sets is a constant beside its use."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from helpers.paths import ROOT
from helpers.source_tree import source_files, tool_files, tree

ENDINGS = ("Options", "Settings", "Limits", "Config")
"""Ends of the names of classes that hold options."""
UNSET = {
    "BatchOptions.scratch": "a machine whose system folder for temporary files is too small",
    "GuideViewOptions.crease_angle_deg": "recorded with the guide views, and read back from their files",
    "SessionOptions.detector": "hands the options of the detector to a session in Python",
    "SessionOptions.finder": "an object of the caller, see docs/reference/plug-ins.md",
    "SessionOptions.matcher": "an object of the caller, see docs/reference/plug-ins.md",
    "SparseOptions.first_features": "together with ``features`` it trades time for accuracy",
    "UncertaintyOptions.draws": "together with ``monte_carlo`` it trades time for accuracy",
}
"""Options that nothing in src, tools or samples sets, with the reason for which they are options nevertheless."""


@dataclass(frozen=True)
class OptionClass:
    """A frozen dataclass of options.

    Attributes:
        name: of the class.
        owners: its fields in their order, and the class that declares each first: itself or one that it inherits from.
        own: the fields that it gives a default itself; one that it inherits is set by it.
    """

    name: str
    owners: dict[str, str]
    own: frozenset[str]


def option_classes(trees: list[ast.Module]) -> dict[str, OptionClass]:
    """The classes of options by their names, each with the fields that it inherits from another of them."""
    nodes = {
        node.name: node
        for module in trees
        for node in ast.walk(module)
        if isinstance(node, ast.ClassDef) and node.name.endswith(ENDINGS) and is_frozen_dataclass(node)
    }

    def owners_of(node: ast.ClassDef) -> dict[str, str]:
        found: dict[str, str] = {}
        for base in node.bases:
            if isinstance(base, ast.Name) and base.id in nodes:
                found |= owners_of(nodes[base.id])
        return found | {line: node.name for line in declared(node) if line not in found}

    return {
        name: OptionClass(name, owners_of(node), frozenset(f for f, is_given in declared(node).items() if is_given))
        for name, node in nodes.items()
    }


def declared(node: ast.ClassDef) -> dict[str, bool]:
    """The fields that a class declares itself, and whether it gives each a default."""
    return {
        line.target.id: line.value is not None
        for line in node.body
        if isinstance(line, ast.AnnAssign) and isinstance(line.target, ast.Name)
    }


def is_frozen_dataclass(node: ast.ClassDef) -> bool:
    return any(
        isinstance(one, ast.Call)
        and ast.unparse(one.func).split(".")[-1] == "dataclass"
        and any(k.arg == "frozen" and isinstance(k.value, ast.Constant) and k.value.value is True for k in one.keywords)
        for one in node.decorator_list
    )


def fields_set(module: ast.Module, classes: dict[str, OptionClass]) -> Iterator[tuple[str, str]]:
    """(class, field) of the options that a module sets.

    A call of a class sets its keywords and positions; ``replace`` sets its keywords in every class that has all of
    them; an assignment sets an attribute in every class that has it. What is passed on by ``**`` comes from somewhere
    else in the module: the keys of its tables and the keywords of its calls are set in the classes called like that.
    """
    aliases = {name: name for name in classes} | {
        node.targets[0].id: node.value.id
        for node in ast.walk(module)
        if isinstance(node, ast.Assign)
        and isinstance(node.targets[0], ast.Name)
        and isinstance(node.value, ast.Name)
        and node.value.id in classes
    }
    named: set[str] = set()
    unpacked: set[str] = set()
    for node in ast.walk(module):
        if isinstance(node, ast.Assign | ast.AugAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            attributes = {target.attr for target in targets if isinstance(target, ast.Attribute)}
            yield from ((one.name, field) for one in classes.values() for field in attributes & set(one.owners))
        elif isinstance(node, ast.Dict):
            named |= {k.value for k in node.keys if isinstance(k, ast.Constant) and isinstance(k.value, str)}
        elif isinstance(node, ast.Call):
            called = ast.unparse(node.func).split(".")[-1]
            keywords = {keyword.arg for keyword in node.keywords if keyword.arg is not None}
            is_open = len(keywords) < len(node.keywords)
            named |= keywords
            if called in aliases:
                one = classes[aliases[called]]
                yield from ((one.name, field) for field in keywords)
                yield from ((one.name, field) for field in list(one.owners)[: len(node.args)])
                unpacked |= {one.name} if is_open else set()
            elif called == "replace":
                fitting = [one for one in classes.values() if keywords <= set(one.owners)]
                yield from ((one.name, field) for one in fitting for field in keywords)
                unpacked |= {one.name for one in fitting} if is_open else set()
    yield from ((name, field) for name in unpacked for field in named & set(classes[name].owners))


@cache
def sample_files() -> tuple[Path, ...]:
    return tuple(sorted((ROOT / "samples").rglob("*.py")))


def unset(trees: list[ast.Module], users: list[ast.Module]) -> set[str]:
    """``Class.field`` of the options of some modules that neither these nor others set."""
    classes = option_classes(trees)
    given = {pair for module in [*trees, *users] for pair in fields_set(module, classes)}
    owned = {(classes[name].owners[field], field) for name, field in given if field in classes[name].owners}
    owned |= {
        (one.owners[field], field) for one in classes.values() for field in one.own if one.owners[field] != one.name
    }
    mine = {(one.name, field) for one in classes.values() for field in one.own if one.owners[field] == one.name}
    return {f"{name}.{field}" for name, field in mine - owned}


def test_what_sets_an_option() -> None:
    defined = """
@dataclass(frozen=True)
class StepOptions:
    size: float
    count: int = 3
    limit: float = 1.0
    is_exact: bool = False

@dataclass(frozen=True)
class FineOptions(StepOptions):
    pass
"""
    users = {
        "": {"count", "limit", "is_exact"},
        "StepOptions(1.0, 2)": {"limit", "is_exact"},
        "StepOptions(1.0, limit=2.0)": {"count", "is_exact"},
        "OtherOptions(limit=2.0)": {"count", "limit", "is_exact"},
        "replace(options, limit=2.0, count=1)": {"is_exact"},
        "replace(photo, limit=2.0, name='a')": {"count", "limit", "is_exact"},
        "options.is_exact = True": {"count", "limit"},
        "given = {'count': 3}\nStepOptions(1.0, **given)": {"limit", "is_exact"},
        "given = {'count': 3}": {"count", "limit", "is_exact"},
        "FineOptions(1.0, count=2)": {"limit", "is_exact"},
    }
    for text, expected in users.items():
        assert unset([ast.parse(defined)], [ast.parse(text)]) == {f"StepOptions.{name}" for name in expected}, text


def test_no_option_that_nothing_sets() -> None:
    trees = [tree(path) for path in source_files()]
    assert len(option_classes(trees)) > 20
    found = unset(trees, [tree(path) for path in (*tool_files(), *sample_files())])
    assert found == set(UNSET), f"make them constants beside their use: {sorted(found - set(UNSET))}"
