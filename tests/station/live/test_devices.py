"""Paired devices: tokens that last over restarts, their file, names, bounds, and how they are revoked."""

from __future__ import annotations

import http.client
import json
import stat
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from arview.cli import main
from arview.station.live.security.addresses import LOOPBACK
from arview.station.live.security.devices import Devices, device_name, read_devices
from helpers.live_client import Http, Running, running, wait
from helpers.live_sample import loader, options

PHONE = (
    "Mozilla/5.0 (Linux; Android 14; K) AppleWebKit/537.36 (KHTML, like Gecko) Chrome/131.0.0.0 Mobile Safari/537.36"
)


def test_tokens_last_and_only_their_hashes_are_kept(tmp_path: Path) -> None:
    path = tmp_path / "data" / "devices.json"
    name, token = Devices(path).pair(PHONE)
    again = Devices(path)
    assert name == "Android Chrome" and again.find(token) == name and again.has(name)
    assert again.find(token[:-1]) is None and again.find("") is None and again.find(token + "é") is None
    assert token not in path.read_text() and len(token) >= 32
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert {Devices(path).pair(PHONE)[0] for _ in range(2)} == {"Android Chrome 2", "Android Chrome 3"}


@pytest.mark.parametrize(
    ("user_agent", "name"),
    [
        (
            "Mozilla/5.0 (iPhone; CPU iPhone OS 17_5 like Mac OS X) Version/17.5 Safari/604.1",
            "iPhone Safari",
        ),
        ("Mozilla/5.0 (X11; Linux x86_64; rv:140.0) Gecko/20100101 Firefox/140.0", "Linux Firefox"),
        ("Mozilla/5.0 (Windows NT 10.0) AppleWebKit/537.36 Chrome/130.0 Safari/537.36 Edg/130.0", "Windows Edge"),
        ("", "Device"),
    ],
)
def test_devices_are_named_after_system_and_browser(user_agent: str, name: str) -> None:
    assert device_name(user_agent) == name


def test_one_too_many_takes_the_place_of_the_one_not_used_for_longest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("arview.station.live.security.devices.MAX_DEVICES", 3)
    devices = Devices(tmp_path / "devices.json")
    tokens = [devices.pair(PHONE)[1] for _ in range(3)]
    assert devices.find(tokens[0])  # used now
    newest = devices.pair(PHONE)[1]
    assert [devices.find(token) is not None for token in [*tokens, newest]] == [True, False, True, True]


def test_devices_that_are_not_used_are_forgotten(tmp_path: Path) -> None:
    path = tmp_path / "devices.json"
    devices = Devices(path)
    (_, old), (_, new) = devices.pair("iPhone"), devices.pair("iPad")
    long_ago = datetime.now(UTC) - timedelta(days=200)
    for key, device in devices._devices.items():
        if device.name == "iPhone":
            devices._devices[key] = replace(device, created=long_ago, last_used=long_ago)
    devices._write()
    later = Devices(path)
    later.save()
    assert later.find(new) == "iPad" and later.find(old) is None


def test_a_clock_put_forward_forgets_nobody(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    devices = Devices(tmp_path / "devices.json")
    (_, phone), (_, tablet) = devices.pair("iPhone"), devices.pair("iPad")

    class Later(datetime):
        @classmethod
        def now(cls, tz: Any = None) -> datetime:
            return datetime.now(tz) + timedelta(days=3650)

    with monkeypatch.context() as patch:
        patch.setattr("arview.station.live.security.devices.datetime", Later)
        assert devices.find(phone) == "iPhone"
        devices.save()
        assert devices.find(tablet) == "iPad"
    assert devices.find(phone) == "iPhone"
    devices.save()
    again = Devices(tmp_path / "devices.json")
    assert again.find(phone) == "iPhone" and again.find(tablet) == "iPad"


def test_two_processes_share_the_file_and_a_revoked_device_does_not_come_back(tmp_path: Path) -> None:
    path = tmp_path / "devices.json"
    server = Devices(path)
    name, token = server.pair(PHONE)
    other = Devices(path)
    assert other.revoke(name) and not other.revoke(name)
    assert server.find(token) == name  # until it reads the file again
    server.refresh()
    assert server.find(token) is None
    server.save()
    assert read_devices(path) == ()


def test_a_damaged_file_is_set_aside(tmp_path: Path) -> None:
    path = tmp_path / "devices.json"
    for content in ("{", "[]", '{"format": "arview devices", "version": 1, "devices": [3]}', '{"format": "x"}'):
        path.write_text(content)
        devices = Devices(path)
        assert devices.listed() == () and (tmp_path / "devices.json.damaged").read_text() == content
        name, token = devices.pair(PHONE)
        assert Devices(path).find(token) == name


def test_times_of_last_use_are_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("arview.station.live.security.devices.SAVE_INTERVAL_S", 0.0)
    path = tmp_path / "devices.json"
    devices = Devices(path)
    _, token = devices.pair(PHONE)
    paired = read_devices(path)[0].last_used
    devices.find(token)
    devices.refresh()
    assert read_devices(path)[0].last_used > paired


@pytest.fixture
def server(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Running]:
    monkeypatch.setattr("arview.station.live.server.hub.RELOAD_INTERVAL_S", 0.2)
    chosen = options(devices=tmp_path / "devices.json")
    with running(chosen, loader(chosen)) as server:
        yield server


def opened(port: int, token: str, cookie: str = "") -> tuple[int, str | None]:
    """Status and cookie of the page, opened by its link."""
    connection = http.client.HTTPConnection(LOOPBACK, port, timeout=60)
    connection.request(
        "GET", f"/?token={token}", headers={"User-Agent": PHONE, **({"Cookie": cookie} if cookie else {})}
    )
    answer = connection.getresponse()
    answer.read()
    connection.close()
    return answer.status, answer.headers["Set-Cookie"]


@pytest.mark.slow
def test_a_phone_stays_paired_over_a_restart_and_the_link_does_not(tmp_path: Path) -> None:
    chosen = options(devices=tmp_path / "devices.json")
    with running(chosen, loader(chosen)) as first:
        status, cookie = opened(first.port, first.token)
        assert status == 200 and cookie is not None and "Max-Age=15552000" in cookie and first.token not in cookie
        value = cookie.split(";")[0].partition("=")[2]
        link = first.token
    with running(chosen, loader(chosen)) as second:
        page = Http(second.port, second.token)
        page.headers["Cookie"] = f"arview_{second.port}={value}"
        assert page.json("GET", "/api/status")[0] == 200
        listed = page.json("GET", "/api/devices")[1]["devices"]
        assert [one["is_this"] for one in listed if one["name"] == "Android Chrome"] == [True]
        assert opened(second.port, link)[0] == 403  # the token of the run before
        # The token of the run pairs, and is good for nothing else.
        page.headers["Cookie"] = f"arview_{second.port}={second.token}"
        assert page.json("GET", "/api/status")[0] == 403
        # A browser that is paired stays the same device.
        count = len(listed)
        assert opened(second.port, second.token, f"arview_{second.port}={value}")[1] is not None
        page.headers["Cookie"] = f"arview_{second.port}={value}"
        assert len(page.json("GET", "/api/devices")[1]["devices"]) == count


@pytest.mark.slow
def test_a_revoked_device_is_out_at_once(server: Running, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    page, boss = server.session(), server.session()
    page.join()
    names = [one["name"] for one in boss.json("GET", "/api/devices")[1]["devices"]]
    assert sorted(names) == ["Device", "Device 2"]
    assert boss.json("DELETE", "/api/devices/nobody")[0] == 404
    assert boss.json("DELETE", "/api/devices/Device")[0] == 204
    assert page.json("GET", "/api/status")[0] == 403 and not server.hub.clients
    # And by the program, beside the running server.
    monkeypatch.setenv("ARVIEW_DATA", str(tmp_path))
    boss.join()
    listed = CliRunner().invoke(main, ["live", "--devices"])
    assert listed.exit_code == 0 and listed.output.startswith("Device 2  paired 20")
    assert CliRunner().invoke(main, ["live", "--revoke", "Device 2"]).exit_code == 0
    wait(lambda: boss.json("GET", "/api/status")[0] == 403 and not server.hub.clients, 20)
    for name in ("Phone A", "Phone B"):
        Devices(tmp_path / "devices.json").pair(name)
    both = CliRunner().invoke(main, ["live", "--devices", "--revoke", "Device"])
    assert both.exit_code == 0 and "Device is no longer paired" in both.stderr
    assert both.stdout.startswith("Device 2  paired 20") and len(both.stdout.splitlines()) == 1
    assert CliRunner().invoke(main, ["live", "--revoke", "Device 2"]).exit_code == 0
    missing = CliRunner().invoke(main, ["live", "--revoke", "Device 2"])
    assert missing.exit_code == 64 and "paired are: none" in missing.stderr
    assert json.loads((tmp_path / "devices.json").read_text())["devices"] == []
