"""The program's own source as syntax trees: modules, imports, definitions and names, for tests that hold its rules."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path

from helpers.paths import ROOT, TOOLS

SRC = ROOT / "src"


@cache
def source_files() -> tuple[Path, ...]:
    """Every Python file of the package."""
    return tuple(sorted((SRC / "arview").rglob("*.py")))


@cache
def lab_files() -> tuple[Path, ...]:
    """Every Python file of the laboratory, a package of its own."""
    return tuple(sorted((TOOLS / "lab" / "arview_lab").rglob("*.py")))


@cache
def tool_files() -> tuple[Path, ...]:
    """Every Python file of ``tools/`` but tests, those without a suffix included."""
    return tuple(
        sorted(
            path
            for path in TOOLS.rglob("*")
            if path.is_file()
            and not {"__pycache__", "tests"} & set(path.relative_to(TOOLS).parts)
            and (path.suffix == ".py" or _is_script(path))
        )
    )


def _is_script(path: Path) -> bool:
    with path.open("rb") as file:
        line = file.readline(80)
    return path.suffix == "" and line.startswith(b"#!") and b"python" in line


@cache
def tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def label(path: Path) -> str:
    """The path as it is named in findings: relative to the checkout."""
    return path.relative_to(ROOT).as_posix()


def module_name(path: Path) -> str:
    """``arview.cad.part`` of ``src/arview/cad/part.py``."""
    return ".".join(path.with_suffix("").relative_to(SRC).parts).removesuffix(".__init__")


@cache
def modules() -> dict[str, Path]:
    """Path of every module by its dotted name."""
    return {module_name(path): path for path in source_files()}


@cache
def imports(name: str) -> frozenset[str]:
    """Modules of the package that a module imports anywhere: in functions and for type checking, too."""
    found: set[str] = set()
    for node in ast.walk(tree(modules()[name])):
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{name}: relative import"
            if node.module is None or node.module.split(".")[0] != "arview":
                continue
            for alias in node.names:
                full = f"{node.module}.{alias.name}"
                if full in modules():
                    found.add(full)
                else:
                    found.add(node.module)
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names if alias.name.split(".")[0] == "arview"}
    unknown = found - set(modules())
    assert not unknown, f"{name} imports what is not there: {unknown}"
    return frozenset(found - {name})


def functions(path: Path) -> Iterator[tuple[str, ast.FunctionDef | ast.AsyncFunctionDef]]:
    """Every function and method with its qualified name, ``Class.method`` or ``outer.inner``."""

    def walk(node: ast.AST, prefix: str) -> Iterator[tuple[str, ast.FunctionDef | ast.AsyncFunctionDef]]:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef):
                yield prefix + child.name, child
            is_scope = isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef)
            yield from walk(child, f"{prefix}{child.name}." if is_scope else prefix)

    yield from walk(tree(path), "")


def identifiers(path: Path) -> frozenset[str]:
    """Names that a file defines: functions, classes, parameters, variables, attributes, and its own."""
    found = {path.stem}
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            found.add(node.name)
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            found.add(node.id)
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            found.add(node.attr)
        elif isinstance(node, ast.arg):
            found.add(node.arg)
        elif isinstance(node, ast.alias) and node.asname:
            found.add(node.asname)
    return frozenset(found)
