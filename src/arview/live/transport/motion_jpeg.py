"""Motion JPEG over HTTP, for screens that only watch."""

from __future__ import annotations

import asyncio
import time
from contextlib import suppress
from typing import Protocol

from starlette.responses import Response
from starlette.types import Receive, Scope, Send

from arview.live.stream.drawing import Drawing
from arview.live.stream.feed import Feed, Tracked
from arview.live.stream.subject import Look

BOUNDARY = "arview-frame"
SEND_TIMEOUT_S = 10.0
"""A screen that takes no picture for so long has gone."""
WAIT_S = 2.0
"""Without a new picture for so long the last is sent again, so that a vanished screen is noticed."""


class Watchable(Protocol):
    """Whatever provides the stream that watching screens show; the hub of the server does.

    Attributes:
        watchers: number of screens that are being served.
    """

    watchers: int

    def watched(self) -> tuple[Feed, Drawing] | None:
        """The feed to show and its drawing, or None while there is none."""
        ...


class MotionJpeg(Response):
    """An endless answer: the newest annotated picture, again and again, as fast as the screen takes them."""

    def __init__(self, hub: Watchable, fps: float) -> None:
        super().__init__()
        self._hub, self._fps = hub, fps

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send pictures until the screen goes."""
        kind = f"multipart/x-mixed-replace; boundary={BOUNDARY}".encode()
        await send({"type": "http.response.start", "status": 200, "headers": [(b"content-type", kind)]})
        self._hub.watchers += 1
        gone = asyncio.ensure_future(_disconnected(receive))
        try:
            with suppress(TimeoutError):
                await self._send_pictures(send, gone)
        finally:
            self._hub.watchers -= 1
            gone.cancel()

    async def _send_pictures(self, send: Send, gone: asyncio.Future[None]) -> None:
        shown: Tracked | None = None
        sent_s = 0.0
        while not gone.done():
            watched = self._hub.watched()
            newest = watched[0].newest if watched is not None else None
            is_due = newest is not shown or time.monotonic() - sent_s > WAIT_S
            if watched is None or newest is None or not is_due:
                await asyncio.wait([gone], timeout=0.02)
                continue
            content = await asyncio.to_thread(_jpeg, watched[1], newest)
            head = f"--{BOUNDARY}\r\nContent-Type: image/jpeg\r\nContent-Length: {len(content)}\r\n\r\n"
            message = {"type": "http.response.body", "body": head.encode() + content + b"\r\n", "more_body": True}
            await asyncio.wait_for(send(message), SEND_TIMEOUT_S)
            shown, sent_s = newest, time.monotonic()
            await asyncio.wait([gone], timeout=1.0 / self._fps)


def _jpeg(drawing: Drawing, tracked: Tracked) -> bytes:
    return drawing.draw(tracked, Look()).jpeg


async def _disconnected(receive: Receive) -> None:
    while (await receive())["type"] != "http.disconnect":
        pass
