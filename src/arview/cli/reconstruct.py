"""The command reconstruct: photos → camera poses, scale, dense cloud."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, get_args

import click

from arview import reconstruction, workflow
from arview.cli.common import UNIT, main, say, stage_bar
from arview.cli.exit_codes import ExitCode
from arview.core.atomic import write_file
from arview.errors import InputError

if TYPE_CHECKING:
    pass

STAGES = ("photos", "sparse", "scale", "dense")


@main.command(
    short_help="Make camera poses and a metric cloud from photos.",
    epilog="""\b
Examples:
  arview reconstruct photos/ --part part.toml -o out/
  arview reconstruct walk.mp4 --part part.toml --camera phone.json -o out/
  arview reconstruct photos/ --part part.toml --board charuco:8x6:30:22:DICT_5X5_100 -o out/
  arview reconstruct photos/ --scale-bar 3:7:412.55 -o out/
  arview reconstruct photos/ --part part.toml --until sparse -o out/
  Notes: docs/reference/command-notes.md""",
    exit_codes={ExitCode.CANNOT_MEASURE: "the photos can be read but not reconstructed"},
)
@click.argument("source", metavar="PHOTOS|VIDEO")
@click.option("--part", "part_path", metavar="PART", help="Part file or CAD file.")
@click.option("-o", "--output", required=True, metavar="OUT", help="Folder for the files of all stages.")
@click.option("--camera", metavar="CAMERA", help="Camera file, profile[:NAME] or fov:DEG.")
@click.option("--board", "boards", multiple=True, metavar="SPEC", help="Board of known size in view.")
@click.option("--tag", "tags", multiple=True, metavar="SPEC", help="Tags of known size in view.")
@click.option("--scale-bar", "bars", multiple=True, metavar="SPEC", help="Known distance of two tags.")
@click.option(
    "--scale-file", metavar="FILE", help="Boards, tags, tag layouts, scale bars and rig in a TOML or JSON file."
)
@click.option("--rig", metavar="FILE", help="Known camera poses in mm.")
@click.option(
    "--sparse",
    "poses",
    metavar="FOLDER|FILE",
    help="Camera poses by COLMAP, Metashape or nerfstudio.",
)
@click.option(
    "--masks",
    metavar="FOLDER|auto",
    help="Masks IMAGE.png, black: not used; auto: from the CAD.",
)
@click.option("--points", metavar="FILE.csv", help="Also write the points with their standard uncertainty.")
@click.option("--until", type=click.Choice(STAGES), default="dense", show_default=True, help="Last stage to do.")
@click.option(
    "--band",
    type=click.FloatRange(min=0.1),
    default=5.0,
    show_default=True,
    metavar="MM",
    help="Displacements that the dense stage covers.",
)
@click.option(
    "--max-frames",
    type=click.IntRange(min=3),
    default=60,
    show_default=True,
    metavar="N",
    help="Frames to take from a video.",
)
@click.option("--seed", type=int, default=0, show_default=True, help="The same seed gives the same cloud.")
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
def reconstruct(
    source: str,
    part_path: str | None,
    output: str,
    camera: str | None,
    boards: tuple[str, ...],
    tags: tuple[str, ...],
    bars: tuple[str, ...],
    scale_file: str | None,
    rig: str | None,
    poses: str | None,
    masks: str | None,
    points: str | None,
    until: str,
    band: float,
    max_frames: int,
    seed: int,
    threads: int,
    device: str,
    force: bool,
    unit: str | None,
) -> None:
    """Reconstruct PHOTOS (a folder or glob) or VIDEO: camera poses, scale in mm, dense cloud.

    With --part the result is roughly in the frame of the CAD; `arview measure` refines it on the datums.
    """
    from arview.cad import load_part
    from arview.reconstruction import run

    folder = Path(output)
    if points is not None and until == "photos":
        raise InputError("--points needs camera poses; give --until sparse or later")
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{output}: is a file; give a folder for the results")
    if Path(source).is_dir() and folder.resolve() == Path(source).resolve():
        raise InputError(f"{output}: is the folder of the photos; give another one for the results")
    if masks == reconstruction.AUTO and part_path is None:
        raise InputError("--masks auto masks by the CAD's silhouette; give the CAD with --part, or a folder of masks")
    part = load_part(part_path, unit) if part_path else None
    options = run.ReconstructOptions(
        video=reconstruction.VideoIntakeOptions(max_frames=max_frames),
        sparse=reconstruction.SparseOptions(seed=seed, threads=threads, device=device),
        sources=_sources(boards, tags, bars, scale_file, rig),
        dense=reconstruction.DenseOptions(seed=seed, band_mm=band, threads=threads, device=device),
        poses=Path(poses) if poses else None,
        masks=Path(masks) if masks and masks != reconstruction.AUTO else None,
        silhouettes=workflow.CadSilhouettes(part) if masks == reconstruction.AUTO and part is not None else None,
        last_stage=get_args(run.StageName)[STAGES.index(until)],
        starts_over=force,
    )
    with stage_bar() as progress:
        result = run.reconstruct(source, folder, part, camera, options, progress=progress)
    _print(result, part is not None)
    if points is not None and result.sparse is not None:
        table = reconstruction.points_table(result.sparse, "mm" if result.is_metric else "unit")
        write_file(Path(points), table.encode())
        click.echo(f"wrote {points}: {len(result.sparse.points_in_scan)} points, standard uncertainty (k = 1)")


def _sources(
    boards: tuple[str, ...], tags: tuple[str, ...], bars: tuple[str, ...], scale_file: str | None, rig: str | None
) -> reconstruction.ScaleSources:
    """The known lengths in the scene, from the options and the file together."""
    from dataclasses import replace

    from arview.fiducials import parse_board, parse_tags

    known = reconstruction.load_scale_file(scale_file) if scale_file else reconstruction.ScaleSources()
    return replace(
        known,
        boards=(*known.boards, *(parse_board(text) for text in boards)),
        tags=(*known.tags, *(parse_tags(text) for text in tags)),
        bars=(*known.bars, *(reconstruction.parse_scale_bar(text) for text in bars)),
        rig=reconstruction.load_rig(rig) if rig else known.rig,
    )


def _print(result: reconstruction.Reconstruction, has_part: bool) -> None:
    """Print what was found, in a few lines; warnings go to stderr."""
    for name, reason in result.intake.rejected:
        say(f"left out {name}: {reason}")
    for warning in result.intake.warnings:
        say(f"warning: {warning}")
    for lens in result.intake.lenses:
        click.echo(f"lens {lens.key}: {lens.focal_from}")
    sparse, scale, quality = result.sparse, result.scale, result.quality
    if sparse is not None and quality is not None:
        for name, reason in sparse.unplaced:
            say(f"not placed {name}: {reason}")
        camera = sparse.photos[0].camera
        click.echo(
            f"{quality.photos} of {quality.photos + len(sparse.unplaced)} photos placed, {quality.points} points, "
            f"{quality.reprojection_rms_px:.2f} px rms, {quality.track_length:.1f} photos per point; focal length "
            f"{camera.fx:.1f} px"
        )
    if scale is not None:
        for warning in scale.warnings:
            say(f"warning: {warning}")
        for evidence in scale.evidence:
            used = "" if evidence.is_used else " (not used)"
            click.echo(f"scale from {evidence.detail}: ± {200 * evidence.std:.3f} % (k = 2){used}")
        if scale.scale is None:
            say("warning: NO SCALE: lengths are in an arbitrary unit; give --part, --board, --tag or --scale-bar")
        elif scale.model_from_scan is None and has_part:
            say(f"warning: the part was not found, so there is no CAD frame: {scale.why_no_frame}")
        elif scale.model_from_scan is not None:
            click.echo(f"CAD frame: {scale.consistency.reason}")
    if result.coverage is not None:
        for advice in result.coverage.advice:
            say(f"advice: {advice}")
    if result.cloud is not None and quality is not None:
        unit = "mm" if result.is_metric else "units"
        noise = f", noise {quality.cloud_sigma:.3f} {unit}" if quality.cloud_sigma is not None else ""
        click.echo(f"cloud of {quality.cloud_points} points{noise}")
        if quality.cloud_points == 0:
            say("warning: the cloud is empty: the photos agree on no surface; the part may have no texture at all")
    times = ", ".join(f"{name} {seconds:.0f} s" for name, seconds in result.seconds.items())
    click.echo(f"wrote {result.folder} ({times})")
