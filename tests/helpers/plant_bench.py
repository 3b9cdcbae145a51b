"""A plant about a station: a broker, a link to it that can be cut, a consumer, settings and results."""

from __future__ import annotations

import json
import shutil
import socket
import subprocess
import threading
import time
import tomllib
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import paho.mqtt.client as mqtt
import pytest

from arview import cad
from arview.inspection import Verdict
from arview.station.plant import read_plant
from arview.station.plant.messages import MeasuredValue, Result
from arview.station.plant.settings import PlantSettings

MOSQUITTO = shutil.which("mosquitto", path="/usr/sbin:/usr/local/sbin:/usr/bin:/usr/local/bin")
needs_broker = pytest.mark.skipif(MOSQUITTO is None, reason="mosquitto is not installed: tools/setup")


def free_port() -> int:
    with socket.socket() as line:
        line.bind(("127.0.0.1", 0))
        return int(line.getsockname()[1])


def wait(condition: Callable[[], Any], timeout_s: float = 90.0) -> Any:
    """The first value of a condition that is true."""
    end_s = time.monotonic() + timeout_s
    while not (found := condition()):
        assert time.monotonic() < end_s, "it did not happen in time"
        time.sleep(0.01)
    return found


@contextmanager
def broker(folder: Path, *lines: str, port: int | None = None) -> Iterator[int]:
    """The port of a mosquitto with these lines in its configuration."""
    assert MOSQUITTO is not None
    port = port or free_port()
    access = () if any("allow_anonymous" in line for line in lines) else ("allow_anonymous true",)
    config = folder / "mosquitto.conf"
    config.write_text("\n".join((f"listener {port} 127.0.0.1", "user root", "max_queued_messages 0", *access, *lines)))
    process = subprocess.Popen([MOSQUITTO, "-c", config], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        wait(lambda: answers(port))
        yield port
    finally:
        process.terminate()
        process.wait(10)


def answers(port: int) -> bool:
    with suppress(OSError), socket.create_connection(("127.0.0.1", port), 1.0):
        return True
    return False


TOPICS = ("results", "alarms", "state", "errors")


class Consumer:
    """Subscribes to all that stations tell; ``told`` are topics, documents and whether they were retained."""

    def __init__(self, port: int, user: str | None = None, password: str | None = None) -> None:
        self.told: list[tuple[str, dict[str, Any], bool]] = []
        self.client = mqtt.Client(mqtt.CallbackAPIVersion.VERSION2, protocol=mqtt.MQTTv5)
        self.client.username_pw_set(user, password)
        subscribed = threading.Event()
        self.client.on_connect = lambda client, *_: client.subscribe([(f"+/+/{topic}", 1) for topic in TOPICS])
        self.client.on_subscribe = lambda *_: subscribed.set()
        self.client.on_message = lambda _, __, got: self.told.append((got.topic, json.loads(got.payload), got.retain))
        self.client.connect("127.0.0.1", port)
        self.client.loop_start()
        assert subscribed.wait(10)

    def of(self, topic: str) -> list[dict[str, Any]]:
        return [document for name, document, _ in list(self.told) if name.endswith(f"/{topic}")]

    def result_keys(self) -> list[str]:
        return [document["key"] for document in self.of("results")]

    def publish(self, topic: str, content: bytes | dict[str, Any], retain: bool = False) -> None:
        body = content if isinstance(content, bytes) else json.dumps(content).encode()
        self.client.publish(topic, body, qos=1, retain=retain).wait_for_publish(10)

    def close(self) -> None:
        self.client.disconnect()
        self.client.loop_stop()


@contextmanager
def consuming(port: int, user: str | None = None, password: str | None = None) -> Iterator[Consumer]:
    consumer = Consumer(port, user, password)
    try:
        yield consumer
    finally:
        consumer.close()


class Cable:
    """A TCP connection through this process that can be pulled out at once, and left without traffic."""

    def __init__(self, port: int) -> None:
        self._target, self._lines = port, list[socket.socket]()
        self.is_stalled, self.is_closed = False, False
        self._server = socket.create_server(("127.0.0.1", 0))
        self.port = int(self._server.getsockname()[1])
        threading.Thread(target=self._accept, daemon=True).start()

    def cut(self, for_s: float = 0.0) -> int:
        """Pull it out for a time; the number of connections that were reset."""
        self.is_closed = True
        lines, self._lines = self._lines, []
        for line in lines:
            with suppress(OSError):
                line.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")
                line.shutdown(socket.SHUT_RDWR)
            line.close()
        time.sleep(for_s)
        self.is_closed = False
        return len(lines) // 2

    def _accept(self) -> None:
        with suppress(OSError):
            while True:
                line, _ = self._server.accept()
                if self.is_closed:
                    line.close()
                    continue
                other = socket.create_connection(("127.0.0.1", self._target))
                self._lines += [line, other]
                for pair in ((line, other), (other, line)):
                    threading.Thread(target=self._carry, args=pair, daemon=True).start()

    def _carry(self, source: socket.socket, target: socket.socket) -> None:
        with suppress(OSError):
            while content := source.recv(65536):
                if not self.is_stalled:
                    target.sendall(content)
        with suppress(OSError):
            target.shutdown(socket.SHUT_RDWR)


def settings(folder: Path, text: str) -> PlantSettings:
    """The settings of a ``station.toml``."""
    path = folder / "station.toml"
    path.write_text(text, encoding="utf-8")
    root = cad.TomlTable(path, "", tomllib.loads(text))
    found = read_plant(root)
    root.finish()
    return found


def mqtt_settings(folder: Path, port: int, more: str = "") -> PlantSettings:
    return settings(folder, f'name = "cell-3"\n[mqtt]\nhost = "127.0.0.1"\nport = {port}\n{more}')


def result(number: int, **more: Any) -> Result:
    """A result with a key of its own."""
    values: dict[str, Any] = {
        "key": f"{number:064x}", "station": "cell-3", "part": "plate", "serial": f"SN-{number:04d}", "order": "",
        "recipe": "", "trigger": "", "verdict": Verdict.PASS, "summary": "1 component: 1 in tolerance",
        "created": datetime(2026, 3, 1, 12, tzinfo=UTC), "characteristics": (), "warnings": (),
        "components": (MeasuredValue(name="post_1", kind="displacement", verdict=Verdict.PASS, value_mm=0.1,
                                     uncertainty_mm=0.05, upper_mm=0.5),),
    }  # fmt: skip
    return Result(**{**values, **more})
