"""Access control: token, host, origin, paths, sizes, rates, slow and misbehaving clients."""

from __future__ import annotations

import http.client
import json
import random
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from arview.station.live.options import RequestLimits
from arview.station.live.security import limits
from arview.station.live.security.access import Access
from arview.station.live.security.addresses import LOOPBACK
from arview.station.live.security.limits import MAX_ADDRESSES, RateLimit
from arview.station.live.security.refusals import Refusal
from arview.station.live.server.app import static_files
from arview.station.live.server.uvicorn_server import TimeLimitedProtocol
from arview.station.live.stream.frames import to_jpeg
from helpers.live_client import Http, Running, running
from helpers.live_sample import frames, loader, options


@pytest.fixture(scope="module")
def server() -> Iterator[Running]:
    chosen = options(max_age_s=None, clients=4)
    with running(chosen, loader(chosen)) as server:
        yield server


def raw(server: Running, content: bytes, timeout_s: float = 10.0) -> bytes:
    """The response of the server to raw bytes, until it closes the connection or the time is up."""
    with socket.create_connection((LOOPBACK, server.port), timeout=timeout_s) as line:
        line.sendall(content)
        said = b""
        with suppress(TimeoutError, ConnectionError):
            while chunk := line.recv(65536):
                said += chunk
        return said


def bare(server: Running, path: str, **headers: str) -> tuple[int, dict[str, str], bytes]:
    """A request with only these headers."""
    connection = http.client.HTTPConnection(LOOPBACK, server.port, timeout=10)
    connection.request("GET", path, headers={name.replace("_", "-"): value for name, value in headers.items()})
    answer = connection.getresponse()
    given = answer.status, {k.lower(): v for k, v in answer.getheaders()}, answer.read()
    connection.close()
    return given


@pytest.mark.slow
def test_the_link_brings_the_page_and_the_cookie(server: Running) -> None:
    status, headers, _ = bare(server, f"/?token={server.token}")
    assert status == 200 and "text/html" in headers["content-type"]
    cookie = headers["set-cookie"]
    assert "HttpOnly" in cookie and "SameSite=Strict" in cookie and "Path=/" in cookie
    value = cookie.split(";")[0]
    assert bare(server, "/api/part", Cookie=value)[0] == 200
    assert bare(server, "/watch", Cookie=f"other=1; {value}; more=2")[0] == 200
    policy = headers["content-security-policy"]
    assert "default-src 'none'" in policy and "unsafe" not in policy and "frame-ancestors 'none'" in policy
    assert headers["x-content-type-options"] == "nosniff" and headers["referrer-policy"] == "no-referrer"
    assert "server" not in headers


@pytest.mark.slow
@pytest.mark.parametrize(
    "path", ["/", "/watch", "/api/part", "/api/model.glb", "/static/index.html", "/watch.mjpg", "/x"]
)
def test_nothing_without_the_token(server: Running, path: str) -> None:
    wrong = server.token[:-1] + ("A" if server.token[-1] != "A" else "B")
    for headers in ({}, {"Cookie": f"arview_{server.port}={wrong}"}, {"Cookie": "arview=x; ;=;;"}, {"Cookie": "é" * 9}):
        status, answered, content = bare(server, path, **headers)
        assert status == 403 and "set-cookie" not in answered
        assert server.token.encode() not in content
    for query in (f"?token={wrong}", "?token=", "?token", f"?token={'A' * 3000}", "?" + "&".join(["a=1"] * 300)):
        assert bare(server, path + query)[0] in (403, 414)
    if path not in ("/", "/watch"):
        assert bare(server, f"{path}?token={server.token}")[0] == 403  # only the URL of a page may carry it
    else:
        assert b"Scan the code" in bare(server, path)[2]


def test_tokens_differ_in_each_run() -> None:
    tokens = {Access.to(["127.0.0.1"], 1, True).token for _ in range(50)}
    assert len(tokens) == 50 and all(len(token) >= 32 for token in tokens)
    assert "Secure" in Access.to(["127.0.0.1"], 1, True).cookie
    assert tokens.isdisjoint(repr(Access.to(["127.0.0.1"], 1, True)))


@pytest.mark.slow
@pytest.mark.parametrize("host", ["evil.example", "127.0.0.1", "127.0.0.1:1", "[::1]:80", "", "localhost:80"])
def test_other_names_for_the_server_are_refused(server: Running, host: str) -> None:
    status, _, content = bare(server, f"/?token={server.token}", Host=host)
    assert status == 421 and json.loads(content)["error"] == "other_host"


def test_localhost_is_a_name_of_the_server(server: Running) -> None:
    assert bare(server, f"/?token={server.token}", Host=f"localhost:{server.port}")[0] == 200


def test_other_pages_cannot_do_anything(server: Running, page: Http) -> None:
    wanted = json.dumps({"transport": "jpeg"}).encode()
    for origin in (
        "https://evil.example",
        "null",
        f"https://127.0.0.1:{server.port}",
        f"http://127.0.0.1:{server.port + 1}",
        "",
    ):
        status, _, content = page.ask("POST", "/api/clients", wanted, Content_Type="application/json", Origin=origin)
        assert status == 403 and json.loads(content)["error"] == "other_origin"
    del page.headers["Origin"]
    assert page.ask("POST", "/api/clients", wanted, Content_Type="application/json")[0] == 403
    assert page.ask("DELETE", "/api/clients/x")[0] == 403
    assert page.ask("GET", "/api/part", Sec_Fetch_Site="cross-site")[0] == 403
    assert page.ask("GET", "/api/part", Sec_Fetch_Site="same-origin")[0] == 200
    assert not server.hub.clients


PATHS = [
    "/static/../protocol.py", "/static/..%2fprotocol.py", "/static/%2e%2e/server.py", "/static//etc/passwd",
    "/static/....//....//etc/passwd", "/static/..\\server.py", "/static/%00index.html", "/static/", "/static",
    "/../../etc/passwd", "/api/recordings/..%2f..%2fetc%2fpasswd", "/api/recordings/-1", "/api/recordings/999999999999",
    "/static/index.html/", "/api/clients/../part", "/.git/config", "/static/__init__.py", "/api/clients/x/frame?id=1e3",
]  # fmt: skip


@pytest.mark.parametrize("path", PATHS)
def test_no_file_but_the_listed_ones_can_be_had(page: Http, path: str) -> None:
    status, _, content = page.ask("GET", path)
    assert status in (307, 400, 404)
    assert b"root:" not in content and b"import" not in content


def test_what_is_served_is_what_pages_need() -> None:
    served = static_files("arview.station.live")
    assert {"index.html", "watch.html", "main.js", "web/three.min.js"} <= set(served)
    assert not [
        name for name in served if name.endswith((".py", ".pem", ".key", ".map")) or name.startswith((".", "/"))
    ]
    here = Path(__file__).parent
    assert all(str(here) not in name and ".." not in name for name in served)


@pytest.mark.slow
def test_bodies_too_large_are_refused_by_what_they_say_and_by_what_they_are(server: Running, page: Http) -> None:
    name, limits = page.join(), RequestLimits()
    for path, kind, most in (
        ("/api/clients", "application/json", limits.offer_bytes),
        (f"/api/clients/{name}/control", "application/json", limits.control_bytes),
        (f"/api/clients/{name}/frame?id=0", "image/jpeg", limits.jpeg_bytes),
    ):
        status, _, content = page.ask("POST", path, b" " * (most + 1), Content_Type=kind)
        assert (status, json.loads(content)["error"]) == (413, "too_large")
        connection = http.client.HTTPConnection(LOOPBACK, server.port, timeout=20)
        with suppress(ConnectionError):
            # Chunked: the length is not declared.
            connection.request(
                "POST", path, iter([b" " * 65536] * (2 + most // 65536)), {**page.headers, "Content-Type": kind},
                encode_chunked=True,
            )  # fmt: skip
            assert connection.getresponse().status == 413
        connection.close()
        page.close()
    assert page.ask("POST", "/api/clients", b"{}", Content_Type="text/plain")[0] == 415
    assert page.ask("POST", f"/api/clients/{name}/frame?id=0", to_jpeg(frames()[0]), Content_Type="image/png")[0] == 415


@pytest.mark.parametrize(
    "content",
    [b"", b"[]", b"3", b"{", b'{"a":' * 2000, b'{"transport": NaN}', b"\xff\xfe{}", b'{"transport": ["jpeg"]}'],
)
def test_bodies_that_are_no_json_object(page: Http, content: bytes) -> None:
    status, _, answer = page.ask("POST", "/api/clients", content, Content_Type="application/json")
    assert status == 400 and json.loads(answer)["error"] == "bad_request"


@pytest.mark.slow
def test_slow_headers_and_bodies_are_cut(server: Running, page: Http, monkeypatch: pytest.MonkeyPatch) -> None:
    options = server.hub.options
    monkeypatch.setattr(server.hub, "options", replace(options, requests=replace(options.requests, body_timeout_s=0.5)))
    monkeypatch.setattr(TimeLimitedProtocol, "limits", ConnectionLimits(headers_timeout_s=0.7))
    began_s = time.monotonic()
    assert raw(server, b"GET / HTTP/1.1\r\nHost: x\r\nX-Slow: ", 8) == b""
    assert 0.3 < time.monotonic() - began_s < 5
    head = (
        f"POST /api/clients HTTP/1.1\r\nHost: 127.0.0.1:{server.port}\r\nCookie: {page.headers['Cookie']}\r\n"
        f"Origin: {page.headers['Origin']}\r\nContent-Type: application/json\r\nContent-Length: 50\r\n\r\n{{"
    )
    began_s = time.monotonic()
    assert b" 408 " in raw(server, head.encode(), 8)
    assert time.monotonic() - began_s < 7


@pytest.mark.slow
def test_a_client_that_takes_no_answer_is_cut(server: Running, page: Http, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(TimeLimitedProtocol, "limits", ConnectionLimits(write_timeout_s=0.5))
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as line:
        line.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        line.settimeout(10)
        line.connect((LOOPBACK, server.port))
        head = (
            f"GET /api/model.glb HTTP/1.1\r\nHost: 127.0.0.1:{server.port}\r\nCookie: {page.headers['Cookie']}\r\n\r\n"
        )
        address, is_cut, lost = line.getsockname(), threading.Event(), TimeLimitedProtocol.connection_lost

        def connection_lost(self: TimeLimitedProtocol, error: Exception | None) -> None:
            if self.client == address:
                is_cut.set()
            lost(self, error)

        monkeypatch.setattr(TimeLimitedProtocol, "connection_lost", connection_lost)
        line.sendall(20 * head.encode())
        assert is_cut.wait(60)
        taken = 0
        with suppress(ConnectionError):
            while chunk := line.recv(1 << 20):
                taken += len(chunk)
        assert taken < 20 * 448_168


@pytest.mark.slow
def test_snapshots_are_rate_limited() -> None:
    # A low rate, so that a slow machine gets no new tokens while it draws.
    chosen = options(requests=RequestLimits(images_per_s=0.1))
    with running(chosen, loader(chosen)) as server:
        page = server.session()
        name = page.join()
        page.ask("POST", f"/api/clients/{name}/frame?id=0", to_jpeg(frames()[0]), Content_Type="image/jpeg")
        statuses = [page.ask("GET", f"/api/clients/{name}/snapshot.png")[0] for _ in range(20)]
    assert statuses[:6] == [200] * 6 and statuses.count(429) >= 8


@pytest.mark.slow
def test_too_many_requests_are_slowed_down() -> None:
    chosen = options(requests=RequestLimits(per_s=5.0, burst=11.0))
    with running(chosen, loader(chosen)) as slow:
        page = slow.session()
        given = [page.ask("GET", "/api/status") for _ in range(30)]
        assert [status for status, _, _ in given[:10]] == [200] * 10
        refused = [headers for status, headers, _ in given if status == 429]
        assert len(refused) >= 10 and all(int(headers["retry-after"]) >= 1 for headers in refused)
        time.sleep(0.5)
        assert page.ask("GET", "/api/status")[0] == 200
    chosen = options(requests=RequestLimits(joins_per_s=0.1, joins_burst=2.0), clients=10)
    with running(chosen, loader(chosen)) as slow:
        page = slow.session()
        assert [page.json("POST", "/api/clients", {"transport": "jpeg"})[0] for _ in range(4)] == [201, 201, 429, 429]


def test_rate_limit_counts_by_address_and_forgets(monkeypatch: pytest.MonkeyPatch) -> None:
    now_s = [100.0]
    monkeypatch.setattr(limits, "time", SimpleNamespace(monotonic=lambda: now_s[0]))
    rate = RateLimit(10.0, 3.0)
    assert [rate.take("a") == 0.0 for _ in range(5)] == [True, True, True, False, False]
    assert rate.take("b") == 0.0
    with pytest.raises(Refusal):
        rate.check("a")
    now_s[0] += 0.15
    assert rate.take("a") == 0.0
    for number in range(3000):
        rate.take(str(number))
    assert len(rate._buckets) <= MAX_ADDRESSES


@pytest.mark.slow
def test_a_fuzzing_client_does_not_affect_others(server: Running) -> None:
    """Random methods, paths, headers and bodies, by HTTP and as raw bytes, while another page is served."""
    rng = random.Random(7)
    good, mad = server.session(), server.session()
    good_name = good.join()
    pieces = [
        "/", "api", "clients", "part", "static", "watch", "frame", "control", good_name, "..", "%00", "é", "?id=", "1",
        "=", "&", "snapshot.png", "recordings", "{}", "index.html", "\\", "//", "#", "model.glb", "status",
    ]  # fmt: skip
    statuses: dict[int, int] = {}
    for number in range(10_000):
        path = "/" + "".join(rng.choice(pieces) for _ in range(rng.randrange(6)))
        method = rng.choice(["GET", "POST", "PUT", "DELETE", "PATCH", "HEAD", "OPTIONS", "TRACE", "FOO"])
        body = rng.choice([None, b"", b"{}", b'{"mode":"poses"}', rng.randbytes(rng.randrange(2000))])
        if "watch.mjpg" in path or (method == "DELETE" and path.endswith(good_name)):
            continue
        kind = rng.choice(["application/json", "image/jpeg", "x", "\x01"])
        try:
            status, _, _ = mad.ask(method, path.encode("utf-8").decode("latin-1"), body, Content_Type=kind)
            statuses[status] = statuses.get(status, 0) + 1
        except (ValueError, http.client.HTTPException, UnicodeError):  # the client library refuses to send it
            mad.close()
        if number % 1000 == 0:
            answer = good.ask(
                "POST", f"/api/clients/{good_name}/frame?id={number}", to_jpeg(frames()[0]), Content_Type="image/jpeg"
            )
            assert answer[0] == 200 and json.loads(answer[2])["state"] == "tracked"
    for number in range(200):
        line = rng.choice(
            [
                b"GET / HTTP/1.1\r\n",
                b"\x16\x03\x01",
                b"PRI * HTTP/2.0\r\n\r\n",
                b"POST / HTTP/1.1\r\nContent-Length: -5\r\n\r\n",
            ]
        )
        with suppress(OSError), socket.create_connection((LOOPBACK, server.port), timeout=5) as wire:
            wire.sendall(line + rng.randbytes(rng.randrange(400)))
            if number % 10 == 0:
                wire.settimeout(0.2)
                wire.recv(100)
    assert not [status for status in statuses if status >= 500 and status != 503], statuses
    assert set(statuses) >= {404, 405} and sum(statuses.values()) > 8000
    answer = good.ask("POST", f"/api/clients/{good_name}/frame?id=1", to_jpeg(frames()[1]), Content_Type="image/jpeg")
    assert answer[0] == 200 and json.loads(answer[2])["state"] == "tracked"
    good.ask("DELETE", f"/api/clients/{good_name}")


@pytest.mark.slow
def test_many_pages_at_once(server: Running) -> None:
    """Twenty pages join at the same time and four are admitted; the others are refused, and the four are served."""
    from concurrent.futures import ThreadPoolExecutor

    pages = [server.session() for _ in range(20)]
    with ThreadPoolExecutor(20) as pool:
        answers = list(pool.map(lambda page: page.json("POST", "/api/clients", {"transport": "jpeg"}), pages))
    statuses = sorted(status for status, _ in answers)
    assert statuses == [201] * 4 + [503] * 16
    served = [(page, answer["client"]) for page, (status, answer) in zip(pages, answers, strict=True) if status == 201]

    def track(who: tuple[Http, str]) -> list[str]:
        page, name = who
        jpegs = [to_jpeg(frames()[k]) for k in range(4)]
        path = f"/api/clients/{name}/frame?id="
        return [
            json.loads(page.ask("POST", f"{path}{k}", jpeg, Content_Type="image/jpeg")[2])["state"]
            for k, jpeg in enumerate(jpegs)
        ]

    with ThreadPoolExecutor(4) as pool:
        states = list(pool.map(track, served))
    assert states == [["tracked"] * 4] * 4
    for page, name in served:
        page.ask("DELETE", f"/api/clients/{name}")
