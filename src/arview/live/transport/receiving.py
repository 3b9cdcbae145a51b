"""What a live receiver needs beyond aiortc: frames as soon as they are complete, no queue that grows, one interface.

aiortc hands a frame to the decoder when the first packet of the next one has come, 33 ms late at 30 fps, lets the
decoder's queue grow without limit when the machine is too slow, and offers ICE candidates on every interface but the
loopback. These functions change that on one connection; they use private names of aiortc (1.14 to 1.16) and aioice,
and do nothing where a later version no longer has them.
"""

from __future__ import annotations

import logging
import queue
from collections.abc import Awaitable, Callable, Sequence
from functools import partial
from typing import Any

from aiortc.jitterbuffer import JitterBuffer, JitterFrame

logger = logging.getLogger("arview.live")

WAITING_FRAMES = 3
"""Encoded frames that may wait for the decoder; more means that it cannot keep up."""
_BUFFER = "_RTCRtpReceiver__jitter_buffer"
_QUEUE = "_RTCRtpReceiver__decoder_queue"
_ERROR = "_RTCRtpReceiver__decoder_error"


class PromptJitterBuffer(JitterBuffer):
    """Hands out a frame at its last packet, which carries the marker bit (RFC 3550 5.1, RFC 7741 4.1, RFC 6184 5.1)."""

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


class ShortQueue(queue.Queue[Any]):
    """The decoder's queue; when it is full all of it is dropped, and a key frame is asked for.

    Frames depend on those before them, so that single ones cannot be dropped.
    """

    def __init__(self, decoder_error: Any) -> None:
        super().__init__()
        self._decoder_error = decoder_error
        self.dropped = 0

    def put(self, item: Any, block: bool = True, timeout: float | None = None) -> None:
        """Add a frame, or None to end the decoder."""
        if item is not None and self.qsize() >= WAITING_FRAMES:
            while True:
                try:
                    self.get_nowait()
                except queue.Empty:
                    break
                self.dropped += 1
            self._decoder_error.set()
        super().put(item, block, timeout)


def make_prompt(receiver: Any) -> None:
    """Change an aiortc receiver that has not begun to receive."""
    buffer, error = getattr(receiver, _BUFFER, None), getattr(receiver, _ERROR, None)
    if buffer is None or error is None or not hasattr(receiver, _QUEUE):
        logger.warning("this aiortc is not known: frames are taken one frame late")
        return
    setattr(receiver, _BUFFER, PromptJitterBuffer(capacity=buffer.capacity, is_video=True))
    setattr(receiver, _QUEUE, ShortQueue(error))


def bind_to(connection: Any, addresses: Sequence[str]) -> None:
    """Have a peer connection, before it gathers, offer candidates at these addresses only."""
    transports = [transceiver.receiver.transport for transceiver in connection.getTransceivers()]
    if connection.sctp is not None:
        transports.append(connection.sctp.transport)
    for ice_transport in {transport.transport for transport in transports}:
        ice = getattr(ice_transport.iceGatherer, "_connection", None)
        gather = getattr(ice, "get_component_candidates", None)
        if ice is None or gather is None:
            logger.warning("this aiortc is not known: it offers all addresses of this machine")
            continue
        ice.get_component_candidates = partial(_gather_at, gather, list(addresses))


async def _gather_at(
    gather: Callable[..., Awaitable[Any]], own: list[str], component: int, addresses: list[str], timeout: int = 5
) -> Any:
    """Gathering as aioice does it, with our addresses instead of those that it would take."""
    return await gather(component=component, addresses=own, timeout=timeout)
