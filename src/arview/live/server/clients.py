"""Client: one page that takes part."""

from __future__ import annotations

import asyncio
import secrets
import time
from dataclasses import replace
from typing import Any, get_args

from arview.errors import InputError
from arview.live.protocol import FRAME_IDS, Transport, Way
from arview.live.security.refusals import Refusal
from arview.live.stream.drawing import Drawing
from arview.live.stream.feed import Feed, Tracked
from arview.live.stream.newest import Inbox
from arview.live.stream.subject import Look
from arview.live.transport.webrtc import Connection

_LOOKS: dict[str, tuple[type, ...]] = {
    "ghost": (bool,),
    "edges": (str,),
    "labels": (bool,),
    "opacity": (int, float),
    "only": (str, type(None)),
    "status": (bool,),
}


class Client:
    """A page that takes part.

    Attributes:
        name: by which the page is called in addresses; not to be guessed.
        feed, drawing: its own for a phone, common to all of a station.
        way: what it wants back.
        connection: its WebRTC connection, if that is its transport.
        inbox: newest frame of the feed, for the transport without WebRTC.
        held: frame that it keeps for a snapshot.
        is_busy: a JPEG of it is being tracked.
        seen_s: monotonic time of its last request.
    """

    def __init__(self, feed: Feed, drawing: Drawing, transport: Transport, way: Way) -> None:
        self.name = secrets.token_urlsafe(12)
        self.feed, self.drawing, self.transport, self.way = feed, drawing, transport, way
        self.connection: Connection | None = None
        self.inbox: Inbox[Tracked] = Inbox(asyncio.get_running_loop())
        self.held: Tracked | None = None
        self.is_busy = False
        self.joined_s = self.seen_s = time.monotonic()
        self.told: tuple[object, float] = (None, 0.0)  # what the last status said, and when
        if transport == "jpeg":
            feed.listen(self.inbox.put)

    async def close(self) -> None:
        """Let go of the connection and of the feed's frames."""
        self.feed.unlisten(self.inbox.put)
        if self.connection is not None:
            await self.connection.close()

    def find(self, frame_id: int) -> Tracked | None:
        """A tracked frame that is still kept."""
        if self.held is not None and self.held.picture.frame_id == frame_id:
            return self.held
        return self.feed.find(frame_id)

    def seen(self) -> None:
        """Note a sign of life."""
        self.seen_s = time.monotonic()


def one_of(value: Any, kind: Any, name: str) -> Any:
    """A value that must be one of a Literal's.

    Raises:
        Refusal: another value.
    """
    choices = get_args(kind)
    if not isinstance(value, str) or value not in choices:
        raise Refusal(400, "bad_request", f"{name}: expected one of {', '.join(choices)}")
    return value


def check_control(control: dict[str, Any], look: Look, components: tuple[str, ...]) -> Look:
    """The look after a control, all of which is checked.

    Raises:
        Refusal: an unknown key, a wrong type or value.
    """
    for key, value in control.items():
        is_good = {
            "way": isinstance(value, str) and value in get_args(Way),
            "look": isinstance(value, dict),
            "reset": isinstance(value, bool),
            "record": isinstance(value, bool),
            "hold": value is None or (type(value) is int and 0 <= value < FRAME_IDS),
        }.get(key, False)
        if not is_good:
            raise Refusal(400, "bad_control", f"control: {key[:40]!r} is unknown or has a wrong value")
    wanted = control.get("look", {})
    for key, value in wanted.items():
        kinds = _LOOKS.get(key)
        if kinds is None or not isinstance(value, kinds) or (isinstance(value, bool) and bool not in kinds):
            raise Refusal(400, "bad_control", f"look: {key[:40]!r} is unknown or has a wrong value")
    if wanted.get("only") is not None and wanted["only"] not in components:
        raise Refusal(400, "bad_control", "look: only names no component of the part")
    try:
        return replace(look, **wanted)
    except InputError as error:
        raise Refusal(400, "bad_control", str(error)) from error
