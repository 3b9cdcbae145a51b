"""The threads for drawing, JPEG and files: those that do not come back are replaced, and never waited for."""

from __future__ import annotations

import asyncio
import logging
import queue
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, TypeVar

from arview.errors import ArviewError

logger = logging.getLogger("arview.station.live")
T = TypeVar("T")

CHECK_INTERVAL_S = 0.5
"""Time between two looks at the workers."""


class StuckError(ArviewError):
    """A piece of work took so long that it was given up."""


@dataclass
class _Task:
    future: Future[Any]
    work: Callable[[], Any]
    began_s: float | None = None


class WorkerPool(ThreadPoolExecutor):
    """An executor for `asyncio.to_thread` whose threads may get stuck in native code.

    A task that takes longer than ``timeout_s`` fails with `StuckError`, and its thread is replaced; threads cannot be
    ended, so a stuck one stays behind until its native call returns. After ``max_lost`` such threads the pool takes no
    work any more. All threads are daemons: none keeps the program from exiting.

    Args:
        count: number of threads.
        timeout_s: longest time for a task.
        max_lost: number of stuck threads that may stay behind at once.

    Attributes:
        replaced: number of threads that were replaced so far.
    """

    def __init__(self, count: int, timeout_s: float, max_lost: int = 32) -> None:
        super().__init__(max_workers=1)  # its own thread is never started; asyncio demands a ThreadPoolExecutor
        self._timeout_s, self._max_lost = timeout_s, max_lost
        self._tasks: queue.SimpleQueue[_Task | None] = queue.SimpleQueue()
        self._running: dict[threading.Thread, _Task | None] = {}
        self._lost: set[threading.Thread] = set()
        self._lock = threading.Lock()
        self._is_closed = threading.Event()
        self.replaced = 0
        for _ in range(count):
            self._start()
        threading.Thread(target=self._watch, name="arview-worker-watch", daemon=True).start()

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Run a call in a thread.

        Raises:
            RuntimeError: the pool is shut down.
            StuckError: too many threads are stuck.
        """
        if self._is_closed.is_set():
            raise RuntimeError("cannot schedule new futures after shutdown")
        with self._lock:
            self._lost = {thread for thread in self._lost if thread.is_alive()}
            if len(self._lost) >= self._max_lost:
                raise StuckError(f"{len(self._lost)} workers do not come back; start the server again")
        future: Future[Any] = Future()
        self._tasks.put(_Task(future, lambda: fn(*args, **kwargs)))
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Take no more work. Running threads are not waited for, whatever ``wait`` says."""
        self._is_closed.set()
        for _ in range(len(self._running)):
            self._tasks.put(None)

    def _start(self) -> None:
        thread = threading.Thread(target=self._run, name="arview-worker", daemon=True)
        self._running[thread] = None
        thread.start()

    def _run(self) -> None:
        own = threading.current_thread()
        while (task := self._tasks.get()) is not None:
            if not task.future.set_running_or_notify_cancel():
                continue
            with self._lock:
                task.began_s = time.monotonic()
                self._running[own] = task
            result, failure = None, None
            try:
                result = task.work()
            except BaseException as error:
                failure = error
            with self._lock:
                if own not in self._running:  # given up meanwhile: the future has its error, another thread its place
                    return
                self._running[own] = None
            if failure is not None:
                task.future.set_exception(failure)
            else:
                task.future.set_result(result)
            del task, result, failure  # what a task held is released now, not with the next one

    def _watch(self) -> None:
        while not self._is_closed.wait(CHECK_INTERVAL_S):
            for task in self._give_up():
                logger.warning("a worker did not come back within %.0f s and is replaced", self._timeout_s)
                task.future.set_exception(StuckError("this took too long and was given up"))

    def _give_up(self) -> list[_Task]:
        """Replace the threads whose task takes too long; returns those tasks."""
        given_up: list[_Task] = []
        now_s = time.monotonic()
        with self._lock:
            for thread, task in list(self._running.items()):
                if task is not None and task.began_s is not None and now_s - task.began_s > self._timeout_s:
                    del self._running[thread]
                    self._lost.add(thread)
                    given_up.append(task)
                    self.replaced += 1
                    self._start()
        return given_up


async def in_daemon_thread(work: Callable[[], T]) -> T:
    """As `asyncio.to_thread`, but in a daemon thread, which does not keep the program from exiting."""
    loop = asyncio.get_running_loop()
    done: asyncio.Future[T] = loop.create_future()

    def set_outcome(result: T | None, error: BaseException | None) -> None:
        if done.cancelled():
            return
        if error is not None:
            done.set_exception(error)
        else:
            done.set_result(result)  # type: ignore[arg-type]

    def run() -> None:
        result: T | None = None
        failure: BaseException | None = None
        try:
            result = work()
        except BaseException as error:
            failure = error
        with suppress(RuntimeError):  # the loop has ended in the meantime
            loop.call_soon_threadsafe(set_outcome, result, failure)

    threading.Thread(target=run, name="arview-own", daemon=True).start()
    return await done
