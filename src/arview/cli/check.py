"""The command check: what a part consists of, and what will be hard to find and track."""

from __future__ import annotations

import click

from arview import cad, guideviews
from arview.cli.common import UNIT, main, say
from arview.errors import InputError


def _show_example(ctx: click.Context, _parameter: click.Parameter, is_wanted: bool) -> None:
    """Print a part file that has every key, and exit."""
    if is_wanted:
        click.echo(cad.PART_FILE_EXAMPLE, nl=False)
        ctx.exit()


@main.command(
    short_help="Print what a part consists of, and what will be hard.",
    epilog="""\b
Examples:
  arview check part.toml
  arview check housing.stl --unit mm --camera fov:65
  arview check left.step --against right.step
  arview check bracket.step --pmi""",
)
@click.argument("part")
@UNIT
@click.option("--camera", "camera_spec", metavar="CAMERA", help="Camera file or fov:DEG, for sizes in pixels.")
@click.option(
    "--against", "others", multiple=True, metavar="PART", help="Another part it might be taken for; may be repeated."
)
@click.option(
    "--example",
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=_show_example,
    help="Print a part file with every key and what it means, and exit.",
)
@click.option("--pmi", is_flag=True, help="Print a part file with what the PMI of a STEP file (AP242) requires.")
def check(part: str, unit: str | None, camera_spec: str | None, others: tuple[str, ...], pmi: bool) -> None:
    """Print what PART consists of, and what will be hard about finding and tracking it.

    Symmetric or ambiguous shapes, components too small to be seen from the declared distance, thin or open
    geometry. Findings are not errors: the exit code is 0.
    """
    from arview.camera import load_camera

    loaded = cad.load_part(part, unit)
    if pmi:
        click.echo(cad.propose_part(loaded), nl=False)
        return
    beside = [cad.load_part(other, unit) for other in others]
    camera = None
    if camera_spec is not None:
        size = (1280, 720) if camera_spec.startswith("fov:") else (None, None)
        camera = load_camera(camera_spec, *size)
        if camera.doubt:
            say(f"warning: camera {camera_spec}: {camera.doubt}")
    try:
        findings = guideviews.uniqueness_findings(loaded.model, loaded.effective_view_range)
    except InputError:  # a range of views that cannot be used, which the check of the part explains
        findings = []
    if beside:
        findings += [one.finding() for one in guideviews.compare_parts(loaded, beside)]
    click.echo(cad.check_part(loaded, camera).with_findings(findings).format())
