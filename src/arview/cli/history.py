"""The commands history …: a store of inspections, and what it says over time."""

from __future__ import annotations

import json
import zoneinfo
from collections.abc import Callable, Sequence
from datetime import UTC, datetime, tzinfo

import click

from arview.cli.common import main, output_path, progress_bar, say
from arview.cli.exit_codes import ExitCode
from arview.core.atomic import write_file
from arview.core.extras import require
from arview.errors import ArviewError, InputError
from arview.quality import decisions
from arview.quality import history as quality

_SHOWN_CHANGES = 8
_QUANTITIES = ("distance", "dx", "dy", "dz", "tilt", "twist")

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


def _parse_zone(ctx: click.Context, parameter: click.Parameter, value: str) -> tzinfo:
    if value.upper() == "UTC":
        return UTC
    try:
        return zoneinfo.ZoneInfo(value)
    except (zoneinfo.ZoneInfoNotFoundError, ValueError, OSError) as error:
        raise click.BadParameter(f"{value!r}: expected a time zone such as Europe/Berlin") from error


ZONE = click.option("--zone", metavar="ZONE", default="UTC", show_default=True, callback=_parse_zone,
                    help="Time zone of the dates, such as Europe/Berlin.")  # fmt: skip


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
  arview history void 12 --reason "part was not seated"
  arview history add out/inspection.json --store postgresql://qa@db/arview

\b
The store only grows: results are added, never changed or deleted; the database itself refuses that. One
that must not count is voided with a reason, and stays visible.
Each result is identified by the SHA-256 of its content, so that adding it again changes nothing. Two
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
    with _open(store) as opened, progress_bar("history") as progress:
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
    limit: int | None, voided: bool, zone: tzinfo, store: str | None,
) -> None:  # fmt: skip
    """List the results in the order in which they were measured."""
    with _open(store, must_exist=True) as opened:
        found = opened.listed(
            part, serial, station, verdict, _moment(since, zone), limit=limit, with_voided=voided
        )  # fmt: skip
        states = _states(opened, found)
    _table(
        ("no.", f"measured ({zone})", "part", "serial", "station", "verdict", "decided", "hash"),
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
@STORE
def show(result: str, output: str | None, store: str | None) -> None:
    """Show the RESULT with this number, or whose hash begins so."""
    target = None if output is None else output_path(output, [])
    with _open(store, must_exist=True) as opened:
        found, document = opened.find(result)
        order = {one["name"]: place for place, one in enumerate(json.loads(document)["components"])}
        rows = sorted(opened.components([found.id]), key=lambda row: order.get(row["name"], 0))
        entries, state = opened.decisions(found.id), _states(opened, [found]).get(found.id)
    _about(found)
    if state is not None:
        click.echo(f"decided  {state.sentence}")
    _table(
        ("component", "dx", "dy", "dz", "distance", "U", "tolerance", "tilt", "verdict"),
        [(row["name"], *(_number(row[key], sign) for key, sign in
                         (("dx_mm", "+"), ("dy_mm", "+"), ("dz_mm", "+"), ("distance_mm", ""), ("uncertainty_mm", ""),
                          ("tolerance_mm", ""))),
          _number(row["tilt_deg"], "", 2), row["finding"] or row["verdict"].replace("_", " ")) for row in rows],
    )  # fmt: skip
    if entries:
        _print_decisions([(found, one) for one in entries], UTC)
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
@STORE
def void(result: str, reason: str, by: str | None, store: str | None) -> None:
    """Void the RESULT with this number, or whose hash begins so."""
    with _open(store, must_exist=True) as opened:
        _about(opened.void(result, reason, by))


@history.command(
    short_help="Trend, control limits, Cp and Cpk of a component.",
    epilog="""\b
Examples:
  arview history chart --component post_1
  arview history chart --part plate --component post_1 --of dx -o post_1_dx.svg
  arview history chart --component nut_2 --of tilt --upper 0.5 -o tilt.png

\b
Individuals and moving ranges (ISO 7870-2): the control limits are 3 standard deviations, estimated from
the mean moving range. A value beyond them, 8 in a row on one side of the mean, or 6 in a row that rise or
fall are signals. Cp and Cpk (ISO 22514-2) come with 95 % confidence intervals. They are called Pp and Ppk
when the process is not in control, refused below 10 values, and given with a warning below 50. Each value
is judged by the limits that held when it was measured: where these changed, the date is printed, and
there are indices for the values of each. A distance has an upper limit only, hence Cpk alone. Distances
near zero are not normally distributed: their index is by the percentiles of a distribution of lengths
that fits, such as Rayleigh's or the folded normal; dx, dy and dz describe a process better. A serial that
was measured again counts once, by its last measurement (--first: its first, --repeats: each); the indices
are of the first ones, before any rework. A part without the component is not within its limits. Only
results of the newest CAD model count, unless --revisions is given.""",
)
@click.option("--component", required=True, metavar="NAME", help="Component to chart.")
@click.option("--of", "quantity", type=click.Choice(_QUANTITIES), default="distance", show_default=True,
              help="Quantity to chart.")  # fmt: skip
@click.option("--lower", type=float, metavar="X", help="Lower limit, instead of the tolerance's.")
@click.option("--upper", type=float, metavar="X", help="Upper limit, instead of the tolerance's.")
@ZONE
@click.option("--first", is_flag=True, help="Count the first measurement of a serial, not the last.")
@click.option("--repeats", is_flag=True, help="Count every measurement of a serial.")
@click.option("--revisions", is_flag=True, help="Count results of every CAD model that has the component.")
@click.option("-o", "--output", metavar="FILE", help="Picture to write: .svg, .png or .pdf.")
@PART
@STATION
@SINCE
@STORE
def chart(
    component: str, quantity: str, lower: float | None, upper: float | None, first: bool, repeats: bool,
    revisions: bool, output: str | None, zone: tzinfo, part: str | None, station: str | None, since: str | None,
    store: str | None,
) -> None:  # fmt: skip
    """Show the trend of a component over the parts, with control limits, Cp and Cpk."""
    if output is not None:
        require("a figure", "matplotlib")
    target = None if output is None else output_path(output, [])
    if target is not None and target.suffix.lstrip(".").lower() not in quality.FORMATS:
        raise InputError(f"{target}: expected a name that ends with {', '.join('.' + one for one in quality.FORMATS)}")
    if first and repeats:
        raise InputError("--first and --repeats exclude each other: give one of them")
    with _open(store, must_exist=True) as opened:

        def series_of(counted: str) -> quality.ComponentSeries:
            moment = _moment(since, zone)
            found = quality.series_of(
                opened, component, quantity, part, station, moment, counted, revisions  # type: ignore[arg-type]
            )  # fmt: skip
            return found.with_limits(lower, upper).in_zone(zone)

        series = series_of("first" if first else "all" if repeats else "last")
        again = series.earlier > 0 and not first
        made = series_of("first") if again else series
    for reason in series.left_out:
        say(f"left out: {reason}{' (--revisions counts them)' if 'CAD model' in reason else ''}")
    values = [one.value for one in series.values]
    click.echo(f"{series.part}, {series.component}, {series.quantity} in {series.unit}: {_count(values)}")
    changes = series.changes()
    for sentence in changes[:_SHOWN_CHANGES]:
        click.echo(_one_line(sentence))
    if len(changes) > _SHOWN_CHANGES:
        click.echo(f"and {len(changes) - _SHOWN_CHANGES} more changes")
    limits = None
    try:
        limits = quality.control_chart(values, series.is_length)
        _print_chart(limits, series)
    except ArviewError as error:
        say(str(error))
    for one, when in ((series, ""), (made, " at their first measurement, of which the indices are"))[: 1 + again]:
        within, counted = one.within
        if counted:
            absent = f"; it is missing on {len(one.missing)}" if one.missing else ""
            click.echo(f"{within} of {counted} within the limits that held for them{when}{absent}")
    ability = None
    found = quality.capability_by_limits(made)
    for (low, high), index in found.items():
        _print_capability(index, made, (low, high) if len(found) > 1 else None)
        if isinstance(index, quality.Capability) and (low, high) == (series.lower, series.upper) and not again:
            ability = index
    if target is not None:
        write_file(target, quality.draw(series, limits, ability, target.suffix.lstrip(".").lower()))
        click.echo(f"wrote {target}")


def _print_chart(limits: quality.ControlChart, series: quality.ComponentSeries) -> None:
    click.echo(f"mean {limits.center:+.4f}, control limits {limits.lower:+.4f} to {limits.upper:+.4f}, "
               f"mean moving range {limits.range_center:.4f}")  # fmt: skip
    for index, why in limits.signals.items():
        one = series.values[index]
        name = _one_line(one.serial) or f"no. {one.result_id}"
        click.echo(f"  {name} ({one.measured:%Y-%m-%d %H:%M}): {one.value:+.4f}, {why}")


def _print_capability(
    ability: quality.Capability | InputError,
    series: quality.ComponentSeries,
    limits: tuple[float | None, float | None] | None,
) -> None:
    """Print the indices of the values with these limits; of all values with None."""
    lead = ""
    if limits is not None:
        values = series.by_limits()[limits]
        lead = f"limits {quality.limits_text(values[0])}, {_count(values)}: "
    if isinstance(ability, InputError):
        say(f"{lead}{ability}")
        return
    name_cp, name_cpk = ability.names
    if ability.cp is not None and ability.cp_interval is not None:
        low, high = ability.cp_interval
        click.echo(f"{lead}{name_cp} {ability.cp:.2f} (95 %: {low:.2f} to {high:.2f})")
    low, high = ability.cpk_interval
    of = "" if ability.distribution == "normal" else f", by the percentiles of the {ability.distribution} distribution"
    click.echo(f"{lead}{name_cpk} {ability.cpk:.2f} (95 %: {low:.2f} to {high:.2f}){of}")
    for warning in ability.warnings:
        say(f"warning: {lead}{warning}")


def _count(values: Sequence[object]) -> str:
    return f"{len(values)} value{'s' * (len(values) != 1)}"


@history.command(short_help="Write results as CSV or JSON lines.", epilog="""\b
Examples:
  arview history export -o plate.csv --part plate
  arview history export -o all.jsonl

\b
.csv has a line for each component of each result; .jsonl has one whole inspection per line.""")  # fmt: skip
@click.option("-o", "--output", required=True, metavar="FILE", help="File to write: .csv or .jsonl.")
@_with_filters
def export(
    output: str, zone: tzinfo, part: str | None, serial: str | None, station: str | None, since: str | None,
    store: str | None,
) -> None:  # fmt: skip
    """Write results to a file; its times are UTC."""
    target = output_path(output, [])
    kind = target.suffix.lower()
    if kind not in (".csv", ".jsonl"):
        raise InputError(f"{target}: expected a name that ends with .csv or .jsonl")
    with _open(store, must_exist=True) as opened:
        found = opened.listed(part, serial, station, since=_moment(since, zone))
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
    with _open(store, must_exist=True) as opened:
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
    output: str | None, zone: tzinfo, part: str | None, serial: str | None, station: str | None, since: str | None,
    store: str | None,
) -> None:  # fmt: skip
    """List the decisions, ticks and signatures about the results."""
    target = None if output is None else output_path(output, [])
    with _open(store, must_exist=True) as opened:
        found = opened.listed(part, serial, station, since=_moment(since, zone))
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


def _print_decisions(rows: Sequence[tuple[quality.StoredResult, decisions.Decision]], zone: tzinfo) -> None:
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
    _table(("no.", f"decided ({zone})", "serial", "component", "decision", "by", "reason and note"), cells)


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


def _open(store: str | None, must_exist: bool = False) -> quality.HistoryStore:
    return quality.HistoryStore(store or quality.default_store(), must_exist, say)


def _moment(text: str | None, zone: tzinfo) -> datetime | None:
    """The time of --since, which is in the zone unless it states its offset."""
    if text is None:
        return None
    try:
        moment = datetime.fromisoformat(text)
    except ValueError as error:
        raise InputError(f"--since {text!r}: expected a date like 2026-03-01 or 2026-03-01T12:00") from error
    return moment if moment.tzinfo is not None else moment.replace(tzinfo=zone)


def _about(one: quality.StoredResult) -> None:
    click.echo(f"no. {one.id}, {_one_line(f'{one.part} {one.serial}')}, {one.verdict.replace('_', ' ')}")
    click.echo(f"measured {one.measured:%Y-%m-%d %H:%M:%S} UTC at {_one_line(one.station)} by {_one_line(one.tool)}")
    click.echo(f"added    {one.added:%Y-%m-%d %H:%M:%S} UTC, content {one.content_hash}")
    click.echo(f"CAD      {one.model_hash}")
    if one.void is not None:
        click.echo(f"void     {one.void.added:%Y-%m-%d %H:%M:%S} UTC by {one.void.by}: {one.void.reason}")


def _number(value: float | None, sign: str, digits: int = 3) -> str:
    return "?" if value is None else format(value, f"{sign}.{digits}f")


def _one_line(text: str) -> str:
    """A text of a file or a user with a space for each line break and control character."""
    return "".join(letter if letter.isprintable() else " " for letter in text)


def _table(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> None:
    """Print columns as narrow as their content allows: text to the left, numbers to the right."""
    rows = [tuple(map(_one_line, row)) for row in rows]
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
