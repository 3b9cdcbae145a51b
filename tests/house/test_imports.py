"""The table of rooms: who may import whom, lazy imports and imports for type checking counted."""

from __future__ import annotations

import ast
from importlib import import_module
from pathlib import Path

import pytest

from helpers.rooms import LEVEL, folders, room, rooms_with
from helpers.source_tree import imports, lab_files, modules, source_files, tree

FORBIDDEN = {
    "measurement": {"detection", "refinement", "tracking"},
    "detection": {"assembly"},
}
FRONT = {"arview", "arview.__main__", "arview.station", "arview.quality"}
"""The front door and those of the wings, which are of no room."""


def test_every_module_is_in_a_room_of_the_table() -> None:
    found = {room(name) for name in modules() if name not in FRONT}
    assert found == set(LEVEL)


def test_no_room_imports_one_that_is_not_above_it() -> None:
    crossings = [
        (name, other)
        for name in modules()
        if name not in FRONT
        for other in imports(name)
        if other not in FRONT and room(other) != room(name)
    ]
    assert len(crossings) > 300
    upwards = {f"{name} imports {other}" for name, other in crossings if LEVEL[room(other)] >= LEVEL[room(name)]}
    assert upwards == set()


SHELVES = {"errors", "version", "geometry", "pose", "pose_file", "annotation", "core", "web", "weights"}
"""Single modules, and rooms that are shelves of small modules: their modules are imported by name."""


def test_rooms_are_entered_by_their_doors() -> None:
    """A module of another room is imported by name only for a function that is called like its module."""
    past_the_door, through = [], 0
    for name, path in modules().items():
        for node in ast.walk(tree(path)):
            if not (isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("arview.")):
                continue
            for alias in node.names:
                full = f"{node.module}.{alias.name}"
                taken = full if full in modules() else node.module
                if name in FRONT or taken in FRONT or room(taken) in {room(name), *SHELVES}:
                    continue
                is_door = taken == f"arview.{room(taken)}"
                through += is_door
                if not is_door and alias.name != taken.rpartition(".")[2]:
                    past_the_door.append(f"{name}: {full}")
    assert through > 400
    assert past_the_door == []


def test_doors_offer_what_they_say() -> None:
    doors = [
        name
        for name in modules()
        if name == f"arview.{room(name)}" and name not in FRONT and room(name) not in {*SHELVES, "cli"}
    ]
    assert len(doors) > 20
    for name in doors:
        door = import_module(name)
        assert door.__all__ and all(hasattr(door, offered) for offered in door.__all__), name


def test_the_rooms_that_import_a_room() -> None:
    assert {"refinement", "detection", "tracking"} <= set(rooms_with("refinement"))
    assert "calibration" not in rooms_with("tracking")
    assert [path.name for path in folders("station.studio")] == ["cli", "studio"]
    with pytest.raises(KeyError):
        rooms_with("lobby")


def test_no_room_imports_the_front() -> None:
    assert [name for name in modules() if name not in FRONT and imports(name) & FRONT] == []


def test_rooms_that_know_nothing_of_each_other() -> None:
    for name in modules():
        if name not in FRONT:
            assert not {room(other) for other in imports(name)} & FORBIDDEN.get(room(name), set()), name


def test_the_program_knows_nothing_of_the_laboratory() -> None:
    def knows(path: Path) -> bool:
        return any(
            name.split(".")[0] == "arview_lab"
            for node in ast.walk(tree(path))
            if isinstance(node, ast.Import | ast.ImportFrom)
            for name in ([alias.name for alias in node.names] if isinstance(node, ast.Import) else [node.module or ""])
        )

    assert sum(map(knows, lab_files())) > 20
    assert [path.name for path in source_files() if knows(path)] == []


def test_there_is_no_circle() -> None:
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"b"}}) == [["b", "c"]]
    found = circles({name: set(imports(name)) - FRONT for name in modules() if name not in FRONT})
    assert {" ".join(circle) for circle in found} == set()


def circles(graph: dict[str, set[str]]) -> list[list[str]]:
    """Strongly connected components of more than one module, each sorted (Tarjan 1972)."""
    index: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    found: list[list[str]] = []

    def visit(node: str) -> None:
        index[node] = low[node] = len(index)
        stack.append(node)
        for other in sorted(graph[node]):
            if other not in index:
                visit(other)
                low[node] = min(low[node], low[other])
            elif other in stack:
                low[node] = min(low[node], index[other])
        if low[node] == index[node]:
            component = stack[stack.index(node) :]
            del stack[stack.index(node) :]
            if len(component) > 1:
                found.append(sorted(component))

    for node in sorted(graph):
        if node not in index:
            visit(node)
    return found
