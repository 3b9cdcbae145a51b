"""The tree of an assembly as text: assemblies with the number of their components, equal ones gathered in one line."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field

MAX_LINES = 60
"""Lines of a tree, after which the rest is counted."""


@dataclass
class _Node:
    """An assembly or a component of a tree; ``count`` components are in it, itself included if it is one."""

    name: str
    children: dict[str, _Node] = field(default_factory=dict)
    count: int = 0
    leaves: int = 0

    @property
    def signature(self) -> tuple[object, ...]:
        """What is equal for nodes that are gathered: the name without numbers, and the same of the children."""
        below = sorted((child.signature for child in self.children.values()), key=repr)
        return re.sub(r"\d+", "#", self.name), self.leaves, tuple(below)


def tree_lines(paths: Sequence[tuple[str, ...]]) -> list[str]:
    """The tree of components by their paths, from the root on; no lines where no assembly is in another one.

    Args:
        paths: of each component, its names from the root on.
    """
    root = _Node("")
    for path in paths:
        node = root
        node.count += 1
        for name in path or ("(no name)",):
            node = node.children.setdefault(name, _Node(name))
            node.count += 1
        node.leaves += 1
    while len(root.children) == 1 and not root.leaves:
        root = next(iter(root.children.values()))
    if not any(child.children for child in root.children.values()):
        return []
    lines = [f"{root.name or 'assembly'}: {root.count} components"]
    _add(root, 1, lines)
    if len(lines) > MAX_LINES:
        lines = [*lines[:MAX_LINES], f"  … and {len(lines) - MAX_LINES} more lines"]
    return lines


def _add(node: _Node, depth: int, lines: list[str]) -> None:
    groups: dict[tuple[object, ...], list[_Node]] = {}
    for child in node.children.values():
        groups.setdefault(child.signature, []).append(child)
    for group in groups.values():
        first, several = group[0], sum(max(one.leaves, 1) for one in group)
        name = first.name if len(group) == 1 else f"{first.name} … {group[-1].name}"
        times = f"  × {several}" if several > 1 else ""
        held = f": {first.count} components" if first.children else ""
        lines.append(f"{'  ' * depth}{name}{times}{f'{held} each' if held and times else held}")
        _add(first, depth + 1, lines)
