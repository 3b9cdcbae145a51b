"""The live server from start to end: sockets, certificates, loading, serving, closing."""

from __future__ import annotations

import asyncio
import logging
import socket
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from arview.errors import InputError
from arview.live.options import LiveOptions
from arview.live.security.access import Access
from arview.live.security.addresses import LOOPBACK, bind, choose_host
from arview.live.security.certificates import (
    Certificates,
    local_certificates,
    own_certificates,
)
from arview.live.security.trust_page import trust_app
from arview.live.server.app import make_app
from arview.live.server.hub import Hub
from arview.live.server.uvicorn_server import Server
from arview.live.stream.subject import Subject
from arview.live.transport.webrtc import raise_bitrates

logger = logging.getLogger("arview.live")
T = TypeVar("T")

RENEW_EVERY_S = 12 * 3600.0
WORKERS = 16
"""Threads for drawing, JPEG and files; they mostly wait for each other's drawing."""


@dataclass(frozen=True)
class Place:
    """Where the server listens.

    Attributes:
        listener: bound socket of the pages.
        port: of it.
        addresses: at which it is reached, the one for links first.
        certificates: None: plain HTTP.
        trust_listener: bound socket of the page about the certificate, if it is the local authority's.
    """

    listener: socket.socket
    port: int
    addresses: Sequence[str]
    certificates: Certificates | None = None
    trust_listener: socket.socket | None = None

    @property
    def trust_link(self) -> str | None:
        """Address of the page about the certificate."""
        if self.trust_listener is None:
            return None
        return f"http://{self.addresses[0]}:{self.trust_listener.getsockname()[1]}/"


def take_place(
    host: str | None, port: int, is_plain: bool = False, cert: Path | None = None, key: Path | None = None
) -> Place:
    """Bind the sockets and get the certificates.

    Args:
        host: see `choose_host`; with plain HTTP this machine's own browser only, whatever it is.
        port: of the pages; the page about the certificate gets the next one. 0: any.
        is_plain: HTTP without certificates, at 127.0.0.1: browsers give the camera to this address too.
        cert, key: a certificate of the user's own.

    Raises:
        InputError: a port or address that cannot be had, or a certificate that cannot be used.
        OutputError: certificates cannot be kept.
    """
    if is_plain:
        if host not in (None, "localhost", LOOPBACK):
            raise InputError(
                f"--http with --host {host}: browsers give the camera to plain HTTP at this machine itself only; "
                "leave out --http, or --host"
            )
        listener = bind(LOOPBACK, port)
        return Place(listener, listener.getsockname()[1], [LOOPBACK, "localhost"])
    address, addresses = choose_host(host)
    listener = bind(address, port)
    try:
        if cert is not None and key is not None:
            return Place(listener, listener.getsockname()[1], addresses, own_certificates(cert, key))
        certificates = local_certificates(addresses)
        trust_listener = bind(address, port + 1 if port else 0)
        return Place(listener, listener.getsockname()[1], addresses, certificates, trust_listener)
    except BaseException:
        listener.close()
        raise


class LiveServer:
    """Serves the pages of one part at one place.

    Args:
        options: what is served, within which limits.
        place: where; its sockets are closed at the end.
    """

    def __init__(self, options: LiveOptions, place: Place) -> None:
        self.options, self.place = options, place
        names = [*place.addresses, *(["localhost"] if LOOPBACK in place.addresses else [])]
        self.access = Access.to(names, place.port, place.certificates is not None)
        self._stop: asyncio.Event | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._is_stopped = False

    @property
    def origin(self) -> str:
        """Scheme, address and port of the pages."""
        return f"{self.access.scheme}://{self.place.addresses[0]}:{self.place.port}"

    @property
    def link(self) -> str:
        """Address of the page with the token of this run."""
        return f"{self.origin}/?token={self.access.token}"

    def stop(self) -> None:
        """End `serve`, from any thread."""
        self._is_stopped = True
        if self._loop is not None and self._stop is not None:
            with suppress(RuntimeError):
                self._loop.call_soon_threadsafe(self._stop.set)

    async def serve(self, load: Callable[[], Subject], on_ready: Callable[[Hub], None] = lambda hub: None) -> None:
        """Serve until `stop`; files are finished then.

        Args:
            load: loads the part, in a thread; pages say so meanwhile.
            on_ready: called when pages can take part.

        Raises:
            what ``load`` raises.
        """
        self._loop, self._stop = asyncio.get_running_loop(), asyncio.Event()
        if self._is_stopped:
            self._stop.set()
        self._loop.set_default_executor(ThreadPoolExecutor(WORKERS, thread_name_prefix="arview-worker"))
        raise_bitrates()
        hub = Hub(self.options, [address for address in self.place.addresses if address != "localhost"])
        servers = [Server(make_app(hub, self.access), self.place.listener, self.place.certificates)]
        if self.place.trust_listener is not None and self.place.certificates is not None:
            servers.append(Server(trust_app(self.place.certificates), self.place.trust_listener))
        stopped = asyncio.ensure_future(self._stop.wait())
        tasks = [asyncio.ensure_future(server.run_until_stopped()) for server in servers]
        tasks.append(asyncio.ensure_future(self._renew(servers[0])))
        loaded = asyncio.ensure_future(_in_daemon_thread(load))
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
            await hub.close()
            for server in servers:
                server.stop()
            tasks[-1].cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    async def _renew(self, server: Server) -> None:
        """Renew the server's certificate while it runs for months."""
        while True:
            await asyncio.sleep(RENEW_EVERY_S)
            if self.place.trust_listener is None:
                continue
            try:
                server.renew(await asyncio.to_thread(local_certificates, self.place.addresses))
            except Exception as error:  # the present certificate is good for weeks yet
                logger.warning("the certificate could not be renewed: %s", error)


async def _in_daemon_thread(work: Callable[[], T]) -> T:
    """Like `asyncio.to_thread`, but does not keep the program from ending."""
    loop = asyncio.get_running_loop()
    done: asyncio.Future[T] = loop.create_future()

    def settle(result: T | None, error: BaseException | None) -> None:
        if done.cancelled():
            return
        if error is not None:
            done.set_exception(error)
        else:
            done.set_result(result)  # type: ignore[arg-type]

    def run() -> None:
        result: T | None = None
        failure: BaseException | None = None
        try:
            result = work()
        except BaseException as error:
            failure = error
        with suppress(RuntimeError):  # the loop has ended meanwhile
            loop.call_soon_threadsafe(settle, result, failure)

    threading.Thread(target=run, name="arview-loader", daemon=True).start()
    return await done
