"""Connections of the results store: URLs, settings of SQLite, and the file system that a store lies on."""

from __future__ import annotations

import getpass
import os
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any

import sqlalchemy as sa
from sqlalchemy.exc import ArgumentError, DBAPIError, OperationalError, SQLAlchemyError

from arview.errors import InputError, OutputError

BUSY_S = 2.0
"""Time that a writer waits for others before it says so and tries again; a result is written in milliseconds."""
READ_BUSY_S = 30.0
"""Time that a reader waits, which a writer hardly ever makes it do."""

_NETWORK_FILE_SYSTEMS = ("nfs", "nfs4", "cifs", "smb3", "smbfs", "fuse.sshfs", "9p", "afs", "glusterfs", "ceph")

_TEMPORARY = ("locked", "busy", "deadlock", "serialize", "could not connect", "server closed", "terminating connection")
"""Words of errors after which another attempt may succeed."""


def store_url(where: str) -> sa.URL:
    """The URL of a file or database.

    Raises:
        InputError: it is no URL, or of a database that is not supported.
    """
    if "://" not in where:
        return sa.URL.create("sqlite", database=where)
    try:
        url = sa.make_url(where)
    except ArgumentError as error:
        raise InputError("store: is not a URL of a database; expected postgresql://user@host/database") from error
    kind = url.get_backend_name()
    if kind == "postgresql":
        return url.set(drivername="postgresql+psycopg")
    if kind == "sqlite" and url.database:
        return url
    raise InputError(f"store: {kind} is not supported; give a file (SQLite) or postgresql://user@host/database")


def prepare_sqlite(connection: Any, record: Any) -> None:
    """Settings of a new connection to SQLite: a log written ahead, on the disk before a transaction ends."""
    connection.isolation_level = None  # transactions are started below, not by the driver
    for pragma in ("journal_mode = WAL", "synchronous = FULL", "foreign_keys = ON"):
        connection.execute(f"PRAGMA {pragma}")


def begin_sqlite(connection: sa.Connection) -> None:
    """Begin a transaction."""
    # A writer takes the lock immediately; a transaction that reads first could not wait for another writer.
    writes = connection.get_execution_options().get("arview_writes")
    waits_s = BUSY_S if writes or connection.get_execution_options().get("arview_retries") else READ_BUSY_S
    connection.exec_driver_sql(f"PRAGMA busy_timeout = {waits_s * 1000:.0f}")
    connection.exec_driver_sql("BEGIN IMMEDIATE" if writes else "BEGIN")


def file_system(path: Path) -> str:
    """Type of the file system of a path as in /proc/mounts; empty when unknown."""
    try:
        mounts = Path("/proc/mounts").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return ""
    place = path.resolve()
    best, kind = -1, ""
    for line in mounts:
        _, point, name, *_ = line.split(" ")
        folder = Path(point.replace("\\040", " "))
        if place.is_relative_to(folder) and len(folder.parts) >= best:
            best, kind = len(folder.parts), name
    return kind


def check_file(path: Path, must_exist: bool, tell: Callable[[str], object]) -> None:
    """Check that the file of a store is there or can be made, and that it is no place where SQLite is unsafe.

    Raises:
        InputError: the file or its folder does not exist, is a folder, or is on a network file system.
        OutputError: the folder of the user's store cannot be made.
    """
    if not path.exists():
        if must_exist:
            raise InputError(f"{path}: no such store; `arview history add` creates it")
        if not path.parent.is_dir():
            if path != own_store():
                raise InputError(
                    f"{path.parent}: no such folder for a store; create it, or mount the share that it is on"
                )
            try:
                path.parent.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise OutputError(f"{path.parent}: cannot be created ({error.strerror or error})") from error
        tell(f"{path}: a new store is made, there was none")
    elif path.is_dir():
        raise InputError(f"{path}: is a folder; expected the file of a store")
    kind = file_system(path)
    if kind in _NETWORK_FILE_SYSTEMS:
        raise InputError(
            f"{path}: is on a network file system ({kind}), on which SQLite is not safe with several writers;"
            " use PostgreSQL (--store postgresql://…)"
        )


def default_store() -> str:
    """The store of ``ARVIEW_STORE``, else a file in the data folder of the user."""
    return os.environ.get("ARVIEW_STORE") or str(own_store())


def own_store() -> Path:
    """The store in the data folder of the user, whose folders are made where they are missing."""
    data = Path(os.environ.get("XDG_DATA_HOME") or Path.home() / ".local" / "share")
    return data / "arview" / "history.sqlite"


def default_station() -> str:
    """The name of ``ARVIEW_STATION``, else that of this machine."""
    return os.environ.get("ARVIEW_STATION") or socket.gethostname()


def default_author() -> str:
    """Who works with the store: the user's name, if it is known, and the name of this machine."""
    try:
        user = getpass.getuser()
    except (KeyError, OSError, ImportError):
        user = "unknown"
    return f"{user}@{socket.gethostname()}"


def is_temporary(error: SQLAlchemyError) -> bool:
    """Whether another attempt may succeed after an error of the database."""
    return isinstance(error, OperationalError | DBAPIError) and any(word in str(error).lower() for word in _TEMPORARY)
