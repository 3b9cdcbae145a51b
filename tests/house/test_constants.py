"""Numbers that are policy are fields of options: few stand at the top of modules where poses are found."""

from __future__ import annotations

import ast
import re
from functools import cache
from pathlib import Path

from helpers.source_tree import SRC, label, source_files, tree

ROOMS = ("detection", "refinement", "tracking", "assembly")
MAX_PER_1000_LINES = 8.0
CONSTANT = re.compile(r"_?[A-Z][A-Z0-9_]*$")
KERNEL_DECORATORS = {"kernel", "njit", "jit", "vectorize", "guvectorize"}


def files() -> list[Path]:
    return [path for path in source_files() if path.relative_to(SRC / "arview").parts[0] in ROOMS]


def numeric_constants(path: Path) -> set[str]:
    """Module-level UPPER_CASE names bound to numbers, or to tables of nothing but numbers."""
    found = set()
    for node in tree(path).body:
        value = node.value if isinstance(node, ast.Assign | ast.AnnAssign) else None
        targets = node.targets if isinstance(node, ast.Assign) else [node.target] if value is not None else []
        for target in targets:
            names = target.elts if isinstance(target, ast.Tuple) else [target]
            if value is not None and is_numeric(value):
                found |= {n.id for n in names if isinstance(n, ast.Name) and CONSTANT.match(n.id)}
    return found


def is_numeric(value: ast.expr) -> bool:
    """Whether an expression is made of numbers, other constants and functions of them; a class's instance is not."""
    numbers = 0
    for node in ast.walk(value):
        if isinstance(node, ast.Constant):
            if isinstance(node.value, bool) or not isinstance(node.value, int | float):
                return False
            numbers += 1
        elif isinstance(node, ast.Name) and CONSTANT.match(node.id):
            numbers += 1
        elif isinstance(node, ast.Call):
            called = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "A")
            if called[0].isupper() or called == "range":
                return False
        elif isinstance(node, ast.Lambda | ast.Subscript | ast.Set | ast.ListComp | ast.GeneratorExp):
            return False
    return numbers > 0


def kernel_names(path: Path) -> set[str]:
    """Names that compiled functions of a file read: constants among them are fixed when they are compiled."""
    found = set()
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.FunctionDef):
            words = {n.id for d in node.decorator_list for n in ast.walk(d) if isinstance(n, ast.Name)}
            words |= {n.attr for d in node.decorator_list for n in ast.walk(d) if isinstance(n, ast.Attribute)}
            if words & KERNEL_DECORATORS:
                found |= {n.id for n in ast.walk(node) if isinstance(n, ast.Name)}
    return found


def index_names(path: Path) -> set[str]:
    """Names by which a column or an item is taken: ``table[:, NAME]``."""
    return {
        name.id
        for node in ast.walk(tree(path))
        if isinstance(node, ast.Subscript)
        for name in ast.walk(node.slice)
        if isinstance(name, ast.Name)
    }


@cache
def taken_from(path: Path) -> dict[str, set[str]]:
    """Names that a file imports, by module."""
    found: dict[str, set[str]] = {}
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.ImportFrom) and node.module is not None:
            found.setdefault(node.module, set()).update(alias.name for alias in node.names)
    return found


def policy_constants() -> list[str]:
    found = []
    for path in files():
        module = ".".join(path.with_suffix("").relative_to(SRC).parts)
        names = numeric_constants(path) - kernel_names(path) - index_names(path)
        for other in source_files():
            taken = taken_from(other).get(module, set()) & names
            if taken:
                names -= taken & (kernel_names(other) | index_names(other))
        found += [f"{label(path)}:{name}" for name in sorted(names)]
    return found


def test_what_counts_as_a_number() -> None:
    def check(text: str) -> bool:
        return is_numeric(ast.parse(text, mode="eval").body)

    assert all(check(text) for text in ("3", "-0.5", "(1.0, 2.0)", "2 * LIMIT", "np.deg2rad(5.0)", "{1: 2.0}"))
    assert not any(check(text) for text in ("True", "'x'", "Options(1.0)", "(Stage(1), Stage(2))", "range(3)", "names"))


def test_policy_constants_are_few() -> None:
    constants = policy_constants()
    lines = sum(len(path.read_text(encoding="utf-8").splitlines()) for path in files())
    assert lines > 5000
    share = 1000.0 * len(constants) / lines
    assert share < MAX_PER_1000_LINES, f"{len(constants)} in {lines} lines: {', '.join(constants)}"
