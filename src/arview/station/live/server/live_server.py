"""The life cycle of the live server: sockets, certificates, loading, serving, closing."""

from __future__ import annotations

import asyncio
import logging
import socket
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from starlette.types import Receive, Scope, Send

from arview.errors import InputError
from arview.station.live.options import LiveOptions
from arview.station.live.security.access import Access
from arview.station.live.security.addresses import LOOPBACK, bind, choose_host
from arview.station.live.security.certificates import (
    Certificates,
    local_certificates,
    own_certificates,
)
from arview.station.live.security.connections import ConnectionTable
from arview.station.live.security.devices import Devices
from arview.station.live.security.trust_page import trust_app
from arview.station.live.server.app import make_app
from arview.station.live.server.hub import Hub
from arview.station.live.server.uvicorn_server import UvicornServer
from arview.station.live.server.workers import WorkerPool, in_daemon_thread
from arview.station.live.stream.subjects import Subjects
from arview.station.live.transport.webrtc import raise_bitrates

RENEWAL_INTERVAL_S = 12 * 3600.0
"""Time between two checks of the age of the certificate."""
CLOCK_INTERVAL_S, CLOCK_JUMP_S = 20.0, 3600.0
"""Time between two looks at the clock, and by how much it must have been put for a check at once."""
WORKER_TIMEOUT_S = 30.0
"""A thread for drawing, JPEG or files that takes longer is given up and replaced."""
WORKERS = 16
"""Threads for drawing, JPEG and files; most of them wait for a renderer."""

logger = logging.getLogger("arview.station.live")


@dataclass(frozen=True)
class Endpoint:
    """The sockets, addresses and certificates of the server.

    Attributes:
        listener: bound socket of the pages.
        port: port of that socket.
        addresses: addresses at which the server is reached, the one for links first.
        certificates: certificates of HTTPS; None for plain HTTP.
        trust_listener: bound socket of the page about the certificate, if the local authority signed it.
    """

    listener: socket.socket
    port: int
    addresses: Sequence[str]
    certificates: Certificates | None = None
    trust_listener: socket.socket | None = None

    @property
    def trust_link(self) -> str | None:
        """URL of the page about the certificate, or None."""
        if self.trust_listener is None:
            return None
        return f"http://{self.addresses[0]}:{self.trust_listener.getsockname()[1]}/"


def open_endpoint(
    host: str | None, port: int, is_plain: bool = False, cert: Path | None = None, key: Path | None = None
) -> Endpoint:
    """Bind the sockets and load or create the certificates.

    Args:
        host: see `choose_host`; plain HTTP is always served at the loopback address.
        port: port of the pages; the page about the certificate gets the next one. 0 stands for any free port.
        is_plain: serve HTTP without certificates at 127.0.0.1, where browsers allow the camera, too.
        cert, key: certificate and key provided by the user.

    Raises:
        InputError: a port or address is not available, or a certificate cannot be used.
        OutputError: certificates cannot be stored.
    """
    if is_plain:
        if host not in (None, "localhost", LOOPBACK):
            raise InputError(
                f"--http with --host {host}: browsers allow the camera over plain HTTP on this machine only; "
                "omit --http or --host"
            )
        listener = bind(LOOPBACK, port)
        return Endpoint(listener, listener.getsockname()[1], [LOOPBACK, "localhost"])
    address, addresses = choose_host(host)
    listener = bind(address, port)
    try:
        if cert is not None and key is not None:
            return Endpoint(listener, listener.getsockname()[1], addresses, own_certificates(cert, key))
        certificates = local_certificates(addresses)
        trust_listener = bind(address, port + 1 if port else 0)
        return Endpoint(listener, listener.getsockname()[1], addresses, certificates, trust_listener)
    except BaseException:
        listener.close()
        raise


class LiveServer:
    """Serves the pages of one part, or of several in one picture.

    Args:
        options: what is served, and within which limits.
        endpoint: where it is served; its sockets are closed at the end.

    Attributes:
        access: what requests must present.
    """

    def __init__(self, options: LiveOptions, endpoint: Endpoint) -> None:
        self.options, self.endpoint = options, endpoint
        names = [*endpoint.addresses, *(["localhost"] if LOOPBACK in endpoint.addresses else [])]
        self.access = Access.to(names, endpoint.port, endpoint.certificates is not None, Devices(options.devices))
        self._stop: asyncio.Event | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._is_stopped = False

    @property
    def origin(self) -> str:
        """Origin of the pages: scheme, address and port."""
        return f"{self.access.scheme}://{self.endpoint.addresses[0]}:{self.endpoint.port}"

    @property
    def link(self) -> str:
        """URL of the page with the token of this run, which pairs the browser that opens it."""
        return f"{self.origin}/?token={self.access.token}"

    def stop(self) -> None:
        """Make `serve` end; may be called from any thread."""
        self._is_stopped = True
        if self._loop is not None and self._stop is not None:
            with suppress(RuntimeError):
                self._loop.call_soon_threadsafe(self._stop.set)

    async def serve(self, load: Callable[[], Subjects], on_ready: Callable[[Hub], None] = lambda hub: None) -> None:
        """Serve until `stop`, then finish the files.

        Args:
            load: loads the parts, in a thread, while the pages show that they are being loaded. What it raises is
                raised here.
            on_ready: called with the hub when pages can take part.
        """
        self._loop, self._stop = asyncio.get_running_loop(), asyncio.Event()
        if self._is_stopped:
            self._stop.set()
        self._loop.set_default_executor(WorkerPool(WORKERS, WORKER_TIMEOUT_S))
        raise_bitrates()
        addresses = [address for address in self.endpoint.addresses if address != "localhost"]
        hub = Hub(self.options, addresses, self.access.devices)
        connections, place = ConnectionTable(), self.endpoint
        app = make_app(hub, self.access, connections)
        servers = [UvicornServer(app, place.listener, place.certificates, connections)]
        if self.endpoint.trust_listener is not None and self.endpoint.certificates is not None:
            self._trust = trust_app(self.endpoint.certificates)

            async def serve_trust(scope: Scope, receive: Receive, send: Send) -> None:
                await self._trust(scope, receive, send)

            servers.append(UvicornServer(serve_trust, self.endpoint.trust_listener))
        stopped = asyncio.ensure_future(self._stop.wait())
        tasks = [asyncio.ensure_future(server.run_until_stopped()) for server in servers]
        tasks.append(asyncio.ensure_future(self._renew(servers[0])))
        loaded = asyncio.ensure_future(in_daemon_thread(load))
        try:
            await asyncio.wait([stopped, loaded, *tasks], return_when=asyncio.FIRST_COMPLETED)
            if loaded.done():
                hub.begin(loaded.result())
                on_ready(hub)
                await asyncio.wait([stopped, *tasks], return_when=asyncio.FIRST_COMPLETED)
            for task in tasks:
                if task.done():
                    task.result()
        finally:
            loaded.cancel()
            stopped.cancel()
            for server in servers:
                server.stop()
            await hub.close()
            if self.access.devices is not None:
                self.access.devices.save()
            tasks[-1].cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    async def _renew(self, server: UvicornServer) -> None:
        """Renew the certificate of a server that runs for months, or whose clock is put right while it runs."""
        ahead_s, due_s = time.time() - time.monotonic(), time.monotonic() + RENEWAL_INTERVAL_S
        while True:
            await asyncio.sleep(CLOCK_INTERVAL_S)
            now_s = time.time() - time.monotonic()
            is_due = abs(now_s - ahead_s) > CLOCK_JUMP_S or time.monotonic() > due_s
            if not is_due or self.endpoint.trust_listener is None:
                continue
            ahead_s, due_s = now_s, time.monotonic() + RENEWAL_INTERVAL_S
            try:
                made = await asyncio.to_thread(local_certificates, self.endpoint.addresses)
                server.renew(made)
                if made.is_authority_new:
                    self._trust = trust_app(made)
                    logger.warning(
                        "the clock was put right, so there is a new certificate: phones have to trust it at %s",
                        self.endpoint.trust_link,
                    )
            except Exception as error:  # the current certificate stays valid for weeks
                logger.warning("the certificate could not be renewed: %s", error)
