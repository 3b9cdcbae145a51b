"""Changes to aiortc for live video: low latency, bounded queues, and candidates on chosen interfaces only.

aiortc passes a frame to the decoder when the first packet of the next frame arrives, which is 33 ms late at 30 fps. The
queue of its decoder grows without limit on a slow machine, and it offers ICE candidates on all interfaces except the
loopback. These functions change that for one connection. They use private names of aiortc (1.14 to 1.16) and aioice,
and have no effect with later versions that no longer have these names.
"""

from __future__ import annotations

import logging
import queue
from collections.abc import Awaitable, Callable, Sequence
from functools import partial
from typing import Any

from aiortc.jitterbuffer import JitterBuffer, JitterFrame

logger = logging.getLogger("arview.station.live")

MAX_WAITING_FRAMES = 3
"""Encoded frames that may wait for the decoder; when there are more, it cannot keep up."""
_BUFFER = "_RTCRtpReceiver__jitter_buffer"
_QUEUE = "_RTCRtpReceiver__decoder_queue"
_ERROR = "_RTCRtpReceiver__decoder_error"


class PromptJitterBuffer(JitterBuffer):
    """Releases a frame at its last packet, which has the marker bit (RFC 3550 5.1, RFC 7741 4.1, RFC 6184 5.1)."""

    def _remove_frame(self, sequence_number: int) -> JitterFrame | None:
        packets: list[Any] = []
        for count in range(self._capacity):
            packet = self._packets[(self._origin + count) % self._capacity]
            if packet is None:
                return None
            if packets and packet.timestamp != packets[0].timestamp:
                break  # the marker is missing: the next frame has begun
            packets.append(packet)
            if packet.marker:
                break
        self.remove(len(packets))
        return JitterFrame(data=b"".join(packet._data for packet in packets), timestamp=packets[0].timestamp)


class BoundedFrameQueue(queue.Queue[Any]):
    """The queue of a decoder. When it is full, all its frames are dropped and a key frame is requested.

    Single frames cannot be dropped because frames depend on those before them.

    Attributes:
        dropped: number of frames dropped so far.
    """

    def __init__(self, decoder_error: Any) -> None:
        super().__init__()
        self._decoder_error = decoder_error
        self.dropped = 0

    def put(self, item: Any, block: bool = True, timeout: float | None = None) -> None:
        """Add a frame, or None to stop the decoder."""
        if item is not None and self.qsize() >= MAX_WAITING_FRAMES:
            while True:
                try:
                    self.get_nowait()
                except queue.Empty:
                    break
                self.dropped += 1
            self._decoder_error.set()
        super().put(item, block, timeout)


def reduce_latency(receiver: Any) -> None:
    """Give an aiortc receiver, before it starts, the prompt jitter buffer and the bounded queue."""
    buffer, error = getattr(receiver, _BUFFER, None), getattr(receiver, _ERROR, None)
    if buffer is None or error is None or not hasattr(receiver, _QUEUE):
        logger.warning("unknown version of aiortc: frames are received one frame late")
        return
    setattr(receiver, _BUFFER, PromptJitterBuffer(capacity=buffer.capacity, is_video=True))
    setattr(receiver, _QUEUE, BoundedFrameQueue(error))


def restrict_candidates(connection: Any, addresses: Sequence[str]) -> None:
    """Make a peer connection, before it gathers candidates, offer these addresses only."""
    transports = [transceiver.receiver.transport for transceiver in connection.getTransceivers()]
    if connection.sctp is not None:
        transports.append(connection.sctp.transport)
    for ice_transport in {transport.transport for transport in transports}:
        ice = getattr(ice_transport.iceGatherer, "_connection", None)
        gather = getattr(ice, "get_component_candidates", None)
        if ice is None or gather is None:
            logger.warning("unknown version of aiortc: it offers all addresses of this machine")
            continue
        ice.get_component_candidates = partial(_gather_at, gather, list(addresses))


async def _gather_at(
    gather: Callable[..., Awaitable[Any]], own: list[str], component: int, addresses: list[str], timeout: int = 5
) -> Any:
    """Gather candidates as aioice does, at given addresses instead of those that it would choose."""
    return await gather(component=component, addresses=own, timeout=timeout)
