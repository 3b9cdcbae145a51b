"""What the commands share: the group that turns errors into one line, options, bars, files."""

from __future__ import annotations

import os
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click

from arview import __version__
from arview.core.atomic import replacing
from arview.core.progress import Progress, StepProgress
from arview.errors import ArviewError, OutputError

EXIT_ERROR, EXIT_BUG, EXIT_INTERRUPTED = 2, 1, 130


class _Group(click.Group):
    """Turns exceptions of the commands into one line on stderr and an exit code."""

    def invoke(self, ctx: click.Context) -> Any:
        """Run the chosen command."""
        try:
            return super().invoke(ctx)
        except ArviewError as error:
            say(f"error: {error}")
            ctx.exit(EXIT_ERROR)
        except KeyboardInterrupt:
            say("interrupted")
            ctx.exit(EXIT_INTERRUPTED)
        except (click.ClickException, click.exceptions.Exit, click.Abort, BrokenPipeError):
            raise
        except Exception as error:
            say_bug(error)
            ctx.exit(EXIT_BUG)


def say_bug(error: Exception) -> None:
    """One line on an error that nobody foresaw; what Python knows of it when ARVIEW_DEBUG is set."""
    if os.environ.get("ARVIEW_DEBUG"):
        traceback.print_exception(error)
    hint = "" if os.environ.get("ARVIEW_DEBUG") else " with what ARVIEW_DEBUG=1 prints"
    say(f"internal error: {type(error).__name__}: {error}; please report this{hint}")


def say(text: str) -> None:
    """One line on stderr, whatever the text holds."""
    click.echo("arview: " + " ".join(text.split()), err=True)


@click.group(
    cls=_Group,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
    epilog="""\b
Examples:
  arview inspect --part part.toml --photos photos/ --video walk.mp4 -o out/
  arview check bracket.step
  arview annotate clip.mp4 --part part.toml --camera camera.json --inspection inspection.json
  arview reconstruct photos/ --part part.toml -o out/
  arview live --part part.toml --inspection inspection.json
  arview evaluate bop/castle --init truth

\b
PART is a part file (part.toml; `arview check --help` shows one) or a CAD file (STEP, glTF, OBJ, STL,
PLY, 3MF). Exit codes: 0 done, 2 bad input, 130 interrupted (files are finished), 1 a bug in
arview; of inspect, batch and measure, the verdict: see there.""",
)
@click.version_option(__version__, prog_name="arview")
def main() -> None:
    """AR inspection of assemblies: find and track a part in video by its CAD, draw what was measured."""


UNIT = click.option("--unit", type=click.Choice(["mm", "cm", "m", "inch"]), help="Unit of the numbers in the CAD file.")
RENDERER = click.option(
    "--renderer",
    type=click.Choice(["auto", "pyrender", "zbuffer"]),
    default="auto",
    show_default=True,
    help="What draws guide views: pyrender needs a GL library, zbuffer nothing.",
)


@contextmanager
def progress_bar(label: str, total: int | None = None) -> Iterator[StepProgress]:
    """A bar on stderr, shown only on a terminal; yields a function of (done, in all)."""
    from tqdm import tqdm

    with tqdm(desc=label, total=total, disable=None, leave=False, unit="") as bar:

        def update(done: int, in_all: int) -> None:
            bar.total = in_all or None
            bar.update(done - bar.n)

        yield update


@contextmanager
def stage_bar() -> Iterator[Progress]:
    """Like ``progress_bar`` for work in stages: yields a function of (stage, done, in all)."""
    from tqdm import tqdm

    with tqdm(disable=None, leave=False, unit="") as bar:
        shown = ""

        def update(stage: str, done: int, in_all: int) -> None:
            nonlocal shown
            if stage != shown:
                shown = stage
                bar.reset(in_all or None)
                bar.set_description(stage)
            bar.total = in_all or None
            bar.update(done - bar.n)

        yield update


def output_path(path: str, inputs: list[Any]) -> Path:
    """The path of an output, after making sure that it can be one and overwrites no input."""
    target = Path(path)
    if not target.parent.is_dir():
        raise OutputError(f"{path}: there is no folder {target.parent}; create it first")
    if target.is_dir():
        raise OutputError(f"{path}: is a folder; give the name of a file")
    if not os.access(target.parent, os.W_OK):
        raise OutputError(f"{path}: the folder {target.parent} cannot be written to; choose another")
    for other in inputs:
        if other is not None and target.resolve() == Path(other).resolve():
            raise OutputError(f"{path}: would overwrite an input or another output; choose another name")
    return target


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file that appears complete or not at all."""
    try:
        with replacing(path) as file:
            file.write(content)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror or error})") from error
