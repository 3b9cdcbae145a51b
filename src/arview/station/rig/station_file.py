"""station.toml: the cameras of a cell, the part under them, and where the results go."""

from __future__ import annotations

import re
import tomllib
from dataclasses import dataclass
from pathlib import Path

from arview import cad
from arview.cad import Part, load_part
from arview.camera import Camera, load_camera
from arview.errors import InputError
from arview.video import check_source

STATION_FILE_EXAMPLE = """\
# A cell of fixed cameras. Paths are relative to this file.
name = "cell 4"                # names the station in every message
part = "part.toml"             # part file or CAD file
rig = "rig.json"               # poses of the cameras; `arview station calibrate` writes it
cycles = "cycles"              # folder of the results, one folder for each cycle
keep = 200                     # cycles that are kept; older ones are removed
# store = "history.sqlite"     # store of `arview history`, file or URL, to which each result is added

[[cameras]]
name = "north"
source = "rtsp://10.0.4.11/1"  # camera index, address, file, folder or SCHEME:… of another package
camera = "north.json"          # intrinsics, by `arview calibrate`
burst = 4                      # pictures that are averaged, against noise; default: 1

[[cameras]]
name = "south"
source = "rtsp://10.0.4.12/1"
camera = "south.json"

# … and one more at least. What follows is for the line; see docs/reference/plant.md. Without it Enter measures.
# [http]                       # triggers, /health, /ready, /metrics, /schema
# port = 8080
# address = "0.0.0.0"          # default: 127.0.0.1; all others need a token
# token_file = "token.txt"
#
# [mqtt]
# host = "broker.local"
#
# [[hooks]]
# name = "mes"
# url = "https://mes.local/results"
#
# [opcua]
# endpoint = "opc.tcp://0.0.0.0:4840"
"""
_NAME = re.compile(r"[\w-]{1,40}")
MIN_CAMERAS = 3
"""Cameras from which a component can be measured: two place it, and the third can contradict them."""


@dataclass(frozen=True)
class RigCamera:
    """One camera of a cell: where its frames come from, its intrinsics, and how many frames are averaged."""

    name: str
    source: str
    camera: Camera
    burst: int = 1


@dataclass(frozen=True)
class Station:
    """What a station file says.

    Attributes:
        name: of the station.
        path: of the file.
        part: under the cameras.
        cameras: of the cell.
        rig_path: file of their poses, which need not exist yet.
        cycles: folder of the results.
        keep: number of cycles that are kept.
        store: file or URL of the store to which results are added; empty: none.
        http: address and port for triggers and monitors, and their token; None: there is no server.
        table: the whole file, from which other rooms read their tables; `finish` was not yet called.
    """

    name: str
    path: Path
    part: Part
    cameras: tuple[RigCamera, ...]
    rig_path: Path
    cycles: Path
    keep: int
    store: str
    http: tuple[str, int, str] | None
    table: cad.TomlTable


def read_station(path: str | Path) -> Station:
    """Read a station file.

    Raises:
        InputError: it cannot be read, or a value is wrong; unknown keys are left to ``table.finish()``.
    """
    path = Path(path)
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: is not a TOML file ({error})") from error
    table = cad.TomlTable(path, "", content)
    folder = path.parent
    cameras: list[RigCamera] = []
    for entry in table.tables("cameras"):
        name, source = entry.line("name", ""), _located(folder, entry.text("source"))
        if not _NAME.fullmatch(name) or name in {one.name for one in cameras}:
            entry.fail("name", name, "letters, digits, - and _, another one for each camera")
        burst = entry.positive("burst", 1.0) or 1.0
        if burst != int(burst) or burst > 64:
            entry.fail("burst", burst, "a whole number from 1 to 64")
        check_source(source)
        camera = load_camera(folder / entry.text("camera"))
        entry.finish()
        cameras.append(RigCamera(name, source, camera, int(burst)))
    if len(cameras) < MIN_CAMERAS:
        raise InputError(f"{path}: has {len(cameras)} [[cameras]]; a cell needs at least {MIN_CAMERAS} to measure")
    keep = table.positive("keep", 200.0) or 200.0
    return Station(
        table.line("name", path.stem),
        path,
        load_part(folder / table.text("part")),
        tuple(cameras),
        rig_path=folder / table.text("rig", "rig.json"),
        cycles=folder / table.text("cycles", "cycles"),
        keep=int(keep),
        store=_located(folder, store) if (store := table.text("store", "")) else "",
        http=_read_http(table),
        table=table,
    )


def _read_http(root: cad.TomlTable) -> tuple[str, int, str] | None:
    """Address, port and token of ``[http]``."""
    table = root.table("http")
    if not table.content:
        return None
    port, address = table.positive("port", required=True) or 0.0, table.line("address", "127.0.0.1")
    if port != int(port) or port > 65535:
        table.fail("port", port, "a port from 1 to 65535")
    file = table.text("token_file", "")
    table.finish()
    try:
        token = (root.path.parent / file).read_text(encoding="utf-8").strip() if file else ""
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{root.path}: [http] token_file: {file}: cannot be read ({error})") from error
    if not token and address not in ("127.0.0.1", "::1", "localhost"):
        raise InputError(f"{root.path}: [http] address {address}: others than this machine need a token_file")
    return address, int(port), token


def _located(folder: Path, source: str) -> str:
    """A source whose path is relative to the station file; others as they are."""
    is_path = not re.match(r"[a-zA-Z][\w+.-]*:", source) and not source.isdecimal()
    return str(folder / source) if is_path else source
