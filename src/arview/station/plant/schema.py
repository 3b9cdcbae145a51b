"""The messages as JSON Schema, in documents of the HTTP routes (OpenAPI) and of the topics of MQTT (AsyncAPI)."""

from __future__ import annotations

import re
from typing import Any

import msgspec

from arview.station.plant.messages import Alarm, MeasuredValue, RefusedMessage, Result, StationState, Trigger
from arview.version import __version__

TOPICS: dict[str, type] = {
    "results": Result,
    "alarms": Alarm,
    "state": StationState,
    "errors": RefusedMessage,
    "triggers": Trigger,
}
"""The message of each topic; the station receives triggers and sends the others."""
_ATTRIBUTE = re.compile(r"^ {8}(\w+): (.+?)(?=^ {8}\w|\Z)", re.MULTILINE | re.DOTALL)


def message_schemas() -> dict[str, Any]:
    """The JSON Schema of each message and of the measured values by name, described by their docstrings."""
    kinds = [MeasuredValue, *TOPICS.values()]
    _, schemas = msgspec.json.schema_components(kinds, ref_template="#/components/schemas/{name}")
    for kind in kinds:
        schema, (text, _, attributes) = schemas[kind.__name__], (kind.__doc__ or "").partition("Attributes:")
        schema["description"] = " ".join(text.split())
        for name, words in _ATTRIBUTE.findall(attributes):
            schema["properties"][name]["description"] = " ".join(words.split())
    return schemas


def openapi(base: str) -> dict[str, Any]:
    """The OpenAPI document of the routes; its ``x-mqtt`` holds the AsyncAPI document of the topics below a base."""
    about, schemas = {"title": "arview station", "version": __version__}, message_schemas()
    paths: dict[str, Any] = {
        path: {"get": {"summary": summary, "responses": {"200": {"description": "see the summary"}}}}
        for path, summary in {
            "/health": "that the station is alive, and what each outlet has still to confirm",
            "/ready": "whether triggers are taken: 200, else 503",
            "/metrics": "figures as text for Prometheus",
            "/schema": "this document",
        }.items()
    }
    answers = {"202": "taken", "400": "refused, with the reason", "401": "no token", "415": "not application/json"}
    paths["/triggers"] = {
        "post": {
            "summary": "inspect the part that is in the station",
            "requestBody": {"required": True, "content": {"application/json": {"schema": _reference(Trigger)}}},
            "responses": {code: {"description": text} for code, text in answers.items()},
        }
    }
    channels = {
        name: {"address": f"{base}/{name}", "messages": {kind.__name__: {"payload": _reference(kind)}}}
        for name, kind in TOPICS.items()
    }
    operations = {
        name: {"action": "receive" if kind is Trigger else "send", "channel": {"$ref": f"#/channels/{name}"}}
        for name, kind in TOPICS.items()
    }
    mqtt = {"asyncapi": "3.0.0", "info": about, "channels": channels, "operations": operations}
    components = {"components": {"schemas": schemas}}
    return {"openapi": "3.1.0", "info": about, "paths": paths, **components, "x-mqtt": {**mqtt, **components}}


def _reference(kind: type) -> dict[str, str]:
    return {"$ref": f"#/components/schemas/{kind.__name__}"}
