"""Clients: the pages that take part."""

from __future__ import annotations

import asyncio
import secrets
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, get_args

from arview.core.messages import with_messages
from arview.errors import InputError
from arview.station.live.jobs.desk import Binding
from arview.station.live.protocol import FRAME_IDS, Transport, ViewMode
from arview.station.live.security.refusals import Refusal
from arview.station.live.stream.annotator import AnnotatedFrame, FrameAnnotator, Screen
from arview.station.live.stream.documents import Document, pose_document
from arview.station.live.stream.feed import Feed, TrackedFrame
from arview.station.live.stream.newest import AsyncNewestSlot
from arview.station.live.stream.subject import OverlayStyle
from arview.station.live.transport.webrtc import Connection

MAX_JOB_NAME = 200
"""Letters of the name of a job."""
_STYLE_TYPES: dict[str, tuple[type, ...]] = {
    "ghost": (bool,),
    "edges": (str,),
    "labels": (bool,),
    "opacity": (int, float),
    "only": (str, type(None)),
    "only_part": (int,),
    "status": (bool,),
}


class Client:
    """A page that takes part.

    Attributes:
        name: random name of the client in URLs.
        device: name of the paired device; None where devices are not paired.
        feed, annotator: those of the phone, or those that all pages of a station camera share.
        transport: how frames and poses are transmitted.
        mode: what the page wants to receive.
        screen: where the page shows annotated video; None: it is not told.
        connection: the WebRTC connection, if that is the transport.
        inbox: newest frame of the feed, for the transport without WebRTC.
        binding: job that the page shows, if any.
        serial: serial number of the job that it showed last.
        held: frame that is kept for a snapshot.
        is_busy: whether a request for a frame is being served.
        joined_s, seen_s: monotonic times of joining and of the last request.
        last_status: content of the last status message that was sent, and its monotonic time.
    """

    def __init__(
        self,
        feed: Feed,
        annotator: FrameAnnotator,
        transport: Transport,
        mode: ViewMode,
        device: str | None = None,
    ) -> None:
        self.name, self.device = secrets.token_urlsafe(12), device
        self.feed, self.annotator, self.transport, self.mode = feed, annotator, transport, mode
        self.screen: Screen | None = None
        self.connection: Connection | None = None
        self.inbox: AsyncNewestSlot[TrackedFrame] = AsyncNewestSlot(asyncio.get_running_loop())
        self.binding: Binding | None = None
        self.serial: str | None = None
        self.held: TrackedFrame | None = None
        self.is_busy = False
        self.joined_s = self.seen_s = time.monotonic()
        self.last_status: tuple[object, float] = (None, 0.0)
        if transport == "jpeg":
            feed.listen(self.inbox.put)

    async def close(self) -> None:
        """Close the connection and stop listening to the feed."""
        self.feed.unlisten(self.inbox.put)
        if self.connection is not None:
            await self.connection.close()

    def shown(self, tracked: TrackedFrame) -> TrackedFrame:
        """A tracked frame with what this page shows of it: the labels of its job."""
        return tracked if self.binding is None else self.binding.view.shown(tracked)

    def draw(self, tracked: TrackedFrame) -> AnnotatedFrame:
        """A tracked frame with the overlay of this page, for its screen; not in the event loop."""
        return self.annotator.draw(self.shown(tracked), screen=self.screen)

    def document(self, tracked: TrackedFrame) -> Document:
        """*Pose* of a tracked frame for this page."""
        document = with_messages(pose_document(self.shown(tracked), time.monotonic()))
        guiding = None if self.binding is None else self.binding.guiding
        if guiding is not None and (advice := guiding.document()) is not None:
            document["capture"] = advice
        return document

    def told(self, message: Document) -> None:
        """Take a message of the page on the data channel."""
        if message.get("type") == "motion":
            self.turned(message.get("gyro_rad_s"))

    def turned(self, gyro_rad_s: Any) -> None:
        """Note how fast the device turns, for guided capture; anything but a number of rad/s is ignored."""
        is_number = isinstance(gyro_rad_s, int | float) and not isinstance(gyro_rad_s, bool)
        if self.binding is not None and self.binding.guiding is not None and is_number and 0.0 <= gyro_rad_s < 100.0:
            self.binding.guiding.gyro_rad_s = float(gyro_rad_s)

    def find(self, frame_id: int) -> TrackedFrame | None:
        """The tracked frame with this id, if it is still kept."""
        if self.held is not None and self.held.frame.frame_id == frame_id:
            return self.held
        return self.feed.find(frame_id)

    def seen(self) -> None:
        """Note the time of a request."""
        self.seen_s = time.monotonic()


def choice_of(value: Any, kind: Any, name: str) -> Any:
    """The value, which must be one of those of a Literal.

    Raises:
        Refusal: it is another value.
    """
    choices = get_args(kind)
    if not isinstance(value, str) or value not in choices:
        raise Refusal(400, "bad_request", f"{name}: expected one of {', '.join(choices)}")
    return value


def screen_of(value: Any) -> Screen | None:
    """The ``screen`` of a *Control* request; None when it is none."""
    if not isinstance(value, dict) or value.keys() != {"width", "height", "density"}:
        return None
    numbers = [value[key] for key in ("width", "height", "density")]
    if any(isinstance(one, bool) or not isinstance(one, int | float) for one in numbers):
        return None
    width, height, density = numbers
    if not all(float(side).is_integer() and 64 <= side <= 8192 for side in (width, height)):
        return None
    return Screen(int(width), int(height), float(density)) if 0.5 <= density <= 8.0 else None


def check_control(control: dict[str, Any], style: OverlayStyle, components: Sequence[Sequence[str]]) -> OverlayStyle:
    """The overlay style after a *Control* request, all of which is checked.

    Args:
        control: the request.
        style: overlay style so far.
        components: names of the components of each part.

    Raises:
        Refusal: an unknown key, or a wrong type or value.
    """

    def is_part(value: Any) -> bool:
        return type(value) is int and 0 <= value < len(components)

    def is_name(value: Any) -> bool:
        return isinstance(value, str) and 0 < len(value) <= MAX_JOB_NAME

    for key, value in control.items():
        is_good = {
            "mode": isinstance(value, str) and value in get_args(ViewMode),
            "style": isinstance(value, dict),
            "reset": isinstance(value, bool) or is_part(value),
            "confirm": (isinstance(value, bool) and (len(components) == 1 or not value)) or is_part(value),
            "record": isinstance(value, bool),
            "screen": value is None or screen_of(value) is not None,
            "job": value is None or is_name(value),
            "capture": value is None or is_name(value),
            "hold": value is None or (type(value) is int and 0 <= value < FRAME_IDS),
        }.get(key, False)
        if not is_good:
            raise Refusal(400, "bad_control", f"control: {key[:40]!r} is unknown or has a wrong value")
    wanted = control.get("style", {})
    for key, value in wanted.items():
        kinds = _STYLE_TYPES.get(key)
        if kinds is None or not isinstance(value, kinds) or (isinstance(value, bool) and bool not in kinds):
            raise Refusal(400, "bad_control", f"style: {key[:40]!r} is unknown or has a wrong value")
    if "only_part" in wanted and not is_part(wanted["only_part"]):
        raise Refusal(400, "bad_control", "style: only_part is not the number of a part")
    if wanted.get("only") is not None and wanted["only"] not in components[wanted.get("only_part", 0)]:
        raise Refusal(400, "bad_control", "style: only is no component of the part")
    try:
        return replace(style, **{"only_part": 0, **wanted} if "only" in wanted else wanted)
    except InputError as error:
        raise Refusal(400, "bad_control", str(error)) from error
