"""The command warmup: all kernels compiled ahead."""

from __future__ import annotations

import click

from arview.cli.common import main, progress_bar


@main.command(
    short_help="Compile all inner loops now, so that no command has to wait.",
    epilog="""\b
Examples:
  arview warmup
  arview warmup --processes 2
  arview warmup --without refinement.modalities.shading

\b
The inner loops are compiled when they are first used and kept in the cache folder (ARVIEW_CACHE, else
~/.cache/arview). This command compiles all of them at once, on all cores. What is in the cache already is
not compiled again. Run it after installing or updating arview.""",
)
@click.option("--processes", type=click.IntRange(min=1), metavar="N", help="Processes; default: one per core.")
@click.option("--without", multiple=True, metavar="MODULE",
              help="Leave out a room or module; may be repeated.")  # fmt: skip
def warmup(processes: int | None, without: tuple[str, ...]) -> None:
    """Compile all inner loops of arview into the cache folder."""
    from arview.core.cache_folder import cache_folder
    from arview.core.warm_up import warm_up

    with progress_bar("compiling") as progress:
        compiled = warm_up(progress, processes, without)
    click.echo(f"{compiled} function signatures compiled, the others were in {cache_folder()}")
