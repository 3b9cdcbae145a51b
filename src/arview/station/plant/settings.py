"""The plant's tables of ``station.toml``, checked before anything is opened."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated

import msgspec
from msgspec import Meta

from arview import cad
from arview.errors import InputError

TABLES = ("name", "mqtt", "hooks", "opcua", "alarms")
"""Keys of ``station.toml`` that are the plant's."""


class _Table(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A table of the settings."""


class MqttTable(_Table, frozen=True, kw_only=True):
    """``[mqtt]``: the broker.

    Attributes:
        host: name or address.
        port: usually 1883, or 8883 with TLS.
        prefix: beginning of all topics.
        tls: whether the connection is encrypted and the broker's certificate checked.
        ca_file: authority that signed the certificate, if it is none of the system's.
        user: name to log in with.
        password_file: file with the password, which is read for each connection; without it the password is in
            ``ARVIEW_MQTT_PASSWORD``.
    """

    host: str
    port: Annotated[int, Meta(ge=1, le=65535)] = 1883
    prefix: str = "arview"
    tls: bool = False
    ca_file: str | None = None
    user: str | None = None
    password_file: str | None = None


class HookTable(_Table, frozen=True, kw_only=True):
    """``[[hooks]]``: a URL to which results and alarms are posted.

    Attributes:
        name: by which the outbox knows it, whatever its URL is.
        url: http or https.
        token_file: file with a token that is shown as ``Authorization: Bearer …``.
    """

    name: str
    url: str
    token_file: str | None = None


class OpcuaTable(_Table, frozen=True, kw_only=True):
    """``[opcua]``: the address at which the server listens."""

    endpoint: str


class AlarmTable(_Table, frozen=True, kw_only=True):
    """``[alarms]``: newest results that the rules look at, and the largest share of them without a decision."""

    last: Annotated[int, Meta(ge=20, le=1000)] = 50
    undecided: Annotated[float, Meta(gt=0.0, le=1.0)] = 0.2


class PlantSettings(_Table, frozen=True, kw_only=True):
    """The station's name and its connections; paths are relative to ``folder``."""

    name: str
    folder: str
    mqtt: MqttTable | None = None
    hooks: tuple[HookTable, ...] = ()
    opcua: OpcuaTable | None = None
    alarms: AlarmTable = AlarmTable()

    @property
    def topic(self) -> str:
        """Beginning of the topics of this station."""
        return f"{'arview' if self.mqtt is None else self.mqtt.prefix}/{self.name}"

    def secret(self, file: str | None) -> str | None:
        """The text of a file with a password or token, without the end of the line; None without a file.

        Raises:
            InputError: it cannot be read.
        """
        try:
            return None if file is None else Path(self.folder, file).read_text(encoding="utf-8").rstrip("\r\n")
        except (OSError, UnicodeDecodeError) as error:
            raise InputError(
                f"{Path(self.folder, file or '')}: cannot be read ({getattr(error, 'strerror', error)})"
            ) from error


def read_plant(root: cad.TomlTable) -> PlantSettings:
    """The settings in the keys ``name``, ``mqtt``, ``hooks``, ``opcua`` and ``alarms`` of a table.

    Other keys are left to the caller, who calls ``finish``.

    Raises:
        InputError: a value is wrong, a key of these tables unknown, or a file with a secret cannot be read.
    """
    content = {key: root.content[key] for key in TABLES if root.known(key)}
    try:
        settings = msgspec.convert({**content, "folder": str(root.path.parent)}, PlantSettings)
    except msgspec.ValidationError as error:
        raise InputError(f"{root.path}: {error}; see docs/reference/plant.md") from None
    mqtt, hooks, opcua = settings.mqtt, settings.hooks, settings.opcua
    names = ["mqtt", "opcua", *(hook.name for hook in hooks)]
    topics = [settings.name, *(mqtt.prefix.split("/") if mqtt is not None else ())]
    for is_right, key, expected in (
        (re.fullmatch(r"[^/+#\s][^/+#\t-\r]*", settings.name), "name", "a text of one line without / + #"),
        (all(re.fullmatch(r"[^+#\s]+", one) for one in topics[1:]), "[mqtt] prefix", "a topic without + # and spaces"),
        (mqtt is None or mqtt.user or not mqtt.password_file, "[mqtt] user", "the user of the password"),
        (all(names) and len(set(names)) == len(names), "[[hooks]] name", "another name for each hook and outlet"),
        (all(re.match(r"https?://[^/@?#\s]+(/|$)\S*$", hook.url) for hook in hooks), "[[hooks]] url",
         '"https://host/path" without user and password'),
        (opcua is None or re.fullmatch(r"opc\.tcp://[^/@\s]+:\d+(/\S*)?", opcua.endpoint), "[opcua] endpoint",
         'an address such as "opc.tcp://0.0.0.0:4840"'),
    ):  # fmt: skip
        if not is_right:
            raise InputError(f"{root.path}: {key}: expected {expected}")
    for file in (
        *(hook.token_file for hook in hooks),
        *((mqtt.password_file, mqtt.ca_file) if mqtt is not None else ()),
    ):
        settings.secret(file)
    return settings
