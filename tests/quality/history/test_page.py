"""The read-only page of the store, asked as a browser asks it."""

from __future__ import annotations

import asyncio
import sqlite3
from dataclasses import replace
from datetime import UTC
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from arview.inspection import CharacteristicResult, Verdict, save_inspection
from arview.quality.history import HistoryStore, application
from helpers.inspections import deviation, inspection, missing
from helpers.photo_scene import bench

MODEL = bench()
EVIL = "<script>alert(1)</script>"


def ask(app: Any, path: str, host: str = "127.0.0.1:8090", method: str = "GET") -> tuple[int, dict[str, str], str]:
    """Status, headers and body of the answer to a request."""
    path, _, query = path.partition("?")
    sent: list[dict[str, Any]] = []
    scope = {
        "type": "http", "asgi": {"version": "3.0"}, "http_version": "1.1", "method": method, "path": path,
        "raw_path": path.encode(), "query_string": query.encode(), "headers": [(b"host", host.encode())],
        "scheme": "http", "server": ("127.0.0.1", 8090), "client": ("127.0.0.1", 1), "root_path": "",
    }  # fmt: skip

    async def receive() -> dict[str, Any]:
        return {"type": "http.request", "body": b"", "more_body": False}

    async def send(message: dict[str, Any]) -> None:
        sent.append(message)

    asyncio.run(app(scope, receive, send))
    headers = {name.decode(): value.decode() for name, value in sent[0]["headers"]}
    return sent[0]["status"], headers, b"".join(one.get("body", b"") for one in sent[1:]).decode("utf-8")


@pytest.fixture
def where(tmp_path: Path) -> Path:
    """12 parts: block_1 fails on every third, block_2 is missing on one, a hole fails on two; one more is void."""
    with HistoryStore(tmp_path / "results.sqlite") as store:
        for index in range(13):
            block = deviation("block_1", (0.8 if index % 3 == 0 else 0.1, 0.02, 0.01 * index), np.zeros(3), 0.5, 0.02)
            second = missing("block_2", np.zeros(3)) if index == 5 else deviation("block_2", (0.1, 0, 0), np.zeros(3))
            is_ok = index not in (1, 2)
            hole = CharacteristicResult(
                "hole & pin",
                "position",
                ("h",),
                Verdict.PASS if is_ok else Verdict.FAIL,
                0.1 + 0.5 * (not is_ok),
                0.02,
                0.3,
            )
            made = inspection(MODEL, (block, second), EVIL if index == 6 else f"S{index:02d}", minutes=60 * index)
            save_inspection(replace(made, characteristics=(hole,)), tmp_path / "a.json")
            store.add(tmp_path / "a.json", "cell-1")
        store.void("13", "not seated")
    return tmp_path / "results.sqlite"


def test_the_page(where: Path) -> None:
    before = where.read_bytes()
    with HistoryStore(where, must_exist=True) as store:
        app = application(store, UTC)
        status, headers, body = ask(app, "/")
        rows = [row.split("</tr>")[0] for row in body.split("<tr>")[1:]]
        pareto = [row for row in rows if "<rect" in row]
        assert [row.split("</th>")[0] for row in pareto] == ["<th>block_1", "<th>hole &amp; pin", "<th>block_2"]
        for row, cells in zip(pareto, ("4 57 57", "2 29 86", "1 14 100"), strict=True):
            count, share, together = cells.split()
            assert f"<td>{count}</td><td>{share} %</td><td>{together} %</td>" in row
        last = next(row for row in rows if row.startswith("<th>S09"))
        assert "2026-03-01 21:30" in last and "block_1" in last
        assert "S12" not in body  # void
        assert [row.count("hole &amp; pin") for row in rows if row.startswith(("<th>S01", "<th>S02"))] == [1, 1]
        assert EVIL not in body and "&lt;script&gt;" in body
        assert status == 200 and headers["content-security-policy"].startswith("default-src 'none'")
        charts = ["/chart.svg?part=bench&amp;name=hole%20%26%20pin&amp;of=characteristic",
                  "/chart.svg?part=bench&amp;name=block_2&amp;of=distance"]  # fmt: skip
        assert [body.count(path[1:]) for path in charts] == [1, 1]
        status, headers, body = ask(app, charts[0].replace("&amp;", "&"))
        assert (status, headers["content-type"], body[:5]) == (200, "image/svg+xml", "<?xml")
        for path, reason in (
            ("/chart.svg?part=bench&name=nut", "has no component 'nut'"),
            ("/chart.svg?part=bench&name=block_1&of=weight", "expected one of distance"),
            ("/chart.svg?part=none&name=block_1", "no such results"),
            ("/nothing", "Not Found"),
        ):
            status, headers, body = ask(app, path)
            assert status == 404 and reason in body
        assert ask(app, "/", method="POST")[0] == 405
        assert ask(app, "/", host="evil.example")[0] == 400
        assert ask(app, "/?part=none")[0] == 200
    assert where.read_bytes() == before


def test_a_store_without_results(tmp_path: Path) -> None:
    with HistoryStore(tmp_path / "results.sqlite") as store:
        status, _, body = ask(application(store), "/")
    assert (status, "No results yet" in body, body.count("Nothing has failed")) == (200, True, 2)


def test_the_page_reads_while_another_writes(where: Path) -> None:
    writer = sqlite3.connect(where, isolation_level=None)
    writer.execute("BEGIN IMMEDIATE")
    with HistoryStore(where, must_exist=True) as store:
        assert ask(application(store), "/")[0] == 200
    writer.close()
