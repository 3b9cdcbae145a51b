"""Motion JPEG over HTTP for screens that only watch."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Protocol

from starlette.responses import Response
from starlette.types import Receive, Scope, Send

from arview.station.live.stream.annotator import FrameAnnotator
from arview.station.live.stream.feed import Feed, TrackedFrame
from arview.station.live.stream.subject import OverlayStyle

WATCH_FPS = 15.0
"""Frame rate of these: enough to watch, at half the encoding work."""
WATCH_TIMEOUT_S = 10.0
"""A screen that takes no picture for so long is disconnected."""
WATCH_REPEAT_S = 2.0
"""Without a new picture the last one is sent again, to notice closed connections."""

BOUNDARY = "arview-frame"


class Watchable(Protocol):
    """Whatever provides the stream that watching screens show; the hub of the server does.

    Attributes:
        watchers: number of screens that are being served.
    """

    watchers: int

    def watched(self) -> tuple[Feed, FrameAnnotator] | None:
        """The feed to show and its annotator, or None while there is none."""
        ...


class MotionJpeg(Response):
    """An endless response: the newest annotated pictures, as fast as the screen takes them.

    Args:
        hub: provides the feed.
        may_watch: asked before each picture; the response ends when the device is no longer paired.
    """

    def __init__(self, hub: Watchable, may_watch: Callable[[], bool] = lambda: True) -> None:
        super().__init__()
        self._hub, self._may_watch = hub, may_watch

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send pictures until the screen disconnects."""
        kind = f"multipart/x-mixed-replace; boundary={BOUNDARY}".encode()
        await send({"type": "http.response.start", "status": 200, "headers": [(b"content-type", kind)]})
        self._hub.watchers += 1
        disconnected = asyncio.ensure_future(_wait_for_disconnect(receive))
        try:
            with suppress(TimeoutError):
                await self._send_pictures(send, disconnected)
        finally:
            self._hub.watchers -= 1
            disconnected.cancel()

    async def _send_pictures(self, send: Send, disconnected: asyncio.Future[None]) -> None:
        shown: TrackedFrame | None = None
        sent_s = 0.0
        while not disconnected.done() and self._may_watch():
            watched = self._hub.watched()
            newest = watched[0].newest if watched is not None else None
            is_due = newest is not shown or time.monotonic() - sent_s > WATCH_REPEAT_S
            if watched is None or newest is None or not is_due:
                await asyncio.wait([disconnected], timeout=0.02)
                continue
            content = await asyncio.to_thread(_jpeg, watched[1], newest)
            head = f"--{BOUNDARY}\r\nContent-Type: image/jpeg\r\nContent-Length: {len(content)}\r\n\r\n"
            message = {"type": "http.response.body", "body": head.encode() + content + b"\r\n", "more_body": True}
            await asyncio.wait_for(send(message), WATCH_TIMEOUT_S)
            shown, sent_s = newest, time.monotonic()
            await asyncio.wait([disconnected], timeout=1.0 / WATCH_FPS)


def _jpeg(annotator: FrameAnnotator, tracked: TrackedFrame) -> bytes:
    return annotator.draw(tracked, OverlayStyle()).jpeg


async def _wait_for_disconnect(receive: Receive) -> None:
    while (await receive())["type"] != "http.disconnect":
        pass
