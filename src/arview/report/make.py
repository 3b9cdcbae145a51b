"""The report of an inspection, written by one call."""

from __future__ import annotations

from pathlib import Path
from types import NoneType
from typing import Any

from arview.cad import Part
from arview.core.atomic import write_file
from arview.core.checks import PATH, check_type
from arview.core.extras import require
from arview.core.progress import Progress
from arview.errors import InputError, MissingDependencyError
from arview.report.evidence import ReportEvidence, gather
from arview.report.page import build_context, render

PANGO_INSTALL_COMMAND = (
    "apt-get install -y --no-install-recommends libpango-1.0-0 libpangoft2-1.0-0 libharfbuzz-subset0"
)


FORMS = {"first-article": Path(__file__).with_name("first_article.html")}
"""Templates beside that of the report, by name."""


def make_report(
    inspection: str | Path,
    html: str | Path | None = None,
    pdf: str | Path | None = None,
    part: Part | None = None,
    *,
    folder: str | Path | None = None,
    photos: str | Path | None = None,
    progress: Progress | None = None,
    template: str | Path | None = None,
) -> ReportEvidence:
    """Write the report of an inspection as one self-contained HTML file, as PDF, or both.

    Args:
        inspection: ``inspection.json``, beside the files that `arview measure` wrote.
        html: page to write, or None.
        pdf: PDF to write, or None.
        part: the part that was inspected; without it the report has no pictures and no CAD model.
        folder: folder of a reconstruction; default: the folder of the inspection, if it contains one.
        photos: folder of the photos if they were moved.
        progress: called with (step, done, total).
        template: a Jinja template in place of the report's, or ``first-article``: a form for each characteristic.

    Returns:
        the data of the report; its ``absent`` explains what is missing.

    Raises:
        InputError: the inspection cannot be read, ``folder`` is not a reconstruction, or no file is given.
        MismatchError: the part is not the one that was inspected.
        MissingDependencyError: the PDF needs libraries that are not installed.
        OutputError: a file cannot be written.
    """
    check_type(inspection, PATH, "make_report: inspection")
    check_type(part, (Part, NoneType), "make_report: part")
    if html is None and pdf is None:
        raise InputError("report: give a file to write, HTML or PDF")
    report_progress = progress or (lambda what, done, total: None)
    if pdf is not None:
        _weasyprint()
    report_progress("reading", 0, 1)
    form = None if template is None else FORMS.get(str(template), Path(template))
    evidence = gather(inspection, part, folder, photos)
    context = build_context(evidence, report_progress)
    if html is not None:
        write_file(Path(html), render(context, False, form).encode("utf-8"))
    if pdf is not None:
        report_progress("PDF", 0, 1)
        write_file(Path(pdf), pdf_of(render(context, True, form), evidence))
    report_progress("done", 1, 1)
    return evidence


def pdf_of(page: str, evidence: ReportEvidence) -> bytes:
    """The page as PDF/A-3 with the inspection attached."""
    weasyprint = _weasyprint()
    attachment = weasyprint.Attachment(
        string=evidence.source.read_bytes(),
        name=evidence.source.name,
        description="the inspection (arview)",
        relationship="Source",
    )
    return bytes(weasyprint.HTML(string=page).write_pdf(attachments=[attachment], pdf_variant="pdf/a-3u"))


def _weasyprint() -> Any:
    import logging

    for name in ("weasyprint", "fontTools"):
        logging.getLogger(name).setLevel(logging.ERROR)
    require("the PDF", "weasyprint")
    try:
        import weasyprint
    except OSError as error:
        raise MissingDependencyError(
            f"the PDF needs the Pango libraries: {PANGO_INSTALL_COMMAND} (the HTML report does not)"
        ) from error
    return weasyprint
