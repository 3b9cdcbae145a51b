"""The commands history …: a store of inspections; its statistics are in `arview.cli.history_statistics`."""

from __future__ import annotations

import json
import zoneinfo
from collections.abc import Callable, Sequence
from datetime import UTC, datetime, tzinfo

import click

from arview.cli.common import main, output_path, progress_bar, say
from arview.cli.exit_codes import ExitCode
from arview.core.atomic import write_file
from arview.errors import InputError
from arview.quality import decisions
from arview.quality import history as quality

STORE = click.option(
    "--store", metavar="FILE|URL",
    help="SQLite file or postgresql://user@host/database; default: ARVIEW_STORE, else a file in your data folder.",
)  # fmt: skip
PART = click.option("--part", metavar="NAME", help="Only results of this part.")
SERIAL = click.option("--serial", metavar="SERIAL", help="Only results of this serial.")
STATION = click.option("--station", metavar="NAME", help="Only results of this station.")
SINCE = click.option(
    "--since", metavar="DATE", help="Only results measured from then on: 2026-03-01 or with a time (+02:00)."
)


def _parse_zone(ctx: click.Context, parameter: click.Parameter, value: str) -> tzinfo | None:
    if value.lower() in ("local", "utc"):
        return UTC if value.lower() == "utc" else None
    try:
        return zoneinfo.ZoneInfo(value)
    except (zoneinfo.ZoneInfoNotFoundError, ValueError, OSError) as error:
        raise click.BadParameter(f"{value!r}: expected a time zone such as Europe/Berlin") from error


ZONE = click.option("--zone", metavar="ZONE", default="local", show_default=True, callback=_parse_zone,
                    help="Time zone of the dates: UTC, Europe/Berlin, or that of this machine.")  # fmt: skip


def _with_filters(command: Callable[..., None]) -> Callable[..., None]:
    """The options of a command that writes chosen results."""
    for option in (STORE, SINCE, STATION, SERIAL, PART, ZONE):
        command = option(command)
    return command


@main.group(
    short_help="Store results; list them, trends and capability.",
    epilog="""\b
Examples:
  arview history add out/*/inspection.json --station cell-3
  arview history list --part plate --limit 20
  arview history show 12 -o inspection.json
  arview history chart --part plate --component post_1 -o post_1.svg
  arview history export -o plate.csv --part plate
  arview history grr --part plate --component post_1
  arview history void 12 --reason "part was not seated"
  arview history same 3fa94c21 9be07d55 --reason "only the logo changed"
  arview history serve

\b
The store only grows: results are added, never changed or deleted; the database itself refuses that. One
that must not count is voided with a reason, and stays visible. Times are stored as UTC and printed in
--zone. Each result is identified by the SHA-256 of its content, so that adding it again changes nothing. Two
stations may add at the same time. SQLite serves one machine; use PostgreSQL for several
(the extra `postgres`).""",
)
def history() -> None:
    """Store inspections, and see trends and capability over time."""


@history.command(
    short_help="Add inspections.",
    epilog="""\b
Examples:
  arview history add out/inspection.json
  arview history add out/*/inspection.json --station cell-3 --store /data/plate.sqlite

\b
Files that are not inspections are named and left out. Results already in the store stay as they are;
decisions beside them that the store does not have (decisions.jsonl) are added.""",
    exit_codes={
        ExitCode.DONE: "all are in the store",
        ExitCode.BAD_INPUT: "a file is not an inspection, or other bad input; the others were added",
    },
)
@click.argument("inspections", nargs=-1, required=True, metavar="INSPECTION...")
@click.option(
    "--station", metavar="NAME", help="Name of the measuring station; default: ARVIEW_STATION or this machine."
)
@STORE
def add(inspections: tuple[str, ...], station: str | None, store: str | None) -> None:
    """Add the INSPECTIONs to the store."""
    new = same = decided = 0
    failed: list[str] = []
    with open_store(store) as opened, progress_bar("history") as progress:
        for done, path in enumerate(inspections, 1):
            try:
                added = opened.add(path, station)
            except InputError as error:
                failed.append(str(error))
                continue
            failed += [f"{path}: {fault}; decisions are left out" for fault in added.decision_faults]
            decided += added.decisions
            new, same = new + added.is_new, same + (not added.is_new)
            if len(inspections) == 1:
                state = "added as" if added.is_new else "already there as"
                click.echo(f"{path}: {state} {added.id}, {added.content_hash[:12]}")
                if added.decisions:
                    click.echo(f"{added.decisions} new decisions")
            progress(done, len(inspections))
        name = opened.name
    for reason in failed:
        say(f"error: {reason}")
    if len(inspections) > 1:
        more = f", {decided} new decisions" if decided else ""
        click.echo(f"{new} added, {same} already there, {len(failed)} refused{more}: {name}")
    if failed:
        click.get_current_context().exit(ExitCode.BAD_INPUT)


@history.command("list", short_help="List results.", epilog="""\b
Examples:
  arview history list
  arview history list --part plate --verdict fail --since 2026-03-01
  arview history list --voided --zone Europe/Berlin""")  # fmt: skip
@PART
@SERIAL
@STATION
@SINCE
@click.option(
    "--verdict",
    type=click.Choice(["pass", "fail", "undecided", "measured", "not_measured"]),
    help="Only results with this verdict.",
)
@click.option("--limit", type=click.IntRange(min=1), metavar="N", help="Only the newest N.")
@click.option("--voided", is_flag=True, help="Also those that were voided.")
@ZONE
@STORE
def list_results(
    part: str | None, serial: str | None, station: str | None, since: str | None, verdict: str | None,
    limit: int | None, voided: bool, zone: tzinfo | None, store: str | None,
) -> None:  # fmt: skip
    """List the results in the order in which they were measured."""
    with open_store(store, must_exist=True) as opened:
        found = opened.listed(
            part, serial, station, verdict, parse_moment(since, zone), limit=limit, with_voided=voided
        )  # fmt: skip
        states = _states(opened, found)
    table(
        ("no.", f"measured ({zone_name(zone)})", "part", "serial", "station", "verdict", "decided", "hash"),
        [(str(r.id), f"{r.measured.astimezone(zone):%Y-%m-%d %H:%M:%S}", r.part, r.serial or "-", r.station,
          "void" if r.void is not None else r.verdict.replace("_", " "), _decided_word(states.get(r.id)),
          r.content_hash[:12]) for r in found],
    )  # fmt: skip
    click.echo(f"{len(found)} result{'s' * (len(found) != 1)}")


@history.command(short_help="Show one result.", epilog="""\b
Examples:
  arview history show 12
  arview history show 3fa94c21b0 -o inspection.json""")  # fmt: skip
@click.argument("result")
@click.option("-o", "--output", metavar="FILE", help="Write its inspection.json.")
@ZONE
@STORE
def show(result: str, output: str | None, zone: tzinfo | None, store: str | None) -> None:
    """Show the RESULT with this number, or whose hash begins so."""
    target = None if output is None else output_path(output, [])
    with open_store(store, must_exist=True) as opened:
        found, document = opened.find(result)
        order = {one["name"]: place for place, one in enumerate(json.loads(document)["components"])}
        rows = sorted(opened.components([found.id]), key=lambda row: order.get(row["name"], 0))
        entries, state = opened.decisions(found.id), _states(opened, [found]).get(found.id)
    _about(found, zone)
    if state is not None:
        click.echo(f"decided  {state.sentence}")
    table(
        ("component", "dx", "dy", "dz", "distance", "U", "tolerance", "tilt", "verdict"),
        [(row["name"], *(_number(row[key], sign) for key, sign in
                         (("dx_mm", "+"), ("dy_mm", "+"), ("dz_mm", "+"), ("distance_mm", ""), ("uncertainty_mm", ""),
                          ("tolerance_mm", ""))),
          _number(row["tilt_deg"], "", 2), row["finding"] or row["verdict"].replace("_", " ")) for row in rows],
    )  # fmt: skip
    requirements = json.loads(document).get("characteristics", ())
    if requirements:
        table(
            ("characteristic", "value", "U", "zone", "verdict"),
            [(one["name"], *(_number(one.get(key), "") for key in ("value_mm", "uncertainty_mm", "zone_mm")),
              one["verdict"].replace("_", " ")) for one in requirements],
        )  # fmt: skip
    if entries:
        _print_decisions([(found, one) for one in entries], zone)
    if target is not None:
        text = json.dumps(json.loads(document), indent=2, ensure_ascii=False) + "\n"
        write_file(target, text.encode())
        click.echo(f"wrote {target}")


@history.command(short_help="Void a result.", epilog="""\b
Examples:
  arview history void 12 --reason "part was not seated"

\b
The result stays in the store with the reason, and `show` and `list --voided` still print it. Lists,
trends, capability and exports leave it out. This cannot be undone.""")  # fmt: skip
@click.argument("result")
@click.option("--reason", required=True, metavar="TEXT", help="Why it does not count.")
@click.option("--by", metavar="NAME", help="Who voids it; default: your user name and this machine.")
@ZONE
@STORE
def void(result: str, reason: str, by: str | None, zone: tzinfo | None, store: str | None) -> None:
    """Void the RESULT with this number, or whose hash begins so."""
    with open_store(store, must_exist=True) as opened:
        _about(opened.void(result, reason, by), zone)


@history.command(short_help="Join the series of two CAD models.", epilog="""\b
Examples:
  arview history same 3fa94c21 9be07d55 --reason "only the logo changed"

\b
`history show` prints the hash of the CAD model; its first digits are enough. The statement stays in the
store with its reason and holds for all parts of both models. This cannot be undone.""")  # fmt: skip
@click.argument("old")
@click.argument("new")
@click.option("--reason", required=True, metavar="TEXT", help="Why their values can be compared.")
@click.option("--by", metavar="NAME", help="Who states it; default: your user name and this machine.")
@STORE
def same(old: str, new: str, reason: str, by: str | None, store: str | None) -> None:
    """State that the CAD models OLD and NEW are revisions of the same part."""
    with open_store(store, must_exist=True) as opened:
        before, after = opened.same(old, new, reason, by)
    click.echo(f"series of {before[:12]} go on in {after[:12]}")


@history.command(short_help="Write results as CSV or JSON lines.", epilog="""\b
Examples:
  arview history export -o plate.csv --part plate
  arview history export -o all.jsonl

\b
.csv has a line for each component of each result; .jsonl has one whole inspection per line.""")  # fmt: skip
@click.option("-o", "--output", required=True, metavar="FILE", help="File to write: .csv or .jsonl.")
@_with_filters
def export(
    output: str, zone: tzinfo | None, part: str | None, serial: str | None, station: str | None, since: str | None,
    store: str | None,
) -> None:  # fmt: skip
    """Write results to a file; its times are UTC."""
    target = output_path(output, [])
    kind = target.suffix.lower()
    if kind not in (".csv", ".jsonl"):
        raise InputError(f"{target}: expected a name that ends with .csv or .jsonl")
    with open_store(store, must_exist=True) as opened:
        found = opened.listed(part, serial, station, since=parse_moment(since, zone))
        content = quality.to_csv(opened, found) if kind == ".csv" else quality.to_json_lines(opened, found)
    write_file(target, content)
    click.echo(f"wrote {target}: {len(found)} results")


@history.command(
    short_help="Check that nothing was changed.",
    epilog="""\b
Examples:
  arview history check
  arview history check --store /data/plate.sqlite

Notes on it: docs/reference/command-notes.md""",
    exit_codes={ExitCode.DONE: "every result is as it was added", ExitCode.FAIL: "a result is damaged"},
)
@STORE
def check(store: str | None) -> None:
    """Check each result against its hash."""
    with open_store(store, must_exist=True) as opened:
        count, faults = opened.check()
    for fault in faults:
        click.echo(fault)
    click.echo(f"{count} results, {len(faults)} damaged")
    if faults:
        click.get_current_context().exit(ExitCode.FAIL)


@history.command(
    "decisions",
    short_help="List what people decided about results.",
    epilog="""\b
Examples:
  arview history decisions --part plate
  arview history decisions --serial PL-0417 -o decisions.csv

\b
`arview history add` copies them from the decisions.jsonl beside an inspection.""",
)
@click.option("-o", "--output", metavar="FILE", help="Write them as CSV.")
@_with_filters
def list_decisions(
    output: str | None, zone: tzinfo | None, part: str | None, serial: str | None, station: str | None,
    since: str | None, store: str | None,
) -> None:  # fmt: skip
    """List the decisions, ticks and signatures about the results."""
    target = None if output is None else output_path(output, [])
    with open_store(store, must_exist=True) as opened:
        found = opened.listed(part, serial, station, since=parse_moment(since, zone))
        decided = opened.decided([one.id for one in found])
    rows = [(one, entry) for one in found for entry in decided.get(one.id, ())]
    if target is None:
        _print_decisions(rows, zone)
        click.echo(f"{len(rows)} entr{'y' if len(rows) == 1 else 'ies'}")
        return
    pieces = [decisions.decisions_csv(decided[one.id], one.part, one.serial) for one in found if one.id in decided]
    head = decisions.decisions_csv(())
    write_file(target, (head + "".join(piece.removeprefix(head) for piece in pieces)).encode("utf-8"))
    click.echo(f"wrote {target}: {len(rows)} entries")


def _print_decisions(rows: Sequence[tuple[quality.StoredResult, decisions.Decision]], zone: tzinfo | None) -> None:
    cells: list[tuple[str, ...]] = []
    for result, one in rows:
        word = decisions.decision_word(one) or one.kind
        if one.step is not None:
            word = f"step {one.step + 1} {'done' if one.is_done else 'not done'}"
        time = f"{one.time.astimezone(zone):%Y-%m-%d %H:%M:%S}"
        text = " ".join("; ".join(part for part in (one.reason, one.note) if part).split())
        cells.append(
            (f"{result.id}.{one.number}", time, result.serial or "-", one.component or "-", word, one.by, text)
        )
    table(("no.", f"decided ({zone_name(zone)})", "serial", "component", "decision", "by", "reason and note"), cells)


def _states(store: quality.HistoryStore, found: Sequence[quality.StoredResult]) -> dict[int, decisions.RecordState]:
    """What people decided about results, for those about which there is something."""
    by_id = {one.id: one for one in found}
    return {number: store.state(by_id[number], entries) for number, entries in store.decided(list(by_id)).items()}


def _decided_word(state: decisions.RecordState | None) -> str:
    if state is None:
        return "-"
    if state.faults:
        return "changed"
    if state.is_released:
        return "released"
    if state.signature is None:
        return "not signed"
    return "void" if state.signature.void else "not released"


def open_store(store: str | None, must_exist: bool = False) -> quality.HistoryStore:
    """The store that was chosen; what it has to say is printed."""
    return quality.HistoryStore(store or quality.default_store(), must_exist, say)


def parse_moment(text: str | None, zone: tzinfo | None) -> datetime | None:
    """The time of --since, which is in the zone unless it states its offset."""
    if text is None:
        return None
    try:
        moment = datetime.fromisoformat(text)
    except ValueError as error:
        raise InputError(f"--since {text!r}: expected a date like 2026-03-01 or 2026-03-01T12:00") from error
    return (moment if moment.tzinfo is not None else moment.replace(tzinfo=zone)).astimezone(UTC)


def zone_name(zone: tzinfo | None) -> str:
    """The name of a zone for people."""
    return str(zone or "local time")


def _about(one: quality.StoredResult, zone: tzinfo | None) -> None:
    name, shape = zone_name(zone), "%Y-%m-%d %H:%M:%S"
    click.echo(f"no. {one.id}, {one_line(f'{one.part} {one.serial}')}, {one.verdict.replace('_', ' ')}")
    measured, added = (f"{moment.astimezone(zone):{shape}} ({name})" for moment in (one.measured, one.added))
    click.echo(f"measured {measured} at {one_line(one.station)} by {one_line(one.tool)}")
    click.echo(f"added    {added}, content {one.content_hash}")
    click.echo(f"CAD      {one.model_hash}")
    if one.void is not None:
        voided = f"{one.void.added.astimezone(zone):{shape}} ({name})"
        click.echo(f"void     {voided} by {one.void.by}: {one.void.reason}")


def _number(value: float | None, sign: str, digits: int = 3) -> str:
    return "?" if value is None else format(value, f"{sign}.{digits}f")


def one_line(text: str) -> str:
    """A text of a file or a user with a space for each line break and control character."""
    return "".join(letter if letter.isprintable() else " " for letter in text)


def table(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> None:
    """Print columns as narrow as their content allows: text to the left, numbers to the right."""
    rows = [tuple(map(one_line, row)) for row in rows]
    widths = [max(len(row[i]) for row in [head, *rows]) for i in range(len(head))]
    is_text = [
        i == 0 or name in ("hash", "serial") or name.startswith(("measured", "decided")) for i, name in enumerate(head)
    ]
    numeric = [
        bool(rows) and not is_text[i] and all(row[i][:1] in "+-?0123456789" for row in rows) for i in range(len(head))
    ]
    for row in [head, *rows]:
        cells = [c.rjust(w) if n else c.ljust(w) for c, w, n in zip(row, widths, numeric, strict=True)]
        click.echo("  ".join(cells).rstrip())
