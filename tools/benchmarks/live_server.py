"""`arview live` in a process of its own, to be measured from outside."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def live_server(arguments: Sequence[object], folder: Path | None = None) -> Iterator[tuple[int, str]]:
    """Run `arview live` during a block.

    Args:
        arguments: of the command.
        folder: working folder of the process.

    Yields:
        its process id and the link to its page.
    """
    command = [sys.executable, "-m", "arview.cli", "live", *map(str, arguments)]
    server = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, cwd=folder)
    try:
        assert server.stdout is not None
        found = next((match for line in server.stdout if (match := re.search(r"https?://\S+token=\S+", line))), None)
        if found is None:
            raise SystemExit("live: the server did not start")
        yield server.pid, found.group()
    finally:
        server.send_signal(signal.SIGINT)
        try:
            server.wait(20)
        except subprocess.TimeoutExpired:
            server.kill()
