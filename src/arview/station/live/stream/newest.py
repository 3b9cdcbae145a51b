"""Slots that hold one value, the newest: from thread to thread, and from threads to a task. Nothing queues up."""

from __future__ import annotations

import asyncio
import threading
from contextlib import suppress
from typing import Generic, TypeVar

T = TypeVar("T")


class NewestSlot(Generic[T]):
    """Passes the newest value to one waiting thread.

    Attributes:
        dropped: number of values that were replaced before they were taken.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._value: T | None = None
        self._is_closed = False
        self.dropped = 0

    def put(self, value: T) -> None:
        """Store a value; one that still waits is dropped and counted."""
        with self._changed:
            if self._is_closed:
                return
            self.dropped += self._value is not None
            self._value = value
            self._changed.notify()

    def take(self, timeout_s: float | None = None) -> T | None:
        """Wait for a value and take it; None after the timeout or when the slot was closed."""
        with self._changed:
            self._changed.wait_for(lambda: self._value is not None or self._is_closed, timeout_s)
            value, self._value = self._value, None
            return None if self._is_closed else value

    def close(self) -> None:
        """Wake the waiting threads and ignore later values."""
        with self._changed:
            self._is_closed, self._value = True, None
            self._changed.notify_all()

    @property
    def is_closed(self) -> bool:
        """Whether the slot was closed."""
        return self._is_closed


class AsyncNewestSlot(Generic[T]):
    """Passes the newest value, stored by any thread, to one waiting task of an event loop."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop
        self._lock = threading.Lock()
        self._arrived = asyncio.Event()
        self._value: T | None = None
        self._is_scheduled = False

    def put(self, value: T) -> None:
        """Store a value; one that still waits is dropped."""
        with self._lock:
            self._value = value
            if self._is_scheduled:
                return
            self._is_scheduled = True
        with suppress(RuntimeError):  # the loop has ended, so that no task waits
            self._loop.call_soon_threadsafe(self._arrived.set)

    async def take(self) -> T:
        """Wait for the next value and take it."""
        while True:
            await self._arrived.wait()
            with self._lock:
                value, self._value = self._value, None
                self._is_scheduled = False
                self._arrived.clear()
            if value is not None:
                return value
