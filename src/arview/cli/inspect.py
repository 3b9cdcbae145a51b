"""The command inspect: photos and a video of one part → verdict, report, coloured cloud, film."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import click

from arview.cli.common import UNIT, main, say, say_bug
from arview.core.progress import Progress
from arview.errors import ArviewError, CannotMeasureError

if TYPE_CHECKING:
    from arview.workflow.run import Outcome

EXIT_CODES = {"pass": 0, "fail": 1, "undecided": 2, "not_measured": 3}
EXIT_CANNOT_MEASURE = 3
EXIT_BAD_INPUT, EXIT_BUG = 64, 70
"""EX_USAGE and EX_SOFTWARE of sysexits.h: no verdict has them, and neither click nor Python ends with them."""


class VerdictCommand(click.Command):
    """A command whose exit code is a verdict: errors have codes of their own, above those of verdicts."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Wrong usage ends with 64, where click has 2."""
        try:
            return super().parse_args(ctx, args)
        except click.UsageError as error:
            error.show()
            raise click.exceptions.Exit(EXIT_BAD_INPUT) from error

    def invoke(self, ctx: click.Context) -> Any:
        """Run; errors are one line and a code."""
        try:
            return super().invoke(ctx)
        except CannotMeasureError as error:
            say(f"could not measure: {error}")
            ctx.exit(EXIT_CANNOT_MEASURE)
        except ArviewError as error:
            say(f"error: {error}")
            ctx.exit(EXIT_BAD_INPUT)
        except (click.ClickException, click.exceptions.Exit, click.Abort, BrokenPipeError, KeyboardInterrupt):
            raise
        except Exception as error:
            say_bug(error)
            ctx.exit(EXIT_BUG)


@main.command(
    cls=VerdictCommand,
    short_help="Photos and a video of one part: verdict, report, film.",
    epilog="""\b
Examples:
  arview inspect --part part.toml --photos photos/ -o out/
  arview inspect --part part.toml --photos photos/ --video walk.mp4 --serial PL-0417 -o out/
  arview inspect --part part.toml --video walk.mp4 -o out/
  arview inspect --part part.toml --photos photos/ -o out/ --store /data/plate.sqlite --station cell-3

\b
What `arview reconstruct`, `measure`, `report` and `annotate` do, in one go. OUT holds
  inspection.json              displacement, U and verdict of each component
  report.html, report.pdf      the report
  inspection_distances/        the cloud coloured by its distance to the CAD, pictures, histograms
  annotated.mp4, poses.jsonl   the video with ghost and measured errors, the pose of each frame
and the files of the stages. Each stage is known by the content of its inputs: what is finished is not done again, a
run that was interrupted goes on where it was, and a change repeats what depends on it. Results of other inputs are
removed before the work begins.

\b
Without --photos the sharp and well-spread frames of the video are measured. Millimetres come from the CAD, unless
--scale-file names boards, tags or bars in view (`arview reconstruct --help`). The camera of the video is that of the
photos where its picture has their shape; a phone films with another crop: give --video-camera then.

\b
Exit codes: 0 pass, 1 fail, 2 undecided, 3 could not measure, 64 bad input or usage, 70 a bug in arview, 130 interrupted
(finished stages are kept).
  0  every component passes, and nothing foreign is there
  1  a component fails or is missing
  2  none fails, but one is undecided or was not measured, or there is a foreign object (`measure` ends with 4 then)
  3  no component could be measured: photos that cannot be used, do not fit together, do not show the part, or
     contradict its CAD
 64  a file is missing or damaged, an option is wrong, the store or OUT cannot be written to
A film or PDF that cannot be made is a warning: the verdict stands without it.""",
)
@click.option("--part", "part_path", required=True, metavar="PART", help="Part file or CAD file.")
@click.option("--photos", metavar="PHOTOS", help="Folder or glob of photos; default: frames of the video.")
@click.option("--video", metavar="FILE", help="Video of the part, to be annotated.")
@click.option("-o", "--output", required=True, metavar="OUT", help="Folder for everything.")
@click.option("--serial", metavar="SERIAL", help="Of the specimen; default: that of the part file.")
@click.option("--store", metavar="FILE|URL", help="Also add the result to this store (`arview history`).")
@click.option("--station", metavar="NAME", help="Where it was measured; default: ARVIEW_STATION or this machine.")
@click.option("--camera", metavar="CAMERA", help="Calibrated camera file of the photos, or fov:DEG.")
@click.option("--video-camera", metavar="CAMERA", help="The same of the video, where it is another.")
@click.option("--scale-file", metavar="FILE", help="Boards, tags, scale bars and rig in view, TOML.")
@click.option("--tolerance", type=click.FloatRange(min=0, min_open=True), metavar="MM",
              help="Largest distance allowed, for components without one in the part file.")  # fmt: skip
@click.option("--guard", type=click.FloatRange(0, 3), default=1.0, show_default=True, metavar="G",
              help="Share of U kept from the tolerance; 0 is simple acceptance.")  # fmt: skip
@click.option("--max-frames", type=click.IntRange(min=3), default=60, show_default=True, metavar="N",
              help="Of a video without photos: frames to measure.")  # fmt: skip
@click.option("--no-pdf", is_flag=True, help="Report as HTML alone.")
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="The same seed, the same cloud.")
@click.option("--threads", type=click.IntRange(min=0), default=0, metavar="N", help="Default: all cores.")
@click.option("--device", default="auto", show_default=True, metavar="auto|cpu|cuda[:N]",
              help="Where dense matching runs.")  # fmt: skip
@click.option("--force", is_flag=True, help="Start over, though an earlier run left finished stages in OUT.")
@UNIT
def inspect(
    part_path: str,
    photos: str | None,
    video: str | None,
    output: str,
    serial: str | None,
    store: str | None,
    station: str | None,
    camera: str | None,
    video_camera: str | None,
    scale_file: str | None,
    tolerance: float | None,
    guard: float,
    max_frames: int,
    no_pdf: bool,
    seed: int,
    threads: int,
    device: str,
    force: bool,
    unit: str | None,
) -> None:
    """Inspect one part: reconstruct PHOTOS, measure, judge; write report, coloured cloud and annotated VIDEO."""
    from arview.workflow.job import InspectJob
    from arview.workflow.run import inspect_part

    job = InspectJob(
        part_path, photos, video, serial, camera, video_camera, scale_file, unit, tolerance, guard, max_frames, seed,
        threads, device, not no_pdf,
    )  # fmt: skip
    if store is not None:
        from arview.history import HistoryStore

        HistoryStore(store).close()  # a store that cannot be used is known of now, not in some minutes
    with line_bar(video is not None, photos is None, not no_pdf) as progress:
        outcome = inspect_part(job, output, progress, force)
    print_outcome(outcome)
    if store is not None:
        from arview.history import HistoryStore

        with HistoryStore(store) as opened:
            added = opened.add(outcome.folder / "inspection.json", station)
            state = "added as" if added.is_new else "is there already as"
            click.echo(f"history: {state} {added.id} in {opened.name}")
    click.echo(f"{outcome.inspection.part} {outcome.inspection.serial}".rstrip() + f": {word(outcome)}")
    code = EXIT_CODES[outcome.verdict.value]
    if code:
        click.get_current_context().exit(code)


def word(outcome: Outcome) -> str:
    """The verdict in capitals, and the counts."""
    return f"{outcome.verdict.value.replace('_', ' ').upper()}; {outcome.sentence}"


def print_outcome(outcome: Outcome) -> None:
    """What was measured, what each stage took and found, and the files; doubts go to stderr."""
    from arview.cli.measure import print_components

    for warning in outcome.warnings:
        say(f"warning: {warning}")
    print_components(outcome.inspection)
    for one in outcome.inspection.foreign_objects:
        click.echo(one.text)
    click.echo(f"\n{'stage':22}{'time':>8}  found")
    for stage in outcome.stages:
        time = f"{stage.seconds:.0f} s" if stage.state == "done" else stage.state
        click.echo(f"{stage.name:22}{time:>8}  {stage.note}".rstrip())
    total = sum(stage.seconds for stage in outcome.stages)
    click.echo(f"{'together':22}{f'{total:.0f} s':>8}  at most {outcome.peak_memory_mb / 1024:.1f} GB of memory\n")
    for path in outcome.files:
        click.echo(f"wrote {path}")


@contextmanager
def line_bar(has_film: bool, is_from_video: bool, has_pdf: bool) -> Iterator[Progress]:
    """One bar for all stages, with the time left; shown only on a terminal."""
    from tqdm import tqdm

    from arview.workflow.clock import Clock, Moment, clock_text

    with tqdm(total=100.0, disable=None, leave=False, bar_format="{desc} {percentage:3.0f} % |{bar}|") as bar:

        def show(moment: Moment) -> None:
            bar.set_description_str(f"{moment.step:18}{clock_text(moment):>18}", refresh=False)
            bar.update(100.0 * moment.share - bar.n)

        yield Clock(show, is_from_video, has_film, has_pdf).tell
