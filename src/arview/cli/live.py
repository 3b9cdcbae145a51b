"""The command live: the overlay, served to phones and screens."""

from __future__ import annotations

import gc
import logging
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from arview import guideviews
from arview.cli.batch import RESOURCES, SCHEDULER
from arview.cli.common import (
    RENDERER,
    UNIT,
    check_profile,
    inspection_file,
    main,
    output_path,
    progress_bar,
    refuse_for_several,
    say,
)
from arview.cli.exit_codes import ExitCode
from arview.core.extras import require, require_extra
from arview.errors import InputError, MissingDependencyError
from arview.station import live as station

if TYPE_CHECKING:
    pass

CLUSTER_JOBS = 16
"""Inspections that are given to a cluster at once; it puts them in order by itself."""
STOP_DEADLINE_S = 4.6
"""Time from a signal to the end of the program, whatever its workers do."""
_AGES_S = {"min": 60.0, "h": 3600.0, "d": 86400.0}


def _parse_age(ctx: click.Context, parameter: click.Parameter, value: str) -> float | None:
    """Seconds of an age like 8h, 3d or 90min; None for never."""
    if value == "never":
        return None
    for unit, length_s in _AGES_S.items():
        if value.endswith(unit):
            try:
                age_s = float(value.removesuffix(unit)) * length_s
            except ValueError:
                break
            if 0 < age_s < float("inf"):
                return age_s
    raise click.BadParameter(f"{value!r}: expected an age like 8h, 3d or 90min, or never")


def _parse_size(ctx: click.Context, parameter: click.Parameter, value: str) -> tuple[int, int]:
    """Width and height of 640x480."""
    width, _, height = value.lower().partition("x")
    if not (width.isdecimal() and height.isdecimal()):
        raise click.BadParameter(f"{value!r}: expected a size like 1280x720")
    return int(width), int(height)


def _keep_device_option(ctx: click.Context, parameter: click.Parameter, value: bool | tuple[str, ...]) -> None:
    """Keep the value of --devices or --revoke; with the second of them, forget and list as asked, and exit."""
    if ctx.resilient_parsing:
        return
    asked = ctx.meta.setdefault("arview.devices", {})
    asked[parameter.name] = value
    if len(asked) == 2 and any(asked.values()):
        _revoke_devices(asked["revoke"])
        if asked["devices"]:
            _list_devices()
        ctx.exit(0)


def _list_devices() -> None:
    """Print the paired devices."""
    devices = station.read_devices(station.devices_path())
    width = max((len(one.name) for one in devices), default=0)
    for one in sorted(devices, key=lambda one: one.last_used, reverse=True):
        click.echo(f"{one.name:{width}}  paired {one.created:%Y-%m-%d}  last used {one.last_used:%Y-%m-%d %H:%M} UTC")
    if not devices:
        say("no device is paired")


def _revoke_devices(names: tuple[str, ...]) -> None:
    """Forget paired devices. Raises InputError for a name that none has."""
    devices = station.Devices(station.devices_path())
    for name in dict.fromkeys(names):
        if not devices.revoke(name):
            known = ", ".join(one.name for one in devices.listed()) or "none"
            raise InputError(f"--revoke {name}: there is no device of that name; paired are: {known}")
        say(f"{name} is no longer paired")


def _job_options(
    folder: str, archive_days: float | None, scheduler: str | None, resources: dict[str, float]
) -> station.JobOptions:
    """Options of the inspections; a cluster gets more of them at once than this machine."""
    at_once = CLUSTER_JOBS if scheduler else 1
    return station.JobOptions(
        folder=Path(folder), archive_days=archive_days, workers=at_once, scheduler=scheduler, resources=resources
    )


@main.command(
    short_help="Show the overlay live on a phone or screen.",
    epilog="""\b
Examples:
  arview live --part part.toml --inspection inspection.json
  arview live --part part.toml --source rtsp://camera.local/1 --camera station.json
  arview live --part part.toml --source clip.mp4 --camera camera.json --http
  arview live --part part.toml --scheduler tcp://cluster.local:8786 --resources GPU=1""",
    exit_codes={ExitCode.INTERRUPTED: "ended by Ctrl-C; files are finished"},
)
@click.option(
    "--part",
    "part_paths",
    required=True,
    multiple=True,
    metavar="PART",
    help="Part file or CAD file; again for further parts.",
)
@click.option("--instances", type=click.IntRange(1, 16), default=1, metavar="N", help="Specimens of each part in view.")
@click.option("--guideviews", "views_path", metavar="SET", help="Guide views; default: rendered and cached.")
@click.option(
    "--inspection",
    "inspection_paths",
    multiple=True,
    callback=inspection_file,
    metavar="JOB",
    help="Job folder or inspection.json; again for others.",
)
@click.option("--source", default="phone", show_default=True, metavar="SOURCE", help="Camera or video to show.")
@click.option("--camera", "camera_spec", metavar="CAMERA", help="Camera file or fov:DEG.")
@click.option("--photo-camera", metavar="CAMERA", help="Camera of the full-size photos of phones.")
@click.option("--save-profile", "profile", metavar="NAME", help="Keep the estimated camera as a profile.")
@click.option("--init", metavar="guide:NAME", help="Align the part with an outline first, as in annotate.")
@click.option("--host", metavar="ADDRESS", help="Address to listen at; default: in the local network.")
@click.option(
    "--port",
    type=click.IntRange(0, 65534),
    default=8443,
    show_default=True,
    help="Port of the pages.",
)
@click.option("--http", "is_plain", is_flag=True, help="Plain HTTP for a browser on this machine.")
@click.option("--cert", metavar="PEM", type=click.Path(path_type=Path), help="Your own certificate chain.")
@click.option("--key", metavar="PEM", type=click.Path(path_type=Path), help="Key of that certificate.")
@click.option(
    "--clients",
    type=click.IntRange(1, 64),
    metavar="N",
    help="Most pages at once; default: 2 phones or 8 viewers.",
)
@click.option("--record", metavar="OUT.mp4", help="Record from the start.")
@click.option(
    "--quota",
    type=click.FloatRange(0, min_open=True),
    default=20.0,
    show_default=True,
    metavar="GB",
    help="Largest size of all recordings.",
)
@click.option("--serial", metavar="TEXT", help="Serial number of the part in view.")
@click.option(
    "--max-age",
    callback=_parse_age,
    default="24h",
    show_default=True,
    metavar="AGE",
    help="Age at which an inspection is old, or never.",
)
@click.option(
    "--jobs",
    "jobs",
    metavar="FOLDER",
    type=click.Path(file_okay=False),
    default="arview_jobs",
    show_default=True,
    help="Folder of the inspections.",
)
@click.option(
    "--archive",
    type=click.FloatRange(min=0),
    metavar="DAYS",
    help="Put signed jobs DAYS old into FOLDER/archive.",
)
@SCHEDULER
@RESOURCES
@click.option(
    "--devices",
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=_keep_device_option,
    help="List the paired phones and screens, and exit.",
)
@click.option(
    "--revoke",
    metavar="NAME",
    multiple=True,
    is_eager=True,
    expose_value=False,
    callback=_keep_device_option,
    help="Forget a paired device, and exit.",
)
@click.option(
    "--size",
    callback=_parse_size,
    default="1280x720",
    show_default=True,
    metavar="WxH",
    help="Size of the phone's pictures in landscape.",
)
@click.option("--fps", type=float, default=30.0, show_default=True, help="Frame rate of the phone's pictures.")
@RENDERER
@UNIT
@click.pass_context
def live(
    ctx: click.Context,
    part_paths: tuple[str, ...],
    instances: int,
    views_path: str | None,
    inspection_paths: tuple[str, ...],
    source: str,
    camera_spec: str | None,
    photo_camera: str | None,
    profile: str | None,
    init: str | None,
    host: str | None,
    port: int,
    is_plain: bool,
    cert: Path | None,
    key: Path | None,
    clients: int | None,
    record: str | None,
    quota: float,
    serial: str | None,
    max_age: float | None,
    jobs: str,
    archive: float | None,
    scheduler: str | None,
    resources: dict[str, float],
    size: tuple[int, int],
    fps: float,
    renderer: str,
    unit: str | None,
) -> None:
    """Serve the overlay of PARTs to phones and screens; notes: docs/reference/command-notes.md."""
    import asyncio

    require_extra("arview live", "station")
    check_profile(profile, camera_spec)
    _check_inputs(part_paths, source)
    if instances * len(part_paths) > 1:
        refuse_for_several({"--init": init, "--guideviews": views_path, "--serial": serial, "--save-profile": profile})
    if init is not None and not init.startswith("guide:"):
        raise InputError(f"--init {init}: expected guide:NAME")
    if (cert is None) != (key is None):
        raise InputError("--cert and --key belong together; give both or none")
    inputs = [*part_paths, views_path, *inspection_paths, camera_spec, source]
    video = _record_path(record, inputs) if record else None
    options = station.LiveOptions(
        source=source,
        camera=camera_spec,
        photo_camera=photo_camera,
        profile=profile,
        devices=station.devices_path(),
        inspections=tuple(Path(path) for path in inspection_paths),
        serial=serial,
        max_age_s=max_age,
        guide=init.removeprefix("guide:") if init else None,
        record=video,
        record_folder=video.parent if video else Path(),
        recording=station.RecordingOptions(quota_bytes=round(1e9 * quota)),
        jobs=_job_options(jobs, archive, scheduler, resources),
        width=size[0],
        height=size[1],
        fps=fps,
        clients=clients,
    )
    _tell_logs()
    server = station.LiveServer(options, station.open_endpoint(host, port, is_plain, cert, key))

    drawing = guideviews.GuideViewOptions(renderer=renderer)

    def load() -> station.Subjects:
        with progress_bar("guide views") as progress:
            return station.load_subjects(part_paths, unit, views_path, options, drawing, progress, instances)

    with _stopped_by_signals(server):
        asyncio.run(_serve(server, load))
    say("ended; files are finished")
    _leave_threads()
    ctx.exit(ExitCode.INTERRUPTED)


def _check_inputs(part_paths: tuple[str, ...], source: str) -> None:
    """Check that the parts and the source are there, before anything takes time. Raises InputError."""
    from arview.cad import find_part_file
    from arview.video import check_source

    for path in part_paths:
        find_part_file(path)
    if source != "phone":
        check_source(source)


def _record_path(record: str, inputs: list[Any]) -> Path:
    """Path of the video to record; neither it nor its poses may be one of the inputs. Raises InputError."""
    path = output_path(record, inputs)
    if path.suffix.lower() not in (".mp4", ".m4v", ".mov"):
        raise InputError(f"--record {record}: the name of the video must end in .mp4, .m4v or .mov")
    output_path(str(path.with_suffix(".jsonl")), inputs)
    return path


@contextmanager
def _stopped_by_signals(server: station.LiveServer) -> Iterator[None]:
    """Stop the server at the first SIGINT or SIGTERM: in good order, or anyway when it takes too long.

    A thread of its own waits for the signal (`signal.set_wakeup_fd`), so that neither a blocked event loop nor a stuck
    worker can delay it. A second signal ends at once.
    """
    reading, writing = os.pipe()
    os.set_blocking(writing, False)

    def wait() -> None:
        if not os.read(reading, 1) or is_over.is_set():
            return
        server.stop()
        if is_over.wait(STOP_DEADLINE_S):
            return
        say("ended, but a worker did not come back: a recording may be incomplete")
        sys.stdout.flush()
        os._exit(ExitCode.INTERRUPTED)

    def again(number: int, frame: object) -> None:
        """The first signal leaves the second one to the system."""
        signal.signal(number, signal.SIG_DFL)

    is_over = threading.Event()
    before = {number: signal.signal(number, again) for number in (signal.SIGINT, signal.SIGTERM)}
    woken = signal.set_wakeup_fd(writing, warn_on_full_buffer=False)
    threading.Thread(target=wait, name="signals", daemon=True).start()
    try:
        yield
    finally:
        is_over.set()
        signal.set_wakeup_fd(woken)
        os.write(writing, b"\0")
        for number, handler in before.items():
            signal.signal(number, handler)


def _leave_threads() -> None:
    """End the program at once when a thread is still searching or compiling: its result is no longer needed."""
    if any(thread.name.startswith("arview-") and thread.is_alive() for thread in threading.enumerate()):
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(ExitCode.INTERRUPTED)


async def _serve(server: station.LiveServer, load: Callable[[], station.Subjects]) -> None:

    def ready(hub: station.Hub) -> None:
        gc.collect()
        gc.freeze()  # what is loaded stays: the collector need not visit it again while phones wait
        _print_welcome(server)
        if hub.subjects is not None:
            for notice in hub.subjects.notices():
                say(f"{notice.level}: {notice.text}")
            station.warm_up(hub.subjects)

    await server.serve(load, ready)


def _print_welcome(server: station.LiveServer) -> None:
    try:
        require("an inspection started on the page", "pycolmap", "jinja2", "markupsafe", "matplotlib")
    except MissingDependencyError as error:
        say(f"warning: {error}")
    endpoint = server.endpoint
    certificates = endpoint.certificates
    click.echo(f"page:  {server.link}")
    if endpoint.trust_link is not None and certificates is not None and certificates.authority_der is not None:
        click.echo(f"first time on a phone:  {endpoint.trust_link}")
        click.echo(f"fingerprint:  {station.fingerprint(certificates.authority_der)}")
        if certificates.is_authority_new:
            _print_code(
                "new certificate authority: every phone has to trust this station once, so scan this first:",
                endpoint.trust_link,
            )
    _print_code("the page, for phones that trust this station:", server.link)
    click.echo("Ctrl-C ends")


def _print_code(caption: str, link: str) -> None:
    """Print a QR code of an address if stdout is a terminal."""
    if not sys.stdout.isatty():
        return
    import segno

    click.echo(caption)
    segno.make(link, error="l").terminal(compact=True)


def _tell_logs() -> None:
    """Print warnings of the server as lines on stderr."""

    class Lines(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            text = record.getMessage()
            if record.exc_info and record.exc_info[1] is not None:
                text += f": {type(record.exc_info[1]).__name__}: {record.exc_info[1]}"
            say(f"{record.levelname.lower()}: {text}")

    logger = logging.getLogger("arview.station.live")
    logger.addHandler(Lines())
    logger.setLevel(logging.INFO)
    logger.propagate = False
    for name in ("uvicorn", "uvicorn.error", "aiortc", "aioice", "libav", "asyncio"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
