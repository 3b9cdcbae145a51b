"""The WebRTC connection of a page: receives camera frames, sends poses and pictures, always the newest."""

from __future__ import annotations

import asyncio
import ipaddress
import json
import re
import time
from collections.abc import Callable, Coroutine, Sequence
from contextlib import suppress
from fractions import Fraction
from functools import partial
from typing import Any, Protocol

import aiortc.codecs.h264
import aiortc.codecs.vpx
from aiortc import RTCConfiguration, RTCPeerConnection, RTCSessionDescription
from aiortc.mediastreams import MediaStreamError, MediaStreamTrack
from av.video.frame import VideoFrame

from arview.errors import InputError
from arview.station.live.protocol import CHANNEL, ViewMode
from arview.station.live.stream.annotator import AnnotatedFrame
from arview.station.live.stream.documents import Document
from arview.station.live.stream.feed import Feed, TrackedFrame
from arview.station.live.stream.frames import IncomingFrame, from_stamped
from arview.station.live.stream.newest import AsyncNewestSlot
from arview.station.live.stream.stamp import stamped
from arview.station.live.transport.receiving import reduce_latency, restrict_candidates

MAX_CANDIDATES = 32
"""ICE candidates in an offer."""
MAX_BUFFERED_BYTES = 32_768
"""Messages waiting on the data channel, about fifteen; later ones are dropped."""

_CLOCK_HZ = 90_000
MAX_MESSAGE = 1000
"""Letters of a message of a page."""
_BITRATES = {"DEFAULT_BITRATE": 2_500_000, "MIN_BITRATE": 500_000, "MAX_BITRATE": 8_000_000}
"""Bitrates of aiortc's encoders, bit/s. Its own ones are for video calls, in which labels would not be readable."""
_KBITS = "x-google-min-bitrate=800;x-google-start-bitrate=4000;x-google-max-bitrate=10000"
"""Bitrates that Chromium is asked to send, kbit/s. It would start at 300, too blurred to detect the part."""


def raise_bitrates() -> None:
    """Make the encoders of aiortc use the bitrates above, in this process."""
    for codec in (aiortc.codecs.h264, aiortc.codecs.vpx):
        for name, value in _BITRATES.items():
            setattr(codec, name, value)


class Viewer(Protocol):
    """The page at the other end of a connection.

    Attributes:
        mode: what it wants to receive.
    """

    mode: ViewMode

    def draw(self, tracked: TrackedFrame, /) -> AnnotatedFrame:
        """A tracked frame with the overlay of the page."""
        ...

    def document(self, tracked: TrackedFrame, /) -> Document:
        """*Pose* of a tracked frame for the page."""
        ...

    def told(self, message: Document, /) -> None:
        """Take a message of the page."""
        ...


class OutgoingVideoTrack(MediaStreamTrack):
    """The track that sends the newest frames of a feed, stamped.

    Args:
        feed: the feed.
        viewer: who sees it. In mode "video" annotated frames are sent, in mode "poses" the plain frames of a station
            camera; a phone has its own frames.
    """

    kind = "video"

    def __init__(self, feed: Feed, viewer: Viewer) -> None:
        super().__init__()
        self._feed, self._viewer = feed, viewer
        self._inbox: AsyncNewestSlot[TrackedFrame] = AsyncNewestSlot(asyncio.get_running_loop())
        self._began_s = time.monotonic()
        self._ticks = -1
        feed.listen(self._inbox.put)

    async def recv(self) -> VideoFrame:
        """Wait for the next frame to send."""
        while True:
            tracked = await self._inbox.take()
            if self.readyState != "live":
                raise MediaStreamError
            mode = self._viewer.mode
            if mode == "poses" and self._feed.kind == "phone":
                continue
            frame = await asyncio.to_thread(self._frame, tracked, mode)
            self._ticks = max(self._ticks + 1, round((time.monotonic() - self._began_s) * _CLOCK_HZ))
            frame.pts, frame.time_base = self._ticks, Fraction(1, _CLOCK_HZ)
            return frame

    def stop(self) -> None:
        """End the track."""
        self._feed.unlisten(self._inbox.put)
        super().stop()

    def _frame(self, tracked: TrackedFrame, mode: ViewMode) -> VideoFrame:
        image = self._viewer.draw(tracked).image if mode == "video" else tracked.frame.image
        height, width = image.shape[0] // 2 * 2, image.shape[1] // 2 * 2
        return VideoFrame.from_ndarray(stamped(image[:height, :width], tracked.frame.frame_id), format="rgb24")


class Connection:
    """A peer connection.

    Args:
        feed: receives the camera frames of the page, or provides those of the station camera.
        viewer: the page.
        addresses: addresses at which ICE candidates are offered.
        on_end: called once when the connection has failed or the page has closed it.

    Attributes:
        is_connected: whether the connection is established.
        dropped: number of messages dropped because the page was too slow.
    """

    def __init__(
        self,
        feed: Feed,
        viewer: Viewer,
        addresses: Sequence[str],
        on_end: Callable[[], None],
    ) -> None:
        self._feed, self._viewer = feed, viewer
        self._addresses, self._on_end = addresses, on_end
        self._peer = RTCPeerConnection(RTCConfiguration(iceServers=[]))
        self._channel: Any = None
        self._track: OutgoingVideoTrack | None = None
        self._inbox: AsyncNewestSlot[TrackedFrame] = AsyncNewestSlot(asyncio.get_running_loop())
        self._tasks: set[asyncio.Task[None]] = set()
        self._is_closed = False
        self.is_connected = False
        self.dropped = 0
        self._peer.on("track", self._on_track)
        self._peer.on("datachannel", self._on_channel)
        self._peer.on("connectionstatechange", self._on_state)

    async def answer(self, offer_sdp: str) -> str:
        """The SDP that answers the offer of a page.

        Raises:
            InputError: the offer is damaged or does not follow the protocol.
        """
        try:
            await self._peer.setRemoteDescription(
                RTCSessionDescription(_checked_offer(offer_sdp, MAX_CANDIDATES), "offer")
            )
            videos = [one for one in self._peer.getTransceivers() if one.kind == "video"]
            if len(videos) != 1 or self._peer.sctp is None:
                raise InputError("the offer needs one video transceiver and one data channel")
            self._track = OutgoingVideoTrack(self._feed, self._viewer)
            self._peer.addTrack(self._track)
            restrict_candidates(self._peer, self._addresses)
            await self._peer.setLocalDescription(await self._peer.createAnswer())
        except InputError:
            raise
        except Exception as error:  # the parser of aiortc raises exceptions of many types
            raise InputError(f"the offer cannot be used ({type(error).__name__})") from error
        self._feed.listen(self._inbox.put)
        self._start(self._send_poses())
        return _with_bitrates(self._peer.localDescription.sdp)

    def send(self, document: Document) -> None:
        """Send a message; it is dropped when the channel is congested or not open yet."""
        channel = self._channel
        if channel is None or channel.readyState != "open":
            return
        if channel.bufferedAmount > MAX_BUFFERED_BYTES:
            self.dropped += 1
            return
        channel.send(json.dumps(document, allow_nan=False))

    async def close(self) -> None:
        """Close the connection with its tasks and tracks."""
        self._is_closed = True
        self._feed.unlisten(self._inbox.put)
        for task in self._tasks:
            task.cancel()
        if self._track is not None:
            self._track.stop()
        with suppress(Exception):  # a connection that broke while being set up cannot always be closed cleanly
            await asyncio.wait_for(self._peer.close(), timeout=5.0)
        self._peer.remove_all_listeners()

    def _on_track(self, track: Any) -> None:
        for transceiver in self._peer.getTransceivers():
            if transceiver.receiver.track is track:
                reduce_latency(transceiver.receiver)
        self._start(self._drain(track))

    def _on_channel(self, channel: Any) -> None:
        if channel.label == CHANNEL and self._channel is None:
            self._channel = channel
            channel.on("message", self._on_message)

    def _on_message(self, message: Any) -> None:
        """Take a message of the page; what is no small JSON object is ignored."""
        if not isinstance(message, str) or len(message) > MAX_MESSAGE:
            return
        try:
            document = json.loads(message)
        except (ValueError, RecursionError):
            return
        if isinstance(document, dict):
            self._viewer.told(document)

    def _on_state(self) -> None:
        self.is_connected = self._peer.connectionState == "connected"
        if self._peer.connectionState in ("failed", "closed") and not self._is_closed:
            self._is_closed = True
            self._on_end()

    async def _drain(self, track: Any) -> None:
        """Take every decoded frame immediately, so that none waits in aiortc."""
        with suppress(MediaStreamError):
            while True:
                frame = await track.recv()
                if self._feed.kind == "phone" and isinstance(frame, VideoFrame):
                    self._feed.put(IncomingFrame(partial(from_stamped, frame), time.monotonic()))

    async def _send_poses(self) -> None:
        while True:
            tracked = await self._inbox.take()
            self.send(self._viewer.document(tracked))

    def _start(self, work: Coroutine[Any, Any, None]) -> None:
        task = asyncio.ensure_future(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)


def _checked_offer(sdp: str, max_candidates: int) -> str:
    """An offer without candidates that would make the server resolve names or contact addresses outside the network.

    The candidates of the page are hardly needed: its connectivity checks arrive here and show its address. The end of
    candidates is removed so that the server waits for these checks.

    Raises:
        InputError: too many candidates, or other media than the protocol defines.
    """
    lines = []
    candidates = 0
    for line in sdp.splitlines():
        if line.startswith("a=end-of-candidates"):
            continue
        if line.startswith("a=candidate:"):
            fields = line.split()
            candidates += 1
            if candidates > max_candidates:
                raise InputError(f"the offer holds more than {max_candidates} candidates")
            if len(fields) < 8 or fields[2].lower() != "udp" or not _is_local(fields[4]):
                continue
        lines.append(line)
    if sum(line.startswith("m=") for line in lines) != 2:
        raise InputError("the offer needs one video transceiver and one data channel")
    return "\r\n".join(lines) + "\r\n"


def _is_local(address: str) -> bool:
    """Whether this is an address of a local network and not a name; no other is contacted."""
    try:
        return ipaddress.ip_address(address).is_private
    except ValueError:
        return False


def _with_bitrates(sdp: str) -> str:
    """An answer that asks Chromium for a high bitrate from the start; other browsers ignore it."""
    lines = sdp.splitlines()
    video = [
        match.group(1) for line in lines if (match := re.match(r"a=rtpmap:(\d+) (?:VP8|H264)/90000", line)) is not None
    ]
    done = set()
    for index, line in enumerate(lines):
        match = re.match(r"a=fmtp:(\d+) ", line)
        if match and match.group(1) in video:
            lines[index] = f"{line};{_KBITS}"
            done.add(match.group(1))
    for payload in video:
        if payload not in done:
            place = next(i for i, line in enumerate(lines) if line.startswith(f"a=rtpmap:{payload} "))
            lines.insert(place + 1, f"a=fmtp:{payload} {_KBITS}")
    return "\r\n".join(lines) + "\r\n"
