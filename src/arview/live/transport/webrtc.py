"""One WebRTC connection of one page: camera frames in, poses and pictures out, the newest only."""

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
from typing import Any

import aiortc.codecs.h264
import aiortc.codecs.vpx
from aiortc import RTCConfiguration, RTCPeerConnection, RTCSessionDescription
from aiortc.mediastreams import MediaStreamError, MediaStreamTrack
from av.video.frame import VideoFrame

from arview.errors import InputError
from arview.live.protocol import CHANNEL, Way
from arview.live.stream.documents import Document, pose_document
from arview.live.stream.drawing import Drawing
from arview.live.stream.feed import Feed, Tracked
from arview.live.stream.frames import Incoming, from_stamped
from arview.live.stream.newest import Inbox
from arview.live.stream.stamp import stamped
from arview.live.transport.receiving import bind_to, make_prompt

BEHIND_BYTES = 32_768
"""So much waiting on the data channel, some fifteen answers, and new ones are left out."""
MOST_CANDIDATES = 32
_CLOCK_HZ = 90_000
_BITRATES = {"DEFAULT_BITRATE": 2_500_000, "MIN_BITRATE": 500_000, "MAX_BITRATE": 8_000_000}
"""Of what aiortc encodes, bit/s: its own limits are for video calls; labels are to be read over a local network."""
_KBITS = "x-google-min-bitrate=800;x-google-start-bitrate=4000;x-google-max-bitrate=10000"
"""What Chromium is asked to send: it would begin with 300 kbit/s, too blurred to find the part."""


def raise_bitrates() -> None:
    """Have aiortc encode at the rates above, in this process."""
    for codec in (aiortc.codecs.h264, aiortc.codecs.vpx):
        for name, value in _BITRATES.items():
            setattr(codec, name, value)


class BackTrack(MediaStreamTrack):
    """The newest picture of a feed as the page has asked for it, stamped; waits while there is none to send.

    Args:
        feed: whose frames are sent.
        drawing: draws them.
        way: called for each frame; "video": annotated. "poses": plain, of a station; a phone has its own frames.
    """

    kind = "video"

    def __init__(self, feed: Feed, drawing: Drawing, way: Callable[[], Way]) -> None:
        super().__init__()
        self._feed, self._drawing, self._way = feed, drawing, way
        self._inbox: Inbox[Tracked] = Inbox(asyncio.get_running_loop())
        self._began_s = time.monotonic()
        self._ticks = -1
        feed.listen(self._inbox.put)

    async def recv(self) -> VideoFrame:
        """The next frame to send."""
        while True:
            tracked = await self._inbox.take()
            if self.readyState != "live":
                raise MediaStreamError
            way = self._way()
            if way == "poses" and self._feed.kind == "phone":
                continue
            frame = await asyncio.to_thread(self._frame, tracked, way)
            self._ticks = max(self._ticks + 1, round((time.monotonic() - self._began_s) * _CLOCK_HZ))
            frame.pts, frame.time_base = self._ticks, Fraction(1, _CLOCK_HZ)
            return frame

    def stop(self) -> None:
        """End the track."""
        self._feed.unlisten(self._inbox.put)
        super().stop()

    def _frame(self, tracked: Tracked, way: Way) -> VideoFrame:
        image = self._drawing.draw(tracked).image if way == "video" else tracked.picture.image
        height, width = image.shape[0] // 2 * 2, image.shape[1] // 2 * 2
        return VideoFrame.from_ndarray(stamped(image[:height, :width], tracked.picture.frame_id), format="rgb24")


class Connection:
    """A peer connection.

    Args:
        feed: gets the page's camera frames, or has a station's.
        drawing: of that feed.
        way: what the page wants back, asked for each frame.
        addresses: at which to offer ICE candidates.
        on_end: called once when the connection has failed or was closed by the page.
    """

    def __init__(
        self,
        feed: Feed,
        drawing: Drawing,
        way: Callable[[], Way],
        addresses: Sequence[str],
        on_end: Callable[[], None],
    ) -> None:
        self._feed, self._drawing, self._way = feed, drawing, way
        self._addresses, self._on_end = addresses, on_end
        self._peer = RTCPeerConnection(RTCConfiguration(iceServers=[]))
        self._channel: Any = None
        self._track: BackTrack | None = None
        self._inbox: Inbox[Tracked] = Inbox(asyncio.get_running_loop())
        self._tasks: set[asyncio.Task[None]] = set()
        self._is_closed = False
        self.is_connected = False
        self.left_out = 0  # answers that the page was too slow for
        self._peer.on("track", self._on_track)
        self._peer.on("datachannel", self._on_channel)
        self._peer.on("connectionstatechange", self._on_state)

    async def answer(self, offer_sdp: str) -> str:
        """The SDP that answers a page's offer.

        Raises:
            InputError: an offer that is damaged or asks for something else than the protocol says.
        """
        try:
            await self._peer.setRemoteDescription(RTCSessionDescription(_checked(offer_sdp), "offer"))
            videos = [one for one in self._peer.getTransceivers() if one.kind == "video"]
            if len(videos) != 1 or self._peer.sctp is None:
                raise InputError("the offer needs one video transceiver and one data channel")
            self._track = BackTrack(self._feed, self._drawing, self._way)
            self._peer.addTrack(self._track)
            bind_to(self._peer, self._addresses)
            await self._peer.setLocalDescription(await self._peer.createAnswer())
        except InputError:
            raise
        except Exception as error:  # aiortc raises whatever its parser stumbles over
            raise InputError(f"the offer cannot be used ({type(error).__name__})") from error
        self._feed.listen(self._inbox.put)
        self._start(self._send_poses())
        return _faster(self._peer.localDescription.sdp)

    def send(self, document: Document) -> None:
        """Send a message, or leave it out when the page is behind or not there yet."""
        channel = self._channel
        if channel is None or channel.readyState != "open":
            return
        if channel.bufferedAmount > BEHIND_BYTES:
            self.left_out += 1
            return
        channel.send(json.dumps(document, allow_nan=False))

    async def close(self) -> None:
        """End the connection and all that belongs to it."""
        self._is_closed = True
        self._feed.unlisten(self._inbox.put)
        for task in self._tasks:
            task.cancel()
        if self._track is not None:
            self._track.stop()
        with suppress(Exception):  # a connection that broke half-way cannot always be closed in good order
            await asyncio.wait_for(self._peer.close(), timeout=5.0)
        self._peer.remove_all_listeners()

    def _on_track(self, track: Any) -> None:
        for transceiver in self._peer.getTransceivers():
            if transceiver.receiver.track is track:
                make_prompt(transceiver.receiver)
        self._start(self._drain(track))

    def _on_channel(self, channel: Any) -> None:
        if channel.label == CHANNEL and self._channel is None:
            self._channel = channel

    def _on_state(self) -> None:
        self.is_connected = self._peer.connectionState == "connected"
        if self._peer.connectionState in ("failed", "closed") and not self._is_closed:
            self._is_closed = True
            self._on_end()

    async def _drain(self, track: Any) -> None:
        """Take every decoded frame at once, so that none waits in aiortc."""
        with suppress(MediaStreamError):
            while True:
                frame = await track.recv()
                if self._feed.kind == "phone" and isinstance(frame, VideoFrame):
                    self._feed.put(Incoming(partial(from_stamped, frame), time.monotonic()))

    async def _send_poses(self) -> None:
        while True:
            tracked = await self._inbox.take()
            self.send(pose_document(tracked, time.monotonic()))

    def _start(self, work: Coroutine[Any, Any, None]) -> None:
        task = asyncio.ensure_future(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)


def _checked(sdp: str) -> str:
    """An offer without what would make the server look up names or call many addresses.

    The page's own candidates are hardly needed: its checks arrive here and tell its address. Without an end of
    candidates the server waits for them.
    """
    lines = []
    candidates = 0
    for line in sdp.splitlines():
        if line.startswith("a=end-of-candidates"):
            continue
        if line.startswith("a=candidate:"):
            fields = line.split()
            candidates += 1
            if candidates > MOST_CANDIDATES:
                raise InputError(f"the offer holds more than {MOST_CANDIDATES} candidates")
            if len(fields) < 8 or fields[2].lower() != "udp" or not _is_local(fields[4]):
                continue
        lines.append(line)
    if sum(line.startswith("m=") for line in lines) != 2:
        raise InputError("the offer needs one video transceiver and one data channel")
    return "\r\n".join(lines) + "\r\n"


def _is_local(address: str) -> bool:
    """Whether this is an address, not a name, of a local network: no other is ever called."""
    try:
        return ipaddress.ip_address(address).is_private
    except ValueError:
        return False


def _faster(sdp: str) -> str:
    """An answer that asks Chromium for enough bits from the start; other browsers do not know the words."""
    lines = sdp.splitlines()
    video = [
        match.group(1) for line in lines if (match := re.match(r"a=rtpmap:(\d+) (?:VP8|H264)/90000", line)) is not None
    ]
    told = set()
    for index, line in enumerate(lines):
        match = re.match(r"a=fmtp:(\d+) ", line)
        if match and match.group(1) in video:
            lines[index] = f"{line};{_KBITS}"
            told.add(match.group(1))
    for payload in video:
        if payload not in told:
            place = next(i for i, line in enumerate(lines) if line.startswith(f"a=rtpmap:{payload} "))
            lines.insert(place + 1, f"a=fmtp:{payload} {_KBITS}")
    return "\r\n".join(lines) + "\r\n"
