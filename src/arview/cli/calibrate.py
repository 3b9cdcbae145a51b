"""The commands calibrate …: a board to print, and the camera from photos or a video of it."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import click

from arview import calibration
from arview.cli.common import Group, main, output_path, progress_bar, say
from arview.cli.exit_codes import ExitCode
from arview.core.atomic import write_file
from arview.core.extras import require
from arview.errors import InputError, OutputError

if TYPE_CHECKING:
    pass


class _WithDefault(Group):
    """A group with the default command ``lens``: ``arview calibrate PHOTOS …``."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        if args and args[0] not in self.commands and args[0] not in ("-h", "--help"):
            args = ["lens", *args]
        return super().parse_args(ctx, args)


@main.group(
    cls=_WithDefault,
    short_help="Calibrate a camera from pictures of a board.",
    epilog="""\b
Examples:
  arview calibrate board -o board.pdf
  arview calibrate photos/ --board charuco:11x8:21:16:DICT_5X5_100 -o camera.json
  arview calibrate clip.mp4 --board charuco:11x8:21:16:DICT_5X5_100 -o camera.json --plot camera.png --profile

\b
1. Print the board in actual size and glue it onto something flat.
2. Take 20 to 40 photos of it, or a slow video of about a minute, in the mode and with the zoom that
   will be used, with locked focus: tilted by 30° to 45° to all sides, from near and far, and reaching
   every corner of the picture.
3. Run `arview calibrate PHOTOS`, which is short for `arview calibrate lens PHOTOS`; the options are
   listed by `arview calibrate lens --help`.""",
)
def calibrate() -> None:
    """Calibrate a camera: print a board, photograph it, and get the camera with its uncertainty."""


@calibrate.command(
    short_help="Make a ChArUco board to print: PDF in true scale.",
    epilog="""\b
Examples:
  arview calibrate board -o board.pdf
  arview calibrate board -o board.pdf --paper A3
  arview calibrate board -o board.pdf --paper 600x400 --squares 14x9
  arview calibrate board -o board.pdf --board charuco:9x6:25:18:DICT_4X4_50

\b
Without --board the squares are as large as the paper allows. Print at 100 % ("actual size"); two
rulers on the page show whether the printer kept the scale. The page also states what to give to
`arview calibrate --board`.""",
)
@click.option("-o", "--output", required=True, metavar="PDF", help="File to write.")
@click.option(
    "--paper",
    default="A4",
    show_default=True,
    metavar="SIZE",
    help="A4 to A0, letter, tabloid (landscape), or WIDTHxHEIGHT in mm.",
)
@click.option("--squares", metavar="COLUMNSxROWS", help="Number of squares.  [default: 11x8]")
@click.option("--board", "board_spec", metavar="SPEC", help="charuco:COLUMNSxROWS:SQUARE_MM:MARKER_MM:DICTIONARY.")
def board(output: str, paper: str, squares: str | None, board_spec: str | None) -> None:
    """Write a ChArUco board as a PDF in true scale."""
    from arview.fiducials import board_pdf, fit_board, parse_board, parse_paper, place_board, spec_of

    target = output_path(output, [])
    size = parse_paper(paper)
    if board_spec and squares:
        raise InputError("--board already states the number of squares; leave out --squares")
    one = parse_board(board_spec) if board_spec else fit_board(size, *_parse_squares(squares))
    sheet = place_board(one, size)
    write_file(target, board_pdf(sheet))
    click.echo(
        f"{one}, {sheet.width_mm:g}×{sheet.height_mm:g} mm: print it at 100 %; both rulers must measure"
        f" {sheet.ruler_mm:g} mm"
    )
    click.echo(f"then: arview calibrate PHOTOS --board {spec_of(one)} -o camera.json")
    click.echo(f"wrote {target}")


@calibrate.command(
    name="lens",
    short_help="Calibrate from photos or a video of the board (default).",
    epilog="""\b
Examples:
  arview calibrate photos/ --board charuco:11x8:21:16:DICT_5X5_100 -o camera.json
  arview calibrate clip.mp4 --board charuco:11x8:21:16:DICT_5X5_100 -o camera.json --plot camera.png
  arview calibrate *.heic --board charuco:11x8:21:16:DICT_5X5_100 --profile
  arview calibrate photos/ --board checkerboard:9x6:25 -o camera.json -o ros:info.yaml
  arview calibrate action/ --board charuco:11x8:21:16:DICT_5X5_100 --lens fisheye -o camera.json

\b
Boards without markers (checkerboard, circles, acircles: every second row shifted) count in pictures that
show them whole. The pitch is from centre to centre, of acircles from row to row.

\b
-o may be given several times: .json is arview's own format (with uncertainties, covariance and verdict),
.yaml and .xml OpenCV's, .txt COLMAP's. FORMAT:FILE asks for another one: arview, bop, opencv, opencv-xml,
opencv-json, ros, colmap. The camera describes the sensor's picture: portrait and landscape photos of one
phone give one camera, and the other commands rotate it as they rotate pictures.

\b
--profile stores the calibration under make, model, focal length and picture size, or under the name that
is given, for `--camera profile:NAME` in the other commands, or `--camera profile` where the pictures say
what took them. `arview calibrate profiles` lists them. An insufficient calibration is not written, unless
--anyway is given.""",
    exit_codes={
        ExitCode.DONE: "the calibration is good or usable",
        ExitCode.CANNOT_MEASURE: "the views are not enough for a calibration",
    },
)
@click.argument("sources", nargs=-1, required=True, metavar="PHOTOS...|VIDEO")
@click.option(
    "--board",
    "board_spec",
    required=True,
    metavar="SPEC",
    help="charuco:COLUMNSxROWS:SQUARE_MM:MARKER_MM:DICTIONARY, checkerboard:COLUMNSxROWS:SQUARE_MM (inner corners),"
    " circles:COLUMNSxROWS:PITCH_MM or acircles:COLUMNSxROWS:PITCH_MM.",
)
@click.option("-o", "--output", "outputs", multiple=True, metavar="[FORMAT:]CAMERA", help="Camera file to write.")
@click.option("--profile", is_flag=False, flag_value="", metavar="[NAME]", help="Also store it as a profile.")
@click.option("--plot", metavar="PNG", help="Plot corners, residuals and uncertainty over the picture (png, svg, pdf).")
@click.option(
    "--lens",
    "lens_model",
    type=click.Choice(["brown", "fisheye"]),
    default="brown",
    show_default=True,
    help="Lens model: k1 k2 p1 p2 k3, or OpenCV's fisheye; the report says which fits.",
)
@click.option(
    "--max-views",
    type=click.IntRange(min=5),
    default=40,
    show_default=True,
    metavar="N",
    help="Views to calibrate from; the most informative ones are chosen.",
)
@click.option("--anyway", is_flag=True, help="Write the camera even if the views are not enough.")
def lens(
    sources: tuple[str, ...],
    board_spec: str,
    outputs: tuple[str, ...],
    profile: str | None,
    plot: str | None,
    lens_model: str,
    max_views: int,
    anyway: bool,
) -> None:
    """Calibrate the camera that took PHOTOS (files, folders, globs), or VIDEO, of a board."""
    from arview.camera import format_and_path, holds_distortion, profile_name, profile_path, write_camera
    from arview.fiducials import parse_board

    if not outputs and profile is None:
        raise InputError("nothing to write: give -o camera.json or --profile")
    targets: list[tuple[str, Path]] = []
    for text in outputs:
        kind, name = format_and_path(text)
        targets.append((kind, output_path(name, [*sources, *(other for _, other in targets)])))
    picture = None if plot is None else output_path(plot, [*sources, *(path for _, path in targets)])
    if picture is not None:
        require("--plot", "matplotlib")
    if profile:
        profile_path(profile)
    one = parse_board(board_spec)
    with progress_bar("looking for the board") as progress:
        choice = calibration.ChoiceOptions(
            max_views=max_views, candidates=max(max_views, calibration.ChoiceOptions.candidates)
        )
        result = calibration.calibrate(
            sources, one, choice, progress=progress, lens=calibration.CalibratedLens(lens_model)
        )
    _print(result)
    if picture is not None:
        write_file(picture, calibration.draw(result, picture.suffix.lower().removeprefix(".")))
        click.echo(f"wrote {picture}")
    not_enough = result.verdict.grade.value == "not enough"
    if not_enough and not (anyway and math.isfinite(result.verdict.focal_u)):
        say("no camera was written; follow the advice" + ("" if anyway else ", or write it with --anyway"))
        click.get_current_context().exit(ExitCode.CANNOT_MEASURE)
    extra = calibration.record_of(result)
    if profile is not None:
        kept = profile_path(profile or profile_name(result.lens))
        if not profile and not result.lens.get("model"):
            raise InputError("--profile: the pictures do not say what took them; give --profile NAME")
        try:
            kept.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(f"{kept.parent}: cannot be made ({error.strerror or error})") from error
        targets.append(("arview", kept))
        say(f"use it with --camera profile:{kept.stem}")
    for kind, path in targets:
        if not holds_distortion(kind) and result.camera.is_distorted:
            say(f"warning: {path}: BOP files hold no distortion; use this one with undistorted pictures only")
        write_camera(result.camera, path, kind, extra)
        click.echo(f"wrote {path}")
    if not_enough:
        click.get_current_context().exit(ExitCode.CANNOT_MEASURE)


@calibrate.command(
    short_help="List the stored calibrations.",
    epilog="""\b
Examples:
  arview calibrate profiles""",
)
def profiles() -> None:
    """List the profiles stored by `--profile`, and where they are."""
    from arview.camera import list_profiles, profile_folder

    found = list_profiles()
    for one in found:
        words = [one.lens.get("make"), one.lens.get("model"), f"{one.lens.get('width')}×{one.lens.get('height')}"]
        click.echo(f"{one.name:40} {' '.join(str(word) for word in words if word)}")
    click.echo(f"{len(found)} profile{'' if len(found) == 1 else 's'} in {profile_folder()}")


def _parse_squares(text: str | None) -> tuple[int | None, int | None]:
    if text is None:
        return None, None
    columns, _, rows = text.lower().partition("x")
    if not (columns.isdecimal() and rows.isdecimal() and 3 <= int(columns) <= 60 and 3 <= int(rows) <= 60):
        raise InputError(f"--squares {text!r}: expected COLUMNSxROWS, 3 to 60 each, e.g. 11x8")
    return int(columns), int(rows)


def _print(result: calibration.Calibration) -> None:
    """Print what was seen, the camera with U, the verdict and advice; warnings go to stderr."""
    seen, solution, verdict = result.sightings, result.solution, result.verdict
    for warning in seen.warnings:
        say(f"warning: {warning}")
    reasons: dict[str, list[str]] = {}
    for name, reason in result.rejected.items():
        reasons.setdefault(reason, []).append(name)
    for reason, names in list(reasons.items())[:12]:
        more = f" and {len(names) - 3} more" if len(names) > 3 else ""
        say(f"left out {', '.join(names[:3])}{more}: {reason}")
    if len(reasons) > 12:
        say(f"left out {sum(len(names) for names in list(reasons.values())[12:])} more for other reasons")
    corners = sum(len(view.ids) for view in solution.views)
    click.echo(
        f"board found in {len(seen.views)} of {seen.searched} pictures of {seen.width}×{seen.height} px;"
        f" {len(solution.views)} views with {corners} corners used, residuals {solution.rms_px:.3f} px rms"
    )
    for line in _camera_lines(result):
        click.echo(line)
    least, _, most = verdict.tilts_deg
    click.echo(
        f"coverage: {100 * verdict.coverage:.0f} % of the picture, tilts {least:.0f}° to {most:.0f}°, farthest view"
        f" {verdict.distance_ratio:.1f} × the nearest"
    )
    click.echo(f"verdict: {verdict.grade.value}" + (f": {'; '.join(verdict.reasons)}" if verdict.reasons else ""))
    for advice in verdict.advice:
        click.echo(f"advice: {advice}")


def _camera_lines(result: calibration.Calibration) -> list[str]:

    verdict, solution = result.verdict, result.solution
    cells = [
        f"{name} {value:{form}} ± {2 * std:{form}}"
        for name, value, std, form in zip(
            solution.parameters,
            calibration.intrinsics_of(result.camera),
            solution.std,
            [".2f"] * 4 + [".5f"] * (len(solution.parameters) - 4),
            strict=True,
        )
    ]
    worst = f"{verdict.pixel_u_px[0]:.2f} px in the median, {verdict.pixel_u_px[1]:.2f} px at worst"
    return [
        f"camera: {', '.join(cells[:4])} px (k = 2)",
        f"lens ({calibration.lens_of(result.camera)}): {', '.join(cells[4:])} (k = 2)",
        f"uncertainty (k = 2): focal length {100 * verdict.focal_u:.2f} %, image position of a ray {worst}",
    ]
