"""The command report: an inspection → one HTML file, and a PDF to file."""

from __future__ import annotations

from pathlib import Path

import click

from arview.cli.common import UNIT, main, output_path, say, stage_bar
from arview.errors import InputError


@main.command(
    short_help="Write an inspection as a report, HTML and PDF.",
    epilog="""\b
Examples:
  arview report out/inspection.json --part part.toml
  arview report out/inspection.json --part part.toml -o report.html --pdf report.pdf
  arview report inspection.json --part part.toml --folder out/ --photos /mnt/photos

\b
INSPECTION is the file of `arview measure`. The report holds the verdict, a table of components, a picture
of each finding (photo, ghost at the nominal place, arrow), distance map and histogram, uncertainty
budget, datums, photos, how it was measured, and a 3D view of CAD, cloud and arrows. It is one file that
needs no network. The PDF has all of this except the 3D view, and the inspection as an attachment.

\b
Pictures are made from the photos in the folder of `arview reconstruct` (default: that of INSPECTION), and
need --part. Whatever is not available is left out, and the report says so.""",
)
@click.argument("inspection", metavar="INSPECTION")
@click.option("-o", "--output", metavar="HTML", help="Page to write; default: report.html next to INSPECTION.")
@click.option("--pdf", metavar="PDF", help="Also write a PDF.")
@click.option("--part", "part_path", metavar="PART", help="Part file or CAD file that was measured against.")
@click.option("--folder", metavar="OUT", help="Folder of `arview reconstruct`, if INSPECTION is not in it.")
@click.option("--photos", metavar="FOLDER", help="Folder of the photos, if they were moved.")
@UNIT
def report(
    inspection: str,
    output: str | None,
    pdf: str | None,
    part_path: str | None,
    folder: str | None,
    photos: str | None,
    unit: str | None,
) -> None:
    """Write the report of INSPECTION as one HTML file, and as PDF."""
    from arview.cad import load_part
    from arview.report import make_report

    source = Path(inspection)
    if not source.is_file():
        raise InputError(f"{source}: no such file; give the inspection.json that `arview measure` wrote")
    inputs = [source, part_path]
    html = output_path(output or str(source.parent / "report.html"), inputs)
    paper = None if pdf is None else output_path(pdf, [*inputs, html])
    part = None if part_path is None else load_part(part_path, unit)
    with stage_bar() as progress:
        evidence = make_report(source, html, paper, part, folder=folder, photos=photos, progress=progress)
    for reason in evidence.absent.values():
        say(f"left out: {reason}")
    for path in (html, paper):
        if path is not None:
            click.echo(f"wrote {path}")
