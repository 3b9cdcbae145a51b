"""Hooks of mkdocs: pages of the reference that are made from the program, and pictures of the samples."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from runpy import run_path
from typing import Any

import click
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[2]
SAMPLE_LINK = re.compile(r"\]\((?:\.\./)+samples/([\w/]+\.jpg)\)")


def on_files(files: Files, config: Any) -> Files:
    """Add the pages made from the program and the pictures that pages show from `samples/`."""
    for path, text in generated_pages():
        files.append(File.generated(config, path, content=text))
    for picture in sorted((ROOT / "samples").glob("*/*.jpg")):
        name = f"pictures/{picture.parent.name}_{picture.name}"
        files.append(File.generated(config, name, abs_src_path=str(picture)))
    return files


def on_page_markdown(markdown: str, page: Page, config: Any, files: Files) -> str:
    """Lead links to pictures in `samples/`, which are right in the repository, to their copies in the site."""
    up = "../" * page.file.src_uri.count("/")
    return SAMPLE_LINK.sub(lambda found: f"]({up}pictures/{found[1].replace('/', '_')})", markdown)


def generated_pages() -> Iterator[tuple[str, str]]:
    """Path and text of each page that is made from the program."""
    from arview.cad import PART_FILE_EXAMPLE

    yield "reference/commands.md", "\n".join(command_page())
    yield (
        "reference/part-file.md",
        "# Part file\n\nA part file adds to a CAD file what it does not say. All but `cad` has a default. Keys that "
        f"are not known are an error.\n\n```toml\n{PART_FILE_EXAMPLE}```\n",
    )
    pages = run_path(str(Path(__file__).with_name("schema_page.py")))
    yield "reference/inspection-json.md", pages["schema_markdown"]()
    yield "reference/messages.md", pages["messages_markdown"]()
    yield "reference/api.md", "\n".join(api_page())


def command_page() -> Iterator[str]:
    """The help of each command, as the program prints it."""
    from arview.cli import main

    yield "# Commands\n\nThe help of each command, as `arview COMMAND --help` prints it.\n"
    for name, command in commands(main, "arview"):
        yield f"## {name}\n\n```text\n{help_of(command, name)}\n```\n"


def commands(command: click.Command, name: str) -> Iterator[tuple[str, click.Command]]:
    """A command and those below it, with their whole names; those that installed packages add are among them."""
    yield name, command
    if isinstance(command, click.Group):
        context = click.Context(command)
        for child in command.list_commands(context):
            found = command.get_command(context, child)
            if found is not None:
                yield from commands(found, f"{name} {child}")


def help_of(command: click.Command, name: str) -> str:
    """The text of `--help`."""
    with click.Context(command, info_name=name, terminal_width=100, max_content_width=100) as context:
        return command.get_help(context).rstrip()


def api_page() -> Iterator[str]:
    """A reference to every public name, which mkdocstrings fills from its docstring."""
    import arview

    yield "# Python interface\n\nThe names in `arview.__all__`; what they take and return is in their modules.\n"
    for name in arview.__all__:
        if not name.startswith("__"):
            yield f"::: {arview._MODULE_OF.get(name, 'arview.errors')}.{name}\n"
