"""The commands history chart, grr and serve: statistics of a results store, printed, drawn, or as a page."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import tzinfo
from typing import Any, Literal

import click

from arview.cli.common import output_path, say
from arview.cli.history import (
    PART,
    SINCE,
    STATION,
    STORE,
    ZONE,
    history,
    one_line,
    open_store,
    parse_moment,
    table,
    zone_name,
)
from arview.core.atomic import write_file
from arview.core.extras import require
from arview.errors import ArviewError, InputError
from arview.quality import history as quality

_SHOWN_SIGNALS = 20
_QUANTITIES = ("distance", "dx", "dy", "dz", "tilt", "twist")


def _with_series(command: Callable[..., None]) -> Callable[..., None]:
    """The options of a command about a series."""
    for option in (
        STORE, SINCE, PART, ZONE,
        click.option("--of", "quantity", type=click.Choice(_QUANTITIES), default="distance", show_default=True,
                     help="Quantity of the component."),
        click.option("--characteristic", metavar="NAME", help="Characteristic of the drawing, instead of a component."),
        click.option("--component", metavar="NAME", help="Component of the part."),
    ):  # fmt: skip
        command = option(command)
    return command


def _series(
    store: quality.HistoryStore, asked: dict[str, Any], zone: tzinfo | None, **how: Any
) -> quality.ComponentSeries:
    """The series that the options ask for."""
    component, characteristic = asked["component"], asked["characteristic"]
    if (component is None) == (characteristic is None):
        raise InputError("give --component or --characteristic")
    quantity: Any = asked["quantity"] if characteristic is None else "characteristic"
    since = parse_moment(asked["since"], zone)
    found = quality.series_of(store, component or characteristic, quantity, asked["part"], since=since, **how)
    return replace(found, zone=zone)


@history.command(
    short_help="Trend, control limits, Cp and Cpk of a series.",
    epilog="""\b
Examples:
  arview history chart --component post_1
  arview history chart --part plate --component post_1 --of dx -o post_1_dx.svg
  arview history chart --characteristic "position of hole_1" --subgroup 5 -o hole_1.png

\b
Individuals and moving ranges, or X̄ and R of consecutive subgroups (ISO 7870-2); Nelson's eight rules are
the signals, of which a process in control has a few in a hundred values. Cp and Cpk (ISO 22514-2) are from the
mean range, Pp and Ppk from all values, with 95 % confidence intervals. Values that are not normal
(Shapiro-Wilk, 1 %) are transformed first (Box-Cox); lengths near zero have Ppk alone, by the percentiles of
a distribution of lengths. Each value is judged by the limits that held when it was measured; changes of
limits, CAD model and station are printed and drawn. A serial that was measured again counts once, by its
last measurement; the indices are of the first ones, before any rework. Only results of the newest CAD
model and of those joined with it (`history same`) count.""",
)
@_with_series
@click.option("--lower", type=float, metavar="X", help="Lower limit, instead of the tolerance's.")
@click.option("--upper", type=float, metavar="X", help="Upper limit, instead of the tolerance's.")
@click.option("--subgroup", type=click.IntRange(1, 25), default=1, metavar="N", show_default=True,
              help="Values in a subgroup; 1: individual values.")  # fmt: skip
@click.option("--first", is_flag=True, help="Count the first measurement of a serial, not the last.")
@click.option("--repeats", is_flag=True, help="Count every measurement of a serial.")
@click.option("--revisions", is_flag=True, help="Count results of every CAD model that has the component.")
@click.option("-o", "--output", metavar="FILE", help="Picture to write: .svg, .png or .pdf.")
@STATION
def chart(
    lower: float | None, upper: float | None, subgroup: int, first: bool, repeats: bool, revisions: bool,
    output: str | None, zone: tzinfo | None, store: str | None, station: str | None, **asked: Any,
) -> None:  # fmt: skip
    """Show the trend of a series over the parts, with control limits, Cp and Cpk."""
    if output is not None:
        require("a figure", "matplotlib")
    target = None if output is None else output_path(output, [])
    if target is not None and target.suffix.lstrip(".").lower() not in quality.FORMATS:
        raise InputError(f"{target}: expected a name that ends with {', '.join('.' + one for one in quality.FORMATS)}")
    if first and repeats:
        raise InputError("--first and --repeats exclude each other: give one of them")
    with open_store(store, must_exist=True) as opened:

        def series_of(counted: Literal["last", "first", "all"]) -> quality.ComponentSeries:
            found = _series(opened, asked, zone, counted=counted, station=station, revisions=revisions)
            return found.with_limits(lower, upper)

        series = series_of("first" if first else "all" if repeats else "last")
        again = series.earlier > 0 and not first
        made = series_of("first") if again else series
    for reason in series.left_out:
        say(f"left out: {reason}{' (--revisions counts them)' if 'CAD model' in reason else ''}")
    values = [one.value for one in series.values]
    click.echo(f"{series.part}, {series.component}, {series.quantity} in {series.unit}: {_count(values)}")
    for change in series.changes():
        click.echo(one_line(change.sentence))
    if any(one.bonus for one in series.values):
        click.echo("each part may have its bonus of maximum material beyond the limits; the indices leave it out")
    limits = None
    try:
        limits = quality.control_chart(values, series.is_length, subgroup)
        _print_chart(limits, series)
    except ArviewError as error:
        say(str(error))
    for one, when in ((series, ""), (made, " at their first measurement, of which the indices are"))[: 1 + again]:
        within, counted = one.within
        if counted:
            absent = f"; it is missing on {len(one.missing)}" if one.missing else ""
            click.echo(f"{within} of {counted} within the limits that held for them{when}{absent}")
    ability = None
    found = quality.capability_by_limits(made, subgroup)
    for (low, high), index in found.items():
        _print_capability(index, made, (low, high) if len(found) > 1 else None)
        if isinstance(index, quality.Capability) and (low, high) == (series.lower, series.upper) and not again:
            ability = index
    if target is not None:
        write_file(target, quality.draw(series, limits, ability, target.suffix.lstrip(".").lower()))
        click.echo(f"wrote {target}")


def _print_chart(limits: quality.ControlChart, series: quality.ComponentSeries) -> None:
    of = "moving range" if limits.size == 1 else f"range of {limits.size}"
    click.echo(f"mean {limits.center:+.4f}, control limits {limits.lower:+.4f} to {limits.upper:+.4f}, "
               f"mean {of} {limits.range_center:.4f}")  # fmt: skip
    for index, why in list(limits.signals.items())[-_SHOWN_SIGNALS:]:
        time = one_line(series.time(series.values[(index + 1) * limits.size - 1]))
        click.echo(f"  {time}: {limits.values[index]:+.4f}, {why}")
    if len(limits.signals) > _SHOWN_SIGNALS:
        click.echo(f"  and {len(limits.signals) - _SHOWN_SIGNALS} signals before them")


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
    of = {"normal": "", "Box–Cox": ", by percentiles after a Box–Cox transform"}
    how = of.get(ability.distribution, f", by the percentiles of the {ability.distribution} distribution")
    for name, (value, low, high) in ability.named.items():
        click.echo(f"{lead}{name} {value:.2f} (95 %: {low:.2f} to {high:.2f}){how}")
    for warning in ability.warnings:
        say(f"warning: {lead}{warning}")


def _count(values: Sequence[object]) -> str:
    return f"{len(values)} value{'s' * (len(values) != 1)}"


@history.command(
    short_help="Repeatability and reproducibility of the measurement.",
    epilog="""\b
Examples:
  arview history grr --component post_1 --of dx
  arview history grr --characteristic "position of hole_1" --tolerance 0.4
  arview history grr --component post_1 --serial MASTER-1 --reference 0.212

\b
A crossed study (AIAG MSA-4) from repeated inspections: a part is a serial, an appraiser a station, and each
station must have measured each serial at least twice. By ANOVA, in which an interaction of p > 0.25 is
pooled, and by averages and ranges. %SV is the share of the total variation, %tol six standard deviations
of the tolerance; a distance or zone counts from zero. ndc is the number of distinct categories (5 and more).
With a reference part (--serial) also a type-1 study: Cg and Cgk (1.33 and more), and VDA 5's Q_MS (15 % at
most) and Q_MP (30 % at most) with U (k = 2); the reference part is no part of the crossed study.""",
)
@_with_series
@click.option("--tolerance", type=float, metavar="T", help="Width of the tolerance; default: by the newest limits.")
@click.option("--serial", metavar="SERIAL", help="Serial of a reference part, measured 10 times or more.")
@click.option("--reference", type=float, metavar="X", help="Calibrated value of the reference part.")
@click.option("--calibration", type=float, default=0.0, metavar="U", help="Its expanded uncertainty (k = 2).")
def grr(
    tolerance: float | None, serial: str | None, reference: float | None, calibration: float, zone: tzinfo | None,
    store: str | None, **asked: Any,
) -> None:  # fmt: skip
    """Show what part of the variation is the measurement's, from inspections that were repeated."""
    if (serial is None) != (reference is None):
        raise InputError("--serial and --reference belong together: give both")
    with open_store(store, must_exist=True) as opened:
        series = _series(opened, asked, zone, counted="all")
    if tolerance is None and series.upper is not None and (series.lower is not None or series.is_length):
        tolerance = series.upper - (series.lower or 0.0)
    if tolerance is not None and tolerance <= 0.0:
        raise InputError(f"--tolerance {tolerance:g}: expected a positive width")
    measured, left_out = quality.crossed([one for one in series.values if one.serial != serial])
    studies = quality.study_by_anova(measured), quality.study_by_ranges(measured)
    for reason in left_out:
        say(f"left out: {reason}")
    counts = "{} parts, {} appraisers, {} trials".format(*studies[0].shape)
    click.echo(f"{one_line(series.part)}, {one_line(series.component)}, {series.quantity} in {series.unit}: {counts}")
    for study in studies:
        total = study.rows["total TV"]
        table(
            (f"by {study.method}", "std", "%SV", "%tol"),
            [(name, f"{std:.5f}", f"{100.0 * std / total if total else 0.0:.2f}",
              "-" if tolerance is None else f"{600.0 * std / tolerance:.2f}") for name, std in study.rows.items()],
        )  # fmt: skip
        pooled = "" if study.interaction_p is None else f", interaction p = {study.interaction_p:.3f}"
        click.echo(f"ndc {study.categories}{pooled}")
    first = None
    if serial is not None and reference is not None and tolerance is not None:
        at_reference = [one.value for one in series.values if one.serial == serial]
        first = quality.type_one(at_reference, reference, tolerance)
        bias = f"bias {first.bias:+.5f}, std {first.std:.5f}"
        click.echo(f"type 1: {first.count} values, {bias}, Cg {first.cg:.2f}, Cgk {first.cgk:.2f}")
    for name, expanded in quality.vda5(studies[0], first, calibration).items():
        share = "" if tolerance is None else f", Q_{name} {200.0 * expanded / tolerance:.1f} %"
        click.echo(f"U_{name} {expanded:.5f} (k = 2){share}")
    if tolerance is None:
        say("there is no tolerance: give its width with --tolerance for %tol, Cg and Q")


@history.command(
    short_help="Show trends and failures as a page.",
    epilog="""\b
Examples:
  arview history serve
  arview history serve --store postgresql://qa@db/arview --port 8091 --zone Europe/Berlin

\b
The page reads the store and changes nothing. It has no passwords: by default only this machine sees it, and
behind --host whoever reaches that address does.""",
)
@click.option("--host", default="127.0.0.1", show_default=True, metavar="ADDRESS", help="Address to listen on.")
@click.option("--port", type=click.IntRange(0, 65535), default=8090, show_default=True, help="Port to listen on.")
@ZONE
@STORE
def serve(host: str, port: int, zone: tzinfo | None, store: str | None) -> None:
    """Serve a read-only page with the failures and the trends of the store."""
    require("the page", "starlette", "uvicorn", "jinja2", "matplotlib")
    import uvicorn

    hosts = ("*",) if host in ("0.0.0.0", "::") else (host, "localhost", "127.0.0.1")
    with open_store(store, must_exist=True) as opened:
        click.echo(f"{opened.name}: http://{host}:{port} (Ctrl+C ends it), times in {zone_name(zone)}")
        uvicorn.run(quality.application(opened, zone, hosts), host=host, port=port, log_level="warning")
