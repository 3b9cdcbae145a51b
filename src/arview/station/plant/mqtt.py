"""MQTT: results and alarms go out, triggers come in; the state is retained, and the broker says when we are gone."""

from __future__ import annotations

import asyncio
import os
import ssl
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import aiomqtt
import msgspec
from msgspec.structs import replace
from paho.mqtt.subscribeoptions import SubscribeOptions

from arview.errors import InputError
from arview.station.plant.messages import RefusedMessage, StationState
from arview.station.plant.outbox import Outbox, PendingMessage
from arview.station.plant.outlet import Outlet
from arview.station.plant.settings import PlantSettings

KEEP_ALIVE_S = 10
"""Interval of the pings; a link on which nothing arrives is given up after two."""
TIMEOUT_S = 5.0
"""Time for the broker to confirm a message."""
PASSWORD_VARIABLE = "ARVIEW_MQTT_PASSWORD"
"""Environment variable with the password, where there is no file."""


class _BrokerClient(aiomqtt.Client):
    """A client that notes what the broker refuses; aiomqtt takes a refused message for a delivered one."""

    refusal = ""

    def _on_publish(self, client: Any, userdata: Any, mid: int, reason_code: Any, properties: Any) -> None:
        if getattr(reason_code, "is_failure", False):
            self.refusal = f"the broker refused a message ({reason_code})"
        super()._on_publish(client, userdata, mid, reason_code, properties)

    async def send(self, topic: str, body: bytes, retain: bool = False) -> None:
        """Publish a message and wait until the broker has it. Raises MqttError if it does not take it."""
        await self.publish(topic, body, qos=1, retain=retain)
        if self.refusal:
            raise aiomqtt.MqttError(self.refusal)


class MqttLink(Outlet):
    """A connection to a broker.

    Args:
        settings: of the station.
        outbox: whose messages are sent.
        state: gives the present state.
        take: is called with each trigger that is received. Raises InputError for one that is refused.
    """

    def __init__(
        self,
        settings: PlantSettings,
        outbox: Outbox,
        state: Callable[[], StationState],
        take: Callable[[bytes], object],
    ) -> None:
        super().__init__("mqtt")
        self._settings, self._outbox, self._state, self._take = settings, outbox, state, take

    async def run(self) -> None:
        """Connect, and send and receive until the connection breaks or the task is cancelled.

        Raises:
            MqttError: there is no connection, or it broke.
            ArviewError: the password or the outbox cannot be read.
        """
        async with self._client() as client:
            self.is_connected, self.error = True, ""
            # What was retained is not wanted: the part of that trigger is no longer in the station.
            await client.subscribe(
                f"{self._settings.topic}/triggers", options=SubscribeOptions(qos=1, retainHandling=2)
            )

            async def send(message: PendingMessage) -> None:
                await client.send(f"{self._settings.topic}/{message.topic}", message.body)

            try:
                async with asyncio.TaskGroup() as tasks:
                    tasks.create_task(self._receive(client))
                    tasks.create_task(self._tell_state(client))
                    tasks.create_task(self.deliver(self._outbox, send))
            except ExceptionGroup as group:  # a broker may also end the connection after a refusal
                raise aiomqtt.MqttError(client.refusal or str(group.exceptions[0])) from group
            except asyncio.CancelledError:
                with suppress(aiomqtt.MqttError):
                    await client.send(f"{self._settings.topic}/state", self._offline("stopped"), retain=True)
                raise

    def _client(self) -> _BrokerClient:
        chosen = self._settings.mqtt
        assert chosen is not None
        password = self._settings.secret(chosen.password_file) or os.environ.get(PASSWORD_VARIABLE)
        ca_file = None if chosen.ca_file is None else str(Path(self._settings.folder, chosen.ca_file))
        return _BrokerClient(
            chosen.host,
            chosen.port,
            username=chosen.user,
            password=password if chosen.user else None,
            # Under the same name a new connection ends the old one, whose last will is thus published before its state.
            identifier=f"arview-{self._settings.name}",
            protocol=aiomqtt.ProtocolVersion.V5,
            will=aiomqtt.Will(
                f"{self._settings.topic}/state", self._offline("the connection was lost"), qos=1, retain=True
            ),
            timeout=TIMEOUT_S,
            keepalive=KEEP_ALIVE_S,
            tls_context=ssl.create_default_context(cafile=ca_file) if chosen.tls else None,
        )

    def _offline(self, text: str) -> bytes:
        return msgspec.json.encode(replace(self._state(), state="offline", text=text))

    async def _tell_state(self, client: _BrokerClient) -> None:
        told = None
        while True:
            state = self._state()
            if state != told:
                await client.send(f"{self._settings.topic}/state", msgspec.json.encode(state), retain=True)
                told = state
            await self.await_news()

    async def _receive(self, client: _BrokerClient) -> None:
        async for message in client.messages:
            content = message.payload if isinstance(message.payload, bytes | bytearray) else b""
            try:
                self._take(bytes(content))
            except InputError as error:
                beginning, topic = content[:200].decode("utf-8", "replace"), str(message.topic)
                refused = RefusedMessage(station=self._settings.name, topic=topic, reason=str(error), content=beginning)
                await client.send(f"{self._settings.topic}/errors", msgspec.json.encode(refused))
