"""How far a piece of work has come, and whether it is to stop.

A signal sets a flag that long work looks at between two steps, so that none is cut in the middle.
"""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from traceback import walk_stack
from types import FrameType
from typing import TypeAlias

Progress: TypeAlias = Callable[[str, int, int], None]
"""Called as ``progress(stage, done, total)``: the name of the stage, the steps done and the steps of that stage.

A total of 0 means that the number of steps is not known.
"""

StepProgress: TypeAlias = Callable[[int, int], None]
"""Called as ``progress(done, total)`` by work that has one stage only. A total of 0 means that it is not known."""

GRACE_S = 2.0
"""Time after which a step that has not looked at the flag is interrupted where it is."""
_SIGNALS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
_is_asked = threading.Event()


def check_stop() -> None:
    """Raise KeyboardInterrupt if a signal has asked the program to stop; called between steps of long work."""
    if _is_asked.is_set():
        signal.setitimer(signal.ITIMER_REAL, 0.0)  # what follows finishes what was done
        raise KeyboardInterrupt


@contextmanager
def stops_by_signals() -> Iterator[None]:
    """Let Ctrl-C, SIGTERM and SIGHUP ask to stop; the same signal again ends the program at once.

    Signals that are ignored, as SIGHUP is under nohup, stay so. Outside the main thread, and inside another such block,
    nothing changes.
    """
    is_main = threading.current_thread() is threading.main_thread()
    if not is_main or signal.getsignal(signal.SIGALRM) is _interrupt:
        yield
        return
    numbers = [number for number in _SIGNALS if signal.getsignal(number) is not signal.SIG_IGN]
    before = {number: signal.signal(number, _ask) for number in numbers}
    before[signal.SIGALRM] = signal.signal(signal.SIGALRM, _interrupt)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        _is_asked.clear()
        for number, handler in before.items():
            signal.signal(number, handler)


def _ask(number: int, frame: FrameType | None) -> None:
    if _is_asked.is_set():
        signal.signal(number, signal.SIG_DFL)
        os.kill(os.getpid(), number)
    _is_asked.set()
    signal.setitimer(signal.ITIMER_REAL, GRACE_S)


def _interrupt(number: int, frame: FrameType | None) -> None:
    """Interrupt a step that takes long, but no compiled function that is making its result.

    Numba calls Python for each named tuple that a kernel returns, and crashes when an exception comes out of that.
    """
    if any(
        str(inner.f_globals.get("__name__")).startswith(("namedtuple_", "numba.")) for inner, _ in walk_stack(frame)
    ):
        signal.setitimer(signal.ITIMER_REAL, 0.02)
        return
    raise KeyboardInterrupt
