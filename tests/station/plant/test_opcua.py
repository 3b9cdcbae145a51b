"""The OPC UA server against a real client: a job is started, and its result read."""

from __future__ import annotations

import asyncio
import json
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
from asyncua import Client, ua

from arview.inspection import Verdict
from arview.station.plant import Plant
from arview.station.plant.messages import MeasuredValue
from arview.station.plant.opcua import NAMESPACE
from helpers.plant_bench import free_port, result, settings, wait

SYSTEM = "MachineVision/VisionSystem"
MODE = f"{SYSTEM}/VisionStateMachine/AutomaticModeStateMachine"
RESULTS = f"{SYSTEM}/ResultManagement"


class Line:
    """The control of a line, which knows the paths of the nodes."""

    def __init__(self, client: Client, space: int) -> None:
        self.client, self.space = client, space

    def node(self, path: str) -> Any:
        return self.client.get_node(f"ns={self.space};s={path}")

    async def value(self, path: str) -> Any:
        """The value, or the name of its status if it is not good."""
        found = await self.node(path).read_data_value(raise_on_bad_status=False)
        return found.Value.Value if found.StatusCode.is_good() else found.StatusCode.name

    async def start(self, *texts: str) -> Any:
        try:
            return await self.node(MODE).call_method(f"{self.space}:StartSingleJob", *texts)
        except ua.UaStatusCodeError as error:
            return type(error).__name__

    async def until(self, path: str, expected: object) -> None:
        for _ in range(500):
            if await self.value(path) == expected:
                return
            await asyncio.sleep(0.01)
        raise AssertionError(f"{path}: {await self.value(path)!r}")


def value(name: str, distance: float | None) -> MeasuredValue:
    verdict = Verdict.NOT_MEASURED if distance is None else Verdict.PASS
    return MeasuredValue(name=name, kind="displacement", verdict=verdict, value_mm=distance, upper_mm=0.5)


@pytest.mark.slow
def test_a_client_starts_a_job_and_reads_the_result(tmp_path: Path) -> None:
    port = free_port()
    address = f"opc.tcp://127.0.0.1:{port}"
    with Plant(settings(tmp_path, f'name = "cell-3"\n[opcua]\nendpoint = "{address}"\n'), tmp_path) as plant:
        wait(lambda: plant.health()["outlets"]["opcua"]["is_connected"])

        async def drive() -> None:
            async with Client(address) as client:
                line = Line(client, await client.get_namespace_index(NAMESPACE))
                assert await line.value(f"{SYSTEM}/VisionStateMachine/CurrentState") == "Preoperational"
                assert await line.start("SN-1", "O-1", "r") == "BadInvalidState"
                plant.set_state("ready")
                await line.until(f"{MODE}/CurrentState", "Ready")
                assert await line.value(f"{SYSTEM}/VisionStateMachine/CurrentState") == "Operational"
                assert await line.value(f"{RESULTS}/ResultCount") == 0
                assert await line.value(f"{RESULTS}/Verdict") == "BadNoData"
                assert await line.start("SN-1\n", "", "") == "BadInvalidArgument"
                job = await line.start("SN-1", "O-1", "r")
                trigger = plant.next_trigger(1.0)
                assert trigger is not None and len(job) == 32
                assert (trigger.id, trigger.serial, trigger.order, trigger.recipe) == (job, "SN-1", "O-1", "r")
                plant.set_state("busy")
                await line.until(f"{MODE}/CurrentState", "SingleExecution")
                hole = MeasuredValue(name="hole", kind="position", verdict=Verdict.FAIL, value_mm=0.4,
                                     uncertainty_mm=0.02, upper_mm=0.3)  # fmt: skip
                told = result(1, trigger=job, components=(value("a/b.c ü", 0.1), value("post", None)),
                              characteristics=(hole,), verdict=Verdict.FAIL)  # fmt: skip
                plant.publish(told)
                await line.until(f"{RESULTS}/ResultCount", 1)
                for path, expected in {
                    "Verdict": "fail", "Serial": "SN-0001", "Key": told.key, "Trigger": job, "Part": "plate",
                    "Characteristics/hole/Value": 0.4, "Characteristics/hole/Uncertainty": 0.02,
                    "Characteristics/hole/Upper": 0.3, "Characteristics/hole/Lower": "BadNoData",
                    "Characteristics/hole/Verdict": "fail", "Components/a/b.c ü/Value": 0.1,
                    "Components/post/Value": "BadNoData", "Components/post/Verdict": "not_measured",
                }.items():  # fmt: skip
                    assert await line.value(f"{RESULTS}/{path}") == expected, path
                content = json.loads(await line.value(f"{RESULTS}/Content"))
                assert content["key"] == told.key and content["characteristics"][0]["value_mm"] == 0.4
                created = await line.value(f"{RESULTS}/Created")
                assert created.replace(tzinfo=UTC) == datetime(2026, 3, 1, 12, tzinfo=UTC)
                with pytest.raises(ua.UaStatusCodeError):
                    await line.node(f"{RESULTS}/Verdict").write_value("pass")
                plant.publish(result(2))
                await line.until(f"{RESULTS}/ResultCount", 2)
                assert await line.value(f"{RESULTS}/Characteristics/hole/Value") == "BadNoData"
                assert await line.value(f"{RESULTS}/Components/post_1/Value") == 0.1

        asyncio.run(asyncio.wait_for(drive(), 15))
        assert plant.health()["outlets"]["opcua"] == {"is_connected": True, "error": ""}


@pytest.mark.slow
def test_an_address_that_is_taken_is_said(tmp_path: Path) -> None:
    import socket

    with socket.create_server(("127.0.0.1", 0)) as taken:
        address = f"opc.tcp://127.0.0.1:{taken.getsockname()[1]}"
        with Plant(settings(tmp_path, f'name = "cell-3"\n[opcua]\nendpoint = "{address}"\n'), tmp_path) as plant:
            wait(lambda: "address already in use" in plant.health()["outlets"]["opcua"]["error"])
            assert plant.publish(result(1))
