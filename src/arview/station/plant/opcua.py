"""The OPC UA server: the station as a vision system, with the names of OPC 40100-1.

The types of that companion specification are not loaded: all nodes are of this server's own namespace, see
``docs/reference/plant.md``. The server shows the last result and confirms none.
"""

from __future__ import annotations

import uuid
from collections.abc import Callable
from typing import Any

import msgspec
from asyncua import Node, Server, ua, uamethod

from arview.errors import InputError
from arview.station.plant.messages import Result, StationState, Trigger
from arview.station.plant.outlet import Outlet

NAMESPACE = "urn:arview:plant:1"
"""Namespace of all nodes of this server; it changes when a node is removed or changes its type."""
MACHINE = ("MachineVision", "VisionSystem", "VisionStateMachine")
MODE = (*MACHINE, "AutomaticModeStateMachine")
RESULTS = ("MachineVision", "VisionSystem", "ResultManagement")
STATES = {"preoperational": "Preoperational", "halted": "Halted", "error": "Error", "offline": "Halted"}
"""States of the vision state machine; in all other states of the station it is operational."""
MODES = {"ready": "Ready", "busy": "SingleExecution"}
"""States of the automatic mode; in all other states of the station it is initialised."""
TEXTS = ("key", "part", "serial", "order", "recipe", "trigger", "verdict", "summary")
"""Texts of a result that are variables of their own."""
NUMBERS = {"Value": "value_mm", "Uncertainty": "uncertainty_mm", "Lower": "lower_mm", "Upper": "upper_mm"}
"""Numbers of a measured value that are variables of their own, mm."""
KINDS = dict.fromkeys(NUMBERS, ua.VariantType.Double) | {
    "ResultCount": ua.VariantType.UInt32, "Created": ua.VariantType.DateTime,
}  # fmt: skip
"""Types of variables that are no texts."""

Path = tuple[str, ...]
"""Browse names of a node from the folder of all objects on; joined by ``/`` they are its id."""


class OpcuaView(Outlet):
    """The server, whose variables are written whenever there is news.

    Args:
        endpoint: address to listen at, ``opc.tcp://0.0.0.0:4840``.
        state: gives the present state.
        result: gives the last result, if there is one.
        take: is called with the trigger of a job. Raises InputError if it is refused.
    """

    def __init__(
        self,
        endpoint: str,
        state: Callable[[], StationState],
        result: Callable[[], Result | None],
        take: Callable[[Trigger], object],
    ) -> None:
        super().__init__("opcua")
        self._endpoint, self._state, self._result, self._take = endpoint, state, result, take
        self._nodes: dict[Path, Node] = {}
        self._shown: dict[Path, Any] = {}

    async def run(self) -> None:
        """Serve until the task is cancelled.

        Raises:
            OSError: the server cannot listen at its address.
        """
        server = Server()
        await server.init()
        server.set_endpoint(self._endpoint)
        server.set_server_name(f"arview {self._state().station}")
        server.set_security_policy([ua.SecurityPolicyType.NoSecurity])
        space = await server.register_namespace(NAMESPACE)
        self._nodes, self._shown = {(): server.nodes.objects}, {}
        mode = await self._node(space, MODE)
        texts = [
            ua.Argument(Name=name, DataType=ua.NodeId(ua.ObjectIds.String), ValueRank=-1)
            for name in ("serial", "order", "recipe", "jobId")
        ]
        await mode.add_method(
            *_names(space, (*MODE, "StartSingleJob")), uamethod(self._start_job), texts[:3], texts[3:]
        )
        count, last = 0, None
        async with server:
            while True:
                if (result := self._result()) is not last:
                    count, last = count + 1, result
                await self._show(space, {**_variables(self._state(), result), (*RESULTS, "ResultCount"): count})
                self.is_connected, self.error = True, ""
                await self.await_news()

    async def _show(self, space: int, values: dict[Path, Any]) -> None:
        """Write what has changed; None, and what is no longer there, is the status "no data"."""
        no_data = ua.DataValue(ua.Variant(), ua.StatusCode(ua.StatusCodes.BadNoData))
        for path, value in {**dict.fromkeys(self._shown.keys() - values.keys()), **values}.items():
            if path not in self._shown or self._shown[path] != value:
                kind = KINDS.get(path[-1], ua.VariantType.String)
                node = await self._node(space, path, kind)
                await node.write_value(no_data if value is None else ua.DataValue(ua.Variant(value, kind)))
                self._shown[path] = value

    async def _node(self, space: int, path: Path, kind: ua.VariantType | None = None) -> Node:
        """A variable of some kind, or an object, which is made with all above it unless it is there."""
        if path not in self._nodes:
            parent, names = await self._node(space, path[:-1]), _names(space, path)
            if kind is None:
                self._nodes[path] = await parent.add_object(*names)
            else:
                self._nodes[path] = await parent.add_variable(*names, ua.get_default_value(kind), kind)
        return self._nodes[path]

    def _start_job(self, parent: Any, serial: str | None, order: str | None, recipe: str | None) -> Any:
        """Take the trigger of a job; returns its id, or the status of a call that is refused."""
        job_id = uuid.uuid4().hex
        try:
            self._take(Trigger(id=job_id, serial=serial or "", order=order or "", recipe=recipe or ""))
        except (InputError, ValueError):
            is_ready = self._state().state in MODES
            return ua.StatusCode(ua.StatusCodes.BadInvalidArgument if is_ready else ua.StatusCodes.BadInvalidState)
        return job_id


def _names(space: int, path: Path) -> tuple[Any, Any]:
    """Id and browse name of a node."""
    return ua.NodeId("/".join(path), space), ua.QualifiedName(path[-1], space)


def _variables(state: StationState, result: Result | None) -> dict[Path, Any]:
    """The values of all variables by their paths."""
    values: dict[Path, Any] = {
        (*MACHINE, "CurrentState"): STATES.get(state.state, "Operational"),
        (*MACHINE, "Text"): state.text,
        (*MODE, "CurrentState"): MODES.get(state.state, "Initialized"),
        (*RESULTS, "Content"): None if result is None else msgspec.json.encode(result).decode(),
        (*RESULTS, "Created"): None if result is None else result.created,
    }
    values |= {(*RESULTS, name.capitalize()): None if result is None else str(getattr(result, name)) for name in TEXTS}
    groups = {} if result is None else {"Components": result.components, "Characteristics": result.characteristics}
    for group, measured in groups.items():
        for one in measured:
            path = (*RESULTS, group, one.name)
            values |= {(*path, name): getattr(one, field) for name, field in NUMBERS.items()}
            values[*path, "Verdict"] = one.verdict.value
    return values
