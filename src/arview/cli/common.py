"""What the commands share: how errors end a command, common options, cameras, progress bars, writing of files."""

from __future__ import annotations

import errno
import json
import os
import select
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from traceback import print_exception, walk_tb
from typing import TYPE_CHECKING, Any, TextIO

import click

from arview import tracking
from arview.cli.exit_codes import ExitCode, group_rows, help_rows
from arview.core.atomic import is_device
from arview.core.parallel import bound_arenas
from arview.core.plug_ins import find_plug_ins, load_plug_in
from arview.core.progress import Progress, StepProgress, check_stop, stops_by_signals
from arview.errors import ArviewError, CannotMeasureError, InputError, OutputError, without_credentials
from arview.version import __version__

if TYPE_CHECKING:
    from arview.camera import Camera
    from arview.geometry import Array
    from arview.video import FrameSource

COMMANDS_GROUP = "arview.commands"
"""Entry-point group of commands that other packages add."""
MODALITIES = ("region", "edge", "texture")
_STORAGE_ERRORS = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS})


SECTIONS = {
    "Inspect": ("inspect", "annotate", "live", "station", "measure", "reconstruct", "capture", "batch"),
    "Set up": ("check", "studio", "guideviews", "calibrate", "verify"),
    "Record": ("report", "export", "rework", "decisions", "history", "inspection", "compare"),
}
"""Commands in the help of the program; those that are not named follow under "More"."""


class Command(click.Command):
    """A command whose help ends with its exit codes."""

    def __init__(self, *args: Any, exit_codes: dict[ExitCode, str] | None = None, **options: Any) -> None:
        """``exit_codes`` says what the results of this command mean, see `help_rows`; the rest is click's."""
        super().__init__(*args, **options)
        self.exit_codes = exit_codes

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the epilog and the table of exit codes."""
        super().format_epilog(ctx, formatter)
        _write_exit_codes(formatter, help_rows(self.exit_codes))


class Group(click.Group):
    """A group of commands whose help ends with all exit codes."""

    command_class = Command

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the epilog and the table of exit codes."""
        super().format_epilog(ctx, formatter)
        _write_exit_codes(formatter, group_rows())


def _write_exit_codes(formatter: click.HelpFormatter, rows: list[tuple[str, str]]) -> None:
    with formatter.section("Exit codes"):
        formatter.write_dl(rows)


class _UnusableCommand(Command):
    """Stands in for a command of another package that cannot be loaded, so that the help still names it."""

    def __init__(self, name: str, error: InputError) -> None:
        super().__init__(name, short_help="Cannot be loaded; run it to see why.", add_help_option=False)
        self.error = error

    def make_context(self, *args: Any, **options: Any) -> click.Context:
        """Raise the error, whatever the arguments are."""
        raise self.error


class _Program(Group):
    """The whole program: every way to end is turned into an exit code and at most one line on stderr."""

    group_class = Group

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the commands in sections, see `SECTIONS`."""
        left = {name: self.get_command(ctx, name) for name in self.list_commands(ctx)}
        for title, names in (*SECTIONS.items(), ("More", tuple(left))):
            found = [(name, left.pop(name)) for name in names if name in left]
            rows = [(name, command.get_short_help_str(88)) for name, command in found if command is not None]
            if rows:
                with formatter.section(title):
                    formatter.write_dl(rows)

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Names of arview's own commands and of those that other packages add, in alphabetical order."""
        return sorted({*super().list_commands(ctx), *find_plug_ins(COMMANDS_GROUP)})

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """A command by name. Packages are searched and imported only for a name that arview does not have itself."""
        own = super().get_command(ctx, cmd_name)
        if own is not None:
            return own
        entry = find_plug_ins(COMMANDS_GROUP).get(cmd_name)
        if entry is None:
            return None
        try:
            command: click.Command = load_plug_in(entry, click.Command)
        except InputError as error:
            return _UnusableCommand(cmd_name, error)
        return command

    def make_context(self, *args: Any, **options: Any) -> click.Context:
        """Parse the options; --help prints here."""
        with _closed_pipe_exits():
            return super().make_context(*args, **options)

    def invoke(self, ctx: click.Context) -> Any:
        """Run the chosen command; Ctrl-C ends it."""
        try:
            with _closed_pipe_exits(), stops_by_signals():
                return super().invoke(ctx)
        except KeyboardInterrupt:
            say("interrupted")
            ctx.exit(ExitCode.INTERRUPTED)

    def main(
        self, args: Sequence[str] | None = None, *positional: Any, standalone_mode: bool = True, **options: Any
    ) -> Any:
        """Parse and run, then exit with an `ExitCode`. Without ``standalone_mode`` errors are raised instead."""
        run = partial(super().main, args, *positional, standalone_mode=False, **options)
        if not standalone_mode:
            return run()
        bound_arenas()
        try:
            result: Any = run()
            if sys.stdout is not None:
                sys.stdout.flush()  # a full or closed output shows itself now, not while the interpreter ends
            code = result if isinstance(result, int) else ExitCode.DONE
        except click.ClickException as error:
            _show(error)
            code = ExitCode.BAD_INPUT
        except (click.Abort, KeyboardInterrupt):
            say("interrupted")
            code = ExitCode.INTERRUPTED
        except CannotMeasureError as error:
            say(f"could not measure: {error}")
            code = ExitCode.CANNOT_MEASURE
        except ArviewError as error:
            say(f"error: {error}")
            code = ExitCode.BAD_INPUT
        except OSError as error:
            code = _code_of_os_error(error)
        except Exception as error:
            say_bug(error)
            code = ExitCode.BUG
        sys.exit(int(code))


@contextmanager
def _closed_pipe_exits() -> Iterator[None]:
    """End without a word when the reader of the output closed the pipe, as ``| head`` does."""
    try:
        yield
    except BrokenPipeError as error:
        if not (_is_reader_gone(sys.stdout) or _is_reader_gone(sys.stderr)):
            say_bug(error)  # of another pipe
            raise click.exceptions.Exit(ExitCode.BUG) from error
        _discard(sys.stdout)
        _discard(sys.stderr)
        raise click.exceptions.Exit(ExitCode.CLOSED_PIPE) from error


def _is_reader_gone(stream: TextIO | None) -> bool:
    """True if nobody reads the pipe or socket behind a stream any more; also where that cannot be found out."""
    try:
        if stream is None:
            return False
        poll = select.poll()
        poll.register(stream.fileno(), 0)
        return bool(poll.poll(0))
    except (AttributeError, OSError, ValueError):  # Windows, or not a stream of the operating system
        return True


def _code_of_os_error(error: OSError) -> ExitCode:
    """Exit code of an OSError that no command turned into a message: a full device or disk, or a bug."""
    if error.errno == errno.EPIPE:  # found by the last flush
        _discard(sys.stdout)
        return ExitCode.CLOSED_PIPE
    if error.errno not in _STORAGE_ERRORS:
        say_bug(error)
        return ExitCode.BUG
    is_stdout = any(frame.f_code is click.echo.__code__ for frame, _ in walk_tb(error.__traceback__))
    if _flush_error(sys.stdout) is not None or is_stdout:
        _discard(sys.stdout)
        name = "standard output"
    else:
        name = str(error.filename or "an output file")
    say(f"error: {name}: cannot be written ({error.strerror})")
    return ExitCode.BAD_INPUT


def _flush_error(stream: TextIO | None) -> OSError | None:
    """The error that writing what a stream still holds gives, or None."""
    try:
        if stream is not None:
            stream.flush()
    except OSError as error:
        return error
    except ValueError:  # closed already
        return None
    return None


def _discard(stream: TextIO | None) -> None:
    """Send what a stream still holds to the null device, so that the interpreter does not fail on it at its end."""
    if stream is None:
        return
    try:
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, stream.fileno())
        os.close(null)
    except (OSError, ValueError):  # not a stream of the operating system
        return


def _show(error: click.ClickException) -> None:
    """Print a usage error, where stderr can be written to."""
    try:
        error.show()
    except OSError:
        _discard(sys.stderr)


def say_bug(error: Exception) -> None:
    """Print one line about an unexpected error, and its traceback when ARVIEW_DEBUG is set."""
    if os.environ.get("ARVIEW_DEBUG"):
        print_exception(error)
    hint = "" if os.environ.get("ARVIEW_DEBUG") else " with what ARVIEW_DEBUG=1 prints"
    say(f"internal error: {type(error).__name__}: {error}; please report this{hint}")


def say(text: str) -> None:
    """Print one line on stderr, whatever the text holds, without passwords of addresses.

    A stderr that cannot be written to is ignored.
    """
    try:
        click.echo("arview: " + without_credentials(" ".join(text.split())), err=True)
    except OSError:
        _discard(sys.stderr)


@click.group(
    cls=_Program,
    context_settings={
        "help_option_names": ["-h", "--help"],
        "max_content_width": 100,
        # Help that is piped into a file or a pager is not broken at 80 columns.
        "terminal_width": None if sys.stdout is not None and sys.stdout.isatty() else 100,
    },
    epilog="""\b
Examples:
  arview inspect --part part.toml --photos photos/ --video walk.mp4 -o out/""",
)
@click.version_option(__version__, prog_name="arview")
def main() -> None:
    """AR inspection of assemblies: parts tracked in video by their CAD, with measured errors."""


def _parse_modalities(ctx: click.Context, parameter: click.Parameter, value: str) -> tuple[str, ...]:
    names = tuple(name.strip() for name in value.split(",") if name.strip())
    unknown = [name for name in names if name not in MODALITIES]
    if unknown or not names:
        raise click.BadParameter(f"{value!r}: expected some of {','.join(MODALITIES)}")
    return names


UNIT = click.option("--unit", type=click.Choice(["mm", "cm", "m", "inch"]), help="Unit of the numbers in the CAD file.")
RENDERER = click.option(
    "--renderer",
    type=click.Choice(["auto", "pyrender", "zbuffer"]),
    default="auto",
    show_default=True,
    metavar="NAME",
    help="Draws guide views: pyrender, zbuffer or auto.",
)
MODALITY = click.option(
    "--modalities",
    callback=_parse_modalities,
    default=",".join(MODALITIES),
    show_default=True,
    metavar="LIST",
    help="Tracker's modalities.",
)


def inspection_file(ctx: click.Context, parameter: click.Parameter, value: Any) -> Any:
    """The inspection.json of each folder among the given paths; files as they are."""
    if isinstance(value, tuple):
        return tuple(inspection_file(ctx, parameter, one) for one in value)
    return str(Path(value) / "inspection.json") if value is not None and Path(value).is_dir() else value


def session_options(modalities: tuple[str, ...]) -> tracking.SessionOptions:
    """Options of a tracking session that uses these modalities."""
    return tracking.SessionOptions(
        use_region="region" in modalities,
        use_edge="edge" in modalities,
        use_texture="texture" in modalities,
        # The pose recheck needs edges and colours.
        use_recheck={"region", "edge"} <= set(modalities),
    )


def camera_for(frames: FrameSource, spec: str | None, source: str) -> Camera:
    """Camera of a source's frames. Without ``spec`` it is guessed, and a warning says so."""
    from arview.camera import guess_camera
    from arview.video import load_camera_of

    if spec is not None:
        camera = load_camera_of(frames, spec, source)
        if camera.doubt:
            say(f"warning: camera {spec}: {camera.doubt}")
        return camera
    camera = guess_camera(frames.width, frames.height)
    say(
        f"WARNING: no --camera given: GUESSING a focal length of {camera.fx:.0f} px (1.2 × the longer side)"
        " and no distortion; distances will be wrong by as much. Give a camera file, fov:DEG or exif"
    )
    return camera


def start_session(
    parts: Sequence[tracking.TrackedPart],
    frames: FrameSource,
    camera: Camera,
    options: tracking.SessionOptions | None,
    keep: Callable[[tracking.FocalEstimate], None] | None,
) -> tracking.TrackingSession:
    """The session for a source.

    Args:
        parts: the specimens.
        frames: the source.
        camera: of its frames.
        options: of the session.
        keep: the camera is a guess: of a film it is estimated in a first pass with the first part, and this function
            gets the result; otherwise it is estimated while the session runs. None: the camera is known.
    """
    from arview.annotation import estimate_camera

    if keep is None or frames.is_live:
        return tracking.TrackingSession(parts, camera, options, is_guessed=keep is not None)
    following = tracking.TrackingSession(parts[:1], camera, options, is_guessed=True)
    with progress_bar("focal length") as progress:
        estimate = estimate_camera(frames, following, lambda done: progress(done, frames.frame_count or 0))
    keep(estimate)
    return tracking.TrackingSession(parts, estimate.camera if estimate.is_determined else camera, options)


def load_pose(path: str) -> Array:
    """``cam_from_model`` (4,4), mm, of a JSON file.

    Raises:
        InputError: the file cannot be read, is not JSON, or holds no rigid transform.
    """
    from arview.geometry import check_rigid

    try:
        content = json.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
    except ValueError as error:
        raise InputError(f"{path}: not valid JSON ({error})") from error
    if not isinstance(content, dict) or "cam_from_model" not in content:
        raise InputError(f'{path}: expected {{"cam_from_model": 4×4 row-major, mm}}')
    return check_rigid(content["cam_from_model"], f"{path}: cam_from_model")


@contextmanager
def progress_bar(label: str) -> Iterator[StepProgress]:
    """Show a bar for work of one stage; as `stage_bar`."""
    with stage_bar() as progress:
        yield partial(progress, label)


@contextmanager
def stage_bar() -> Iterator[Progress]:
    """Show a bar on stderr if it is a terminal; yields what moves it, and ends the work after Ctrl-C."""
    from tqdm import tqdm

    with tqdm(disable=None, leave=False, unit="") as bar:
        shown = ""

        def update(stage: str, done: int, in_all: int) -> None:
            nonlocal shown
            check_stop()
            if stage != shown:
                shown = stage
                bar.reset(in_all or None)
                bar.set_description(stage)
            bar.total = in_all or None
            bar.update(done - bar.n)

        yield update


def output_path(path: str, inputs: list[Any]) -> Path:
    """The path of an output file.

    Args:
        path: what the user gave.
        inputs: paths of inputs and other outputs that must not be overwritten; None is ignored.

    Raises:
        OutputError: the file cannot be written there, or would overwrite one of ``inputs``.
    """
    from arview.camera import split_spec

    target = Path(path)
    if not target.parent.is_dir():
        raise OutputError(f"{path}: there is no folder {target.parent}; create it first")
    if target.is_dir():
        raise OutputError(f"{path}: is a folder; give the name of a file")
    if not os.access(target if is_device(target) else target.parent, os.W_OK):
        raise OutputError(f"{path}: the folder {target.parent} cannot be written to; choose another")
    for other in inputs:
        if other is not None and target.resolve() == split_spec(other)[0].resolve():
            raise OutputError(f"{path}: would overwrite an input or another output; choose another name")
    return target


def refuse_for_several(options: dict[str, str | None]) -> None:
    """Refuse options, by their names, that are of one specimen."""
    for name, value in options.items():
        if value:
            raise InputError(f"{name} is for one part; leave it out, or give one --part without --instances")


def check_profile(name: str | None, camera_spec: str | None) -> None:
    """Check that an estimated camera can be kept under a name.

    Raises:
        InputError: a camera was given, so that nothing is estimated, or the name is no name of a profile.
    """
    from arview.camera import profile_path

    if name is None:
        return
    if camera_spec is not None:
        raise InputError("--save-profile keeps a camera that was estimated; leave out --camera to have it estimated")
    profile_path(name)


def report_estimate(estimate: tracking.FocalEstimate, profile: str | None, source: str, turns: int) -> None:
    """Say what was estimated, and keep it as a profile if one was asked for.

    Args:
        estimate: the result.
        profile: name of the profile; None: none was asked for.
        source: video that it was estimated from.
        turns: quarter turns clockwise applied to its frames.
    """
    can_be_kept = estimate.is_determined and profile is None
    say(estimate.text + ("; keep it with --save-profile NAME" if can_be_kept else ""))
    if profile is None:
        return
    if not estimate.is_determined:
        say(f"profile {profile} was not written")
        return
    path = tracking.keep_profile(estimate, profile, source, turns)
    say(f"wrote {path}; use it with --camera profile:{profile}")


def likely_cause(camera: Camera) -> str:
    """What to try when a part was not found with a guessed camera."""
    return (
        f"a likely cause: the camera was guessed, with a focal length of {camera.fx:.0f} px and no distortion; "
        "give --camera with a file, fov:DEG or exif"
    )
