"""Uvicorn on sockets that are already bound, without signal handlers and with time limits for connections."""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections.abc import Generator
from dataclasses import dataclass

import uvicorn
from starlette.types import ASGIApp
from uvicorn.protocols.http.h11_impl import H11Protocol

from arview.live.security.certificates import Certificates


@dataclass(frozen=True)
class ConnectionLimits:
    """Bounds on the connections of the server."""

    headers_timeout_s: float = 10.0  # time to send a whole request; later the connection is closed (Slowloris)
    write_timeout_s: float = 20.0  # a client that accepts no data for so long is disconnected
    keep_alive_s: int = 20  # time between two requests of a connection
    max_connections: int = 200
    max_header_bytes: int = 16_384


class TimeLimitedProtocol(H11Protocol):
    """HTTP/1.1 with time limits for the headers of a request and for the reading of a response."""

    limits = ConnectionLimits()

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
            self._await_headers(self.limits.keep_alive_s + self.limits.headers_timeout_s)

    def connection_lost(self, exc: Exception | None) -> None:
        """Cancel the timers."""
        for timer in (self._headers_timer, self._write_timer):
            if timer is not None:
                timer.cancel()
        super().connection_lost(exc)

    def pause_writing(self) -> None:
        """Start to wait for the client to read the response."""
        super().pause_writing()
        self._write_timer = self.loop.call_later(self.limits.write_timeout_s, self.transport.abort)

    def resume_writing(self) -> None:
        """Stop to wait: the client has read."""
        if self._write_timer is not None:
            self._write_timer.cancel()
        super().resume_writing()

    _headers_timer: asyncio.TimerHandle | None = None
    _write_timer: asyncio.TimerHandle | None = None

    def _await_headers(self, timeout_s: float | None = None) -> None:
        timeout_s = self.limits.headers_timeout_s if timeout_s is None else timeout_s
        if self._headers_timer is not None:
            self._headers_timer.cancel()
        self._headers_timer = self.loop.call_later(timeout_s, self.transport.close)


class UvicornServer(uvicorn.Server):
    """A server on one socket, run as a task of an existing event loop."""

    def __init__(self, app: ASGIApp, listener: socket.socket, certificates: Certificates | None = None) -> None:
        self._listener = listener
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
                limit_concurrency=TimeLimitedProtocol.limits.max_connections,
                timeout_keep_alive=TimeLimitedProtocol.limits.keep_alive_s,
                timeout_graceful_shutdown=1,
                h11_max_incomplete_event_size=TimeLimitedProtocol.limits.max_header_bytes,
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
