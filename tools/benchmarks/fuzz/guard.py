"""Bounds on one attempt: processor time, time and memory; and what an error may look like."""

from __future__ import annotations

import faulthandler
import signal
import time
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from arview.errors import ArviewError

CPU_LIMIT_S = 10.0
WALL_LIMIT_S = 60.0  # of a machine that does other work, too; children and waiting count here only
MEMORY_LIMIT = 1_000_000_000


class Fault(Exception):
    """An answer that arview must not give. ``signature`` is equal for equal causes."""

    def __init__(self, signature: str, text: str) -> None:
        super().__init__(f"{signature}: {text}")
        self.signature, self.text = signature, text


class Hang(BaseException):
    """The attempt took too long; no `except Exception` takes it."""


def _hang(number: int, frame: object) -> None:
    raise Hang(f"more than {CPU_LIMIT_S:.0f} s of the processor, or {WALL_LIMIT_S:.0f} s")


def _memory(key: str) -> int:
    status = Path("/proc/self/status").read_text()
    return 1024 * int(next(line for line in status.splitlines() if line.startswith(key)).split()[1])


@contextmanager
def guarded(name: str, log: Path) -> Iterator[None]:
    """Run an attempt; whatever arview must not do becomes a `Fault`.

    Raises:
        Fault: a traceback, an error of several lines, a hang, or too much memory.
    """
    Path("/proc/self/clear_refs").write_text("5")  # the peak starts anew
    before = _memory("VmRSS")
    signal.signal(signal.SIGPROF, _hang)
    signal.signal(signal.SIGALRM, _hang)
    began_s = time.monotonic()
    with log.open("w") as file:
        faulthandler.dump_traceback_later(3 * WALL_LIMIT_S, exit=True, file=file)  # native code that does not come back
        try:
            signal.setitimer(signal.ITIMER_PROF, CPU_LIMIT_S)
            signal.setitimer(signal.ITIMER_REAL, WALL_LIMIT_S)
            try:
                yield
            finally:
                signal.setitimer(signal.ITIMER_PROF, 0)
                signal.setitimer(signal.ITIMER_REAL, 0)
        except ArviewError as error:
            if not str(error).strip() or len(str(error).splitlines()) != 1:
                raise Fault(f"{name} not one line at {place(error)}", repr(str(error))) from error
        except Hang as error:
            raise Fault(f"{name} hang at {place(error)}", f"{time.monotonic() - began_s:.0f} s") from error
        except Fault:
            raise
        except Exception as error:
            raise Fault(f"{name} {type(error).__name__} at {place(error)}", str(error)[:300]) from error
        finally:
            faulthandler.cancel_dump_traceback_later()
    grown = _memory("VmHWM") - before
    if grown > MEMORY_LIMIT:
        raise Fault(f"{name} memory", f"{grown / 1e6:.0f} MB")


def place(error: BaseException) -> str:
    """File and line of arview that an error comes from."""
    frames = [one for one in traceback.extract_tb(error.__traceback__) if "/arview/" in one.filename]
    if not frames:
        return "outside arview"
    return f"{frames[-1].filename.split('/arview/')[-1]}:{frames[-1].lineno}"
