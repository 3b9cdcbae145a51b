"""The command verify: an acceptance test by known lengths."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING

import click

from arview import acceptance
from arview.cli.common import UNIT, inspection_file, main, output_path, say
from arview.cli.exit_codes import ExitCode, exit_code_of
from arview.core.atomic import write_file
from arview.core.extras import require
from arview.errors import InputError

if TYPE_CHECKING:
    from arview.cad import Model

_SHOWN = 12
_COMPARED = ("dx", "dy", "dz", "distance", "U", "U list", "E_n")


@main.command(
    short_help="Acceptance test: known lengths against measured ones.",
    epilog="""\b
Examples:
  arview verify out/inspection.json samples/plate/truth.json --mpe 0.1+L/10000
  arview verify out/inspection.json certificate.toml --mpe 0.05+L/5000 -o verify.json --plot verify.png
  arview verify points.csv lengths.csv --mpe 0.2
  Notes: docs/reference/command-notes.md""",
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
def verify(
    measured: str,
    known: str,
    mpe: str | None,
    output: str | None,
    plot: str | None,
    shows_all: bool,
) -> None:
    """Test what was MEASURED against KNOWN lengths: errors, limits, and whether the stated U is confirmed."""
    limit = None if mpe is None else acceptance.parse_limit(mpe)
    target = None if output is None else output_path(output, [measured, known])
    picture = None if plot is None else output_path(plot, [measured, known, target])
    if picture is not None:
        require("--plot", "matplotlib")
    if _is_list(measured, known):
        raise InputError(f"{known}: lists places of components, not lengths; use arview compare {known} {measured}")
    places = acceptance.read_measured(measured)
    test = acceptance.verify(places, acceptance.read_known(known, places), known, limit)
    _print(test, shows_all)
    if target is not None:
        write_file(target, (json.dumps(acceptance.record_of(test), indent=2, ensure_ascii=False) + "\n").encode())
        click.echo(f"wrote {target}")
    if picture is not None:
        write_file(picture, acceptance.draw(test, picture.suffix.lower().removeprefix(".")))
        click.echo(f"wrote {picture}")
    click.get_current_context().exit(exit_code_of(test.verdict.value))


@main.command(
    "compare",
    short_help="Compare an inspection with a list measured otherwise, by E_n.",
    epilog="""\b
Examples:
  arview compare cmm.csv out/inspection.json
  arview compare cmm.csv out/ -o compare.json --all
  arview compare cmm.csv

\b
LIST is a CSV of another measurement, such as a coordinate measuring machine's: columns name and x, y, z
(the stated point of the component) or dx, dy, dz (measured minus nominal), in the datum frame, and
optionally U (k = 2) or u (k = 1), in mm; separated by ; or , or tabs, with decimal point or comma.
INSPECTION is an inspection.json or the folder it is in; default: inspection.json in the folder of LIST.
The E_n number (ISO/IEC 17043) of a coordinate is the difference of both over their joint U: up to 1, they
agree. A component has that of its worst coordinate, which is named, with U and U list along it.""",
    exit_codes={
        ExitCode.DONE: "every E_n is at most 1",
        ExitCode.FAIL: "an E_n is above 1",
        ExitCode.UNDECIDED: "no E_n is above 1, but a component was not compared",
    },
)
@click.argument("listed", metavar="LIST")
@click.argument("inspection", metavar="[INSPECTION]", required=False, callback=inspection_file)
@click.option("-o", "--output", metavar="JSON", help="Write all differences and E_n numbers.")
@click.option("--part", "part_path", metavar="PART", help="Part or CAD file, for positions of an old inspection.")
@UNIT
@click.option("--all", "shows_all", is_flag=True, help=f"Print every component, not only the {_SHOWN} largest E_n.")
def compare(
    listed: str, inspection: str | None, output: str | None, part_path: str | None, unit: str | None, shows_all: bool
) -> None:
    """Compare LIST with an inspection, component by component."""
    from arview.cad import load_part

    source = inspection or str(Path(listed).parent / "inspection.json")
    target = None if output is None else output_path(output, [source, listed])
    if not Path(listed).is_file():
        raise InputError(f"{listed}: no such file; give the CSV list of the other measurement")
    if inspection is None and not Path(source).is_file():
        raise InputError(f"{Path(listed).parent}: holds no inspection.json; name the inspection after the list")
    _compare(source, listed, target, None if part_path is None else load_part(part_path, unit).model, shows_all)


def _is_list(measured: str, known: str) -> bool:
    """Whether KNOWN lists components and MEASURED is an inspection to compare them with."""
    source = Path(measured)
    is_inspection = source.is_dir() or source.suffix.lower() == ".json"
    return is_inspection and Path(known).is_file() and acceptance.is_position_list(known)


def _compare(measured: str, known: str, target: Path | None, model: Model | None, shows_all: bool) -> None:
    """Compare an inspection with a list of components, and end with the exit code of the comparison."""
    from arview.inspection import load_inspection

    found = acceptance.compare(load_inspection(measured, model), acceptance.read_position_list(known), known, model)
    _print_left_out(found.left_out)
    width = max(9, *(len(one.name) for one in found.components))
    click.echo(f"{'component':{width}}" + "".join(f"{head:>9}" for head in _COMPARED))
    ranked = sorted(found.components, key=lambda one: -(one.e_n or 0.0))
    for one in found.components if shows_all or len(ranked) <= _SHOWN else ranked[:_SHOWN]:
        cells = [*one.difference_mm, one.distance_mm, one.uncertainty_mm, one.list_uncertainty_mm]
        signs = ("+", "+", "+", "", "", "")
        row = [_cell(value, f"{sign}.3f") for value, sign in zip(cells, signs, strict=True)]
        e_n = f"{_cell(one.e_n, '.2f')} {one.axis}"
        click.echo(f"{one.name:{width}}{''.join(row)}{e_n}{'  differs' if one.agrees is False else ''}")
    if not shows_all and len(ranked) > _SHOWN:
        click.echo(f"… and {len(ranked) - _SHOWN} with smaller E_n (--all shows them)")
    x, y, z = found.common_shift_mm
    click.echo(f"mean difference: {x:+.3f}, {y:+.3f}, {z:+.3f} mm (a common shift points to different datum frames)")
    if any(one.list_uncertainty_mm is None for one in found.components):
        say("note: the list states no U for some coordinates: their E_n takes the inspection's U alone")
    agreeing = sum(bool(one.agrees) for one in found.components)
    missed = f"; {len(found.left_out)} were not compared" if found.left_out else ""
    click.echo(f"E_n ≤ 1 for {agreeing} of {len(found.components)} compared components{missed}")
    if target is not None:
        write_file(
            target, (json.dumps(acceptance.comparison_record(found), indent=2, ensure_ascii=False) + "\n").encode()
        )
        click.echo(f"wrote {target}")
    everything = all(one.agrees is not False for one in found.components)
    code = ExitCode.UNDECIDED if found.left_out else ExitCode.DONE
    click.get_current_context().exit(code if everything else ExitCode.FAIL)


def _cell(value: float | None, kind: str) -> str:
    return f"{'?' if value is None or math.isnan(value) else format(value, kind):>9}"


def _print_left_out(left_out: dict[str, str]) -> None:
    for name, reason in list(left_out.items())[:_SHOWN]:
        say(f"left out {name}: {reason}")
    if len(left_out) > _SHOWN:
        say(f"left out {len(left_out) - _SHOWN} more")


def _print(test: acceptance.Verification, shows_all: bool) -> None:

    _print_left_out(test.left_out)
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
    if test.u_held is acceptance.UncertaintyCheck.NOT_STATED:
        click.echo("U: not stated in the measurement")
    else:
        low, high = test.expected
        why = "simulated, since lengths share marks" if test.is_shared else "binomial"
        click.echo(
            f"U (k = 2) {test.u_held}: {test.within} of {len(test.lengths)} errors are within it, {low} to {high} are"
            f" expected if it is right ({why}); their rms is {test.ratio:.2f} × the"
            " standard uncertainty (1 is expected)"
        )
    if len(test.lengths) < acceptance.FULL_TEST:
        click.echo(f"note: VDI/VDE 2634 part 1 asks for {acceptance.FULL_TEST} lengths, five on each of seven lines")
    counts = [f"{sum(one.verdict.value == v for one in test.lengths)} {v}" for v in ("pass", "fail", "undecided")]
    counted = f" ({', '.join(counts)})" if test.limit is not None else " (U alone: no --mpe was given)"
    click.echo(f"verdict: {test.verdict.value}{counted}")


def _row(one: acceptance.LengthResult, width: int) -> str:
    def cell(value: float | None, size: int) -> str:
        return f"{'' if value is None else format(value, '.3f'):>{size}}"

    return (
        f"{f'{one.known.first} to {one.known.second}':{width}}{one.known.mm:11.3f}{one.measured_mm:11.3f}"
        f"{one.error_mm:+9.3f}{cell(one.uncertainty_mm, 8)}{cell(one.limit_mm, 8)}"
        f"  {one.verdict.value if one.limit_mm is not None else ''}".rstrip()
        + ("  outside U" if one.is_within_u is False else "")
    )
