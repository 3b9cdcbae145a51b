"""The command evaluate: errors of the tracker on recorded scenes with reference poses."""

from __future__ import annotations

import json

import click

from arview.cli.common import (
    MODALITY,
    RENDERER,
    UNIT,
    Command,
    output_path,
    progress_bar,
    say,
    session_options,
)
from arview.core.atomic import write_file
from arview.version import __version__


def _parse_init(ctx: click.Context, parameter: click.Parameter, value: str) -> str:
    if value not in ("truth", "detect") and not value.startswith("guide:"):
        raise click.BadParameter(f"{value!r}: expected truth, detect or guide:NAME")
    return value


@click.command(
    cls=Command,
    short_help="Measure the tracker on BOP scenes.",
    epilog="""\b
Examples:
  arview evaluate bop/castle --init truth
  arview evaluate bop/castle/test/000001 --init detect --modalities region,edge --json castle.json
  arview evaluate lm/test/000001 --part duck.toml

\b
Translation errors are those of the centre of the part's bounding box. Without a view range in a
part file, the range covers the scene's poses with a margin of 20 %.""",
)
@click.argument("scenes", nargs=-1, required=True, metavar="SCENE...")
@click.option("--init", callback=_parse_init, default="truth", show_default=True, metavar="[truth|detect|guide:NAME]",
              help="Start from the first reference pose, detect the part, or wait for it at a guide view.")  # fmt: skip
@click.option("--json", "json_path", metavar="OUT", help="Write the errors of every frame and the summary.")
@click.option("--per-frame", is_flag=True, help="Print a line for every frame.")
@click.option("--part", "part_path", metavar="PART", help="Part or CAD file; default: the dataset's model.")
@click.option("--reference", metavar="FILE", help="Poses for frames without truth; default: peer_visp.json.")
@click.option("--object", "object_id", type=int, metavar="ID", help="Object to track, of a scene with several.")
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

    SCENE is a scene folder (with scene_camera.json) or a dataset folder, of which all test scenes are taken.
    """
    from arview.cad import load_part
    from arview.guideviews import GuideViewOptions
    from arview_lab.evaluation import evaluate_scene, find_scenes, format_result, load_scene, scene_guide_views

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
            result = evaluate_scene(scene, init, session_options(modalities), views, progress)
        click.echo(format_result(result, per_frame))
        results.append(result.to_dict())
    if output is not None:
        content = {"version": __version__, "modalities": list(modalities), "scenes": results}
        write_file(output, (json.dumps(content, indent=1) + "\n").encode())
        click.echo(f"wrote {output}")
