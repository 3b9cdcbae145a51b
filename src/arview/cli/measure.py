"""The command measure: reconstruction → displacement, uncertainty and verdict of every component."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import click

from arview import measurement
from arview.cli.common import UNIT, main, output_path, say, stage_bar
from arview.cli.exit_codes import ExitCode, exit_code_of
from arview.errors import InputError

if TYPE_CHECKING:
    from arview.inspection import ComponentDeviation, Inspection

METHODS = ("sweep", "edges", "cloud")


def _parse_methods(ctx: click.Context, parameter: click.Parameter, value: str) -> tuple[measurement.Method, ...]:
    names = [name.strip() for name in value.split(",") if name.strip()]
    chosen = tuple(name for name in METHODS if name in names)
    if not chosen or any(name not in METHODS for name in names):
        raise click.BadParameter(f"{value!r}: expected some of {','.join(METHODS)}")
    return chosen  # type: ignore[return-value]


@main.command(
    short_help="Measure where components stand, with uncertainty and verdict.",
    epilog="""\b
Examples:
  arview measure out/ --part part.toml
  arview measure out/ --part part.toml -o inspection.json --tolerance 0.5
  arview measure out/ --part plate.step --photos photos/ --methods edges --guard 0
  arview measure --cloud scan.ply --part part.toml
  arview measure --cloud scan.csv --cloud-unit m --rescale --part part.toml
  Notes: docs/reference/command-notes.md""",
    exit_codes={
        ExitCode.DONE: "every component passes or has no tolerance, and there is no foreign object",
        ExitCode.FAIL: "a component fails or is missing",
        ExitCode.UNDECIDED: "none fails, but one is undecided or was not measured, or there is a foreign object",
        ExitCode.CANNOT_MEASURE: "no component could be measured",
    },
)
@click.argument("folder", metavar="[OUT]", required=False)
@click.option(
    "--cloud",
    "cloud_path",
    metavar="FILE",
    help="Measure a cloud instead: PLY, PCD, XYZ, PTS, PTX, CSV, LAS, E57, STL, OBJ.",
)
@click.option("--cloud-unit", metavar="UNIT", help="Unit of the cloud: mm, cm, m, inch, ft, um; default: by its size.")
@click.option(
    "--rescale", is_flag=True, help="Divide the cloud by the factor by which it is larger than the CAD's base."
)
@click.option("--part", "part_path", required=True, metavar="PART", help="Part file or CAD file.")
@click.option("-o", "--output", metavar="INSPECTION", help="File to write; default: inspection.json in OUT.")
@click.option("--photos", metavar="FOLDER", help="Folder of the photos, if they were moved.")
@click.option(
    "--tolerance",
    type=click.FloatRange(min=0, min_open=True),
    metavar="MM",
    help="Tolerance of components that have none in the part file.",
)
@click.option(
    "--guard",
    type=click.FloatRange(0, 3),
    default=1.0,
    show_default=True,
    metavar="G",
    help="Guard band as a multiple of U.",
)
@click.option(
    "--methods",
    callback=_parse_methods,
    default=",".join(METHODS),
    show_default=True,
    metavar="LIST",
    help="Measuring methods, separated by commas.",
)
@click.option("--correct-bias", is_flag=True, help="Correct distances for the bias that noise gives small ones.")
@click.option("--no-monte-carlo", is_flag=True, help="Combine uncertainties by root sum of squares only.")
@click.option("--no-maps", is_flag=True, help="Do not write the pictures and the PLY of the distance map.")
@click.option(
    "--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Seed of the Monte Carlo simulation."
)
@click.option("--anyway", is_flag=True, help="Measure even if the reconstruction contradicts the CAD's shape.")
@UNIT
def measure(
    folder: str | None,
    cloud_path: str | None,
    cloud_unit: str | None,
    rescale: bool,
    part_path: str,
    output: str | None,
    photos: str | None,
    tolerance: float | None,
    guard: float,
    methods: tuple[measurement.Method, ...],
    correct_bias: bool,
    no_monte_carlo: bool,
    no_maps: bool,
    seed: int,
    anyway: bool,
    unit: str | None,
) -> None:
    """Measure the displacement of each component of PART in the reconstruction OUT, or in a cloud."""
    from arview.cad import load_part
    from arview.inspection import overall_verdict, save_inspection

    if (folder is None) == (cloud_path is None):
        raise InputError("give either OUT, the folder of `arview reconstruct`, or --cloud FILE")
    if cloud_path is None and (cloud_unit is not None or rescale):
        raise InputError("--cloud-unit and --rescale are for the file given with --cloud")
    place = Path(folder) if folder is not None else Path(cloud_path or "").parent
    target = output_path(output or str(place / "inspection.json"), [part_path])
    part = load_part(part_path, unit)
    options = measurement.MeasureOptions(
        methods=methods,
        tolerance_mm=tolerance,
        corrects_bias=correct_bias,
        uses_inconsistent=anyway,
        maps_folder=None if no_maps else target.parent / f"{target.stem}_distances",
        uncertainty=measurement.UncertaintyOptions(monte_carlo=not no_monte_carlo, seed=seed),
        decision=measurement.DecisionOptions(guard),
    )
    if folder is None:
        reconstruction = measurement.read_cloud(cloud_path or "", part.model, cloud_unit, rescale)
    else:
        reconstruction = measurement.read_folder(folder, photos, "cloud" in methods)
    try:
        with stage_bar() as progress:
            inspection = measurement.measure(reconstruction, part, options, progress=progress)
    except InputError as error:
        if cloud_path is None or not str(error).startswith("cloud: "):
            raise
        raise InputError(f"{cloud_path}: {str(error).removeprefix('cloud: ')}") from error
    save_inspection(inspection, target)
    _print(inspection, target)
    click.get_current_context().exit(exit_code_of(overall_verdict(inspection).value))


def _print(inspection: Inspection, target: Path) -> None:
    """Print datums, a line for each component, and a summary; warnings go to stderr."""
    from arview.inspection import verdict_sentence

    for warning in inspection.warnings:
        say(f"warning: {warning}")
    system = inspection.datum_system
    if system is not None:
        for datum in system.datums:
            radius = "" if datum.radius_mm is None else f", radius {datum.radius_mm:+.3f} mm"
            count = "best fit" if datum.feature == "fit" else f"{datum.used} of {datum.of} points"
            click.echo(
                f"datum {datum.label} ({datum.feature} of {datum.component}) locks {datum.locked}: {count}, residual "
                f"{datum.residual_mm:.3f} mm{radius}"
            )
        for note in system.notes:
            click.echo(f"datums: {note}")
    print_components(inspection)
    for component in inspection.components:
        for note in component.details.notes if component.details else ():
            say(f"{component.name}: {note}")
    for one in inspection.foreign_objects:
        click.echo(one.text)
    if inspection.distance_map is not None:
        whole = inspection.distance_map.statistics[0]
        click.echo(
            f"distances of the cloud to the CAD: {whole.count} points, mean {whole.mean_mm:+.3f}, sigma "
            f"{whole.sigma_mm:.3f}, FWHM {whole.fwhm_mm:.3f} mm"
        )
    missing = [c.name for c in inspection.components if c.finding is not None]
    click.echo(verdict_sentence(inspection) + (f"; missing: {', '.join(missing)}" if missing else ""))
    click.echo(f"wrote {target}")
    if inspection.distance_map is not None and inspection.distance_map.files:
        cloud, *pictures = inspection.distance_map.files
        click.echo(f"wrote {target.parent / cloud} and {len(pictures)} pictures")


def print_components(inspection: Inspection) -> None:
    """Print a line for each component."""
    width = max(len(component.name) for component in inspection.components)
    head = ("dx", "dy", "dz", "distance", "U", "tilt")
    click.echo(
        f"{'component':{width}}" + "".join(f"{title:>9}" for title in head) + "  verdict       largest term of U"
    )
    for component in inspection.components:
        click.echo(f"{component.name:{width}}{_row(component)}")
    for one in inspection.characteristics:
        u = "" if one.uncertainty_mm is None else f", U {one.uncertainty_mm:.3f}"
        text = f"{one.name}: {one.value_text} of {one.allowed_text} mm{u}, {one.verdict.value.replace('_', ' ')}"
        click.echo(f"{text}: {one.reason}" if one.reason else text)


def _row(component: ComponentDeviation) -> str:
    """Numbers in mm and degrees with the decimals that U allows; ``?`` means undetermined."""
    from arview.inspection import decimals_beside_limit, decimals_of

    decimals = decimals_of(component.uncertainty_mm)
    of_distance = decimals_beside_limit(component.distance_mm or 0.0, component.uncertainty_mm, component.tolerance_mm)
    formats = [f"+.{decimals}f"] * 3 + [f".{of_distance}f", f".{decimals}f"]
    values = [*component.displacement_mm, component.distance_mm, component.uncertainty_mm]
    cells = [f"{'?' if v is None else format(v, kind):>9}" for v, kind in zip(values, formats, strict=True)]
    tilt = component.tilt_deg
    cells.append(f"{'?' if tilt is None or math.isnan(tilt) else format(tilt, '.2f') + '°':>9}")
    verdict = "missing" if component.finding is not None else component.verdict.value.replace("_", " ")
    details = component.details
    budget = details.budget if details is not None else ()
    largest = f"{budget[0].name} {budget[0].std_mm:.3f}" if budget else ""
    return "".join(cells) + f"  {verdict:<13} {largest}".rstrip()
