"""The command capture: a film or a station camera → the photos of a part that are worth measuring."""

from __future__ import annotations

import shutil
import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import click

from arview import guideviews, tracking
from arview.cli.common import (
    RENDERER,
    UNIT,
    camera_for,
    likely_cause,
    load_pose,
    main,
    progress_bar,
    report_estimate,
    say,
    start_session,
)
from arview.cli.exit_codes import ExitCode
from arview.station import capture as station
from arview.station import walk

if TYPE_CHECKING:
    from arview.core.progress import StepProgress

SAID_EVERY_S = 3.0
"""Time between two lines that say where to go, with a camera."""


@main.command(
    short_help="Choose the photos to measure from a film or camera.",
    exit_codes={
        ExitCode.DONE: "done; every component was seen well from enough directions",
        ExitCode.UNDECIDED: "photos were taken, but more are wanted; what is lacking is printed",
        ExitCode.CANNOT_MEASURE: "no photo was taken: the part was not tracked, or never from a good place",
        ExitCode.INTERRUPTED: "interrupted; the photos taken so far are kept and can be used",
    },
    epilog="""\b
Examples:
  arview capture walk.mp4 --part part.toml --camera phone.json -o photos/
  arview inspect --part part.toml --photos photos/ --camera photos/camera.json -o out/
  arview capture 0 --part part.toml --camera station.json -o photos/ --serial PL-0417
  arview capture rtsp://camera.local/1 --part part.toml --camera station.json -o photos/ --count 12
  arview capture "frames/*.png" --fps 24 --part part.toml --camera phone.json -o photos/
  Notes: docs/reference/command-notes.md""",
)
@click.argument("source")
@click.option("--part", "part_path", required=True, metavar="PART", help="Part file or CAD file.")
@click.option("-o", "--output", required=True, metavar="FOLDER", help="New folder for the photos.")
@click.option("--camera", "camera_spec", metavar="CAMERA", help="Camera of the frames; without it, it is guessed.")
@click.option("--serial", metavar="SERIAL", help="Serial number of the specimen: makes FOLDER a job.")
@click.option("--count", type=click.IntRange(3, 200), metavar="N", help="Photos wanted; default: 20.")
@click.option("--init", metavar="POSE.json", help="Rough pose of the part in the first frame.")
@click.option("--stride", type=click.IntRange(min=1), default=1, help="Take every N-th frame.", metavar="N")
@click.option("--fps", type=float, default=30.0, show_default=True, help="Frame rate of a folder or glob of pictures.")
@RENDERER
@UNIT
@click.pass_context
def capture(
    ctx: click.Context,
    source: str,
    part_path: str,
    output: str,
    camera_spec: str | None,
    serial: str | None,
    count: int | None,
    init: str | None,
    stride: int,
    fps: float,
    renderer: str,
    unit: str | None,
) -> None:
    """Take the photos of a part that are worth measuring out of SOURCE: a film, pictures, a camera or an address."""
    from arview.cad import load_part
    from arview.camera import write_camera
    from arview.video import open_source

    part = load_part(part_path, unit)
    first_pose = load_pose(init) if init else None
    with open_source(source, stride=stride, fps=fps) as frames:
        camera = camera_for(frames, camera_spec, source)
        folder = Path(output)
        was_there = folder.exists()
        job = walk.open_folder(folder, part, serial, camera_spec)
        try:
            with progress_bar("guide views") as progress:
                views = guideviews.cached_guide_views(
                    part.model,
                    part.effective_view_range,
                    guideviews.GuideViewOptions(renderer=renderer),
                    progress=progress,
                )
            keep = partial(report_estimate, profile=None, source=source, turns=frames.quarter_turns_clockwise)
            tracked = tracking.TrackedPart(views, part.model, initial_cam_from_model=first_pose)
            session = start_session([tracked], frames, camera, None, keep if camera_spec is None else None)
            with progress_bar("frames") as progress:
                show = _Teller(frames.is_live, frames.frame_count or 0, progress)
                summary = walk.capture_photos(
                    frames, session, part, session.camera_of, job, walk.capture_options(count), show
                )
            if summary.photos and camera_spec is not None:
                write_camera(camera, folder / "camera.json")
        finally:
            if not job.photos():
                _remove(job, was_there)
        for note in frames.notes:
            say(f"note: {note}")
    if summary.ended_reason:
        say(f"warning: {summary.ended_reason}")
    for line in walk.summary_lines(summary, part):
        click.echo(line)
    if summary.photos:
        click.echo(f"\nwrote {folder}: use it with arview inspect --photos {folder}")
    elif camera_spec is None:
        click.echo(likely_cause(camera))
    if summary.is_interrupted:
        say("interrupted")
        ctx.exit(ExitCode.INTERRUPTED)
    if not summary.photos:
        ctx.exit(ExitCode.CANNOT_MEASURE)
    is_enough = summary.advice is not None and summary.advice.is_enough
    ctx.exit(ExitCode.DONE if is_enough else ExitCode.UNDECIDED)


def _remove(job: walk.JobFolder, was_there: bool) -> None:
    """Remove the folder of a capture without photos, or what was put into it."""
    if not was_there:
        shutil.rmtree(job.path, ignore_errors=True)
        return
    for path in [*(job.path / "photos").glob("*"), job.path / "job.json", job.path / ".photos.lock"]:
        path.unlink(missing_ok=True)
    (job.path / "photos").rmdir()


class _Teller:
    """Moves the bar, and says where to go next on stderr, for a camera; a film cannot be told."""

    def __init__(self, is_live: bool, frames: int, progress: StepProgress) -> None:
        self._is_live, self._frames, self._progress = is_live, frames, progress
        self._said = ""
        self._said_s = -SAID_EVERY_S

    def __call__(self, done: int, advice: station.CaptureAdvice) -> None:
        self._progress(done, self._frames)
        text = "; ".join(one for one in (f"{advice.photos} taken", advice.text, advice.reason) if one)
        now_s = time.monotonic()
        if self._is_live and text != self._said and now_s - self._said_s >= SAID_EVERY_S:
            self._said, self._said_s = text, now_s
            say(text)
