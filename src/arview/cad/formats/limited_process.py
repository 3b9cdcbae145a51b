"""A Python script in a process of its own, with limits of time and memory, for native readers of unknown files."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

TIMED_OUT = -24
"""Exit code of a process that computed for too long: SIGXCPU."""
HUNG = -1000
"""Exit code of a process that was ended because it did nothing."""

# Native readers write to the terminal, reserve gigabytes or abort on malformed files.
_LIMITED = """
import sys
cpu_s, memory, output = sys.argv[1:4]
del sys.argv[1:4]
try:
    import resource
    for kind, limit in ((resource.RLIMIT_CPU, cpu_s), (resource.RLIMIT_AS, memory), (resource.RLIMIT_FSIZE, output)):
        hard = resource.getrlimit(kind)[1]
        limit = int(limit) if hard == resource.RLIM_INFINITY else min(int(limit), hard)
        resource.setrlimit(kind, (limit, limit))
except (ImportError, ValueError, OSError):
    pass
"""


IDLE_S = 120.0
"""Seconds in which a process that computes nothing is given up; a busy machine lets each compute a little."""
_POLL_S = 0.5
"""Seconds between two looks at what it has computed."""
OUTPUT_MB = 1000.0
"""Largest file that the process may write, MB."""


@dataclass(frozen=True)
class ProcessLimits:
    """Limits of a reading process: fixed shares, and shares that grow with the size of the file.

    Attributes:
        cpu_s: seconds of computing.
        cpu_s_per_mb: further seconds for each megabyte.
        max_cpu_s: seconds at most.
        memory_mb: address space, MB, of which the libraries take 400.
        memory_mb_per_mb: further address space for each megabyte.
    """

    cpu_s: float = 5.0
    cpu_s_per_mb: float = 20.0
    max_cpu_s: float = 600.0
    memory_mb: float = 1500.0
    memory_mb_per_mb: float = 100.0

    def cpu_of(self, size_mb: float) -> float:
        """Seconds of computing for a file of that size."""
        return min(self.cpu_s + self.cpu_s_per_mb * size_mb, self.max_cpu_s)

    def memory_of(self, size_mb: float) -> float:
        """Address space, MB, for a file of that size."""
        return self.memory_mb + self.memory_mb_per_mb * size_mb


def run_limited(
    script: str, arguments: list[str], folder: Path, size_mb: float, limits: ProcessLimits
) -> tuple[int, str]:
    """Run a script with limits; returns its exit code, TIMED_OUT or HUNG where it was ended, and what it printed.

    Its limit is the time that it computes, not the time that it takes, which depends on what else the machine does.

    Args:
        script: Python text, whose ``sys.argv[1:]`` are the arguments.
        arguments: of the script.
        folder: for the log of what is printed.
        size_mb: size of what it reads.
        limits: see `ProcessLimits`.
    """
    cpu_s = limits.cpu_of(size_mb)
    numbers = [cpu_s, 1e6 * limits.memory_of(size_mb), 1e6 * OUTPUT_MB]
    # Without the limit each thread reserves an arena of address space, which counts as memory.
    environment = {**os.environ, "MALLOC_ARENA_MAX": "2", "OPENBLAS_NUM_THREADS": "1"}
    log = folder / "log.txt"
    with (
        log.open("wb") as output,
        subprocess.Popen(
            [sys.executable, "-c", _LIMITED + script, *(str(int(-(-n // 1))) for n in numbers), *arguments],
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            env=environment,
        ) as process,
    ):
        code = _waited_for(process)
    with log.open("rb") as file:
        return code, file.read(100_000).decode("utf-8", errors="replace")


def _waited_for(process: subprocess.Popen[bytes]) -> int:
    """Exit code of a process; HUNG after it computed nothing for `IDLE_S`. It is ended whatever happens here."""
    computed, since_s = 0, time.monotonic()
    try:
        while True:
            try:
                return process.wait(_POLL_S)
            except subprocess.TimeoutExpired:
                now = _ticks(process.pid)
            if now > computed:
                computed, since_s = now, time.monotonic()
            elif time.monotonic() - since_s > IDLE_S:
                return HUNG
    finally:
        if process.poll() is None:
            process.kill()


def _ticks(pid: int) -> int:
    """Clock ticks that a process has computed; 0 where the system does not tell."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii", errors="replace").rpartition(")")[2].split()
        return int(fields[11]) + int(fields[12])
    except (OSError, ValueError, IndexError):
        return 0
