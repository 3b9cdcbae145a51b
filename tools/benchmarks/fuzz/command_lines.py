"""Command lines: commands with random options and arguments, most of which name valid, damaged or absent files."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click
from click.testing import CliRunner
from guard import Fault, guarded
from hypothesis import strategies as st
from mutations import CHANGES, changed
from seeds import make_seeds

from arview.cli import main

LEFT_OUT = {"live", "studio", "study", "warmup", "batch"}
"""Commands that run for long or start other processes: their options are tested by name in tests/station/live and tests/cli."""
TEXTS = (
    "",
    "-1",
    "0",
    "1",
    "nan",
    "1e999",
    "x",
    "a,b",
    "640x480",
    "0s",
    "1h",
    "=",
    ":",
    "../..",
    "/dev/null",
    "é\u202e",
    "part.toml:x",
    "fov:60",
    "fov:nan",
    "exif",
    "profile:none",
    "guide:none",
    "1:2:100",
    "charuco:8x6:30:22:DICT_5X5_100",
    "2026-01-01",
    "%s",
    "{}",
    "sqlite:///x.db",
    "mm",
    "*",
    "no_such.mp4",
    "-",
    "--",
)
CODES = {0, 1, 2, 3, 64}


def commands(group: click.Group, prefix: tuple[str, ...] = ()) -> list[tuple[tuple[str, ...], click.Command]]:
    """All commands with their names."""
    found: list[tuple[tuple[str, ...], click.Command]] = []
    context = click.Context(group)
    for name in group.list_commands(context):
        command = group.get_command(context, name)
        if name in LEFT_OUT or command is None:
            continue
        if isinstance(command, click.Group):
            found += commands(command, (*prefix, name))
        else:
            found.append(((*prefix, name), command))
    return found


def fuzz_command_line(folder: Path) -> tuple[Callable[[Any], None], st.SearchStrategy[Any]]:
    """The attempt on a command line and the strategy of its argument."""
    home = folder / "commands" / "seeds"
    kinds = ("part", "inspection", "camera", "positions", "guideviews", "picture", "cloud", "scale")
    files = [paths[0] for paths in make_seeds(home, *kinds).values()]
    known = commands(main)
    work = folder / "commands" / "work"
    work.mkdir(parents=True, exist_ok=True)
    os.chdir(work)
    os.environ["ARVIEW_DATA"] = os.environ["ARVIEW_CACHE"] = str(folder / "commands" / "data")
    value = st.tuples(st.integers(0, 3), st.integers(0, 1000), CHANGES)
    line = st.tuples(
        st.integers(0, 1000),
        st.lists(st.tuples(st.integers(0, 1000), value), max_size=5),
        st.lists(value, max_size=2),
    )

    def text_of(argument: tuple[int, int, list[Any]], number: int) -> str:
        kind, index, changes = argument
        path = files[index % len(files)]
        if kind == 0:
            return TEXTS[index % len(TEXTS)]
        if kind == 1:
            return str(path)
        if kind == 2:
            damaged = work.parent / f"current_{number}_{path.name}"
            damaged.write_bytes(changed(path.read_bytes(), changes, True))
            return str(damaged)
        return f"out_{index % 5}{('.json', '.csv', '.html', '.mp4', '')[index % 5]}"

    def attempt(argument: tuple[int, list[Any], list[Any]]) -> None:
        number, options, arguments = argument
        names, command = known[number % len(known)]
        words = list(names)
        choices = [one for one in command.params if isinstance(one, click.Option)]
        for place, (index, content) in enumerate(options if choices else []):
            option = choices[index % len(choices)]
            words.append(option.opts[index % len(option.opts)])
            if not (option.is_flag or option.count):
                words.append(text_of(content, place))
        words += [text_of(one, 10 + place) for place, one in enumerate(arguments)]
        (work.parent / "current_line").write_text(repr(words))
        with guarded(" ".join(names), folder / "commands" / "native.txt"):
            result = CliRunner().invoke(main, words)
            if result.exception is not None and not isinstance(result.exception, SystemExit):
                raise result.exception
            if "Traceback" in result.stderr:
                raise Fault(f"{' '.join(names)} traceback", f"{words} {result.stderr[-300:]}")
            if result.exit_code not in CODES:
                raise Fault(f"{' '.join(names)} exit code {result.exit_code}", f"{words} {result.stderr[-300:]}")
            if result.exit_code == 64 and not result.stderr.strip():
                raise Fault(f"{' '.join(names)} silent", f"{words}")

    return attempt, line
