"""Uvicorn on sockets that are already bound, without signal handlers and with time limits for connections."""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections.abc import Callable, Generator

import uvicorn
from starlette.types import ASGIApp
from uvicorn.protocols.http.h11_impl import H11Protocol

from arview.station.live.security.certificates import Certificates
from arview.station.live.security.connections import ConnectionTable, Peer

HANDSHAKE_TIMEOUT_S = 5.0
"""Time for the TLS handshake."""
CLOSING_TIMEOUT_S = 2.0
"""Time for the other end to answer the end of a TLS connection."""
HEADERS_TIMEOUT_S = 10.0
"""Time to send a whole request; later the connection is closed (Slowloris)."""
WRITE_TIMEOUT_S = 20.0
"""A client that accepts no data for so long is disconnected."""
KEEP_ALIVE_S = 20
"""Time between two requests of a connection."""
MAX_HEADER_BYTES = 16_384


class TimeLimitedProtocol(H11Protocol):
    """HTTP/1.1 with time limits for the headers of a request and for the reading of a response."""

    on_lost: Callable[[], None] | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Start to wait for the first request."""
        super().connection_made(transport)
        self._await_headers()

    def data_received(self, data: bytes) -> None:
        """Process received data; once a request is being served, the handlers limit the time of its body."""
        super().data_received(data)
        is_serving = self.cycle is not None and not self.cycle.response_complete
        if is_serving and self._headers_timer is not None:
            self._headers_timer.cancel()
            self._headers_timer = None

    def on_response_complete(self) -> None:
        """Start to wait for the next request."""
        super().on_response_complete()
        if not self.transport.is_closing():
            self._await_headers(KEEP_ALIVE_S + HEADERS_TIMEOUT_S)

    def connection_lost(self, exc: Exception | None) -> None:
        """Cancel the timers."""
        for timer in (self._headers_timer, self._write_timer):
            if timer is not None:
                timer.cancel()
        super().connection_lost(exc)
        if self.on_lost is not None:
            self.on_lost()

    def pause_writing(self) -> None:
        """Start to wait for the client to read the response."""
        super().pause_writing()
        self._write_timer = self.loop.call_later(WRITE_TIMEOUT_S, self.transport.abort)

    def resume_writing(self) -> None:
        """Stop to wait: the client has read."""
        if self._write_timer is not None:
            self._write_timer.cancel()
        super().resume_writing()

    _headers_timer: asyncio.TimerHandle | None = None
    _write_timer: asyncio.TimerHandle | None = None

    def _await_headers(self, timeout_s: float | None = None) -> None:
        timeout_s = HEADERS_TIMEOUT_S if timeout_s is None else timeout_s
        if self._headers_timer is not None:
            self._headers_timer.cancel()
        self._headers_timer = self.loop.call_later(timeout_s, self.transport.close)


class UvicornServer(uvicorn.Server):
    """A server on one socket, run as a task of an existing event loop.

    It accepts connections itself, so that their number is limited before the TLS handshake.

    Args:
        app: the application.
        listener: the listening socket.
        certificates: of HTTPS; None for plain HTTP.
        connections: the open connections; share it with the application, which sees who shows the token.
    """

    def __init__(
        self,
        app: ASGIApp,
        listener: socket.socket,
        certificates: Certificates | None = None,
        connections: ConnectionTable | None = None,
    ) -> None:
        self._listener = listener
        self._connections = connections or ConnectionTable()
        self._accepting: asyncio.Task[None] | None = None
        self._handshakes: set[asyncio.Task[None]] = set()
        super().__init__(
            uvicorn.Config(
                app,
                http=TimeLimitedProtocol,
                ws="none",
                lifespan="off",
                log_config=None,
                access_log=False,
                server_header=False,
                proxy_headers=False,
                timeout_keep_alive=KEEP_ALIVE_S,
                timeout_graceful_shutdown=1,
                h11_max_incomplete_event_size=MAX_HEADER_BYTES,
                ssl_certfile=str(certificates.chain) if certificates else None,
                ssl_keyfile=str(certificates.key) if certificates else None,
            )
        )

    async def run_until_stopped(self) -> None:
        """Serve until `stop`."""
        await self.serve([self._listener])

    def stop(self) -> None:
        """Stop serving within a second."""
        self.should_exit = True

    def renew(self, certificates: Certificates) -> None:
        """Use other certificates for new connections."""
        if self.config.ssl is not None:
            self.config.ssl.load_cert_chain(certificates.chain, certificates.key)

    @contextlib.contextmanager
    def capture_signals(self) -> Generator[None, None, None]:
        """Leave the handling of signals to the program."""
        yield

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Start to accept connections; the socket is bound already."""
        self.servers = []
        await self.lifespan.startup()
        self._accepting = asyncio.ensure_future(self._accept())
        self.started = True

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Stop accepting, let responses end, then close what is left."""
        if self._accepting is not None:
            self._accepting.cancel()
            await asyncio.wait([self._accepting])
        self._listener.close()
        for handshake in tuple(self._handshakes):
            handshake.cancel()
        await super().shutdown(sockets)
        self._connections.close_all()

    async def _accept(self) -> None:
        loop = asyncio.get_running_loop()
        while True:
            try:
                line, peer = await loop.sock_accept(self._listener)
            except OSError:  # out of file descriptors, or the other end has gone
                await asyncio.sleep(0.1)
                continue
            self._admit(line, (str(peer[0]), int(peer[1])))
            await asyncio.sleep(0)  # a burst of connections leaves the loop to requests

    def _admit(self, line: socket.socket, peer: Peer) -> None:
        """Start the handshake of an accepted connection, or close it."""
        line.setblocking(False)
        protocol = TimeLimitedProtocol(
            config=self.config, server_state=self.server_state, app_state=self.lifespan.state
        )
        protocol.on_lost = lambda: self._connections.remove(peer)
        handshake: list[asyncio.Task[None]] = []

        def close() -> None:
            handshake[0].cancel()
            transport = getattr(protocol, "transport", None)
            if transport is not None:
                transport.abort()

        if not self._connections.admit(peer, close):
            line.close()
            return
        handshake.append(asyncio.ensure_future(self._shake_hands(line, peer, protocol)))
        self._handshakes.add(handshake[0])
        handshake[0].add_done_callback(self._handshakes.discard)

    async def _shake_hands(self, line: socket.socket, peer: Peer, protocol: TimeLimitedProtocol) -> None:
        tls = self.config.ssl
        try:
            await asyncio.get_running_loop().connect_accepted_socket(
                lambda: protocol,
                line,
                ssl=tls,
                ssl_handshake_timeout=HANDSHAKE_TIMEOUT_S if tls else None,
                ssl_shutdown_timeout=CLOSING_TIMEOUT_S if tls else None,
            )
        except OSError:  # the handshake failed or took too long; ssl.SSLError is an OSError
            self._connections.remove(peer)
            line.close()
        except asyncio.CancelledError:
            self._connections.remove(peer)
            line.close()
            raise
