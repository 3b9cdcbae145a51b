"""Limits on the connections of each address, most of all on those that have not shown the token yet."""

from __future__ import annotations

from collections.abc import Callable

from arview.station.live.security.limits import RateLimit
from arview.station.live.security.refusals import Refusal

UNAUTHENTICATED_PER_ADDRESS = 64
"""Connections of one address that have not shown the token; an idle one is 0.3 MB."""
MAX_UNAUTHENTICATED = 256
"""Connections of all addresses that have not shown the token."""
MAX_AUTHENTICATED = 256
"""Connections that have shown the token."""
PER_DEVICE = 48
"""Connections of one device; one more takes the place of its oldest, so that no device locks out others."""
HANDSHAKES_PER_S = 30.0
"""New connections of one address per second: about a tenth of a core at most."""
HANDSHAKES_BURST = 300.0
"""New connections of one address at once."""

Peer = tuple[str, int]
"""Address and port of the other end of a connection."""


class ConnectionTable:
    """The open connections of a server.

    A connection is unauthenticated until a request on it has shown the token; then it is authenticated, and closed for
    newer ones of the same device only. An unauthenticated one too many makes room by closing the oldest one of its
    address, or of the address that has the most: an address that holds many idle connections thus stops neither others
    nor itself, and phones that share one address behind a router can still join.
    """

    def __init__(self) -> None:
        self._rate = RateLimit(HANDSHAKES_PER_S, HANDSHAKES_BURST)
        self._authenticated: dict[Peer, tuple[str, Callable[[], None]]] = {}
        self._unauthenticated: dict[str, dict[Peer, Callable[[], None]]] = {}

    def admit(self, peer: Peer, close: Callable[[], None]) -> bool:
        """Add a new connection, before its handshake; returns whether it may stay.

        Args:
            peer: the other end.
            close: closes the connection at once; called when room is needed.
        """
        address = peer[0]
        if self._rate.take(address) > 0.0:
            return False
        if len(self._unauthenticated.get(address, ())) >= UNAUTHENTICATED_PER_ADDRESS:
            self._close_oldest(address)
        elif self.unauthenticated >= MAX_UNAUTHENTICATED:
            self._close_oldest(max(self._unauthenticated, key=lambda one: len(self._unauthenticated[one])))
        self._unauthenticated.setdefault(address, {})[peer] = close
        return True

    def show_token(self, peer: Peer, device: str = "") -> None:
        """Note that a request of this connection has shown the token of a device.

        Raises:
            Refusal: 503, when too many connections have.
        """
        close = self._unauthenticated.get(peer[0], {}).get(peer)
        if close is None:  # noted before, or closed meanwhile
            return
        own = [one for one, (name, _) in self._authenticated.items() if name == device]
        if len(own) >= PER_DEVICE:
            close_oldest = self._authenticated[own[0]][1]
            self.remove(own[0])
            close_oldest()
        if len(self._authenticated) >= MAX_AUTHENTICATED:
            raise Refusal(503, "busy", "busy: too many connections", {"Retry-After": "5", "Connection": "close"})
        self.remove(peer)
        self._authenticated[peer] = device, close

    def remove(self, peer: Peer) -> None:
        """Forget a connection that has ended."""
        self._authenticated.pop(peer, None)
        unauthenticated = self._unauthenticated.get(peer[0])
        if unauthenticated is not None:
            unauthenticated.pop(peer, None)
            if not unauthenticated:
                del self._unauthenticated[peer[0]]

    @property
    def unauthenticated(self) -> int:
        """Number of connections that have not shown the token."""
        return sum(map(len, self._unauthenticated.values()))

    @property
    def authenticated(self) -> int:
        """Number of connections that have shown the token."""
        return len(self._authenticated)

    def close_all(self) -> None:
        """Close the connections that are still open."""
        for peer, close in [
            *((peer, close) for peer, (_, close) in self._authenticated.items()),
            *(one for of in self._unauthenticated.values() for one in of.items()),
        ]:
            self.remove(peer)
            close()

    def _close_oldest(self, address: str) -> None:
        peer, close = next(iter(self._unauthenticated[address].items()))
        self.remove(peer)
        close()
