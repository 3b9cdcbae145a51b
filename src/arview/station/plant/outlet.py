"""Outlets: what sends the messages of the outbox, each until it is confirmed."""

from __future__ import annotations

import asyncio
from abc import ABC, abstractmethod
from collections.abc import Awaitable, Callable
from contextlib import suppress

from arview.station.plant.outbox import Outbox, PendingMessage

BATCH = 50
"""Messages read from the outbox at once."""
POLL_S = 1.0
"""Time after which it is looked for news again: messages of other processes, and those that are due once more."""
MIN_DELAY_S, MAX_DELAY_S = 1.0, 60.0
"""Time to the next try of a message that failed; it doubles with each."""


class Outlet(ABC):
    """A connection of the plant, which `run` makes and uses until it breaks.

    Attributes:
        name: by which the outbox and people know it.
        is_connected: whether there is a connection.
        error: why there is none, or why the last message was not delivered; else empty.
        news: set when there is a new message or state.
    """

    def __init__(self, name: str) -> None:
        self.name, self.is_connected, self.error, self.news = name, False, "", asyncio.Event()

    @abstractmethod
    async def run(self) -> None:
        """Serve until the connection breaks, which raises an error, or the task is cancelled."""

    async def await_news(self) -> None:
        """Wait until there is news, or for `POLL_S`."""
        with suppress(TimeoutError):
            await asyncio.wait_for(self.news.wait(), POLL_S)
        self.news.clear()

    async def deliver(self, outbox: Outbox, send: Callable[[PendingMessage], Awaitable[str | None]]) -> None:
        """Send the messages of the outbox as they come.

        Args:
            outbox: where they are confirmed.
            send: returns when a message was confirmed, or why it was refused for good; raises an error if it may be
                delivered later.
        """
        while True:
            batch = await asyncio.to_thread(outbox.pending, self.name, BATCH)
            for message in batch:
                try:
                    refusal = await send(message)
                except Exception:
                    delay_s = min(MIN_DELAY_S * 2.0 ** min(message.tries, 16), MAX_DELAY_S)
                    await asyncio.to_thread(outbox.defer, self.name, message.number, delay_s)
                    raise
                await asyncio.to_thread(outbox.confirm, self.name, message.number, refusal)
            if not batch:
                await self.await_news()
