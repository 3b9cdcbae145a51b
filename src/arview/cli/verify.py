"""The command verify: an acceptance test by known lengths."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import click

from arview.cli.common import main, output_path, say, write_bytes
from arview.cli.exit_codes import ExitCode, exit_code_of

if TYPE_CHECKING:
    from arview.acceptance.conformity import LengthResult, Verification

_SHOWN = 12


@main.command(
    short_help="Acceptance test: known lengths against measured ones.",
    epilog="""\b
Examples:
  arview verify out/inspection.json samples/plate/truth.json --mpe 0.1+L/10000
  arview verify out/inspection.json certificate.toml --mpe 0.05+L/5000 -o verify.json --plot verify.png
  arview verify points.csv lengths.csv --mpe 0.2

\b
MEASURED is an inspection.json (the centres of its components are the marks), the folder it is in, or a
CSV of points with the columns name,x,y,z and optionally U_mm (k = 2, of each coordinate). KNOWN is the
truth.json of a rendered sample (all lengths between its components), a CSV with the columns
from,to,mm,U_mm, or TOML:
  [[length]]
  between = ["post_1", "post_3"]
  mm = 221.268
  U_mm = 0.004        # k = 2, from the certificate; default 0

\b
Following VDI/VDE 2634 part 1, the error of each length, measured minus known, is compared with the
maximum permissible error --mpe (A + L/K, at most B). A length passes when |error| + U of the known length
is within it, fails when |error| - U exceeds it, and is undecided otherwise (ISO 14253-1). The stated U is
confirmed when as many errors are within U as must be expected: by the binomial distribution if no two
lengths share a mark, by simulation otherwise.""",
    exit_codes={
        ExitCode.DONE: "every length passes, and the stated U is confirmed",
        ExitCode.FAIL: "a length fails, or the stated U is too small",
        ExitCode.UNDECIDED: "no length fails, but one is undecided",
    },
)
@click.argument("measured", metavar="MEASURED")
@click.argument("known", metavar="KNOWN")
@click.option("--mpe", metavar="A+L/K[<=B]", help="Maximum permissible error in mm; without it only U is tested.")
@click.option("-o", "--output", metavar="JSON", help="Write all lengths, errors and verdicts.")
@click.option("--plot", metavar="PNG", help="Plot the errors over the length (png, svg, pdf).")
@click.option("--all", "shows_all", is_flag=True, help=f"Print every length, not only the {_SHOWN} worst.")
def verify(measured: str, known: str, mpe: str | None, output: str | None, plot: str | None, shows_all: bool) -> None:
    """Test what was MEASURED against KNOWN lengths: errors, limits, and whether the stated U is confirmed."""
    from arview.acceptance.conformity import parse_limit, record_of
    from arview.acceptance.conformity import verify as run
    from arview.acceptance.lengths import read_known, read_measured

    limit = None if mpe is None else parse_limit(mpe)
    target = None if output is None else output_path(output, [measured, known])
    picture = None if plot is None else output_path(plot, [measured, known, target])
    places = read_measured(measured)
    test = run(places, read_known(known, places), known, limit)
    _print(test, shows_all)
    if target is not None:
        write_bytes(target, (json.dumps(record_of(test), indent=2, ensure_ascii=False) + "\n").encode())
        click.echo(f"wrote {target}")
    if picture is not None:
        from arview.acceptance.plot import draw

        write_bytes(picture, draw(test, picture.suffix.lower().removeprefix(".")))
        click.echo(f"wrote {picture}")
    click.get_current_context().exit(exit_code_of(test.verdict.value))


def _print(test: Verification, shows_all: bool) -> None:
    from arview.acceptance.conformity import FULL_TEST, UncertaintyCheck

    for name, reason in list(test.left_out.items())[:_SHOWN]:
        say(f"left out {name}: {reason}")
    if len(test.left_out) > _SHOWN:
        say(f"left out {len(test.left_out) - _SHOWN} more lengths")
    ranked = sorted(test.lengths, key=lambda one: -abs(one.error_mm) / (one.limit_mm or 1.0))
    shown = list(test.lengths) if shows_all else ranked[:_SHOWN]
    width = max(len(f"{one.known.first} to {one.known.second}") for one in shown)
    click.echo(f"{'length':{width}}{'known':>11}{'measured':>11}{'error':>9}{'U':>8}{'limit':>8}  verdict")
    for one in shown:
        click.echo(_row(one, width))
    if len(shown) < len(test.lengths):
        click.echo(f"… and {len(test.lengths) - len(shown)} with smaller errors (--all shows them)")
    largest = test.largest
    limit = f" of ± {largest.limit_mm:.3f} mm permissible" if largest.limit_mm is not None else ""
    click.echo(
        f"largest error: {largest.error_mm:+.3f} mm{limit} ({largest.known.first} to {largest.known.second},"
        f" {largest.known.mm:.1f} mm), {len(test.lengths)} lengths from {min(o.known.mm for o in test.lengths):.1f} to"
        f" {max(o.known.mm for o in test.lengths):.1f} mm"
    )
    if test.u_held is UncertaintyCheck.NOT_STATED:
        click.echo("U: not stated in the measurement")
    else:
        low, high = test.expected
        why = "simulated, since lengths share marks" if test.is_shared else "binomial"
        click.echo(
            f"U (k = 2) {test.u_held}: {test.within} of {len(test.lengths)} errors are within it, {low} to {high} are"
            f" expected if it is right ({why}); the errors are {test.ratio:.2f} × the stated U"
        )
    if len(test.lengths) < FULL_TEST:
        click.echo(f"note: VDI/VDE 2634 part 1 asks for {FULL_TEST} lengths, five on each of seven lines")
    counts = [f"{sum(one.verdict.value == v for one in test.lengths)} {v}" for v in ("pass", "fail", "undecided")]
    counted = f" ({', '.join(counts)})" if test.limit is not None else " (U alone: no --mpe was given)"
    click.echo(f"verdict: {test.verdict.value}{counted}")


def _row(one: LengthResult, width: int) -> str:
    def cell(value: float | None, size: int) -> str:
        return f"{'' if value is None else format(value, '.3f'):>{size}}"

    return (
        f"{f'{one.known.first} to {one.known.second}':{width}}{one.known.mm:11.3f}{one.measured_mm:11.3f}"
        f"{one.error_mm:+9.3f}{cell(one.uncertainty_mm, 8)}{cell(one.limit_mm, 8)}"
        f"  {one.verdict.value if one.limit_mm is not None else ''}".rstrip()
        + ("  outside U" if one.is_within_u is False else "")
    )
