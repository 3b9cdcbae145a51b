"""HTTP hooks: a server that fails some requests gets every message, and confirms each once."""

from __future__ import annotations

import json
import threading
from collections import Counter
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest

from arview.station.plant import Plant, hooks, outlet
from arview.station.plant import plant as plants
from helpers.plant_bench import free_port, result, settings, wait


class Mes:
    """A server that answers by a list of codes, 0 being to hang up; later 204."""

    def __init__(self, *codes: int) -> None:
        self.codes, self.asked, self.taken = list(codes), list[tuple[str, dict[str, str]]](), list[dict[str, Any]]()
        mes = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                body = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
                mes.asked.append((self.headers["Idempotency-Key"], dict(self.headers)))
                code = mes.codes.pop(0) if mes.codes else 204
                if code == 0:
                    self.connection.close()
                    return
                if 200 <= code < 300:
                    mes.taken.append(body)
                self.send_response(code)
                if code == 302:
                    self.send_header("Location", "/login")
                self.send_header("Content-Length", "0")
                self.end_headers()

            do_GET = do_POST

            def log_message(self, *_: object) -> None:
                pass

        self.server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.port = self.server.server_address[1]
        threading.Thread(target=self.server.serve_forever, daemon=True).start()

    def keys(self) -> list[str]:
        return [document["key"] for document in list(self.taken)]


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plants, "MIN_PAUSE_S", 0.01)
    monkeypatch.setattr(plants, "MAX_PAUSE_S", 0.05)
    monkeypatch.setattr(outlet, "MIN_DELAY_S", 0.02)
    monkeypatch.setattr(outlet, "POLL_S", 0.05)
    monkeypatch.setattr(hooks, "TIMEOUT_S", 1.0)


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[Path]:
    (tmp_path / "token").write_text("abc-123\n")
    yield tmp_path


def text(port: int) -> str:
    return f'name = "cell-3"\n[[hooks]]\nname = "mes"\nurl = "http://127.0.0.1:{port}/arview"\ntoken_file = "token"\n'


@pytest.mark.slow
def test_a_server_that_fails_gets_every_message(folder: Path) -> None:
    mes = Mes(503, 200, 0, 500, 201, 429, 408, 302, 200)
    with Plant(settings(folder, text(mes.port)), folder) as plant:
        for number in range(20):
            plant.publish(result(number))
        plant.set_alarm("camera_moved", "Kamera Süd", "moved by 2 mm")
        wait(lambda: plant.health()["outlets"]["mes"]["pending"] == 0)
        health = plant.health()["outlets"]["mes"]
    keys, asked = mes.keys(), Counter(key for key, _ in mes.asked)
    assert len(keys) == len(set(keys)) == 21
    assert {result(number).key for number in range(20)} < set(keys)
    assert sum(asked.values()) == 21 + 6
    assert all(headers["Authorization"] == "Bearer abc-123" for _, headers in mes.asked)
    assert [document["type"] for document in mes.taken].count("alarm") == 1
    assert health["is_connected"] and health["error"] == "" and health["refused"] == 0


@pytest.mark.slow
def test_a_refusal_is_recorded_and_not_tried_again(folder: Path) -> None:
    mes = Mes(422)
    with Plant(settings(folder, text(mes.port)), folder) as plant:
        plant.publish(result(1))
        plant.publish(result(2))
        wait(lambda: mes.keys() == [result(2).key])
        wait(lambda: plant.health()["outlets"]["mes"]["pending"] == 0)
        health = plant.health()["outlets"]["mes"]
        assert 'arview_outlet_refused{outlet="mes"} 1.0\n' in plant.metrics()
    assert (health["refused"], health["refusal"]) == (1, "HTTP Error 422: Unprocessable Entity")
    assert Counter(key for key, _ in mes.asked) == {result(1).key: 1, result(2).key: 1}


@pytest.mark.slow
def test_a_server_that_is_not_there_stops_nothing(folder: Path) -> None:
    port = free_port()
    with Plant(settings(folder, text(port)), folder) as plant:
        plant.publish(result(1))
        wait(lambda: "refused" in plant.health()["outlets"]["mes"]["error"])
        health = plant.health()["outlets"]["mes"]
        assert (health["pending"], health["is_connected"]) == (1, False) and health["oldest_s"] > 0.0
    mes = Mes()
    with Plant(settings(folder, text(mes.port)), folder) as plant:  # another URL, the same name: it is still pending
        wait(lambda: mes.keys() == [result(1).key])
