"""The help texts: their examples are parsed by the program itself, and their exit codes come from one table."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import click
import pytest
from click.testing import CliRunner

from arview.cli import ExitCode, main
from arview.cli.common import SECTIONS, Command, Group
from arview.cli.exit_codes import group_rows, help_rows

ROOT = Path(__file__).parents[2]
DOCUMENTS = ("README.md", *(str(path.relative_to(ROOT)) for path in sorted((ROOT / "docs").glob("*.md"))))
EXAMPLE = re.compile(r"^ +(?:\.venv/bin/)?arview ((?:[^#\n]|(?<=\S)#)*)", re.MULTILINE)


def commands(group: click.Group = main, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], click.Command]]:
    """The program and all its commands, those of `tools/lab` included where it is installed."""
    yield path, group
    context = click.Context(group)
    for name in group.list_commands(context):
        command = group.get_command(context, name)
        assert command is not None
        if isinstance(command, click.Group):
            yield from commands(command, (*path, name))
        else:
            yield (*path, name), command


def help_text(path: tuple[str, ...]) -> str:
    done = CliRunner().invoke(main, [*path, "--help"], prog_name="arview")
    assert done.exit_code == 0, done.output
    return done.output


def parse(arguments: list[str]) -> None:
    """Parse a command line as the program would, without running it. Raises click.ClickException."""
    context = main.make_context("arview", list(arguments))
    command: click.Command = main
    while isinstance(command, click.Group):
        rest = [*context._protected_args, *context.args]
        name, found, rest = command.resolve_command(context, rest)
        assert found is not None and name is not None
        context = found.make_context(name, rest, parent=context)
        command = found


def examples(text: str) -> list[list[str]]:
    text = re.sub(r"\\\n\s+", "", text)
    return [shlex.split(match.group(1)) for match in EXAMPLE.finditer(text)]


@pytest.mark.parametrize("path", [pytest.param(path, id=" ".join(path) or "arview") for path, _ in commands()])
def test_examples_of_help_are_valid(path: tuple[str, ...]) -> None:
    text = help_text(path)
    found = examples(text)
    assert found
    for arguments in found:
        parse(arguments)


@pytest.mark.parametrize("document", DOCUMENTS)
def test_examples_of_documents_are_valid(document: str) -> None:
    found = examples((ROOT / document).read_text(encoding="utf-8"))
    for arguments in found:
        parse(arguments)
    assert found or document != "README.md"


@pytest.mark.parametrize("wrong", [["check", "--bogus"], ["measure", "out/", "--part"], ["annotat", "x"]])
def test_a_wrong_example_would_fail(wrong: list[str]) -> None:
    with pytest.raises(click.UsageError):
        parse(wrong)


def test_every_help_ends_with_its_exit_codes() -> None:
    seen = 0
    for path, command in commands():
        text = " ".join(help_text(path).split())
        assert isinstance(command, Command | Group), path
        rows = help_rows(command.exit_codes) if isinstance(command, Command) else group_rows()
        assert "Exit codes: " + " ".join(" ".join(row) for row in rows) in text, path
        assert {"0", "64", "70", "130"} <= {code for codes, _ in rows for code in codes.split(", ")}
        seen += 1
    assert seen > 20


def test_the_documents_have_the_same_table() -> None:
    text = (ROOT / "docs" / "reference" / "exit-codes.md").read_text(encoding="utf-8")
    for code in ExitCode:
        assert f"| {int(code)} | {code.meaning} |" in text, code


def test_no_help_is_an_essay() -> None:
    lengths = {path: len(help_text(path).splitlines()) for path, _ in commands()}
    assert len(lengths) > 30
    assert {path: lines for path, lines in lengths.items() if lines > 46} == {}


def test_the_program_lists_its_commands_in_sections() -> None:
    text = help_text(())
    places = [text.index(f"\n{title}:\n") for title in (*SECTIONS, "More")]
    assert places == sorted(places)
    for title, names in SECTIONS.items():
        section = text.split(f"\n{title}:\n")[1].split("\n\n")[0]
        assert [line.split()[0] for line in section.splitlines()] == list(names)


def test_lines_of_help_fit_a_terminal() -> None:
    for path, _ in commands():
        for line in help_text(path).splitlines():
            assert len(line) <= 120, (path, line)


def test_notes_show_the_file_of_a_batch_as_it_must_be_written() -> None:
    lines = (ROOT / "docs" / "reference" / "command-notes.md").read_text(encoding="utf-8").splitlines()
    start = lines.index("A file JOBS.toml:") + 3
    assert lines[start].startswith('out = "results"') and lines[start + 1].startswith("[defaults]")


def test_shell_completion() -> None:
    program = [sys.executable, "-c", "from arview.cli import main; main(prog_name='arview')"]
    script = subprocess.run(
        program, capture_output=True, text=True, env={"_ARVIEW_COMPLETE": "bash_source", **environment()}, timeout=60
    )
    assert "_arview_completion" in script.stdout, script.stderr
    words = {"COMP_WORDS": "arview ann", "COMP_CWORD": "1", "_ARVIEW_COMPLETE": "bash_complete"}
    done = subprocess.run(program, capture_output=True, text=True, env={**words, **environment()}, timeout=60)
    assert done.stdout.split() == ["plain,annotate"], done.stderr
    notes = (ROOT / "docs" / "reference" / "command-notes.md").read_text(encoding="utf-8")
    assert "_ARVIEW_COMPLETE=bash_source arview" in notes


def environment() -> dict[str, str]:
    import os

    return dict(os.environ)
