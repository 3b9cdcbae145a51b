"""The command inspect: photos and a video of one part → verdict, report, coloured cloud, annotated video."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import click

from arview import workflow
from arview.cli.common import UNIT, main, say
from arview.cli.exit_codes import ExitCode, exit_code_of
from arview.core.progress import Progress, check_stop
from arview.quality import history

if TYPE_CHECKING:
    from arview.inspection import Inspection


@main.command(
    short_help="Photos and a video of one part: verdict, report.",
    epilog="""\b
Examples:
  arview inspect --part part.toml --photos photos/ -o out/
  arview inspect --part part.toml --photos photos/ --video walk.mp4 --serial PL-0417 -o out/
  arview inspect --part part.toml --video walk.mp4 -o out/
  arview inspect --part part.toml --photos photos/ -o out/ --store /data/plate.sqlite --station cell-3
  Notes: docs/reference/command-notes.md""",
    exit_codes={
        ExitCode.DONE: "pass: every component passes or has no tolerance, and there is no foreign object",
        ExitCode.FAIL: "fail: a component fails or is missing",
        ExitCode.UNDECIDED: "undecided: none fails; one is undecided, not measured, or there is a foreign object",
        ExitCode.CANNOT_MEASURE: "no component could be measured: unusable photos, or they contradict the CAD",
        ExitCode.INTERRUPTED: "interrupted; finished stages are kept",
    },
)
@click.option("--part", "part_path", required=True, metavar="PART", help="Part file or CAD file.")
@click.option("--photos", metavar="PHOTOS", help="Folder or glob of photos; default: frames of the video.")
@click.option("--video", metavar="FILE", help="Video of the part, to be annotated.")
@click.option("-o", "--output", required=True, metavar="OUT", help="Folder for all results.")
@click.option("--serial", metavar="SERIAL", help="Serial number of the specimen; default: that of the part file.")
@click.option("--store", metavar="FILE|URL", help="Also add the result to this store (`arview history`).")
@click.option("--station", metavar="NAME", help="Name of the measuring station; default: this machine.")
@click.option("--camera", metavar="CAMERA", help="Calibrated camera file of the photos, or fov:DEG.")
@click.option("--video-camera", metavar="CAMERA", help="The same for the video, if it was taken with another camera.")
@click.option(
    "--scale-file",
    metavar="FILE",
    help="File of the boards, tags, tag layouts, scale bars and rig in view.",
)
@click.option(
    "--masks",
    metavar="FOLDER|auto",
    help="Masks IMAGE.png, black: not used; auto: from the CAD.",
)
@click.option(
    "--sparse",
    metavar="FOLDER|FILE",
    help="Camera poses by COLMAP, Metashape or nerfstudio.",
)
@click.option("--pairs", metavar="FILE", help="Match only the pairs of sparse/pairs.json of a run.")
@click.option(
    "--tolerance",
    type=click.FloatRange(min=0, min_open=True),
    metavar="MM",
    help="Tolerance of components that have none in the part file.",
)
@click.option(
    "--guard",
    type=click.FloatRange(0, 3),
    default=1.0,
    show_default=True,
    metavar="G",
    help="Guard band as a multiple of U.",
)
@click.option(
    "--max-frames",
    type=click.IntRange(min=3),
    default=60,
    show_default=True,
    metavar="N",
    help="Frames to measure of a video without photos.",
)
@click.option("--no-repeatability", is_flag=True, help="Do not measure two halves of the photos apart to compare them.")
@click.option("--no-cloud", is_flag=True, help="Measure in photos only: no cloud; foreign objects are not looked for.")
@click.option("--no-pdf", is_flag=True, help="Write the report as HTML only.")
@click.option(
    "--seed", type=click.IntRange(min=0), default=0, show_default=True, help="The same seed gives the same cloud."
)
@click.option("--threads", type=click.IntRange(min=0), default=0, metavar="N", help="Threads; default: all cores.")
@click.option(
    "--device",
    default="auto",
    show_default=True,
    metavar="auto|cpu|cuda[:N]",
    help="Device for features, matching, cloud.",
)
@click.option("--force", is_flag=True, help="Repeat all stages, even those already finished in OUT.")
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
    masks: str | None,
    sparse: str | None,
    pairs: str | None,
    tolerance: float | None,
    guard: float,
    max_frames: int,
    no_repeatability: bool,
    no_cloud: bool,
    no_pdf: bool,
    seed: int,
    threads: int,
    device: str,
    force: bool,
    unit: str | None,
) -> None:
    """Inspect one part: reconstruct PHOTOS, measure and decide; write report and VIDEO."""
    job = workflow.InspectJob(
        part_path,
        photos,
        video,
        serial=serial,
        camera=camera,
        video_camera=video_camera,
        scale_file=scale_file,
        unit=unit,
        masks=masks,
        sparse=sparse,
        tolerance_mm=tolerance,
        guard=guard,
        max_frames=max_frames,
        seed=seed,
        threads=threads,
        device=device,
        makes_pdf=not no_pdf,
        makes_cloud=not no_cloud,
        compares_halves=not no_repeatability,
        pairs=pairs,
    )
    if store is not None:
        history.HistoryStore(
            store, tell=say
        ).close()  # a store that cannot be used is reported now, not after the measurement
    with line_bar(job) as progress:
        outcome = workflow.inspect_part(job, output, progress=progress, starts_over=force, on_verdict=say_verdict)
    print_outcome(outcome)
    if store is not None:
        with history.HistoryStore(store, tell=say) as opened:
            added = opened.add(outcome.folder / "inspection.json", station)
            state = "added as" if added.is_new else "already there as"
            click.echo(f"history: {state} {added.id} in {opened.name}")
    click.echo(f"{outcome.inspection.part} {outcome.inspection.serial}".rstrip() + f": {word(outcome)}")
    click.get_current_context().exit(exit_code_of(outcome.verdict.value))


def say_verdict(inspection: Inspection) -> None:
    """Say the verdict by the photos, while cloud, report and film are still made."""
    from arview.inspection import overall_verdict, verdict_sentence

    verdict = overall_verdict(inspection).value.replace("_", " ").upper()
    say(f"by the photos: {verdict}; {verdict_sentence(inspection)}")


def word(outcome: workflow.Outcome) -> str:
    """The verdict in capitals, followed by the counts."""
    return f"{outcome.verdict.value.replace('_', ' ').upper()}; {outcome.sentence}"


def print_outcome(outcome: workflow.Outcome) -> None:
    """Print what was measured, the time and result of each stage, and the files; warnings go to stderr."""
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
    click.echo(f"{'total':22}{f'{total:.0f} s':>8}  at most {outcome.peak_memory_mb / 1024:.1f} GB of memory\n")
    for path in outcome.files:
        click.echo(f"wrote {path}")


@contextmanager
def line_bar(job: workflow.InspectJob) -> Iterator[Progress]:
    """Show one bar for all stages, with the time left, if stderr is a terminal."""
    from tqdm import tqdm

    with tqdm(total=100.0, disable=None, leave=False, bar_format="{desc} {percentage:3.0f} % |{bar}|") as bar:

        def show(moment: workflow.ProgressEstimate) -> None:
            check_stop()
            bar.set_description_str(f"{moment.step:18}{workflow.time_text(moment):>18}", refresh=False)
            bar.update(100.0 * moment.share - bar.n)

        has_film = job.video is not None
        yield workflow.ProgressEstimator(show, job.is_from_video, has_film, job.makes_pdf, job.makes_cloud).update
