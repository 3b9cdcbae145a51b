"""The commands station calibrate, check and run: a cell of fixed cameras."""

from __future__ import annotations

import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from arview import calibration
from arview.cli.common import main, progress_bar, say
from arview.cli.exit_codes import ExitCode, exit_code_of
from arview.core.extras import require_extra
from arview.core.progress import check_stop
from arview.errors import InputError
from arview.station import rig as cell

if TYPE_CHECKING:
    from arview.quality import history
    from arview.station import plant

INLETS = ("mqtt", "opcua", "http")
"""Tables of a station file by which triggers come."""
_GRADES = {"good": ExitCode.DONE, "usable": ExitCode.UNDECIDED, "not enough": ExitCode.FAIL}


@main.group(
    "station",
    short_help="A cell of fixed cameras: calibrate, check, run.",
    epilog="""\b
Examples:
  arview station check --example
  arview station calibrate station.toml --board charuco:12x9:20:15:DICT_5X5_250
  arview station run station.toml""",
)
def station() -> None:
    """A cell of fixed cameras that measures each part within its cycle."""


@station.command(
    "calibrate",
    short_help="Find where the cameras of a cell stand.",
    epilog="""\b
Examples:
  arview station calibrate station.toml --board charuco:12x9:20:15:DICT_5X5_250
  arview station calibrate station.toml --shots 3 --every 10
  Notes: docs/reference/command-notes.md""",
    exit_codes={
        ExitCode.DONE: "good",
        ExitCode.FAIL: "not good enough to measure with",
        ExitCode.UNDECIDED: "usable",
    },
)
@click.argument("path", metavar="STATION")
@click.option("--board", metavar="BOARD", help="Board that is held before the cameras; default: the part is used.")
@click.option(
    "--shots", type=click.IntRange(1, 200), default=10, show_default=True, metavar="N", help="Pictures of each camera."
)
@click.option(
    "--every",
    "interval_s",
    type=click.FloatRange(0),
    default=3.0,
    show_default=True,
    metavar="S",
    help="Seconds from one shot to the next, in which board or part is moved; files are read at once.",
)
def calibrate(path: str, board: str | None, shots: int, interval_s: float) -> None:
    """Find the poses of the cameras of STATION with their U, from a board that several of them see at a time.

    Without a board they are found from the part, which every camera must show.
    """
    from arview.fiducials import parse_board

    setup = cell.read_station(path)
    pattern = None if board is None else parse_board(board)
    lenses = {one.name: one.camera for one in setup.cameras}
    with tempfile.TemporaryDirectory(prefix="arview-rig-") as folder, cell.RigCameras(setup.cameras) as cameras:
        taken: list[dict[str, Path]] = []
        with progress_bar("shots") as progress:
            while len(taken) < shots:
                files, _ = cameras.save(Path(folder) / str(len(taken)))
                if len(files) < 2:
                    break
                taken.append(files)
                progress(len(taken), shots)
                if cameras.is_live and len(taken) < shots:
                    _wait(interval_s)
        if not taken:
            raise InputError(f"{path}: fewer than two cameras give a picture")
        if pattern is not None:
            found = calibration.rig_from_board(taken, lenses, pattern)
        else:
            found = calibration.rig_from_part(taken, lenses, setup.part)
    grade = _print(found)
    found.save(setup.rig_path)
    click.echo(f"wrote {setup.rig_path}")
    click.get_current_context().exit(_GRADES[grade])


@station.command(
    "check",
    short_help="Check a station file, its sources and its rig.",
    epilog="""\b
Examples:
  arview station check station.toml
  arview station check --example""",
    exit_codes={ExitCode.DONE: "good", ExitCode.FAIL: "not good enough to measure with", ExitCode.UNDECIDED: "usable"},
)
@click.argument("path", metavar="[STATION]", required=False)
@click.option("--example", "shows_example", is_flag=True, help="Print a station file with all keys.")
def check(path: str | None, shows_example: bool) -> None:
    """Check STATION before it is used: every key, every source, the cameras' poses with U, and what is sent where."""
    if shows_example:
        click.echo(cell.STATION_FILE_EXAMPLE, nl=False)
        return
    if path is None:
        raise InputError("expected a station file; `arview station check --example` prints one")
    setup = cell.read_station(path)
    settings = _plant_of(setup)
    setup.table.finish()
    click.echo(f"{setup.name}: part {setup.part.name}, {len(setup.cameras)} cameras, cycles in {setup.cycles}")
    if settings is not None:
        outlets = [name for name in (*INLETS, "hooks") if name in setup.table.content]
        click.echo(f"results and triggers by {', '.join(outlets)}")
    if not setup.rig_path.is_file():
        click.echo(f"{setup.rig_path}: not there yet; run `arview station calibrate {path}`")
        click.get_current_context().exit(ExitCode.FAIL)
    click.get_current_context().exit(_GRADES[_print(cell.Cell(setup).rig)])


@station.command(
    "run",
    short_help="Measure a part at each trigger.",
    epilog="""\b
Examples:
  arview station run station.toml
  arview station run station.toml --cycles 1 --serial BP-0042
  arview station run station.toml --cycles 200 --every 20""",
    exit_codes={
        ExitCode.DONE: "the last part passes",
        ExitCode.FAIL: "the last part fails",
        ExitCode.UNDECIDED: "the last part is undecided",
        ExitCode.CANNOT_MEASURE: "the last part was not measured",
        ExitCode.INTERRUPTED: "ended by Ctrl-C",
    },
)
@click.argument("path", metavar="STATION")
@click.option(
    "--cycles",
    type=click.IntRange(1),
    metavar="N",
    help="End after N cycles; where nothing triggers them, they begin at once.",
)
@click.option(
    "--every",
    "interval_s",
    type=click.FloatRange(0),
    metavar="S",
    help="A cycle each S seconds; default: at each press of Enter.",
)
@click.option("--serial", metavar="NUMBER", help="Serial number of the part, with --cycles 1.")
def run(path: str, cycles: int | None, interval_s: float | None, serial: str | None) -> None:
    """Measure one part after another under the cameras of STATION; each cycle has a folder with its files.

    With [mqtt], [opcua] or [http] in the file a trigger from there begins a cycle, and its result goes to all outlets.
    """
    from arview.inspection import overall_verdict

    setup = cell.read_station(path)
    settings = _plant_of(setup)
    setup.table.finish()
    if serial is not None and cycles != 1:
        raise InputError("--serial is of one part: give it with --cycles 1")
    measuring = cell.Cell(setup)
    waits_for_line = interval_s is None and any(name in setup.table.content for name in INLETS)
    verdict, done = "not_measured", 0
    with cell.RigCameras(setup.cameras) as cameras, _line(setup, settings) as line:
        while cycles is None or done < cycles:
            trigger = None
            if waits_for_line and line is not None:
                line.set_state("ready")
                while (trigger := line.next_trigger(0.5)) is None:
                    check_stop()
                line.set_state("busy")
            elif interval_s is None and cycles is None:
                click.prompt("Enter measures the next part", "", show_default=False, prompt_suffix="", err=True)
            elif done:
                _wait(interval_s or 0.0)
            try:
                cycle = measuring.cycle(cameras, serial if trigger is None else trigger.serial or None)
            except InputError as error:
                if done == 0:
                    raise
                say(str(error))
                break
            done += 1
            _tell(setup, line, cycle, trigger)
            verdict = overall_verdict(cycle.inspection).value
            measuring.draw(cycle)
    click.get_current_context().exit(exit_code_of(verdict))


def _plant_of(setup: cell.Station) -> Any:
    """The settings of the outlets of a station file (`plant.read_plant`); None where it has none."""
    if not any(name in setup.table.content for name in (*INLETS, "hooks", "alarms")):
        return None
    require_extra("what a station tells the line", "plant")
    from arview.station import plant

    return plant.read_plant(setup.table)


@contextmanager
def _line(setup: cell.Station, settings: Any) -> Iterator[plant.Plant | None]:
    """The open outlets, and the server for triggers and monitors."""
    if settings is None:
        yield None
        return
    from arview.station import plant

    with plant.Plant(settings, setup.cycles) as line:
        server = None
        if setup.http is not None:
            import uvicorn
            from starlette.applications import Starlette

            address, port, token = setup.http
            app = Starlette(routes=plant.plant_routes(line, token))
            server = uvicorn.Server(uvicorn.Config(app, address, port, log_level="warning", lifespan="off"))
            threading.Thread(target=server.run, name="arview-http", daemon=True).start()
        try:
            yield line
        finally:
            line.set_state("halted")
            if server is not None:
                server.should_exit = True


def _tell(setup: cell.Station, line: plant.Plant | None, cycle: cell.Cycle, trigger: plant.Trigger | None) -> None:
    """Print the result of a cycle, and tell it to the outlets and the store, with the alarms that follow from it."""
    from arview.inspection import verdict_sentence

    seconds = sum(cycle.seconds.values())
    click.echo(f"{cycle.folder.name}: {verdict_sentence(cycle.inspection)} ({seconds:.1f} s)")
    for warning in cycle.inspection.warnings:
        say(warning)
    with _store(setup) as kept:
        if kept is not None:
            kept.add(cycle.folder / "inspection.json", station=setup.name)
        if line is None:
            return
        from arview.station import plant

        line.publish(plant.result_of(cycle.inspection, setup.name, trigger))
        for camera in setup.cameras:
            line.set_alarm("camera_moved", camera.name, cycle.faults.get(camera.name, ""), "error")
        if kept is not None:
            for text in line.check_history(kept, setup.part.name):
                say(text)


@contextmanager
def _store(setup: cell.Station) -> Iterator[history.HistoryStore | None]:
    """The store of the station, if it has one."""
    if not setup.store:
        yield None
        return
    from arview.quality import history

    with history.HistoryStore(setup.store, tell=say) as store:
        yield store


def _print(found: calibration.CameraRig) -> str:
    """Print the cameras with their U, and the verdict; returns the grade."""
    width = max(len(name) for name in found.names)
    for name, (turn_deg, place_mm), left_px, shots in zip(
        found.names, found.uncertainties, found.residuals_px, found.shots, strict=True
    ):
        click.echo(f"{name:{width}}  U {place_mm:.3f} mm, {turn_deg:.4f}°; {left_px:.2f} px in {shots} shots")
    grade, reasons = found.grade
    click.echo(f"{grade.value}: {found.source}")
    for reason in reasons:
        say(reason)
    return grade.value


def _wait(seconds: float) -> None:
    """Wait, but end soon after Ctrl-C."""
    end = time.monotonic() + seconds
    while (left := end - time.monotonic()) > 0:
        check_stop()
        time.sleep(min(left, 0.2))
