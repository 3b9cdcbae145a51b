"""What monitors read of the live server: alive and ready without a token, figures with one."""

from __future__ import annotations

import http.client
import json
from collections.abc import Iterator
from dataclasses import replace

import pytest

from arview.station.live.options import RequestLimits
from arview.station.live.security.addresses import LOOPBACK
from helpers.live_client import Http, Running, running
from helpers.live_sample import loader, options


@pytest.fixture(scope="module")
def server() -> Iterator[Running]:
    chosen = options(max_age_s=None, clients=4)
    with running(chosen, loader(chosen)) as server:
        yield server


def bare(server: Running, path: str, method: str = "GET", **headers: str) -> tuple[int, str]:
    """Status and text of a request without a token."""
    connection = http.client.HTTPConnection(LOOPBACK, server.port, timeout=10)
    connection.request(method, path, headers={name.replace("_", "-"): value for name, value in headers.items()})
    answer = connection.getresponse()
    given = answer.status, answer.read().decode()
    assert answer.getheader("Set-Cookie") is None
    connection.close()
    return given


@pytest.mark.slow
def test_alive_and_ready_without_a_token(server: Running) -> None:
    assert bare(server, "/health") == (200, '{"status":"alive"}')
    assert bare(server, "/ready") == (200, '{"is_ready":true}')
    assert bare(server, "/health", Host="evil.example")[0] == 421
    assert bare(server, "/ready", Sec_Fetch_Site="cross-site")[0] == 403
    for path in ("/metrics", "/health/", "/health/../api/part", "//health", "/api/status"):
        assert bare(server, path)[0] == 403, path
    assert bare(server, "/health", "POST")[0] == 403
    subjects, server.hub.subjects = server.hub.subjects, None
    try:
        status, text = bare(server, "/ready")
        assert status == 503 and json.loads(text)["error"] == "loading"
    finally:
        server.hub.subjects = subjects


@pytest.mark.slow
def test_probes_do_not_use_up_the_requests_of_others() -> None:
    chosen = replace(options(max_age_s=None, clients=4), requests=RequestLimits())
    with running(chosen, loader(chosen)) as server:
        page = server.session()
        connection, answers = http.client.HTTPConnection(LOOPBACK, server.port, timeout=10), []
        for _ in range(300):
            connection.request("GET", "/health")
            answer = connection.getresponse()
            answers.append(answer.status)
            answer.read()
        connection.close()
        assert answers[:50] == [200] * 50 and 429 in answers
        assert page.ask("GET", "/api/part")[0] == 200
        page.close()


@pytest.mark.slow
def test_figures_with_the_token(server: Running) -> None:
    page: Http = server.session()
    page.join()
    status, headers, content = page.ask("GET", "/metrics")
    assert status == 200 and headers["content-type"].startswith("text/plain")
    lines = content.decode().splitlines()
    for line in ("arview_live_ready 1", "arview_live_clients 1", "arview_live_watchers 0", "arview_live_jobs_pending 0",
                 "# TYPE arview_live_clients gauge"):  # fmt: skip
        assert line in lines
    assert any(line.startswith("arview_live_tracked_frames_per_second ") for line in lines)
    page.close()
