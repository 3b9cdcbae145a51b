"""The HTTP routes: what monitors read, triggers, the schema, and the page that describes the messages."""

from __future__ import annotations

import asyncio
import json
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from runpy import run_path
from typing import Any

import jsonschema
import msgspec
import pytest
import yaml
from starlette.applications import Starlette

from arview.inspection import Verdict
from arview.station.plant import Plant, plant_routes, result_of
from arview.station.plant.messages import MeasuredValue, Result, Trigger
from arview.station.plant.schema import TOPICS, message_schemas
from arview.station.plant.settings import AlarmTable, MqttTable, OpcuaTable, PlantSettings
from helpers.inspections import bench_inspection
from helpers.paths import ROOT
from helpers.photo_scene import bench
from helpers.plant_bench import result, settings

SETTINGS = 'name = "cell-3"\n[[hooks]]\nname = "a \\"mes\\""\nurl = "http://127.0.0.1:9/"\n'


@pytest.fixture
def plant(tmp_path: Path) -> Iterator[Plant]:
    with Plant(settings(tmp_path, SETTINGS), tmp_path) as opened:
        yield opened


class Answer:
    """Status and text of an answer."""

    def __init__(self, status_code: int, content: bytes) -> None:
        self.status_code, self.text = status_code, content.decode()

    def json(self) -> Any:
        return json.loads(self.text)


class Http:
    """Asks the routes as a server would."""

    def __init__(self, app: Starlette) -> None:
        self._app = app

    def get(self, path: str, headers: dict[str, str] | None = None) -> Answer:
        return self.ask("GET", path, b"", headers or {})

    def post(
        self, path: str, json: object = None, content: bytes | None = None, headers: dict[str, str] | None = None
    ) -> Answer:
        body = msgspec.json.encode(json) if content is None else content
        return self.ask("POST", path, body, {"content-type": "application/json", **(headers or {})})

    def ask(self, method: str, path: str, body: bytes, headers: dict[str, str]) -> Answer:
        said: list[Any] = []
        scope = {
            "type": "http", "asgi": {"version": "3.0"}, "http_version": "1.1", "method": method, "path": path,
            "raw_path": path.encode(), "query_string": b"", "scheme": "http", "server": ("127.0.0.1", 80),
            "headers": [(name.lower().encode(), value.encode()) for name, value in headers.items()],
        }  # fmt: skip

        async def receive() -> dict[str, Any]:
            return {"type": "http.request", "body": body, "more_body": False}

        async def send(message: Any) -> None:
            said.append(message)

        asyncio.run(self._app(scope, receive, send))
        return Answer(said[0]["status"], b"".join(one.get("body", b"") for one in said[1:]))


def client(plant: Plant, token: str = "") -> Http:
    return Http(Starlette(routes=plant_routes(plant, token)))


def test_health_ready_and_metrics(plant: Plant) -> None:
    http = client(plant)
    assert http.get("/ready").status_code == 503
    plant.set_state("ready", "waiting for a part")
    plant.publish(result(1))
    plant.publish(result(2, verdict=Verdict.FAIL))
    plant.set_alarm("camera_moved", "left", "moved by 2 mm")
    assert http.get("/ready").json() == {"is_ready": True}
    health = http.get("/health").json()
    assert (health["status"], health["state"], health["text"], health["cycle"]) == (
        "alive", "ready", "waiting for a part", 2,
    )  # fmt: skip
    assert health["outlets"]['a "mes"']["pending"] == 3
    assert health["alarms"] == [{"id": "camera_moved//left", "severity": "warning", "text": "moved by 2 mm"}]
    lines = http.get("/metrics").text.splitlines()
    assert set(lines) >= {
        "arview_ready 1.0", "arview_cycles_total 2.0", 'arview_results_total{verdict="pass"} 1.0',
        'arview_results_total{verdict="fail"} 1.0', "arview_alarms 1.0", "# TYPE arview_cycles_total counter",
        'arview_outlet_pending{outlet="a \\"mes\\""} 3.0',
    }  # fmt: skip
    kinds = [line.split()[2] for line in lines if line.startswith("#")]
    assert len(kinds) == len(set(kinds)) == 8


def test_a_station_without_outlets(tmp_path: Path) -> None:
    with Plant(settings(tmp_path, 'name = "cell-3"\n'), tmp_path) as alone:
        assert alone.publish(result(1)) and not alone.publish(result(1))
        alone.set_state("ready")
        alone.take(b'{"id": "7"}')
        assert alone.next_trigger(1.0) == Trigger(id="7")
        assert (alone.health()["outlets"], alone.health()["cycle"]) == ({}, 1)


def test_triggers(plant: Plant) -> None:
    http = client(plant)
    plant.set_state("ready")
    assert http.post("/triggers", json={"id": "7", "serial": "SN-1"}).status_code == 202
    assert plant.next_trigger(1.0) == Trigger(id="7", serial="SN-1")
    refused = http.post("/triggers", json={"id": "8", "serail": "SN-1"})
    assert refused.status_code == 400
    assert refused.json()["error"].startswith("trigger: Object contains unknown field `serail`; allowed keys: ")
    assert http.post("/triggers", content=b"{}", headers={"content-type": "text/plain"}).status_code == 415
    for number in range(16):
        assert http.post("/triggers", json={"id": f"n{number}"}).status_code == 202
    full = http.post("/triggers", json={"id": "one more"})
    assert (full.status_code, full.json()["error"]) == (
        400, "trigger 'one more': 16 others are waiting; send it later",
    )  # fmt: skip
    assert http.post("/triggers", json={"id": "n3"}).status_code == 202  # it waits already
    plant.set_state("halted")
    assert "the station is halted" in http.post("/triggers", json={"id": "x"}).json()["error"]


def test_a_token_guards_all_but_whether_the_station_is_there(plant: Plant) -> None:
    http = client(plant, "wonderful-17")
    plant.set_state("ready")
    assert http.get("/health").json() == {"status": "alive"}
    assert http.get("/ready").status_code == 200 and http.get("/schema").status_code == 200
    for headers in ({}, {"Authorization": "Bearer x"}, {"Authorization": "wonderful-1"}):
        assert http.get("/metrics", headers=headers).status_code == 401
        assert http.post("/triggers", json={"id": "7"}, headers=headers).status_code == 401
    shown = {"Authorization": "Bearer wonderful-17"}
    assert http.get("/health", headers=shown).json()["station"] == "cell-3"
    assert http.post("/triggers", json={"id": "7"}, headers=shown).status_code == 202


def test_the_schema_describes_what_is_sent(plant: Plant) -> None:
    document = client(plant).get("/schema").json()
    assert document["openapi"] == "3.1.0" and set(document["x-mqtt"]["channels"]) == set(TOPICS)
    assert document["x-mqtt"]["channels"]["results"]["address"] == "arview/cell-3/results"
    made = result_of(bench_inspection(bench()), "cell-3", Trigger(id="7", order="O-1", serial="SN-8"))
    content = json.loads(msgspec.json.encode(made))
    schema = {**document, "$ref": "#/components/schemas/Result"}
    jsonschema.validate(content, schema)
    with pytest.raises(jsonschema.ValidationError, match="more"):
        jsonschema.validate({**content, "more": 1}, schema)
    assert (made.verdict, made.serial, made.order, made.trigger) == (Verdict.FAIL, "SN-7", "O-1", "7")
    assert "the trigger names serial SN-8, measured was SN-7" in made.warnings
    by_name = {one.name: one for one in made.components}
    assert (by_name["block_2"].value_mm, by_name["block_2"].upper_mm) == (pytest.approx(3.0), 0.5)
    assert (by_name["block_4"].reason, by_name["block_4"].value_mm) == ("missing", None)
    assert msgspec.json.decode(msgspec.json.encode(made), type=Result) == made


def test_every_key_is_described() -> None:
    for name, schema in message_schemas().items():
        described = {key for key, value in schema.get("properties", {}).items() if "description" in value}
        inherited = {"version"} & set(schema.get("properties", {}))
        assert described | inherited | {"type"} >= set(schema.get("properties", {})), name


def test_the_pages_name_every_message_and_key() -> None:
    page = (ROOT / "docs/reference/plant.md").read_text(encoding="utf-8")
    for topic, kind in TOPICS.items():
        assert f"`PREFIX/NAME/{topic}` | [{kind.__name__}](messages.md#{kind.__name__.lower()})" in page, topic
    messages = run_path(str(ROOT / "tools/docs/schema_page.py"))["messages_markdown"]()
    for kind in (MeasuredValue, *TOPICS.values()):
        section = messages.partition(f"## {kind.__name__}\n")[2].partition("\n## ")[0]
        assert all(f"| `{key}` |" in section for key in kind.__struct_fields__), kind
    (settings_text,) = re.findall(r"```toml title=\"station.toml\"\n(.*?)```", page, re.DOTALL)
    assert set(tomllib.loads(settings_text)) == set(PlantSettings.__struct_fields__) - {"folder"}
    for name, table in (("mqtt", MqttTable), ("opcua", OpcuaTable), ("alarms", AlarmTable)):
        assert set(tomllib.loads(settings_text)[name]) == set(table.__struct_fields__)


def test_the_unit_and_the_roles() -> None:
    unit = ROOT / "tools/container/arview-station.service"
    assert "KillSignal=SIGINT" in unit.read_text() and "ExecStart=/opt/arview/bin/arview station" in unit.read_text()
    roles = re.findall(r"^FROM base AS (\w+)$", (ROOT / "tools/container/Containerfile").read_text(), re.MULTILINE)
    services = yaml.safe_load((ROOT / "tools/container/compose.yaml").read_text())["services"]
    targets = {one["build"]["target"] for one in services.values() if "build" in one}
    assert set(roles) == targets == {"station", "worker", "results"}
