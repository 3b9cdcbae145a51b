"""The commands export and inspection new: an inspection in exchange formats, and one that is written by hand."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Literal

import click

from arview import acceptance
from arview.cli.common import UNIT, inspection_file, main, output_path, say
from arview.core.atomic import write_file
from arview.core.extras import require
from arview.core.plug_ins import find_plug_ins, load_plug_in
from arview.errors import InputError, OutputError
from arview.quality import decisions

PLUG_INS = "arview.exports"
"""Entry points of other packages, named as --to names them."""
FORMATS = ("csv", "characteristics", "qif", "dfq", "glb", "html", "pdf", "decisions")


def _parse_formats(ctx: click.Context, parameter: click.Parameter, value: str) -> tuple[str, ...]:
    names = tuple(dict.fromkeys(name.strip().lower() for name in value.split(",") if name.strip()))
    known = (*FORMATS, *find_plug_ins(PLUG_INS))
    if not names or any(name not in known for name in names):
        raise click.BadParameter(f"{value!r}: expected some of {','.join(known)}")
    return names


@main.command(
    short_help="Write an inspection as CSV, QIF, DFQ, GLB, HTML or PDF, and its decisions.",
    epilog="""\b
Examples:
  arview export out/inspection.json --to csv
  arview export out/inspection.json --to qif,dfq -o /mnt/cmm/
  arview export out/inspection.json --to glb --part part.toml -o deviations.glb

\b
csv   one line per component, with the latest decision of a person about it
characteristics
      CSV with one line per characteristic of the drawing
qif   QIF 3.0 results (ISO 23952): position with spherical zone, x y z, rotation and presence, and the
      characteristics of the drawing, with standard uncertainties
dfq   Q-DAS ASCII transfer format (AQDEF): distance, dx, dy, dz, tilt and presence of each component, and
      those of the drawing; a missing component is an attribute with one error
glb   glTF 2.0: components at nominal and measured place, coloured by verdict, with arrows; needs --part
html  the report, as `arview report` writes it
pdf   the report as PDF
decisions
      decisions.csv: decisions of people about it, ticks of rework and signatures, a line for each

\b
An undetermined quantity has no value in any of them. Numbers are rounded to what their U allows, with U
to two significant digits; inspection.json keeps every digit. Each carries the fingerprint of the
inspection that report and results store show. The fields of inspection.json are described in
src/arview/inspection/schema/inspection-json.md and by the JSON Schema next to it.""",
)
@click.argument("inspection", metavar="INSPECTION", callback=inspection_file)
@click.option(
    "--to",
    "formats",
    callback=_parse_formats,
    required=True,
    metavar="LIST",
    help="csv, characteristics, qif, dfq, glb, html, pdf, decisions, separated by commas.",
)
@click.option("-o", "--output", metavar="FILE|FOLDER", help="File to write, or folder; default: next to INSPECTION.")
@click.option("--part", "part_path", metavar="PART", help="Part file or CAD file, for glb, html and pdf.")
@click.option("--folder", metavar="OUT", help="Folder of `arview reconstruct`, for html and pdf.")
@click.option("--photos", metavar="FOLDER", help="Folder of the photos, for html and pdf.")
@click.option("--decimal-comma", is_flag=True, help="CSV with decimal commas and semicolons.")
@UNIT
def export(
    inspection: str,
    formats: tuple[str, ...],
    output: str | None,
    part_path: str | None,
    folder: str | None,
    photos: str | None,
    decimal_comma: bool,
    unit: str | None,
) -> None:
    """Write INSPECTION in other formats."""
    from arview.cad import load_part
    from arview.inspection import fingerprint_of_file, load_inspection, to_csv, to_dfq, to_glb

    if "qif" in formats:
        from arview.inspection import to_qif
    if {"html", "pdf"} & set(formats):
        require("a report", "jinja2", "markupsafe", "matplotlib", *(("weasyprint",) if "pdf" in formats else ()))
    source = Path(inspection)
    targets = _targets(source, formats, output, part_path)
    part = None if part_path is None else load_part(part_path, unit)
    if "glb" in formats and part is None:
        raise InputError("glb: the CAD is needed; name it with --part")
    loaded = load_inspection(source, None if part is None else part.model)
    sha256 = fingerprint_of_file(source)
    content = decisions.log_of(source).content()
    for line in (*content.faults, *content.notices):
        say(line)
    decided = decisions.decided_cells(content.entries)
    decimal: Literal[".", ","] = "," if decimal_comma else "."
    made: dict[str, Callable[[], bytes]] = {
        "csv": lambda: to_csv(loaded, sha256, decided, decimal=decimal).encode("utf-8"),
        "characteristics": lambda: to_csv(loaded, sha256, of="characteristics", decimal=decimal).encode("utf-8"),
        "decisions": lambda: decisions.decisions_csv(content.entries, loaded.part, loaded.serial).encode("utf-8"),
        "qif": lambda: to_qif(loaded, sha256),
        "dfq": lambda: to_dfq(loaded, sha256),
    }
    if part is not None:
        model = part.model
        made["glb"] = lambda: to_glb(loaded, model, sha256=sha256)
    for name, entry in find_plug_ins(PLUG_INS).items():
        if name in targets and name not in FORMATS:
            made[name] = partial(load_plug_in(entry), loaded)
    for name, target in targets.items():
        if name in made:
            write_file(target, made[name]())
    if {"html", "pdf"} & set(targets):
        from arview.report import make_report

        evidence = make_report(source, targets.get("html"), targets.get("pdf"), part, folder=folder, photos=photos)
        for reason in evidence.absent.values():
            say(f"left out: {reason}")
    for target in targets.values():
        click.echo(f"wrote {target}")


def _targets(source: Path, formats: tuple[str, ...], output: str | None, part_path: str | None) -> dict[str, Path]:
    """The file of each format; a folder that is not there is made where the name ends in / or has no ending."""
    inputs = [source, part_path]
    folder = source.parent if output is None else Path(output)
    if output is not None and not folder.is_dir():
        if not output.endswith("/") and (len(formats) == 1 or folder.suffix or folder.exists()):
            if len(formats) > 1:
                raise InputError(f"{output}: {len(formats)} formats need a folder, not one file")
            return {formats[0]: output_path(output, inputs)}
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(f"{output}: the folder cannot be made ({error.strerror})") from error
    names = {name: f"{source.stem}.{name}" for name in formats}
    if "characteristics" in names:
        names["characteristics"] = f"{source.stem}.characteristics.csv"
    if "decisions" in names:
        names["decisions"] = decisions.log_of(source).path.with_suffix(".csv").name
    return {name: output_path(str(folder / file), inputs) for name, file in names.items()}


@main.group(
    short_help="Make an inspection file by hand, or from a list of values.",
    epilog="""\b
Examples:
  arview inspection new part.toml
  arview inspection new part.toml --values cmm.csv --serial 0042 -o out/inspection.json""",
)
def inspection() -> None:
    """Make inspection files."""


@inspection.command(
    short_help="Make a valid inspection file of a part.",
    epilog="""\b
Examples:
  arview inspection new part.toml
  arview inspection new part.toml --values cmm.csv --serial 0042 -o out/inspection.json

\b
Without --values every component is not_measured, to be filled in by hand; a mistake is named with its
place when the file is read. VALUES is a list of measured components, as a measuring machine writes it:
columns name and dx, dy, dz (measured minus nominal) or x, y, z (position in the frame of the CAD's
datums), and U (k = 2), in mm, separated by ; or , or tabs, with decimal point or comma. x, y, z are of
the point that the part file names, else of the centre of mass; a column measurand (mass or box) says
that they are of another one. Verdicts follow ISO 14253-1 from U and the tolerances of the part file.""",
)
@click.argument("part")
@click.option("-o", "--output", metavar="JSON", default="inspection.json", show_default=True, help="File to write.")
@click.option("--values", metavar="VALUES", help="List of measured components (CSV).")
@click.option("--serial", metavar="SERIAL", help="Serial number of the specimen; default: that of the part file.")
@click.option("--force", is_flag=True, help="Write over a file that exists.")
@UNIT
def new(part: str, output: str, values: str | None, serial: str | None, force: bool, unit: str | None) -> None:
    """Write a valid inspection file of PART."""
    from arview.cad import load_part
    from arview.inspection import save_inspection, verdict_sentence
    from arview.workflow.new_inspection import new_inspection

    target = output_path(output, [part, values])
    if Path(target).exists() and not force:
        raise InputError(f"{target}: exists; name another file with -o, or write over it with --force")
    listed = () if values is None else acceptance.read_position_list(values)
    made = new_inspection(load_part(part, unit), listed, serial, values or "")
    save_inspection(made, target)
    click.echo(f"wrote {target}: {verdict_sentence(made)}")
