"""A temporary PostgreSQL server, where it is installed."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path


def reason_without_server() -> str:
    """Why no server can be started here; empty if it can."""
    if find_spec("psycopg") is None:
        return "psycopg is not installed"
    if not _tools():
        return "PostgreSQL is not installed"
    if os.getuid() == 0 and subprocess.run(["id", "postgres"], capture_output=True).returncode:
        return "PostgreSQL does not run as root, and there is no user postgres"
    return ""


def _tools() -> list[Path]:
    return sorted(Path("/usr/lib/postgresql").glob("*/bin"), key=lambda path: int(path.parent.name))


@contextmanager
def postgresql_server(is_safe: bool = False) -> Iterator[str]:
    """The URL of a database whose server listens on a socket in its own folder only.

    Args:
        is_safe: wait for the disk at each commit, as in production.
    """
    is_root, tools = os.getuid() == 0, _tools()[-1]
    who = ["runuser", "-u", "postgres", "--"] if is_root else []
    folder = Path(tempfile.mkdtemp(prefix="arview-pg-", dir="/tmp"))
    data = folder / "data"

    def run(*command: object, check: bool = True) -> None:
        subprocess.run([*who, *map(str, command)], check=check, capture_output=True, cwd="/", timeout=120)

    try:
        if is_root:
            shutil.chown(folder, "postgres")
        run(tools / "initdb", "-D", data, "-A", "trust", "-U", "postgres")
        options = f"-c listen_addresses='' -k {folder} -c fsync={'on' if is_safe else 'off'}"
        run(tools / "pg_ctl", "-D", data, "-w", "-o", options, "-l", folder / "log", "start")
        try:
            yield f"postgresql://postgres@/postgres?host={folder}"
        finally:
            run(tools / "pg_ctl", "-D", data, "-m", "immediate", "stop", check=False)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
