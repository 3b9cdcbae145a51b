"""What is kept of an inspection: the commands report, rework, decide, sign and decisions."""

from __future__ import annotations

import json
import re
from pathlib import Path

import click

from arview.cli.common import UNIT, inspection_file, main, output_path, say, stage_bar
from arview.cli.exit_codes import ExitCode
from arview.core.atomic import write_file
from arview.errors import InputError, MissingDependencyError, OutputError
from arview.quality import decisions as quality
from arview.quality import history


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
budget, datums, photos, how it was measured, a 3D view of CAD, cloud and arrows, the rework of what is out
of tolerance, and what people decided. It is one file that needs no network. The PDF has all of this except
the 3D view, and the inspection as an attachment. `--template first-article` writes a form after AS9102
with a line for each characteristic; src/arview/report/first_article.html is one to start from.

\b
Pictures are made from the photos in the folder of `arview reconstruct` (default: that of INSPECTION), and
need --part. Whatever is not available is left out, and the report says so.""",
)
@click.argument("inspection", metavar="INSPECTION", callback=inspection_file)
@click.option("-o", "--output", metavar="HTML", help="Page to write; default: report.html next to INSPECTION.")
@click.option("--pdf", metavar="PDF", help="Also write a PDF.")
@click.option("--part", "part_path", metavar="PART", help="Part file or CAD file that was measured against.")
@click.option("--folder", metavar="OUT", help="Folder of `arview reconstruct`, if INSPECTION is not in it.")
@click.option("--photos", metavar="FOLDER", help="Folder of the photos, if they were moved.")
@click.option("--template", metavar="NAME|FILE", help="first-article, or a Jinja template of your own.")
@UNIT
def report(
    inspection: str,
    output: str | None,
    pdf: str | None,
    part_path: str | None,
    folder: str | None,
    photos: str | None,
    template: str | None,
    unit: str | None,
) -> None:
    """Write the report of INSPECTION as one HTML file, and as PDF."""
    from arview.cad import load_part
    from arview.report import make_report

    source = Path(inspection)
    if not source.is_file():
        raise InputError(f"{source}: no such file; give a job folder, or an inspection.json")
    inputs = [source, part_path]
    html = output_path(output or str(source.parent / "report.html"), inputs)
    paper = None if pdf is None else output_path(pdf, [*inputs, html])
    part = None if part_path is None else load_part(part_path, unit)
    with stage_bar() as progress:
        evidence = make_report(
            source, html, paper, part, folder=folder, photos=photos, progress=progress, template=template
        )
    for reason in evidence.absent.values():
        say(f"left out: {reason}")
    for path in (html, paper):
        if path is not None:
            click.echo(f"wrote {path}")


@main.command(
    short_help="Say how components out of tolerance are to be moved, with drawings.",
    epilog="""\b
Examples:
  arview rework out/inspection.json --part part.toml
  arview rework out/inspection.json --part part.toml -o rework/
  arview rework out/inspection.json --part part.toml --json

\b
For each component that is out of tolerance: which way and how far to move and turn it, in directions that
are on the part (towards a neighbour or a datum hole, away from its seat, up), with U. What is below U is
not asked for, and what is undetermined is said. Missing components are to be installed; foreign objects
are no rework. The kind of rework, its steps, pictures and directions come from the part file
(`arview check --help` shows [components.NAME.rework]).

\b
With -o, each gets a drawing, COMPONENT.svg: the place at true scale when printed at 100 %, and the
displacement magnified, with the tolerance zone.""",
    exit_codes={
        ExitCode.DONE: "nothing is out of tolerance",
        ExitCode.FAIL: "there is rework to do",
        ExitCode.UNDECIDED: "no rework is known, but a component is undecided or was not measured",
    },
)
@click.argument("inspection", metavar="INSPECTION", callback=inspection_file)
@click.option(
    "--part", "part_path", metavar="PART", required=True, help="Part file or CAD file that was measured against."
)
@click.option("-o", "--output", metavar="FOLDER", help="Folder for the drawings, which is made if needed.")
@click.option("--json", "as_json", is_flag=True, help="Print the instructions as JSON.")
@UNIT
def rework(inspection: str, part_path: str, output: str | None, as_json: bool, unit: str | None) -> None:
    """Say what to do about the components of INSPECTION that are out of tolerance."""
    from arview.cad import load_part
    from arview.inspection import Verdict, load_inspection
    from arview.quality.rework import drawing_svg, instruction_document, make_instructions

    part = load_part(part_path, unit)
    loaded = load_inspection(inspection, part.model)
    folder = None if output is None else _made_folder(output)
    found = make_instructions(part, loaded)
    if as_json:
        click.echo(json.dumps([instruction_document(one) for one in found], indent=2, ensure_ascii=False))
    for one in () if as_json else found:
        click.echo(f"{one.component} ({one.how}): {one.what}")
        for text in (one.text, one.remark):
            if text:
                click.echo(f"  {text}")
        for number, step in enumerate(one.steps, 1):
            click.echo(f"  {number}. {step}")
    open_names = [one.name for one in loaded.components if one.verdict in (Verdict.NOT_MEASURED, Verdict.UNDECIDED)]
    if not found and not as_json:
        click.echo("nothing is known to be out of tolerance: no rework")
    if open_names:
        say(f"not measured or undecided, so it is not known whether they need rework: {', '.join(open_names)}")
    if folder is not None:
        for one in found:
            # Names of components may hold what a file name may not.
            target = folder / f"{re.sub(r'[^A-Za-z0-9._-]+', '_', one.component).lstrip('.') or 'component'}.svg"
            write_file(target, drawing_svg(part, loaded, one.component).encode("utf-8"))
            say(f"wrote {target}")
    click.get_current_context().exit(ExitCode.FAIL if found else ExitCode.UNDECIDED if open_names else ExitCode.DONE)


def _made_folder(path: str) -> Path:
    folder = Path(path)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{path}: the folder cannot be made ({error.strerror or error})") from error
    return folder


BY = click.option("--by", required=True, metavar="NAME", help="Who decides or signs.")
NOTE = click.option("--note", default="", metavar="TEXT", help="Anything else.")


@main.group(
    short_help="Decide about components, sign, list what was decided.",
    epilog="""\b
Examples:
  arview decisions decide out/ link_1 --not-ok --reason "weld cracked" --by Ada
  arview decisions sign out/ --by "Grace Hopper"
  arview decisions list out/""",
)
def decisions() -> None:
    """Decisions by people about an inspection: kept beside it, line by line, and never changed."""


@decisions.command(
    short_help="Decide about a component: OK or not OK, and why.",
    epilog="""\b
Examples:
  arview decisions decide out/ link_1 --not-ok --reason "weld cracked" --by Ada
  arview decisions decide out/ post_1 --ok --reason "agreed with the customer" --by Ada --photo 0003.jpg

\b
JOB is a job folder, or an inspection.json. Decisions are appended to decisions.jsonl beside it and are
never changed: each line has the hash of the one before. They never change what was measured: report, CSV
and history show both. A decision after a signature makes it void. A report.html beside the inspection is
brought up to date.""",
)
@click.argument("job", metavar="JOB")
@click.argument("component", metavar="COMPONENT")
@click.option("--ok", is_flag=True, help="Take the component as it is.")
@click.option("--not-ok", is_flag=True, help="Do not take the component as it is.")
@click.option("--reason", default="", metavar="TEXT", help="Why; needed unless a component in tolerance is OK.")
@click.option("--photo", metavar="NAME", help="A photo of the job that shows it.")
@NOTE
@BY
def decide(
    job: str, component: str, ok: bool, not_ok: bool, reason: str, photo: str | None, note: str, by: str
) -> None:
    """Decide about COMPONENT of JOB."""
    if ok == not_ok:
        raise click.UsageError("give either --ok or --not-ok, not both" if ok else "give --ok or --not-ok")
    made = quality.decide_component(job, component, ok, reason, note, by, photo)
    click.echo(f"entry {made.number}: {component} {'OK' if ok else 'not OK'}, {made.by}")
    _told_state(job)


@decisions.command(
    short_help="Sign an inspection.",
    epilog="""\b
Examples:
  arview decisions sign out/ --by "Grace Hopper"
  arview decisions sign out/ --by "Grace Hopper" --note "shift 2" --store /data/plate.sqlite

\b
The part is released if each component passed or was accepted with a reason, and none was rejected;
otherwise the signature says that it is not. A later decision, or another inspection.json, makes it
void.""",
    exit_codes={
        ExitCode.DONE: "signed and released",
        ExitCode.FAIL: "signed, not released: a component was rejected or is open",
    },
)
@click.argument("job", metavar="JOB")
@NOTE
@BY
@click.option("--store", metavar="FILE|URL", help="Add inspection and decisions to this results store.")
def sign(job: str, note: str, by: str, store: str | None) -> None:
    """Sign the inspection of JOB as it is now."""
    from contextlib import ExitStack

    with ExitStack() as stack:
        opened = None
        if store is not None:
            quality.first_inspection(job)  # an error of the job comes first
            opened = stack.enter_context(
                history.HistoryStore(store, tell=say)
            )  # before a signature that cannot be taken back
        quality.sign_inspection(job, by, note)
        is_released = _told_state(job)
        if opened is not None:
            for path, _ in quality.rechecks_of(job):
                opened.add(path)
            added = opened.add(quality.first_inspection(job))
            click.echo(f"{opened.name}: result {added.id}, {added.decisions} new entries")
    click.get_current_context().exit(ExitCode.DONE if is_released else ExitCode.FAIL)


@decisions.command(
    "list",
    short_help="List the decisions about an inspection, and check that none was changed.",
    epilog="""\b
Examples:
  arview decisions list out/
  arview decisions list out/ -o decisions.csv""",
    exit_codes={
        ExitCode.DONE: "signed, and the log is as it was written",
        ExitCode.FAIL: "a line was changed or removed; it is named",
        ExitCode.UNDECIDED: "no signature holds",
    },
)
@click.argument("job", metavar="JOB")
@click.option("-o", "--output", metavar="CSV", help="Write them as CSV.")
def list_decisions(job: str, output: str | None) -> None:
    """List the decisions, ticks and signatures of JOB."""
    from arview.inspection import load_inspection

    path = quality.inspection_path(job)
    if not path.is_file():
        raise InputError(f"{path}: no such inspection; give a job folder or an inspection.json")
    target = None if output is None else output_path(output, [path, quality.log_of(job).path])
    content = quality.log_of(job).content()
    for one in content.entries:
        words = [one.component, quality.decision_word(one)]
        if one.step is not None:
            words.append(f"step {one.step + 1} {'done' if one.is_done else 'not done'}")
        text = "; ".join(word for word in (one.reason, one.note) if word)
        line = " ".join(word for word in [one.kind, *words] if word)
        click.echo(f"{one.number:>4}  {one.time:%Y-%m-%d %H:%M:%S}  {one.by}: {line}{f' ({text})' if text else ''}")
    if target is not None:
        loaded = load_inspection(path)
        write_file(target, quality.decisions_csv(content.entries, loaded.part, loaded.serial).encode("utf-8"))
        click.echo(f"wrote {target}")
    _told_state(job)
    if not content.entries:
        click.echo("not signed: nobody has decided anything")
    if content.faults or (signed := quality.state_of_record(job).signature) is None or signed.void:
        click.get_current_context().exit(ExitCode.FAIL if content.faults else ExitCode.UNDECIDED)


def _told_state(job: str) -> bool:
    """Print what was decided so far, and bring the report up to date; whether the part is released."""
    state = quality.state_of_record(job)
    for line in (*state.faults, *state.notices):
        say(line)
    if state.sentence:
        click.echo(state.sentence)
    for page in _not_updated(job):
        say(f"{page}: has no place for these decisions; write it again with `arview report`")
    return state.is_released


def _not_updated(job: str) -> tuple[Path, ...]:
    """Bring the reports of a record up to date, if there are any; those that could not be are returned."""
    if not quality.first_inspection(job).with_name("report.html").is_file():
        return ()
    try:
        from arview.report import update_reports

        return update_reports(job)
    except MissingDependencyError as error:
        say(f"the report was not brought up to date: {error}")
        return ()
