"""Many idle connections of one address stop nobody; unfinished handshakes end; the token authenticates a connection."""

from __future__ import annotations

import asyncio
import http.client
import socket
import ssl
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from arview.station.live.security import connections
from arview.station.live.security.addresses import LOOPBACK
from arview.station.live.security.connections import ConnectionTable
from arview.station.live.security.refusals import Refusal
from arview.station.live.server.live_server import LiveServer, open_endpoint
from helpers.live_sample import loader, options

IDLE = 205


def admitted(table: ConnectionTable, address: str, ports: range, closed: list[tuple[str, int]]) -> int:
    """How many of these connections are admitted; those that are closed for others go into the list."""
    return sum(table.admit((address, port), lambda port=port: closed.append((address, port))) for port in ports)


@pytest.fixture(scope="module", autouse=True)
def patient_servers() -> None:
    """The servers of these tests have the limits of a station."""


def limit(monkeypatch: pytest.MonkeyPatch, **limits: float) -> None:
    for name, value in limits.items():
        monkeypatch.setattr(connections, name, value)


def test_unauthenticated_make_room_for_each_other_and_authenticated_stay(monkeypatch: pytest.MonkeyPatch) -> None:
    limit(monkeypatch, UNAUTHENTICATED_PER_ADDRESS=4, MAX_UNAUTHENTICATED=10, HANDSHAKES_BURST=1e6)
    table = ConnectionTable()
    closed: list[tuple[str, int]] = []
    assert admitted(table, "a", range(4), closed) == 4 and not closed
    table.show_token(("a", 0))
    assert admitted(table, "a", range(4, 7), closed) == 3
    assert closed == [("a", 1), ("a", 2)] and table.authenticated == 1 and table.unauthenticated == 4
    assert admitted(table, "b", range(4), closed) == 4 and admitted(table, "c", range(2), closed) == 2
    closed.clear()
    assert admitted(table, "d", range(1), closed) == 1  # full: the oldest of the address that has the most
    assert len(closed) == 1 and closed[0][0] in "ab" and table.unauthenticated == 10
    table.remove(("a", 0))
    table.remove(("nobody", 1))
    assert table.authenticated == 0


def test_new_connections_of_one_address_are_rated_and_authenticated_are_counted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    limit(monkeypatch, HANDSHAKES_PER_S=0.1, HANDSHAKES_BURST=5, MAX_AUTHENTICATED=2)
    table = ConnectionTable()
    closed: list[tuple[str, int]] = []
    assert admitted(table, "a", range(20), closed) == 5 and admitted(table, "b", range(1), closed) == 1
    table.show_token(("a", 0))
    table.show_token(("a", 1))
    table.show_token(("a", 0))  # noted before
    with pytest.raises(Refusal, match="too many connections"):
        table.show_token(("a", 2))
    table.close_all()
    assert len(closed) == 6 and table.authenticated == table.unauthenticated == 0


def test_no_device_locks_out_others(monkeypatch: pytest.MonkeyPatch) -> None:
    limit(monkeypatch, HANDSHAKES_BURST=1e6, MAX_AUTHENTICATED=10, PER_DEVICE=4)
    table = ConnectionTable()
    closed: list[tuple[str, int]] = []
    admitted(table, "a", range(20), closed)
    for port in range(20):
        table.show_token(("a", port), "iPhone")
    assert table.authenticated == 4 and closed == [("a", port) for port in range(16)]
    admitted(table, "b", range(3), closed)
    for port in range(3):
        table.show_token(("b", port), "iPad")
    assert table.authenticated == 7 and len(closed) == 16


@contextmanager
def https_server(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[LiveServer]:
    monkeypatch.setenv("ARVIEW_DATA", str(folder))
    chosen = options(max_age_s=None)
    server = LiveServer(chosen, open_endpoint(LOOPBACK, 0))
    ready = threading.Event()
    thread = threading.Thread(
        target=lambda: asyncio.run(server.serve(loader(chosen), lambda hub: ready.set())), daemon=True
    )
    thread.start()
    assert ready.wait(120)
    try:
        yield server
    finally:
        server.stop()
        thread.join(20)
    assert not thread.is_alive()


def status_of(line: http.client.HTTPSConnection, cookie: str) -> int:
    line.request("GET", "/api/status", headers={"Cookie": cookie})
    answer = line.getresponse()
    answer.read()
    return answer.status


def paired(line: http.client.HTTPSConnection, server: LiveServer) -> str:
    """The cookie of a browser that has opened the link of the station."""
    line.request("GET", f"/?token={server.access.token}")
    answer = line.getresponse()
    answer.read()
    cookie = answer.getheader("Set-Cookie")
    assert cookie is not None
    return cookie.split(";")[0]


@pytest.mark.slow
@pytest.mark.parametrize("with_handshake", [True, False])
def test_idle_connections_of_one_address_stop_nobody(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, with_handshake: bool
) -> None:
    with https_server(tmp_path, monkeypatch) as server:
        trusting = ssl.create_default_context(cadata=server.endpoint.certificates.authority_der)  # type: ignore[union-attr]
        port = server.endpoint.port
        before = http.client.HTTPSConnection(LOOPBACK, port, timeout=20, context=trusting)
        cookie = paired(before, server)
        assert status_of(before, cookie) == 200
        idle: list[socket.socket] = []
        for _ in range(IDLE):
            line = socket.create_connection((LOOPBACK, port), timeout=20)
            idle.append(trusting.wrap_socket(line, server_hostname=LOOPBACK) if with_handshake else line)
        began_s = time.monotonic()
        new = http.client.HTTPSConnection(LOOPBACK, port, timeout=20, context=trusting)
        assert status_of(before, cookie) == 200 and status_of(new, cookie) == 200
        open_lines = 0
        for line in idle:
            line.settimeout(0.01)
            try:
                open_lines += line.recv(1) != b""
            except TimeoutError:
                open_lines += 1
            except OSError:
                pass
            line.close()
        assert 1 <= open_lines <= connections.UNAUTHENTICATED_PER_ADDRESS
        assert time.monotonic() - began_s < 20
        before.close()
        new.close()


@pytest.mark.slow
def test_handshakes_that_do_not_end_are_cut(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with (
        https_server(tmp_path, monkeypatch) as server,
        socket.create_connection((LOOPBACK, server.endpoint.port), timeout=20) as line,
    ):
        began_s = time.monotonic()
        assert line.recv(1) == b"" and time.monotonic() - began_s >= 4.0
