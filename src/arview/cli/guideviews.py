"""The command guideviews: the guide views of a part, rendered into a file."""

from __future__ import annotations

import time

import click

from arview.cli.common import RENDERER, UNIT, main, output_path, progress_bar, write_bytes
from arview.errors import OutputError


@main.command(
    short_help="Render the guide views of a part into a file.",
    epilog="""\b
Examples:
  arview guideviews part.toml -o bracket.gv
  arview guideviews part.toml -o bracket.gv --preview sheet.png
  arview guideviews part.toml -o post.gv --component post_1""",
)
@click.argument("part")
@click.option("-o", "--output", required=True, metavar="SET", help="File to write.")
@click.option("--component", metavar="NAME", help="Render this component alone.")
@click.option("--preview", metavar="PNG", help="Contact sheet of some of the views, with weak ones marked.")
@UNIT
@RENDERER
def guideviews(
    part: str, output: str, component: str | None, preview: str | None, unit: str | None, renderer: str
) -> None:
    """Render the guide views of PART over its declared range of viewpoints, and store them in a file.

    `annotate` makes and caches guide views by itself; a file saves that step on another machine.
    """
    from arview.cad import load_part
    from arview.guideviews import GuideViewOptions, make_guide_views
    from arview.guideviews.findings import confusable_pair
    from arview.guideviews.uniqueness import assess
    from arview.rendering.renderers import choose_renderer

    loaded = load_part(part, unit)
    path = output_path(output, [loaded.path, loaded.cad_path])
    preview_path = output_path(preview, [loaded.path, loaded.cad_path, path]) if preview else None
    if preview_path is not None and preview_path.suffix.lower() != ".png":
        raise OutputError(f"{preview}: the name of the preview must end in .png")
    model = loaded.model.only([component]) if component else loaded.model
    chosen = choose_renderer(renderer)
    began = time.perf_counter()
    with progress_bar("guide views") as progress:
        views = make_guide_views(
            model, loaded.effective_view_range, GuideViewOptions(renderer=chosen.name), progress=progress
        )
    views.save(path)
    seconds = time.perf_counter() - began
    size_mb = path.stat().st_size / 1e6
    click.echo(f"{path}: {len(views)} views of {model.name} in {seconds:.1f} s, {size_mb:.1f} MB; drawn by {chosen}")
    unique = assess(views)
    click.echo(f"{unique.reason} (score {unique.score:.2f})")
    alike = confusable_pair(views, unique)
    if alike:
        click.echo(alike)
    if preview_path is not None:
        import cv2

        from arview.guideviews.sheet import contact_sheet

        _, png = cv2.imencode(".png", cv2.cvtColor(contact_sheet(model, views, unique=unique), cv2.COLOR_RGB2BGR))
        write_bytes(preview_path, png.tobytes())
        click.echo(f"wrote {preview_path}")
