"""What people decided, in a report: the line beside the verdict and the section; also put into a report that is there.

A decision is made after the report was written. Writing all of it again takes many seconds, so the two places lie
between marks, and `update_report` replaces what is between them.
"""

from __future__ import annotations

from importlib import resources
from pathlib import Path
from typing import Any

from markupsafe import Markup

from arview.core.atomic import write_file
from arview.errors import InputError
from arview.inspection import ComponentDeviation, fingerprint_of_file, load_inspection
from arview.quality import decisions
from arview.report.evidence import ReportEvidence
from arview.report.formatting import short_text, verdict_word
from arview.report.rework import embedded_picture

_PARTS = ("record", "decisions")
_THUMBNAIL_PX = 360


def decisions_context(evidence: ReportEvidence) -> dict[str, Any]:
    """The two parts of the page as HTML, each between its marks."""
    return _rendered(evidence.source, decisions.state_of_record(evidence.source, evidence.inspection))


def update_report(html: str | Path, inspection: str | Path) -> bool:
    """Put the decisions about an inspection, as they are now, into its report.

    Args:
        html: the report, as `make_report` wrote it.
        inspection: ``inspection.json``.

    Returns:
        True if it was updated; False if there is no such file, or it is not a report of this inspection that has a
        place for decisions: then it has to be written again.

    Raises:
        InputError: the inspection, its log or the report cannot be read.
        OutputError: the report cannot be written.
    """
    path, source = Path(html), Path(inspection)
    if not path.is_file():
        return False
    try:
        page = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read ({error})") from error
    if f'<span class="mono">{fingerprint_of_file(source)}</span>' not in page:
        return False
    made = _rendered(source, decisions.state_of_record(source, load_inspection(source)))
    for name in _PARTS:
        begin, end = _marks(name)
        head, found, rest = page.partition(begin)
        _, ended, tail = rest.partition(end)
        if not found or not ended:
            return False
        page = f"{head}{made[f'{name}_html']}{tail}"
    write_file(path, page.encode("utf-8"))
    return True


def update_reports(target: str | Path) -> tuple[Path, ...]:
    """Put the decisions, as they are now, into every ``report.html`` of a record: the first one and those of checks.

    Args:
        target: job folder or inspection, also that of a check.

    Returns:
        the reports that could not be updated and have to be written again.

    Raises:
        InputError, OutputError: as `update_report`.
    """
    first = decisions.first_inspection(target)
    found = [
        (path.with_name("report.html"), path) for path in (first, *(path for path, _ in decisions.rechecks_of(first)))
    ]
    return tuple(page for page, path in found if page.is_file() and not update_report(page, path))


def _marks(name: str) -> tuple[str, str]:
    return f"<!-- arview {name} -->", f"<!-- arview {name} end -->"


def _rendered(source: Path, state: decisions.RecordState) -> dict[str, Any]:
    import jinja2

    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True)
    text = (resources.files("arview.report") / "decisions.html").read_text(encoding="utf-8")
    module: Any = environment.from_string(text).module
    entries = decisions.log_of(source).entries()
    rows = [_row(one, source) for one in entries if one.kind != "tick"]
    made = {"record": module.record(state), "decisions": module.section(state, rows, _ticks(entries), _checked(state))}
    return {
        f"{name}_html": Markup("").join((Markup(_marks(name)[0]), made[name], Markup(_marks(name)[1])))
        for name in _PARTS
    }


def _checked(state: decisions.RecordState) -> list[dict[str, str]]:
    """Components before and after their rework."""
    return [
        {
            "component": one.after.name,
            "before": _value(one.before),
            "after": _value(one.after),
            "time": one.created.strftime("%Y-%m-%d %H:%M UTC"),
        }
        for one in state.rechecked
    ]


def _value(one: ComponentDeviation) -> str:
    return verdict_word(one) if one.distance_mm is None else f"{verdict_word(one)}, {short_text(one)}"


def _row(one: decisions.Decision, source: Path) -> dict[str, Any]:
    picture = None
    if one.photo:
        path = decisions.photo_path(source, one.photo)
        picture = None if path is None else embedded_picture(path, _THUMBNAIL_PX)
    return {
        "time": one.time.strftime("%Y-%m-%d %H:%M:%S UTC"),
        "what": "signed" if one.kind == "signature" else one.component,
        "decision": decisions.decision_word(one),
        "reason": one.reason,
        "note": one.note,
        "by": one.by,
        "photo": one.photo or "",
        "picture": picture,
        "hash": one.sha256[:12],
    }


def _ticks(entries: tuple[decisions.Decision, ...]) -> list[dict[str, str]]:
    """The steps of each component that are done now, and by whom."""
    latest = {(one.component, one.step): one for one in entries if one.kind == "tick"}
    rows: dict[str, list[decisions.Decision]] = {}
    for one in latest.values():
        if one.is_done:
            rows.setdefault(one.component, []).append(one)
    return [
        {
            "component": name,
            "steps": ", ".join(str((one.step or 0) + 1) for one in sorted(done, key=lambda tick: tick.step or 0)),
            "by": ", ".join(dict.fromkeys(one.by for one in done)),
        }
        for name, done in rows.items()
    ]
