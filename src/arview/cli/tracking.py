"""The commands about finding and tracking a part: check, guideviews, annotate, evaluate."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import TYPE_CHECKING, cast

import click

from arview import __version__
from arview.cli.common import EXIT_INTERRUPTED, RENDERER, UNIT, main, output_path, progress_bar, say, write_bytes
from arview.errors import InputError, OutputError

if TYPE_CHECKING:
    from arview.annotation import AnnotateSummary
    from arview.camera import Camera
    from arview.geometry import Array
    from arview.tracking import SessionOptions
    from arview.video import FrameSource

MODALITIES = ("region", "edge", "feature")


def _parse_modalities(ctx: click.Context, parameter: click.Parameter, value: str) -> tuple[str, ...]:
    names = tuple(name.strip() for name in value.split(",") if name.strip())
    unknown = [name for name in names if name not in MODALITIES]
    if unknown or not names:
        raise click.BadParameter(f"{value!r}: expected some of {','.join(MODALITIES)}")
    return names


MODALITY = click.option(
    "--modalities",
    callback=_parse_modalities,
    default=",".join(MODALITIES),
    show_default=True,
    metavar="LIST",
    help="What the tracker measures with, separated by commas.",
)


# --- check ----------------------------------------------------------------------------------------------


class _CheckCommand(click.Command):
    """Its help ends with a complete part file."""

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the examples, then the part file."""
        from arview.cad import PART_FILE_EXAMPLE

        super().format_epilog(ctx, formatter)
        formatter.write("\n" + PART_FILE_EXAMPLE)


@main.command(
    cls=_CheckCommand,
    short_help="Print what is in a part, and what will be hard.",
    epilog="""\b
Examples:
  arview check part.toml
  arview check housing.stl --unit mm --camera fov:65

A part file is a TOML file like this one:""",
)
@click.argument("part")
@UNIT
@click.option("--camera", "camera_spec", metavar="CAMERA", help="Camera file or fov:DEG, for sizes in pixels.")
def check(part: str, unit: str | None, camera_spec: str | None) -> None:
    """Print what is in PART, and what will be hard about finding and tracking it.

    Symmetric or ambiguous shapes, components too small to be seen from the declared distance, thin or open
    geometry. Findings are not errors: the exit code is 0.
    """
    from arview.cad import check_part, load_part
    from arview.camera.read import load_camera
    from arview.guideviews.findings import uniqueness_findings

    loaded = load_part(part, unit)
    camera = None
    if camera_spec is not None:
        size = (1280, 720) if camera_spec.startswith("fov:") else (None, None)
        camera = load_camera(camera_spec, *size)
    findings = uniqueness_findings(loaded.model, loaded.effective_view_range)
    click.echo(check_part(loaded, camera).with_findings(findings).format())


# --- guideviews -----------------------------------------------------------------------------------------


@main.command(
    short_help="Render the guide views of a part into a file.",
    epilog="""\b
Examples:
  arview guideviews part.toml -o bracket.guideviews
  arview guideviews part.toml -o bracket.guideviews --preview sheet.png
  arview guideviews part.toml -o post.guideviews --component post_1""",
)
@click.argument("part")
@click.option("-o", "--output", required=True, metavar="SET", help="File to write.")
@click.option("--component", metavar="NAME", help="Views of this component alone.")
@click.option("--preview", metavar="PNG", help="Picture of a choice of the views, weak ones marked.")
@UNIT
@RENDERER
def guideviews(
    part: str, output: str, component: str | None, preview: str | None, unit: str | None, renderer: str
) -> None:
    """Render the guide views of PART over its declared range of viewpoints, and store them in a file.

    `annotate` makes (and keeps) guide views by itself; a file saves that step on another machine.
    """
    from arview.cad import load_part
    from arview.guideviews import GuideViewOptions, make_guide_views
    from arview.guideviews.findings import most_confusable
    from arview.guideviews.uniqueness import assess

    loaded = load_part(part, unit)
    path = output_path(output, [loaded.path, loaded.cad_path])
    preview_path = output_path(preview, [loaded.path, loaded.cad_path, path]) if preview else None
    if preview_path is not None and preview_path.suffix.lower() != ".png":
        raise OutputError(f"{preview}: the name of the preview must end in .png")
    model = loaded.model.only([component]) if component else loaded.model
    began = time.perf_counter()
    with progress_bar("guide views") as progress:
        views = make_guide_views(model, loaded.effective_view_range, GuideViewOptions(renderer=renderer), progress)
    views.save(path)
    seconds = time.perf_counter() - began
    size_mb = path.stat().st_size / 1e6
    click.echo(f"{path}: {len(views)} views of {model.name} in {seconds:.1f} s, {size_mb:.1f} MB")
    unique = assess(views)
    click.echo(f"{unique.reason} (score {unique.score:.2f})")
    alike = most_confusable(views, unique)
    if alike:
        click.echo(alike)
    if preview_path is not None:
        import cv2

        from arview.guideviews.sheet import contact_sheet

        _, png = cv2.imencode(".png", cv2.cvtColor(contact_sheet(model, views, unique=unique), cv2.COLOR_RGB2BGR))
        write_bytes(preview_path, png.tobytes())
        click.echo(f"wrote {preview_path}")


# --- annotate -------------------------------------------------------------------------------------------


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


@main.command(
    short_help="Track a part in a video and draw on it.",
    epilog="""\b
Examples:
  arview annotate clip.mp4 --part part.toml --camera camera.json --inspection inspection.json -o out.mp4
  arview annotate clip.mov --part housing.step --camera fov:65 --poses poses.jsonl
  arview annotate "shots/*.jpg" --part part.toml --camera exif --start 10 --end 200
  arview annotate rtsp://camera.local/1 --part part.toml --camera camera.json -o live.mp4
  arview annotate 0 --part part.toml --camera fov:65 --init guide:iso -o live.mp4
  arview annotate 0 --part part.toml --camera fov:65 --learned bracket.learned -o live.mp4

\b
Without --init the part is searched for. --init POSE.json, {"cam_from_model": 4x4}, begins near that pose.
--init guide:NAME draws the outline of a guide view over the video, and tracking begins when the part is
brought within about 15 degrees and 15 % of it. NAME is a view of the part file ([guides.NAME]), or one of
these as far as the declared range has them: front (camera at -Y), back (+Y), left (-X), right (+X),
top (+Z), bottom (-Z), iso (front, right and above), middle (of the range); or a direction like
az45_el30, with _d650 for the distance in mm and _r10 for the roll.

\b
While the part is tracked well, up to 48 small pictures of it from different sides are kept in memory; after
a loss it is looked for there first, in every frame. --learned FILE takes such pictures from an earlier run
(where the file exists) and writes all to it at the end, so that the part is found sooner in the next run under
the same light. They only say where to look: what is found must fit the CAD as always.

\b
CAMERA is a file (arview or BOP JSON, OpenCV YAML/XML, ROS camera_info, COLMAP cameras.txt), fov:DEG
(field of view along the longer side), exif, or profile:NAME (of `arview calibrate --profile`; profile alone
takes the one for what the source says of its camera). Each line of a poses file is a JSON object: index, time_s,
state, quality, cam_from_model (4x4 row-major, mm), covariance (6x6), ms, reason (why not tracked),
mismatches, unverified (components that have not been seen yet), alternatives (poses that fit as well).
Ctrl-C ends the run and finishes the files.""",
)
@click.argument("source")
@click.option("--part", "part_path", required=True, metavar="PART", help="Part file or CAD file.")
@click.option("--guideviews", "views_path", metavar="SET", help="Guide views; without it they are made and kept.")
@click.option("--camera", "camera_spec", metavar="CAMERA", help="See below; without it the camera is guessed.")
@click.option("--inspection", "inspection_path", metavar="FILE", help="inspection.json whose values are drawn.")
@click.option("-o", "--output", metavar="OUT.mp4", help="Annotated video.")
@click.option("--poses", "poses_path", metavar="OUT.jsonl", help="Pose of every frame.")
@click.option("--init", metavar="WHERE", help="Pose of the first frame, or guide:NAME to align with; see below.")
@click.option("--learned", "learned_path", metavar="FILE", help="Learned views: read if there, written at the end.")
@click.option("--start", callback=_parse_moment, metavar="S", help="First frame: number, or seconds like 2.5s.")
@click.option("--end", callback=_parse_moment, metavar="S", help="Where to stop: number, or seconds like 8s.")
@click.option("--stride", type=click.IntRange(min=1), default=1, help="Take every N-th frame.", metavar="N")
@click.option("--fps", type=float, default=30.0, show_default=True, help="Rate of a folder or glob of pictures.")
@click.option("--show-edges", type=click.Choice(["none", "visible", "all"]), default="visible", show_default=True)
@click.option("--no-ghost", is_flag=True, help="Leave out the translucent components.")
@click.option("--no-labels", is_flag=True, help="Leave out the labels.")
@click.option("--opacity", type=click.FloatRange(0.0, 1.0), help="Of the translucent components, 0 to 1.")
@MODALITY
@RENDERER
@UNIT
@click.pass_context
def annotate(
    ctx: click.Context,
    source: str,
    part_path: str,
    views_path: str | None,
    camera_spec: str | None,
    inspection_path: str | None,
    output: str | None,
    poses_path: str | None,
    init: str | None,
    learned_path: str | None,
    start: int | float | None,
    end: int | float | None,
    stride: int,
    fps: float,
    show_edges: str,
    no_ghost: bool,
    no_labels: bool,
    opacity: float | None,
    modalities: tuple[str, ...],
    renderer: str,
    unit: str | None,
) -> None:
    """Find and track the part in SOURCE, and write the annotated video and/or the poses.

    SOURCE is a video file, a picture, a folder or glob of pictures, a camera number or an RTSP/HTTP address.
    """
    from arview import annotation
    from arview.cad import load_part
    from arview.guideviews import GuideViewOptions, load_guide_views
    from arview.guideviews.cache import cached_guide_views
    from arview.inspection import load_inspection
    from arview.overlay import OverlayOptions, OverlayRenderer
    from arview.overlay.options import EdgeMode
    from arview.tracking import TrackingSession
    from arview.tracking.guide_pose import GUIDE_PREFIX, guide_pose
    from arview.video import VideoSink, open_source

    if output is None and poses_path is None:
        output = _default_output(source)
        say(f"no -o or --poses given: writing {output}")
    part = load_part(part_path, unit)
    guide_name = init.removeprefix(GUIDE_PREFIX) if init and init.startswith(GUIDE_PREFIX) else None
    init_path = init if guide_name is None else None
    first_pose = _load_pose(init_path) if init_path else None
    inspection = load_inspection(inspection_path, part.model) if inspection_path else None
    inputs = [source, part.path, part.cad_path, views_path, camera_spec, inspection_path, init_path]
    video_path = output_path(output, inputs) if output else None
    poses_file = output_path(poses_path, [*inputs, output]) if poses_path else None
    outputs = [output, poses_path]
    learned_file = output_path(learned_path, [*inputs, *outputs]) if learned_path else None
    first = start if isinstance(start, int) else None
    last = end if isinstance(end, int) else None
    with open_source(source, first, last, stride, fps) as frames:
        camera = _camera_for(frames, camera_spec, source)
        views = load_guide_views(Path(views_path), part.model) if views_path else None
        guide = None
        if guide_name is not None:
            guide = guide_pose(guide_name, part, views.view_range if views else part.effective_view_range, camera)
        if views is None:
            with progress_bar("guide views") as progress:
                views = cached_guide_views(
                    part.model, part.effective_view_range, GuideViewOptions(renderer=renderer), progress
                )
        session = TrackingSession(
            views,
            camera,
            part.model,
            _session_options(modalities),
            initial_cam_from_model=first_pose,
            guide_cam_from_model=guide,
        )
        if learned_file is not None and learned_file.exists():
            session.appearance_memory.load(learned_file)
        overlay = sink = None
        if video_path is not None:
            looks = OverlayOptions(
                show_ghost=not no_ghost,
                show_labels=not no_labels,
                show_edges=cast(EdgeMode, show_edges),
                opacity=OverlayOptions.opacity if opacity is None else opacity,
            )
            overlay = OverlayRenderer(part.model, camera, inspection, looks)
            sink = VideoSink(video_path, frames.width, frames.height, frames.fps, frames)
        with progress_bar("frames", frames.frame_count) as progress:
            summary = annotation.annotate(
                frames,
                session,
                overlay,
                sink,
                poses_file,
                lambda done, pose: progress(done, frames.frame_count or 0),
                start if isinstance(start, float) else None,
                end if isinstance(end, float) else None,
            )
    if sink is not None and sink.audio_note:
        say(f"warning: {sink.audio_note}")
    _print_annotated(summary, [path for path in (video_path, poses_file) if path is not None])
    if learned_file is not None:
        session.appearance_memory.save(learned_file)
        click.echo(f"wrote {learned_file}: {len(session.appearance_memory)} learned views")
    if summary.is_interrupted:
        say("interrupted")
        ctx.exit(EXIT_INTERRUPTED)


def _print_annotated(summary: AnnotateSummary, written: list[Path]) -> None:
    from arview.annotation import reasons_text

    if summary.ended_reason:
        say(f"warning: {summary.ended_reason}")
    if summary.frames == 0:
        click.echo("no frame was processed; nothing is written")
        return
    for path in written:
        click.echo(f"wrote {path}")
    states = ", ".join(f"{count} {state}" for state, count in sorted(summary.states.items()))
    skipped = f", {summary.skipped} broken frames skipped" if summary.skipped else ""
    tracking_ms = sorted(summary.ms)[len(summary.ms) // 2]
    click.echo(
        f"{summary.frames} frames in {summary.seconds:.1f} s ({summary.fps:.1f} fps end to end, tracking "
        f"{tracking_ms:.1f} ms a frame): {states}{skipped}"
    )
    for state, reasons in sorted(summary.reasons.items()):
        click.echo(f"{state} {sum(reasons.values())} frames: {reasons_text(reasons)}")
    if summary.never_seen:
        click.echo(f"not seen surely in any frame: {', '.join(summary.never_seen)}")


# --- evaluate -------------------------------------------------------------------------------------------


def _parse_evaluate_init(ctx: click.Context, parameter: click.Parameter, value: str) -> str:
    if value not in ("truth", "detect") and not value.startswith("guide:"):
        raise click.BadParameter(f"{value!r}: expected truth, detect or guide:NAME")
    return value


@main.command(
    short_help="Measure the tracker on BOP scenes.",
    epilog="""\b
Examples:
  arview evaluate bop/castle --init truth
  arview evaluate bop/castle/test/000001 --init detect --modalities region,edge --json castle.json
  arview evaluate lm/test/000001 --part duck.toml

Translation errors are those of the middle of the part's bounding box. Without a view range in a part file,
the range is what covers the scene's poses with a margin of 20 %.""",
)
@click.argument("scenes", nargs=-1, required=True, metavar="SCENE...")
@click.option("--init", callback=_parse_evaluate_init, default="truth", show_default=True,
              metavar="[truth|detect|guide:NAME]",
              help="Start from the first reference pose, find the part, or wait for it at a guide view.")  # fmt: skip
@click.option("--json", "json_path", metavar="OUT", help="Write the errors of every frame and the summary.")
@click.option("--per-frame", is_flag=True, help="Print a line for every frame.")
@click.option("--part", "part_path", metavar="PART", help="Part or CAD file; default: the dataset's model.")
@click.option("--reference", metavar="FILE", help="Poses for frames without truth; default: peer_visp.json.")
@click.option("--object", "object_id", type=int, metavar="ID", help="Which object of a scene with several.")
@MODALITY
@RENDERER
@UNIT
def evaluate(
    scenes: tuple[str, ...],
    init: str,
    json_path: str | None,
    per_frame: bool,
    part_path: str | None,
    reference: str | None,
    object_id: int | None,
    modalities: tuple[str, ...],
    renderer: str,
    unit: str | None,
) -> None:
    """Track the part through BOP scenes and print how far the poses are from the reference.

    SCENE is a scene folder (with scene_camera.json) or a dataset folder, whose test scenes are all taken.
    """
    from arview.cad import load_part
    from arview.evaluation import evaluate_scene, find_scenes, format_result, load_scene, scene_guide_views
    from arview.guideviews import GuideViewOptions

    folders = [folder for path in scenes for folder in find_scenes(path)]
    output = output_path(json_path, [part_path, reference]) if json_path else None
    part = load_part(part_path, unit) if part_path else None
    loaded = [load_scene(folder, part, reference, object_id) for folder in folders]
    results = []
    for scene in loaded:
        if reference is None and any(f.cam_from_model is not None and not f.is_truth for f in scene.frames):
            say(f"{scene.name}: frames without truth are compared with {scene.reference}")
        with progress_bar(f"{scene.name} guide views") as progress:
            views = scene_guide_views(scene, GuideViewOptions(renderer=renderer), progress)
        with progress_bar(scene.name) as progress:
            result = evaluate_scene(scene, init, _session_options(modalities), views, progress)
        click.echo(format_result(result, per_frame))
        results.append(result.to_dict())
    if output is not None:
        content = {"version": __version__, "modalities": list(modalities), "scenes": results}
        write_bytes(output, (json.dumps(content, indent=1) + "\n").encode())
        click.echo(f"wrote {output}")


# --- shared ---------------------------------------------------------------------------------------------


def _session_options(modalities: tuple[str, ...]) -> SessionOptions:
    from arview.tracking import SessionOptions

    return SessionOptions(
        use_region="region" in modalities,
        use_edge="edge" in modalities,
        use_texture="feature" in modalities,
        # It asks edges and colours.
        use_recheck={"region", "edge"} <= set(modalities),
    )


def _camera_for(frames: FrameSource, spec: str | None, source: str) -> Camera:
    """Camera of a source's frames; a guessed one is announced."""
    from arview.camera.read import guess_camera, load_camera

    if spec is not None:
        return load_camera(spec, frames.width, frames.height, source, frames.quarter_turns_clockwise)
    camera = guess_camera(frames.width, frames.height)
    say(
        f"WARNING: no --camera given: GUESSING a focal length of {camera.fx:.0f} px (1.2 × the longer side)"
        " and no distortion; distances will be wrong by as much. Give a camera file, fov:DEG or exif"
    )
    return camera


def _load_pose(path: str) -> Array:
    """``cam_from_model`` (4,4) of a POSE.json."""
    from arview.geometry import check_rigid

    try:
        content = json.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
    except ValueError as error:
        raise InputError(f"{path}: not valid JSON ({error})") from error
    if not isinstance(content, dict) or "cam_from_model" not in content:
        raise InputError(f'{path}: expected {{"cam_from_model": 4×4 row-major, mm}}')
    return check_rigid(content["cam_from_model"], f"{path}: cam_from_model")


def _default_output(source: str) -> str:
    """Name in the current folder for the annotated video of a source."""
    if source.isdecimal():
        return f"camera_{source}_annotated.mp4"
    stem = "".join(letter for letter in Path(source).stem if letter.isalnum() or letter in "-_. ")
    return f"{stem.strip(' .') or 'video'}_annotated.mp4"
