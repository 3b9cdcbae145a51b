"""Errors of ``station.toml`` in one line that names the key."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest

from arview import cad
from arview.errors import InputError
from arview.station.plant import read_plant
from helpers.plant_bench import settings

WHOLE = """name = "cell-3"
[mqtt]
host = "broker.local"
port = 8883
prefix = "plant/line-2"
tls = true
ca_file = "ca.pem"
user = "station"
password_file = "secret"
[[hooks]]
name = "mes"
url = "https://mes.local:8443/arview?line=2"
token_file = "token"
[[hooks]]
name = "chat"
url = "http://10.0.0.7/"
[opcua]
endpoint = "opc.tcp://0.0.0.0:4840"
[alarms]
last = 100
undecided = 0.1
"""


def test_all_that_can_be_set(tmp_path: Path) -> None:
    for name in ("ca.pem", "secret", "token"):
        (tmp_path / name).write_text(f"{name}\n")
    found = settings(tmp_path, WHOLE)
    assert found.mqtt is not None and found.opcua is not None
    assert (found.mqtt.host, found.mqtt.port, found.mqtt.prefix, found.mqtt.tls) == (
        "broker.local", 8883, "plant/line-2", True,
    )  # fmt: skip
    assert [hook.name for hook in found.hooks] == ["mes", "chat"] and found.secret(found.mqtt.password_file) == "secret"
    assert (found.alarms.last, found.alarms.undecided) == (100, 0.1)


def test_what_is_left_out_is_off(tmp_path: Path) -> None:
    found = settings(tmp_path, 'name = "cell-3"\n')
    assert (found.mqtt, found.hooks, found.opcua) == (None, (), None)
    assert (found.alarms.last, found.alarms.undecided) == (50, 0.2)


def test_other_keys_are_left_to_the_caller(tmp_path: Path) -> None:
    root = cad.TomlTable(tmp_path / "station.toml", "", tomllib.loads('name = "a"\npart = "p"\n[mqtt]\nhost = "h"\n'))
    read_plant(root)
    with pytest.raises(InputError, match="unknown key 'part'"):
        root.finish()


MQTT, HOOK = 'name = "a"\n[mqtt]\nhost = "h"\n', 'name = "a"\n[[hooks]]\nname = "mes"\n'


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", "Object missing required field `name`"),
        ("name = 3", "Expected `str`, got `int` - at `$.name`"),
        ('name = "a/b"', "name: expected a text of one line without / + #"),
        ('name = "a\\nb"', "name: expected a text of one line without / + #"),
        ('name = "a"\nmqtt = 1', "Expected `object | null`, got `int` - at `$.mqtt`"),
        ('name = "a"\n[mqtt]', "Object missing required field `host` - at `$.mqtt`"),
        (MQTT + "prot = 1883", "Object contains unknown field `prot` - at `$.mqtt`"),
        (MQTT + 'port = "1883"', "Expected `int`, got `str` - at `$.mqtt.port`"),
        (MQTT + "port = 70000", "Expected `int` <= 65535 - at `$.mqtt.port`"),
        (MQTT + 'prefix = "a//b"', "[mqtt] prefix: expected a topic without + # and spaces"),
        (MQTT + 'prefix = "#"', "[mqtt] prefix: expected a topic without + # and spaces"),
        (MQTT + 'password_file = "secret"', "[mqtt] user: expected the user of the password"),
        (MQTT + 'user = "u"\npassword_file = "none"', "none: cannot be read (No such file or directory)"),
        (HOOK, "Object missing required field `url` - at `$.hooks[0]`"),
        (HOOK + 'url = "ftp://h/"', '[[hooks]] url: expected "https://host/path" without user and password'),
        (HOOK + 'url = "http://u:pw@h/"', '[[hooks]] url: expected "https://host/path" without user and password'),
        (HOOK + 'url = "http://h/"\n[[hooks]]\nname = "mes"\nurl = "http://i/"',
         "[[hooks]] name: expected another name for each hook and outlet"),
        ('name = "a"\n[[hooks]]\nname = "mqtt"\nurl = "http://h/"',
         "[[hooks]] name: expected another name for each hook and outlet"),
        ('name = "a"\n[opcua]\nendpoint = "http://h:1"',
         '[opcua] endpoint: expected an address such as "opc.tcp://0.0.0.0:4840"'),
        ('name = "a"\n[alarms]\nundecided = 2.0', "Expected `float` <= 1.0 - at `$.alarms.undecided`"),
        ('name = "a"\n[alarms]\nlast = 5', "Expected `int` >= 20 - at `$.alarms.last`"),
    ],
)  # fmt: skip
def test_errors_in_one_line(tmp_path: Path, text: str, expected: str) -> None:
    with pytest.raises(InputError) as raised:
        settings(tmp_path, text)
    said = str(raised.value)
    assert expected in said and "\n" not in said and str(tmp_path) in said and "pw" not in said.replace(expected, "")
