"""The commands study …: accuracy of the registration, on simulated posts."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from arview.cli.common import main, say
from arview.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable

    from arview.measurement.studies import Study

OUTPUT = click.option(
    "-o", "--output", default="studies", show_default=True, metavar="FOLDER", help="Folder for CSV and PNG."
)
QUICK = click.option("--quick", is_flag=True, help="Few runs with few points: seconds instead of minutes.")
SEED = click.option("--seed", type=int, default=0, show_default=True, help="The same seed gives the same figures.")


@main.group(
    short_help="Simulate registrations of posts.",
    epilog="""\b
Examples:
  arview study noise -o studies/
  arview study density --quick

\b
Each command writes CSV and PNG to FOLDER and prints a summary. The posts are 16 mm across and 40 mm
high; measured points are sampled at random from their surface.""",
)
def study() -> None:
    """Simulate registrations of posts: bias, spread, and what they depend on."""


@study.command(
    short_help="Displacements of 1 to 9 mm: true against estimated.",
    epilog="""\b
Examples:
  arview study displacement --quick
  arview study displacement -o studies/ --seed 1""",
)
@OUTPUT
@QUICK
@SEED
def displacement(output: str, quick: bool, seed: int) -> None:
    """Two posts moved by 1 to 9 mm, 24,099 points with 0.1 mm of noise; the cost around the minimum."""
    from arview.measurement.studies import displacement_study

    _write(lambda: displacement_study(quick, seed), output)


@study.command(
    short_help="Noise of 0 to 0.5 mm: registration and cylinder fit.",
    epilog="""\b
Examples:
  arview study noise --quick
  arview study noise -o studies/ --seed 1""",
)
@OUTPUT
@QUICK
@SEED
def noise(output: str, quick: bool, seed: int) -> None:
    """Bias and spread at 0 to 0.5 mm of noise per point, with 10,000 points and 100 runs per level."""
    from arview.measurement.studies import noise_study

    _write(lambda: noise_study(quick, seed), output)


@study.command(
    short_help="Bias of displacements near zero.",
    epilog="""\b
Examples:
  arview study rice --quick
  arview study rice -o studies/ --seed 1""",
)
@OUTPUT
@QUICK
@SEED
def rice(output: str, quick: bool, seed: int) -> None:
    """10,000 measured lengths of displacements of 0 and 1 mm with 0.3 mm of noise, against Rice's distribution.

    Noise makes the length of a displacement near zero too large.
    """
    from arview.measurement.studies import rice_study

    _write(lambda: rice_study(quick, seed), output)


@study.command(
    short_help="Dense and sparse clouds without noise.",
    epilog="""\b
Examples:
  arview study density --quick
  arview study density --rows bd --runs 50 --cloud-runs 5
  arview study density -o studies/ --seed 1""",
)
@OUTPUT
@QUICK
@SEED
@click.option("--runs", type=click.IntRange(min=1), metavar="N", help="Runs with the exact surface.  [default: 500]")
@click.option(
    "--cloud-runs", type=click.IntRange(min=1), metavar="N", help="Runs of ICP between clouds.  [default: 500]"
)
@click.option("--rows", default="abcd", show_default=True, help="Rows of the study, points of reference/measured: "
              "a 240,965/240,965, b 24,099/24,099, c 240,965/24,099, d 240,965/2,411.")  # fmt: skip
def density(output: str, quick: bool, seed: int, runs: int | None, cloud_runs: int | None, rows: str) -> None:
    """Bias and CPU time at a displacement of 1 mm, by number of points: exact surface and ICP between clouds.

    The full study takes more than an hour of CPU time, most of it in row a of ICP between clouds.
    """
    from arview.measurement.studies import density_study

    if not rows or set(rows) - set("abcd"):
        raise InputError(f"--rows {rows!r}: expected letters of abcd")
    _write(lambda: density_study(quick, seed, runs, cloud_runs, rows), output)


@study.command(
    short_help="Convergence thresholds of 0.1 to 1e-5 mm.",
    epilog="""\b
Examples:
  arview study threshold --quick
  arview study threshold -o studies/ --seed 1""",
)
@OUTPUT
@QUICK
@SEED
def threshold(output: str, quick: bool, seed: int) -> None:
    """Error at a displacement of 1 mm against the threshold of the iteration: exact surface and ICP."""
    from arview.measurement.studies import threshold_study

    _write(lambda: threshold_study(quick, seed), output)


def _write(make: Callable[[], Study], output: str) -> None:
    from arview.measurement.studies import write_study

    folder = Path(output)
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{output}: is a file; give a folder for the results")
    result = make()
    for line in result.summary:
        click.echo(line)
    for path in write_study(result, folder):
        say(f"wrote {path}")
