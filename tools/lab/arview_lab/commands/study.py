"""The commands study …: what the accuracy of a measurement depends on, with simulated posts, clouds and photos."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from arview.cli.common import Group, say, stage_bar
from arview.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable

    from arview_lab.studies import Study

OUTPUT = click.option(
    "-o", "--output", default="studies", show_default=True, metavar="FOLDER", help="Folder for CSV and PNG."
)
QUICK = click.option("--quick", is_flag=True, help="Few runs with few points: seconds instead of minutes.")
SEED = click.option("--seed", type=int, default=0, show_default=True, help="The same seed gives the same figures.")


def study_options(command: Callable[..., None]) -> Callable[..., None]:
    """The options that all studies have."""
    return OUTPUT(QUICK(SEED(command)))


@click.group(
    cls=Group,
    short_help="Studies of accuracy, with simulated posts, clouds and photos.",
    epilog="""\b
Examples:
  arview study noise -o studies/
  arview study density --quick
  arview study registration --cloud scan.ply --part part.toml
  arview study photos out/ --part part.toml

\b
Each command writes CSV and PNG to FOLDER and prints a summary. The posts are 16 mm across and 40 mm
high; measured points are sampled at random from their surface. registration and bias also take a cloud,
and photos takes the result of `arview inspect`.""",
)
def study() -> None:
    """Bias and spread of registrations, and what they depend on."""


@study.command(
    short_help="Displacements of 1 to 9 mm: true against estimated.",
    epilog="""\b
Examples:
  arview study displacement --quick
  arview study displacement -o studies/ --seed 1""",
)
@study_options
def displacement(output: str, quick: bool, seed: int) -> None:
    """Two posts moved by 1 to 9 mm, 24,099 points with 0.1 mm of noise; the cost around the minimum."""
    from arview_lab.studies import displacement_study

    _write(lambda: displacement_study(quick, seed), output)


@study.command(
    short_help="Noise of 0 to 0.5 mm: registration and cylinder fit.",
    epilog="""\b
Examples:
  arview study noise --quick
  arview study noise -o studies/ --seed 1""",
)
@study_options
def noise(output: str, quick: bool, seed: int) -> None:
    """Bias and spread at 0 to 0.5 mm of noise per point, with 10,000 points and 100 runs per level."""
    from arview_lab.studies import noise_study

    _write(lambda: noise_study(quick, seed), output)


@study.command(
    short_help="Bias of displacements near zero.",
    epilog="""\b
Examples:
  arview study rice --quick
  arview study rice -o studies/ --seed 1""",
)
@study_options
def rice(output: str, quick: bool, seed: int) -> None:
    """10,000 measured lengths of displacements of 0 and 1 mm with 0.3 mm of noise, against Rice's distribution.

    Noise makes the length of a displacement near zero too large.
    """
    from arview_lab.studies import rice_study

    _write(lambda: rice_study(quick, seed), output)


@study.command(
    short_help="Dense and sparse clouds without noise.",
    epilog="""\b
Examples:
  arview study density --quick
  arview study density --rows bd --runs 50 --cloud-runs 5
  arview study density -o studies/ --seed 1""",
)
@study_options
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
    from arview_lab.studies import density_study

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
@study_options
def threshold(output: str, quick: bool, seed: int) -> None:
    """Error at a displacement of 1 mm against the threshold of the iteration: exact surface and ICP."""
    from arview_lab.studies import threshold_study

    _write(lambda: threshold_study(quick, seed), output)


@study.command(
    "registration",
    short_help="Classical ICP beside the exact surface, on the same clouds.",
    epilog="""\b
Examples:
  arview study registration --quick
  arview study registration --cloud scan.ply --part part.toml
  arview study registration --cloud scan.ply --part samples/plate/part.toml --truth samples/plate/truth.json

\b
The classical way cuts reference and measured points out around the nominal place, averages both on a
0.5 mm grid, and registers by point-to-point, then point-to-plane ICP (Open3D). With --cloud, every
component of PART in that cloud is placed both ways instead; --truth is the truth.json of a sample.""",
)
@study_options
@click.option("--runs", type=click.IntRange(min=1), metavar="N", help="Runs of each row.  [default: 50]")
@click.option("--cloud", metavar="FILE", help="A cloud in any frame and format of `arview measure --cloud`.")
@click.option("--part", metavar="PART", help="Part or CAD file of the cloud.")
@click.option("--truth", metavar="JSON", help="True positions of the components.")
def registration(
    output: str, quick: bool, seed: int, runs: int | None, cloud: str | None, part: str | None, truth: str | None
) -> None:
    """A post displaced by 1 mm with 0 to 0.4 mm of noise, or the components of a cloud: every way in one table."""
    from arview_lab.studies import cloud_registration_study, registration_study

    if (cloud is None) != (part is None) or (truth is not None and cloud is None):
        raise InputError("--cloud needs --part, and --truth needs both")
    if cloud is not None and part is not None:
        _write(lambda: cloud_registration_study(cloud, part, truth), output)
    else:
        _write(lambda: registration_study(quick, seed, runs), output)


@study.command(
    short_help="Down-sampling: grid, random, by information.",
    epilog="""\b
Examples:
  arview study sampling --quick
  arview study sampling -o studies/ --seed 1""",
)
@study_options
def sampling(output: str, quick: bool, seed: int) -> None:
    """Error of a post's position by number of points kept: on a grid, at random, and by their information.

    The post is scanned from one side, with many more points on what faces the scanner.
    """
    from arview_lab.studies import sampling_study

    _write(lambda: sampling_study(quick, seed), output)


@study.command(
    short_help="Local minima over 1 to 9 mm for four kinds of posts.",
    epilog="""\b
Examples:
  arview study minima --quick
  arview study minima -o studies/ --seed 1""",
)
@study_options
def minima(output: str, quick: bool, seed: int) -> None:
    """Share of the runs that end at the true place: round, hexagonal, stepped and grooved posts, moved by 1 to 9 mm.

    Each is registered from its nominal place alone, from several starts, and by classical ICP.
    """
    from arview_lab.studies import minima_study

    _write(lambda: minima_study(quick, seed), output)


@study.command(
    "bias",
    short_help="Map of a cloud's mean signed error beside its noise.",
    epilog="""\b
Examples:
  arview study bias scan.ply --part part.toml
  arview study bias out/cloud.ply --part samples/plate/part.toml --truth samples/plate/truth.json --quick

\b
CLOUD is in any frame and format of `arview measure --cloud`. Its signed distances to the CAD, with the
components at their true places if --truth is given, are averaged in cells of the surface. What varies from
cell to cell by more than the noise of their points allows is systematic: more points do not average it out.""",
)
@click.argument("cloud", metavar="CLOUD")
@click.option("--part", required=True, metavar="PART", help="Part or CAD file.")
@click.option("--truth", metavar="JSON", help="True positions of the components; default: nominal.")
@click.option("--cell", type=click.FloatRange(0.5, 100.0), default=5.0, show_default=True, metavar="MM",
              help="Size of a cell.")  # fmt: skip
@study_options
def bias(cloud: str, part: str, truth: str | None, cell: float, output: str, quick: bool, seed: int) -> None:
    """Mean signed error of CLOUD by place, beside the noise of its points."""
    from arview_lab.studies import bias_study

    _write(lambda: bias_study(cloud, part, truth, cell, quick, seed), output)


@study.command(
    short_help="A quarter of a part beside ten times as many foreign points.",
    epilog="""\b
Examples:
  arview study finding --part part.toml --quick
  arview study finding --part samples/plate/part.toml --runs 12

\b
Every cloud shows one end of the part, a quarter of its surface, among boxes, tubes and balls; half as
many clouds hold these alone. The search of `arview measure --cloud` is compared with FPFH and RANSAC.""",
)
@click.option("--part", required=True, metavar="PART", help="Part or CAD file.")
@click.option("--runs", type=click.IntRange(min=1), metavar="N", help="Clouds with the part.  [default: 6]")
@study_options
def finding(part: str, runs: int | None, output: str, quick: bool, seed: int) -> None:
    """How often a part is found, and how often refused where it is not."""
    from arview_lab.studies import finding_study

    _write(lambda: finding_study(part, quick, seed, runs), output)


@study.command(
    "photos",
    short_help="Number and layout of the photos against the error.",
    epilog="""\b
Examples:
  arview study photos out/ --part part.toml
  arview study photos out/ --part samples/plate/part.toml --truth samples/plate/truth.json --quick
  arview study photos out/ --part part.toml --numbers 6,12,24 --layouts spread,random

\b
FOLDER is what `arview inspect` or `arview reconstruct` wrote. Some of its photos at a time are adjusted and
measured without the others. Without --truth they are compared with the measurement of all photos. Layouts:
  spread      as far apart as possible
  random      at random
  one side    within a sector of 110 degrees
  one height  within a band of heights of 12 degrees
All layouts that a number of photos allows are measured, and all photos together.""",
)
@click.argument("folder", metavar="FOLDER")
@click.option("--part", required=True, metavar="PART", help="Part or CAD file.")
@click.option("--truth", metavar="JSON", help="True positions of the components; default: the result of all photos.")
@click.option("--photos", metavar="FOLDER", help="Folder of the photos, if they have been moved.")
@click.option("--numbers", default="6,8,12,16,24,36,48,60", show_default=True, metavar="N,N", help="Numbers of photos.")
@click.option("--layouts", default="spread,random,one side,one height", show_default=True, metavar="NAME,NAME",
              help="Layouts.")  # fmt: skip
@click.option("--runs", type=click.IntRange(min=1), metavar="N", help="Sets of each number and layout.  [default: 2]")
@study_options
def photos(
    folder: str, part: str, truth: str | None, photos: str | None, numbers: str, layouts: str, runs: int | None,
    output: str, quick: bool, seed: int,
) -> None:  # fmt: skip
    """Error of every component by number and layout of the photos, from 6 to as many as there are.

    --quick measures one set of 8 and of 16 photos of each layout.
    """
    from arview_lab.studies import photo_study
    from arview_lab.studies.photos import QUICK_NUMBERS, PhotoStudyOptions

    try:
        counts = tuple(int(one) for one in numbers.split(","))
    except ValueError:
        raise InputError(f"--numbers {numbers!r}: expected whole numbers with commas between them") from None
    names = tuple(one.strip() for one in layouts.split(","))
    options = PhotoStudyOptions(QUICK_NUMBERS if quick else counts, runs or (1 if quick else 2), seed, names)

    def made() -> Study:
        with stage_bar() as progress:
            return photo_study(folder, part, truth, photos, options, progress)

    _write(made, output)


def _write(make: Callable[[], Study], output: str) -> None:
    from arview_lab.studies import write_study

    folder = Path(output)
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{output}: is a file; give a folder for the results")
    result = make()
    for line in result.summary:
        click.echo(line)
    for path in write_study(result, folder):
        say(f"wrote {path}")
