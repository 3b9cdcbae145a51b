"""The command batch: inspections of many parts, distributed by Dask."""

from __future__ import annotations

import tempfile
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

import click

from arview.cli.common import main, say
from arview.cli.exit_codes import ExitCode, exit_code_of
from arview.quality import batch as quality
from arview.quality import history

if TYPE_CHECKING:
    pass


def _parse_resources(ctx: click.Context, parameter: click.Parameter, value: str | None) -> dict[str, float]:
    """``{"GPU": 1.0}`` of GPU=1."""
    try:
        pairs = [one.split("=") for one in value.split(",")] if value else []
        return {name.strip(): float(amount) for name, amount in pairs}
    except ValueError:
        raise click.BadParameter(f"{value!r}: expected names and amounts like GPU=1,MEMORY=4e9") from None


SCHEDULER = click.option("--scheduler", metavar="URL", help="tcp://host:port of a Dask scheduler; default: none.")
RESOURCES = click.option(
    "--resources", callback=_parse_resources, metavar="NAME=N", help="What its workers must have, e.g. GPU=1."
)


@main.command(
    short_help="Inspect many parts, on this machine or a cluster.",
    epilog="""\b
Examples:
  arview batch jobs.toml
  arview batch jobs.toml --workers 4 --memory-limit 3GB --store plate.sqlite
  arview batch jobs.toml --scheduler tcp://10.0.0.5:8786
  Notes: docs/reference/command-notes.md""",
    exit_codes={
        ExitCode.DONE: "all jobs pass",
        ExitCode.FAIL: "a job fails",
        ExitCode.UNDECIDED: "a job is undecided",
        ExitCode.CANNOT_MEASURE: "a job could not be measured or ended with an error",
        ExitCode.INTERRUPTED: "interrupted; finished jobs are kept",
    },
)
@click.argument("jobs_path", metavar="JOBS.toml")
@SCHEDULER
@RESOURCES
@click.option(
    "--workers",
    type=click.IntRange(min=1),
    metavar="N",
    help="Local workers; default: one per two cores, as far as memory allows.",
)
@click.option(
    "--memory-limit",
    default="4GB",
    show_default=True,
    metavar="SIZE",
    help="Memory per local job; a job that takes more is stopped.",
)
@click.option(
    "--retries",
    type=click.IntRange(min=0),
    default=2,
    show_default=True,
    metavar="N",
    help="Retries of a job that was stopped.",
)
@click.option(
    "--connect-s",
    type=click.FloatRange(min=0.1),
    default=15.0,
    show_default=True,
    metavar="S",
    help="Seconds to wait for a scheduler.",
)
@click.option("--store", metavar="FILE|URL", help="Also add the results to this store (`arview history`).")
@click.option("--station", metavar="NAME", help="Name of the measuring station.")
def batch(
    jobs_path: str,
    scheduler: str | None,
    resources: dict[str, float],
    workers: int | None,
    memory_limit: str,
    retries: int,
    connect_s: float,
    store: str | None,
    station: str | None,
) -> None:
    """Inspect all parts that JOBS.toml names."""
    from tqdm import tqdm

    jobs = quality.load_jobs(jobs_path)
    if store is not None:
        history.HistoryStore(store, tell=say).close()
    options = quality.BatchOptions(scheduler, workers or 0, memory_limit, retries, connect_s, resources=resources)
    with tqdm(desc="jobs", total=len(jobs), disable=None, leave=False, unit="") as bar:

        def started(link: str, count: int) -> None:
            tqdm.write(f"{len(jobs)} jobs on {count} worker{'s' * (count != 1)}; dashboard: {link}")

        def came(result: quality.JobResult) -> None:
            tqdm.write(_line(result))
            bar.update()

        results = quality.run_batch(jobs, options, started=started, progress=came)
    if store is not None:
        _add(results, store, station)
    counts = Counter(one.verdict.replace("_", " ") for one in results)
    kept = sum(one.is_kept for one in results)
    click.echo(
        f"{len(results)} jobs: "
        + ", ".join(f"{count} {verdict}" for verdict, count in counts.most_common())
        + (f"; {kept} of them already done" if kept else "")
    )
    click.get_current_context().exit(worst_exit_code(results))


def worst_exit_code(results: list[quality.JobResult]) -> ExitCode:
    """The worst of all jobs: no verdict, then fail, then undecided."""
    codes = {exit_code_of(one.verdict) for one in results}
    ranking = (ExitCode.CANNOT_MEASURE, ExitCode.FAIL, ExitCode.UNDECIDED)
    return next((code for code in ranking if code in codes), ExitCode.DONE)


def _line(result: quality.JobResult) -> str:
    kept = " (already done)" if result.is_kept else ""
    return f"{result.name}: {result.verdict.replace('_', ' ')}{kept}; {result.text}; {result.out}"


def _add(results: list[quality.JobResult], store: str, station: str | None) -> None:
    """Add the results to the store; those already there stay as they are."""
    with history.HistoryStore(store, tell=say) as opened, tempfile.TemporaryDirectory() as folder:
        new = 0
        for one in results:
            content = quality.read(f"{one.out}/inspection.json") if one.inspection_sha256 else None
            if content is None:
                say(f"history: no result of {one.name}")
                continue
            path = Path(folder) / "inspection.json"
            path.write_bytes(content)
            new += opened.add(path, station).is_new
        click.echo(f"history: {new} added to {opened.name}")
