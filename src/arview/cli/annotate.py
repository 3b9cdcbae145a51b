"""The command annotate: a part is found and tracked in a video, and drawn on."""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, cast

import click

from arview import guideviews, tracking, workflow
from arview import overlay as overlays
from arview.camera import PHOTO_SUFFIXES
from arview.cli.common import (
    MODALITY,
    RENDERER,
    UNIT,
    camera_for,
    check_profile,
    inspection_file,
    likely_cause,
    load_pose,
    main,
    output_path,
    progress_bar,
    refuse_for_several,
    report_estimate,
    say,
    session_options,
    start_session,
)
from arview.cli.exit_codes import ExitCode, finding_exit_code, presence_exit_code
from arview.core.atomic import writing_process
from arview.errors import OutputError

if TYPE_CHECKING:
    from arview.annotation import AnnotateSummary
    from arview.cad import Part
    from arview.camera import Camera
    from arview.geometry import Array


NAMED_PART = f"{__name__}.named_part"
"""Key of frame and pixel of --serial-at in the context of the command."""


class _Outputs(NamedTuple):
    """Files that a run writes, where they were asked for."""

    video: Path | None
    poses: Path | None


def _parse_moment(ctx: click.Context, parameter: click.Parameter, value: str | None) -> int | float | None:
    """A frame number as int, ``2.5s`` as float seconds."""
    if value is None:
        return None
    try:
        moment: int | float = float(value[:-1]) if value.endswith("s") else int(value)
    except ValueError:
        moment = -1
    if not 0 <= moment < float("inf"):
        raise click.BadParameter(f"{value!r}: expected a frame number like 75, or seconds like 2.5s")
    return moment


def _keep_for_drawing(ctx: click.Context, parameter: click.Parameter, value: bool) -> None:
    """Keep a switch that only the options of the drawing need, see `_drawing_options`."""
    ctx.meta[f"{__name__}.{parameter.name}"] = value


def _keep_named_part(ctx: click.Context, parameter: click.Parameter, value: str | None) -> None:
    """Keep frame and pixel of ``120:640,400`` for the session, see `_session`."""
    if value is None:
        return
    match = re.fullmatch(r"(\d+):(\d+(?:\.\d+)?),(\d+(?:\.\d+)?)", value)
    if match is None:
        raise click.BadParameter(f"{value!r}: expected FRAME:X,Y like 120:640,400")
    ctx.meta[NAMED_PART] = int(match[1]), (float(match[2]), float(match[3]))


@main.command(
    short_help="Track a part in a video and draw on it.",
    exit_codes={
        ExitCode.DONE: "done; with --check-presence: all components are present",
        ExitCode.FAIL: "--check-presence: a component is missing or displaced",
        ExitCode.UNDECIDED: "--check-presence: not all components are known to be present",
        ExitCode.CANNOT_MEASURE: "a part was found in no frame",
    },
    epilog="""\b
Examples:
  arview annotate clip.mp4 --part part.toml --camera camera.json --inspection inspection.json -o out.mp4
  arview annotate clip.mov --part housing.step --camera fov:65 --poses poses.jsonl
  arview annotate 0 --part part.toml --camera fov:65 --init guide:iso -o live.mp4
  Notes: docs/reference/command-notes.md""",
)
@click.argument("source")
@click.option(
    "--part",
    "part_paths",
    required=True,
    multiple=True,
    metavar="PART",
    help="Part file or CAD file; again for further parts.",
)
@click.option("--instances", type=click.IntRange(1, 16), default=1, metavar="N", help="Specimens of each part in view.")
@click.option("--guideviews", "views_path", metavar="SET", help="Guide views; default: rendered and cached.")
@click.option("--camera", "camera_spec", metavar="CAMERA", help="Camera file, fov:DEG or exif; default: guessed.")
@click.option("--save-profile", "profile", metavar="NAME", help="Keep the estimated camera as a profile.")
@click.option(
    "--inspection",
    "inspection_paths",
    multiple=True,
    callback=inspection_file,
    metavar="JOB",
    help="Job folder or inspection.json; again for further specimens.",
)
@click.option("-o", "--output", metavar="OUT.mp4", help="Annotated video.")
@click.option("--poses", "poses_path", metavar="OUT.jsonl", help="Pose of every frame.")
@click.option("--init", metavar="WHERE", help="POSE.json, or guide:NAME to align with.")
@click.option(
    "--serial-at",
    expose_value=False,
    callback=_keep_named_part,
    metavar="FRAME:X,Y",
    help="The part that the inspection belongs to.",
)
@click.option("--start", callback=_parse_moment, metavar="S", help="First frame: number, or seconds like 2.5s.")
@click.option("--end", callback=_parse_moment, metavar="S", help="Frame to stop at: number, or seconds like 8s.")
@click.option("--stride", type=click.IntRange(min=1), default=1, help="Take every N-th frame.", metavar="N")
@click.option("--fps", type=float, default=30.0, show_default=True, help="Frame rate of a folder or glob of pictures.")
@click.option(
    "--show-edges",
    metavar="WHICH",
    type=click.Choice(["none", "visible", "all"]),
    default="visible",
    show_default=True,
    help="CAD edges to draw: none, visible or all.",
)
@click.option("--no-ghost", is_flag=True, help="Leave out the translucent components.")
@click.option("--no-labels", is_flag=True, help="Leave out the labels.")
@click.option(
    "--no-occlusion",
    is_flag=True,
    expose_value=False,
    callback=_keep_for_drawing,
    help="Draw over hands and tools before the part, too.",
)
@click.option(
    "--no-legend",
    is_flag=True,
    expose_value=False,
    callback=_keep_for_drawing,
    help="Leave out the legend of components that are not as measured.",
)
@click.option("--check-presence", is_flag=True, help="Exit by whether all components were seen in place.")
@click.option("--opacity", type=click.FloatRange(0.0, 1.0), help="Opacity of the translucent components, 0 to 1.")
@MODALITY
@RENDERER
@UNIT
@click.pass_context
def annotate(
    ctx: click.Context,
    source: str,
    part_paths: tuple[str, ...],
    instances: int,
    views_path: str | None,
    camera_spec: str | None,
    profile: str | None,
    inspection_paths: tuple[str, ...],
    output: str | None,
    poses_path: str | None,
    init: str | None,
    start: int | float | None,
    end: int | float | None,
    stride: int,
    fps: float,
    show_edges: str,
    no_ghost: bool,
    no_labels: bool,
    check_presence: bool,
    opacity: float | None,
    modalities: tuple[str, ...],
    renderer: str,
    unit: str | None,
) -> None:
    """Track the part in SOURCE (video, pictures, camera number, RTSP/HTTP address); write video and poses."""
    from arview.annotation import FollowingOverlay
    from arview.annotation import annotate as annotate_frames
    from arview.video import open_sink, open_source

    check_profile(profile, camera_spec)
    if output is None and poses_path is None:
        output = _default_output(source)
        say(f"no -o or --poses given: writing {output}")
    specimens = workflow.load_specimens(part_paths, instances, inspection_paths, unit)
    if poses_path is None and output is not None and any(one.part.model.steps for one in specimens):
        poses_path = str(Path(output).with_suffix(".jsonl"))
    if len(specimens) > 1:
        refuse_for_several({"--init": init, "--guideviews": views_path})
    guide_name = init.removeprefix(tracking.GUIDE_PREFIX) if init and init.startswith(tracking.GUIDE_PREFIX) else None
    init_path = init if guide_name is None else None
    first_pose = load_pose(init_path) if init_path else None
    files = [path for one in specimens for path in (one.part.path, one.part.cad_path)]
    inputs = source, *files, views_path, camera_spec, *inspection_paths, init_path
    outputs = _check_outputs(output, poses_path, inputs)
    drawing = _drawing_options(show_edges, no_ghost, no_labels, opacity)
    wanted = [moment if isinstance(moment, int) else None for moment in (start, end)]
    is_guessed = camera_spec is None
    with open_source(source, start=wanted[0], end=wanted[1], stride=stride, fps=fps) as frames:
        camera = camera_for(frames, camera_spec, source)
        tracked = _tracked_parts(specimens, camera, views_path, renderer, guide_name, first_pose)
        keep = partial(report_estimate, profile=profile, source=source, turns=frames.quarter_turns_clockwise)
        session = start_session(tracked, frames, camera, session_options(modalities), keep if is_guessed else None)
        sink, overlay = None, None
        if outputs.video is not None:
            sink = open_sink(outputs.video, frames)
            overlay = FollowingOverlay(partial(workflow.make_overlay, specimens, drawing), session.camera_of)
        with progress_bar("frames") as progress:
            summary = annotate_frames(
                frames,
                session,
                overlay,
                sink,
                outputs.poses,
                progress=lambda done, pose: progress(done, frames.frame_count or 0),
                start_s=start if isinstance(start, float) else None,
                end_s=end if isinstance(end, float) else None,
                camera_of=session.camera_of if is_guessed else None,
            )
        if (estimate := session.finish()) is not None:
            keep(estimate)
    notes = [
        *([f"warning: {sink.audio_note}"] if sink and sink.audio_note else []),
        *map("note: {}".format, frames.notes),
    ]
    _print_summary(summary, outputs, notes, session.camera_of(0) if is_guessed else None)
    _exit_if_interrupted(ctx, summary)
    ctx.exit(presence_exit_code(summary) if check_presence else finding_exit_code(summary))


def _exit_if_interrupted(ctx: click.Context, summary: AnnotateSummary) -> None:
    if summary.is_interrupted:
        say("interrupted")
        ctx.exit(ExitCode.INTERRUPTED)


def _drawing_options(
    show_edges: str, no_ghost: bool, no_labels: bool, opacity: float | None
) -> overlays.OverlayOptions:

    switches = click.get_current_context().meta
    return overlays.OverlayOptions(
        show_ghost=not no_ghost,
        show_labels=not no_labels,
        show_legend=not switches[f"{__name__}.no_legend"],
        show_occlusion=not switches[f"{__name__}.no_occlusion"],
        show_edges=cast("overlays.EdgeMode", show_edges),
        opacity=overlays.OverlayOptions.opacity if opacity is None else opacity,
    )


def _check_outputs(video: str | None, poses: str | None, inputs: Sequence[str | Path | None]) -> _Outputs:
    """The paths of the outputs, none of which overwrites an input or another output, or is being written."""
    for path in (video, poses):
        if path and (writer := writing_process(Path(path))) is not None:
            raise OutputError(
                f"{path}: process {writer} is writing it; wait until it ends or choose another name "
                f"(if it is no arview, delete {Path(path).with_name(f'.{Path(path).name}.{writer}.part')})"
            )
    return _Outputs(
        output_path(video, [*inputs]) if video else None,
        output_path(poses, [*inputs, video]) if poses else None,
    )


def _views_and_guide(
    part: Part, camera: Camera, views_path: str | None, renderer: str, guide_name: str | None
) -> tuple[guideviews.GuideViewSet, Array | None]:
    """Guide views from a file, or cached ones, and the guide pose (4,4) where one was asked for."""
    from arview.tracking.guide_pose import guide_pose

    views = guideviews.load_guide_views(Path(views_path), part.model) if views_path else None
    guide = None
    if guide_name is not None:
        guide = guide_pose(guide_name, part, views.view_range if views else part.effective_view_range, camera)
    if views is None:
        with progress_bar("guide views") as progress:
            views = guideviews.cached_guide_views(
                part.model, part.effective_view_range, guideviews.GuideViewOptions(renderer=renderer), progress=progress
            )
    return views, guide


def _tracked_parts(
    specimens: Sequence[workflow.Specimen],
    camera: Camera,
    views_path: str | None,
    renderer: str,
    guide_name: str | None,
    first_pose: Array | None,
) -> list[tracking.TrackedPart]:
    """The specimens for the session; guide views, guide view and first pose (4,4) are given for a single one only."""
    named = click.get_current_context().meta.get(NAMED_PART)
    is_single = len(specimens) == 1
    views = {}
    tracked = []
    for specimen in specimens:
        part = specimen.part
        model = part.model.source_hash
        if model not in views:
            views[model] = _views_and_guide(part, camera, views_path, renderer, guide_name)
        tracked.append(
            tracking.TrackedPart(
                views[model][0],
                part.model,
                "" if is_single else specimen.name,
                specimen.serials,
                initial_cam_from_model=first_pose,
                guide_cam_from_model=views[model][1],
                labels_at=named if is_single else None,
            )
        )
    return tracked


def _print_summary(summary: AnnotateSummary, outputs: _Outputs, notes: Sequence[str], guessed: Camera | None) -> None:
    """Say what was done: notes, files, counts, and what a guessed camera may have to do with them."""
    from arview.annotation import summary_lines

    for note in notes:
        say(note)
    if summary.ended_reason:
        say(f"warning: {summary.ended_reason}")
    if summary.frames == 0:
        click.echo("no frame was processed; nothing is written")
        return
    written = [f"wrote {path}" for path in (outputs.video, outputs.poses) if path is not None]
    for line in [*written, *summary_lines(summary)]:
        click.echo(line)
    if guessed is not None and finding_exit_code(summary) is not ExitCode.DONE:
        click.echo(likely_cause(guessed))


def _default_output(source: str) -> str:
    """Name in the current folder for the annotated video of a source, or for the picture of one picture."""
    if source.isdecimal():
        return f"camera_{source}_annotated.mp4"
    name = Path(source if "://" not in source else source.split("://", 1)[1].rsplit("@", 1)[-1].split("?")[0])
    stem = "".join(letter for letter in name.stem if letter.isalnum() or letter in "-_. ")
    is_picture = name.suffix.lower() in PHOTO_SUFFIXES and not set("*?[%") & set(source)
    return f"{stem.strip(' .') or 'video'}_annotated.{'jpg' if is_picture else 'mp4'}"
