"""The commands guideviews (the guide views of a part into a file) and studio (a page to set up a part)."""

from __future__ import annotations

import time

import click

from arview import guideviews as guide_views
from arview.cli.common import RENDERER, UNIT, main, output_path, progress_bar, say
from arview.cli.exit_codes import ExitCode
from arview.core.atomic import write_file
from arview.errors import OutputError

SUBDIVISIONS = {"4": 4, "8": 3, "16": 2}
"""Subdivisions of the icosahedron by the angle between neighbouring directions, deg."""


@main.command(
    short_help="Render the guide views of a part into a file.",
    epilog="""\b
Examples:
  arview guideviews part.toml -o bracket.gv
  arview guideviews part.toml -o bracket.gv --preview sheet.png
  arview guideviews part.toml -o bracket.gv --spacing 8 --packed --report bracket.md
  arview guideviews part.toml -o post.gv --component post_1""",
)
@click.argument("part")
@click.option("-o", "--output", required=True, metavar="SET", help="File to write.")
@click.option("--component", metavar="NAME", help="Render this component alone.")
@click.option("--preview", metavar="PNG|JPG", help="Contact sheet of some of the views, with weak ones marked.")
@click.option("--report", metavar="MD", help="Uniqueness report: verdict, shares, weakest views.")
@click.option(
    "--spacing",
    type=click.Choice(list(SUBDIVISIONS)),
    default="4",
    show_default=True,
    help="Degrees between neighbouring views; with 8 the file has a quarter of the size.",
)
@click.option("--packed", is_flag=True, help="Write a file of a third of the size, which takes longer to load.")
@UNIT
@RENDERER
def guideviews(
    part: str,
    output: str,
    component: str | None,
    preview: str | None,
    report: str | None,
    spacing: str,
    packed: bool,
    unit: str | None,
    renderer: str,
) -> None:
    """Render the guide views of PART over its declared range of viewpoints, and store them in a file.

    `annotate` makes and caches guide views by itself; a file saves that step on another machine.
    """
    from arview.cad import load_part
    from arview.rendering import choose_renderer

    loaded = load_part(part, unit)
    path = output_path(output, [loaded.path, loaded.cad_path])
    preview_path = output_path(preview, [loaded.path, loaded.cad_path, path]) if preview else None
    if preview_path is not None and preview_path.suffix.lower() not in (".png", ".jpg"):
        raise OutputError(f"{preview}: the name of the preview must end in .png or .jpg")
    report_path = output_path(report, [loaded.path, loaded.cad_path, path, preview_path]) if report else None
    model = loaded.model.only([component]) if component else loaded.model
    options = guide_views.GuideViewOptions(subdivisions=SUBDIVISIONS[spacing], renderer=choose_renderer(renderer).name)
    began = time.perf_counter()
    with progress_bar("guide views") as progress:
        views = guide_views.make_guide_views(model, loaded.effective_view_range, options, progress=progress)
    views.save(path, packed)
    seconds = time.perf_counter() - began
    size_mb = path.stat().st_size / 1e6
    click.echo(
        f"{path}: {len(views)} views of {model.name} in {seconds:.1f} s, {size_mb:.1f} MB; "
        f"drawn by {choose_renderer(renderer)}"
    )
    unique = guide_views.assess(views)
    click.echo(f"{unique.reason} (score {unique.score:.2f})")
    alike = guide_views.confusable_pair(views, unique)
    if alike:
        click.echo(alike)
    if preview_path is not None:
        import cv2

        sheet = cv2.cvtColor(guide_views.contact_sheet(model, views, unique=unique), cv2.COLOR_RGB2BGR)
        _, content = cv2.imencode(preview_path.suffix.lower(), sheet)
        write_file(preview_path, content.tobytes())
        click.echo(f"wrote {preview_path}")
    if report_path is not None:
        write_file(report_path, guide_views.uniqueness_report(views, unique).encode())
        click.echo(f"wrote {report_path}")


@main.command(
    short_help="Set up a part on a page: datums, range, guide views.",
    epilog="""\b
Examples:
  arview studio bracket.step
  arview studio part.toml --port 8500
  arview studio left.step --against right.step

\b
Opens a page for the browser of this machine; nothing leaves it. There roles, colours and tolerances are set in the
assembly tree, a click on a plane, hole, cylinder or edge makes it a datum, the range of viewpoints is dragged, guide
views are shown with what weakens them and what would help, photos are planned, and a picture or clip is tried. Save
writes part.toml beside the CAD (comments are kept); guide views (.gv), a contact sheet and a sheet to print for the
station can be written, too. What the page does can be done by hand: in the part file (`arview check --help`), and by
the commands check, guideviews and annotate.""",
)
@click.argument("part", metavar="PART")
@click.option(
    "--port", type=click.IntRange(0, 65535), default=8460, show_default=True, help="Port of the page; 0: any."
)
@click.option(
    "--against", "others", multiple=True, metavar="PART", help="Another part it might be taken for; may be repeated."
)
@UNIT
@click.option("--no-browser", is_flag=True, help="Print the address, open no browser.")
def studio(part: str, port: int, others: tuple[str, ...], unit: str | None, no_browser: bool) -> None:
    """Set up PART, a CAD or part file, on a local page."""
    import asyncio
    import os
    import signal
    import sys
    import webbrowser

    from arview.core.extras import require_extra

    require_extra("arview studio", "station")
    from arview.cad import load_part
    from arview.station.studio import StudioDocument, StudioServer

    server = StudioServer(StudioDocument(part, unit), port, [load_part(other, unit) for other in others])

    async def serve() -> None:
        for number in (signal.SIGINT, signal.SIGTERM):
            asyncio.get_running_loop().add_signal_handler(number, server.stop)
        await server.serve(ready)

    def ready() -> None:
        click.echo(f"studio: {server.link}")
        say("Ctrl-C ends it; the part file is written by Save only")
        if not no_browser:
            webbrowser.open(server.link)

    asyncio.run(serve())
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(ExitCode.INTERRUPTED)  # threads that still make views are in native code, which aborts at an orderly end
