"""Limits on the connections of each address, most of all on those that have not shown the token yet."""

from __future__ import annotations

from collections.abc import Callable

from arview.station.live.security.limits import RateLimit
from arview.station.live.security.refusals import Refusal

STRANGERS_OF_ADDRESS = 64
"""Connections of one address that have not shown the token; an idle one is 0.3 MB."""
MAX_STRANGERS = 256
"""Of all addresses."""
MAX_GUESTS = 256
"""Connections that have shown the token."""
HANDSHAKES_PER_S = 30.0
"""New connections of one address: about a tenth of a core at most."""
HANDSHAKES_BURST = 300.0

Peer = tuple[str, int]
"""Address and port of the other end of a connection."""


class ConnectionTable:
    """The open connections of a server.

    A connection is a stranger until a request on it has shown the token; then it is a guest and is never closed for
    others. A stranger too many makes room by closing the oldest one of its address, or of the address that has the
    most: an address that holds many idle connections thus stops neither others nor itself, and phones that share one
    address behind a router can still join.
    """

    def __init__(self) -> None:
        self._rate = RateLimit(HANDSHAKES_PER_S, HANDSHAKES_BURST)
        self._guests: dict[Peer, Callable[[], None]] = {}
        self._strangers: dict[str, dict[Peer, Callable[[], None]]] = {}

    def admit(self, peer: Peer, close: Callable[[], None]) -> bool:
        """Add a new connection, before its handshake; returns whether it may stay.

        Args:
            peer: the other end.
            close: closes the connection at once; called when room is needed.
        """
        address = peer[0]
        if self._rate.take(address) > 0.0:
            return False
        if len(self._strangers.get(address, ())) >= STRANGERS_OF_ADDRESS:
            self._close_oldest(address)
        elif self.strangers >= MAX_STRANGERS:
            self._close_oldest(max(self._strangers, key=lambda one: len(self._strangers[one])))
        self._strangers.setdefault(address, {})[peer] = close
        return True

    def show_token(self, peer: Peer) -> None:
        """Note that a request of this connection has shown the token.

        Raises:
            Refusal: 503, when too many connections have.
        """
        close = self._strangers.get(peer[0], {}).get(peer)
        if close is None:  # noted before, or closed meanwhile
            return
        if len(self._guests) >= MAX_GUESTS:
            raise Refusal(503, "busy", "busy: too many connections", {"Retry-After": "5", "Connection": "close"})
        self.remove(peer)
        self._guests[peer] = close

    def remove(self, peer: Peer) -> None:
        """Forget a connection that has ended."""
        self._guests.pop(peer, None)
        strangers = self._strangers.get(peer[0])
        if strangers is not None:
            strangers.pop(peer, None)
            if not strangers:
                del self._strangers[peer[0]]

    @property
    def strangers(self) -> int:
        """Number of connections that have not shown the token."""
        return sum(map(len, self._strangers.values()))

    @property
    def guests(self) -> int:
        """Number of connections that have shown the token."""
        return len(self._guests)

    def close_all(self) -> None:
        """Close the connections that are still open."""
        for peer, close in [*self._guests.items(), *(one for of in self._strangers.values() for one in of.items())]:
            self.remove(peer)
            close()

    def _close_oldest(self, address: str) -> None:
        peer, close = next(iter(self._strangers[address].items()))
        self.remove(peer)
        close()
