"""Uvicorn as the live server needs it: on sockets already bound, without signals, with limits on time."""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections.abc import Generator

import uvicorn
from starlette.types import ASGIApp
from uvicorn.protocols.http.h11_impl import H11Protocol

from arview.live.security.certificates import Certificates

HEADERS_TIMEOUT_S = 10.0
"""A connection that has not sent a whole request by then is closed (Slowloris)."""
WRITE_TIMEOUT_S = 20.0
"""A client that takes nothing of an answer for so long is cut."""
MOST_CONNECTIONS = 200
KEEP_ALIVE_S = 20
HEADER_BYTES = 16_384


class PatientProtocol(H11Protocol):
    """HTTP/1.1 that waits neither for the headers of a request nor for a reader of its answers for ever."""

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Begin to wait for the first request."""
        super().connection_made(transport)
        self._await_headers()

    def data_received(self, data: bytes) -> None:
        """Take what has come; once a request has begun to be served its body is timed by the handlers."""
        super().data_received(data)
        is_serving = self.cycle is not None and not self.cycle.response_complete
        if is_serving and self._headers_timer is not None:
            self._headers_timer.cancel()
            self._headers_timer = None

    def on_response_complete(self) -> None:
        """Begin to wait for the next request."""
        super().on_response_complete()
        if not self.transport.is_closing():
            self._await_headers(KEEP_ALIVE_S + HEADERS_TIMEOUT_S)

    def connection_lost(self, exc: Exception | None) -> None:
        """Stop waiting."""
        for timer in (self._headers_timer, self._write_timer):
            if timer is not None:
                timer.cancel()
        super().connection_lost(exc)

    def pause_writing(self) -> None:
        """Begin to wait for the client to take what is sent."""
        super().pause_writing()
        self._write_timer = self.loop.call_later(WRITE_TIMEOUT_S, self.transport.abort)

    def resume_writing(self) -> None:
        """It has taken it."""
        if self._write_timer is not None:
            self._write_timer.cancel()
        super().resume_writing()

    _headers_timer: asyncio.TimerHandle | None = None
    _write_timer: asyncio.TimerHandle | None = None

    def _await_headers(self, timeout_s: float = HEADERS_TIMEOUT_S) -> None:
        if self._headers_timer is not None:
            self._headers_timer.cancel()
        self._headers_timer = self.loop.call_later(timeout_s, self.transport.close)


class Server(uvicorn.Server):
    """A server on one socket, in a task of an event loop that somebody else runs."""

    def __init__(self, app: ASGIApp, listener: socket.socket, certificates: Certificates | None = None) -> None:
        self._listener = listener
        super().__init__(
            uvicorn.Config(
                app,
                http=PatientProtocol,
                ws="none",
                lifespan="off",
                log_config=None,
                access_log=False,
                server_header=False,
                proxy_headers=False,
                limit_concurrency=MOST_CONNECTIONS,
                timeout_keep_alive=KEEP_ALIVE_S,
                timeout_graceful_shutdown=1,
                h11_max_incomplete_event_size=HEADER_BYTES,
                ssl_certfile=str(certificates.chain) if certificates else None,
                ssl_keyfile=str(certificates.key) if certificates else None,
            )
        )

    async def run_until_stopped(self) -> None:
        """Serve until `stop`."""
        await self.serve([self._listener])

    def stop(self) -> None:
        """End within a second."""
        self.should_exit = True

    def renew(self, certificates: Certificates) -> None:
        """Use other certificates for connections from now on."""
        if self.config.ssl is not None:
            self.config.ssl.load_cert_chain(certificates.chain, certificates.key)

    @contextlib.contextmanager
    def capture_signals(self) -> Generator[None, None, None]:
        """Leave signals to the program."""
        yield
