"""The plant: what a station tells to the outside and is told by it, in threads of their own.

A result or alarm is on the disk before `Plant.publish` and `Plant.set_alarm` return. Whatever happens to a connection
is seen in `Plant.health` and never stops the station.
"""

from __future__ import annotations

import asyncio
import json
import logging
import queue
import threading
from collections import Counter
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from msgspec.structs import replace

from arview.errors import InputError, without_credentials
from arview.inspection import content_hash
from arview.station.plant.hooks import Hook
from arview.station.plant.messages import Alarm, Result, StateName, StationState, Trigger, read_trigger
from arview.station.plant.mqtt import MqttLink
from arview.station.plant.opcua import OpcuaView
from arview.station.plant.outbox import Outbox
from arview.station.plant.outlet import Outlet
from arview.station.plant.settings import PlantSettings
from arview.version import __version__

if TYPE_CHECKING:
    from arview.quality import history

MAX_TRIGGERS = 16
"""Triggers that wait for the station; more are refused: a line that is so far ahead has lost its place."""
MIN_PAUSE_S, MAX_PAUSE_S = 0.5, 30.0
"""Time to the next try of a connection; it doubles until there is one."""
STOP_S = 3.0
"""Time for the connections to close."""
OUTLET_METRICS = {
    "is_connected": "outlet_connected",
    "pending": "outlet_pending",
    "oldest_s": "outlet_oldest_pending_seconds",
    "refused": "outlet_refused",
}
"""Metrics by the keys of an outlet in `Plant.health`."""

logger = logging.getLogger("arview.station.plant")


class Plant:
    """The connections of a station, open inside ``with``.

    Args:
        settings: as `read_plant` reads them.
        folder: of the outbox; it is made if it does not exist.

    Raises:
        InputError: the outbox is of a newer arview.
        OutputError: the outbox cannot be written; so do `publish`, `set_alarm` and `next_trigger`.
    """

    def __init__(self, settings: PlantSettings, folder: Path) -> None:
        self.settings, names = settings, [hook.name for hook in settings.hooks]
        self._outbox = Outbox(folder / "outbox.sqlite", names if settings.mqtt is None else ["mqtt", *names])
        self._lock, self._verdicts = threading.Lock(), Counter[str]()
        self._triggers: queue.Queue[Trigger] = queue.Queue(MAX_TRIGGERS)
        self.state = StationState(
            station=settings.name, state="preoperational", text="", since=datetime.now(UTC), cycle=0,
            software=__version__,
        )  # fmt: skip
        self._result: Result | None = None
        self._outlets: list[Outlet] = [Hook(settings, hook, self._outbox) for hook in settings.hooks]
        if settings.mqtt is not None:
            self._outlets.append(MqttLink(settings, self._outbox, lambda: self.state, self.take))
        if settings.opcua is not None:
            endpoint = settings.opcua.endpoint
            self._outlets.append(OpcuaView(endpoint, lambda: self.state, lambda: self._result, self.take))
        self._loop, self._tasks = asyncio.new_event_loop(), list[asyncio.Task[None]]()
        self._thread = threading.Thread(
            target=lambda: self._loop.run_until_complete(self._serve()), name="plant", daemon=True
        )

    def __enter__(self) -> Plant:
        self._tasks = [self._loop.create_task(self._keep(outlet)) for outlet in self._outlets]
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._loop.call_soon_threadsafe(lambda: [task.cancel() for task in self._tasks])
        self._thread.join(STOP_S)
        self._outbox.close()

    def publish(self, result: Result) -> bool:
        """Tell a result; it is on the disk when this returns. False if it was told already."""
        is_new = self._outbox.add(result)
        if is_new:
            with self._lock:
                self._verdicts[result.verdict.value] += 1
                self.state = replace(self.state, cycle=self.state.cycle + 1)
            self._result = result
        self._wake()
        return is_new

    def take(self, trigger: Trigger | bytes) -> None:
        """Take a trigger, or the JSON of one, for `next_trigger`; one that waits already is not taken twice.

        Raises:
            InputError: it is not a trigger, the station is not ready, or too many are waiting.
        """
        trigger = read_trigger(trigger) if isinstance(trigger, bytes) else trigger
        if not self.is_ready:
            raise InputError(
                f"trigger {trigger.id!r}: the station is {self.state.state}; send it when the station is ready"
            )
        with self._lock:
            if trigger.id in (waiting.id for waiting in self._triggers.queue):
                return
            try:
                self._triggers.put_nowait(trigger)
            except queue.Full:
                raise InputError(f"trigger {trigger.id!r}: {MAX_TRIGGERS} others are waiting; send it later") from None

    def next_trigger(self, timeout_s: float) -> Trigger | None:
        """The next trigger; None if none came in time, or one whose id was carried out already."""
        with suppress(queue.Empty):
            trigger = self._triggers.get(timeout=timeout_s)
            return trigger if self._outbox.take_trigger(trigger) else None
        return None

    @property
    def is_ready(self) -> bool:
        """Whether triggers are taken."""
        return self.state.state in ("ready", "busy")

    def set_state(self, state: StateName, text: str = "") -> None:
        """Tell what the station does, and why in a sentence."""
        with self._lock:
            if (state, text) != (self.state.state, self.state.text):
                self.state = replace(self.state, state=state, text=text, since=datetime.now(UTC))
        self._wake()

    def set_alarm(
        self, kind: str, component: str, text: str, severity: Literal["warning", "error"] = "warning", part: str = ""
    ) -> bool:
        """Begin an alarm with its sentence, or end it with an empty one; False if that is no change.

        Args:
            kind: camera_moved, or another name.
            component: camera, component or characteristic that has it.
            text: what is the matter.
            severity: how much it matters.
            part: name of the part, if it is of a part.
        """
        now, alarm_id = datetime.now(UTC), f"{kind}/{part}/{component}"
        is_change = self._outbox.set_alarm(Alarm(
            key=content_hash([self.settings.name, alarm_id, now.isoformat()]), id=alarm_id, station=self.settings.name,
            kind=kind, severity=severity, part=part, component=component, text=text, since=now, is_active=bool(text),
        ))  # fmt: skip
        self._wake()
        return is_change

    def check_history(self, store: history.HistoryStore, part: str) -> list[str]:
        """Begin and end the alarms that follow from the results of a part; returns the sentences of those that began.

        Call it when a result was added to the store under the name of this station.
        """
        from arview.station.plant.alarms import KINDS, history_conditions

        found = history_conditions(store, part, self.settings.name, self.settings.alarms)
        active = [(one.kind, one.component) for one in self._outbox.alarms() if one.part == part and one.kind in KINDS]
        return [
            text
            for (kind, component), text in (dict.fromkeys(active, "") | found).items()
            if self.set_alarm(kind, component, text, part=part) and text
        ]

    def health(self) -> dict[str, Any]:
        """The state, for each outlet whether it is connected and what it has still to confirm, and the alarms."""
        state, known = self.state, {outlet.name: outlet for outlet in self._outlets}
        outlets: dict[str, dict[str, Any]] = {
            name: {"is_connected": outlet.is_connected, "error": outlet.error} for name, outlet in known.items()
        }
        for name, counts in self._outbox.counts().items():
            outlets[name] = outlets.get(name, {"is_connected": False, "error": "is not configured"}) | counts
        return {
            "status": "alive",
            "is_ready": self.is_ready,
            **{key: getattr(state, key) for key in ("station", "state", "text", "cycle", "software")},
            "outlets": outlets,
            "alarms": [{"id": one.id, "severity": one.severity, "text": one.text} for one in self._outbox.alarms()],
        }

    def metrics(self) -> str:
        """The figures of `health` and the verdicts of this run in the text format of Prometheus."""
        health = self.health()
        values: dict[str, dict[str, Any]] = {
            "ready gauge": {"": health["is_ready"]},
            "cycles_total counter": {"": health["cycle"]},
            "results_total counter": {f'{{verdict="{name}"}}': count for name, count in self._verdicts.items()},
            "alarms gauge": {"": len(health["alarms"])},
        }
        for key, name in OUTLET_METRICS.items():
            outlets = {f"{{outlet={json.dumps(outlet)}}}": one.get(key, 0) for outlet, one in health["outlets"].items()}
            values[f"{name} gauge"] = outlets
        return "".join(
            f"# TYPE arview_{name}\n"
            + "".join(f"arview_{name.split()[0]}{label} {float(value)}\n" for label, value in of.items())
            for name, of in values.items()
        )

    def _wake(self) -> None:
        """Tell the outlets that there is news."""
        for outlet in self._outlets:
            self._loop.call_soon_threadsafe(outlet.news.set)

    async def _serve(self) -> None:
        await asyncio.gather(*self._tasks, return_exceptions=True)

    async def _keep(self, outlet: Outlet) -> None:
        """Run an outlet, again whenever it breaks."""
        pause_s = MIN_PAUSE_S
        while True:
            try:
                await outlet.run()
            except Exception as error:  # no fault of a connection may stop the station
                outlet.error = without_credentials(str(error)) or type(error).__name__
                logger.warning("%s: %s", outlet.name, outlet.error)
            pause_s = MIN_PAUSE_S if outlet.is_connected else min(2.0 * pause_s, MAX_PAUSE_S)
            outlet.is_connected = False
            await asyncio.sleep(pause_s)
