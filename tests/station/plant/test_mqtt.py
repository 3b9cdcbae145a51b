"""MQTT against a real broker: cut links, killed programs, triggers, the state, what the broker refuses, TLS."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from arview.station.plant import Plant, Trigger
from arview.station.plant import mqtt as link
from helpers.plant_bench import Cable, broker, consuming, mqtt_settings, needs_broker, result, wait

pytestmark = needs_broker
RESULTS = 1000


def is_connected(plant: Plant) -> Callable[[], bool]:
    return lambda: bool(plant.health()["outlets"]["mqtt"]["is_connected"])


def pending(plant: Plant) -> int:
    return int(plant.health()["outlets"]["mqtt"]["pending"])


@pytest.mark.slow
def test_a_thousand_results_over_a_link_that_is_cut_five_times(tmp_path: Path) -> None:
    cuts: list[int] = []
    with broker(tmp_path) as port, consuming(port) as consumer:
        cable = Cable(port)

        def cut() -> None:
            for place in (50, 250, 450, 650, 850):
                wait(lambda place=place: len(set(consumer.result_keys())) >= place, 120)
                cuts.append(cable.cut(for_s=0.2))

        cutter = threading.Thread(target=cut)
        cutter.start()
        with Plant(mqtt_settings(tmp_path, cable.port), tmp_path) as plant:
            for number in range(RESULTS):
                assert plant.publish(result(number))
            assert not plant.publish(result(0))  # the same inspection again
            cutter.join(20)
            wait(lambda: pending(plant) == 0, 120)
            wait(lambda: len(set(consumer.result_keys())) == RESULTS)
        told = consumer.result_keys()
    assert cuts == [1] * 5
    assert sorted(set(told)) == [result(number).key for number in range(RESULTS)]
    assert len(told) - RESULTS <= len(cuts)  # at most the message that was under way when the link was cut


SENDER = """
import sys
from pathlib import Path
from arview.station.plant import Plant
from helpers.plant_bench import mqtt_settings, result
folder, port, first = Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])
with Plant(mqtt_settings(folder, port), folder) as plant:
    for number in range(first, first + 1000):
        plant.publish(result(number))
        print(number, flush=True)
"""


@pytest.mark.slow
def test_nothing_is_lost_when_the_program_is_killed(tmp_path: Path) -> None:
    """What `Plant.publish` has returned for is delivered, wherever the program was killed."""
    published: set[int] = set()
    path = f"{Path(__file__).parents[2]}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"
    with broker(tmp_path) as port, consuming(port) as consumer:
        for run, lines in enumerate((1, 20, 60)):
            process = subprocess.Popen(
                [sys.executable, "-c", SENDER, tmp_path, str(port), str(1000 * run)],
                stdout=subprocess.PIPE, text=True, env={**os.environ, "PYTHONPATH": path},
            )  # fmt: skip
            assert process.stdout is not None
            own = [int(process.stdout.readline()) for _ in range(lines)]
            process.send_signal(signal.SIGKILL)
            own += [int(line) for line in process.stdout.read().split("\n") if line]
            process.wait(10)
            published |= set(own)
        with Plant(mqtt_settings(tmp_path, port), tmp_path) as plant:
            wait(lambda: pending(plant) == 0 and is_connected(plant)())
            wait(lambda: {int(key, 16) for key in consumer.result_keys()} >= published, 60)
        told = {int(key, 16) for key in consumer.result_keys()}
    assert len(published) >= 81
    assert len(told - published) <= 3  # written, but the program was killed before it could say so


@pytest.mark.slow
def test_a_broker_that_stops_answering_is_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(link, "TIMEOUT_S", 1.0)
    with broker(tmp_path) as port, consuming(port) as consumer:
        cable = Cable(port)
        with Plant(mqtt_settings(tmp_path, cable.port), tmp_path) as plant:
            wait(is_connected(plant))
            cable.is_stalled = True
            plant.publish(result(1))
            wait(lambda: not is_connected(plant)(), 60)
            assert plant.health()["outlets"]["mqtt"]["error"] == "Operation timed out"
            cable.is_stalled = False
            wait(lambda: pending(plant) == 0)
            started_s = time.monotonic()
        assert time.monotonic() - started_s < 8.0
        assert set(consumer.result_keys()) == {result(1).key}


@pytest.mark.slow
def test_triggers_and_refusals_in_words(tmp_path: Path) -> None:
    with broker(tmp_path) as port, consuming(port) as consumer:
        consumer.publish("arview/cell-3/triggers", {"id": "old", "serial": "SN-0"}, retain=True)
        with Plant(mqtt_settings(tmp_path, port), tmp_path) as plant:
            wait(is_connected(plant))
            consumer.publish("arview/cell-3/triggers", {"id": "early"})
            early = wait(lambda: consumer.of("errors"))[0]
            assert early["reason"] == (
                "trigger 'early': the station is preoperational; send it when the station is ready"
            )
            plant.set_state("ready")
            for content in ({"id": "7", "serial": "SN-1", "order": "O-1", "recipe": "r"}, {"id": "7"}):
                consumer.publish("arview/cell-3/triggers", content)
            assert plant.next_trigger(5.0) == Trigger(id="7", serial="SN-1", order="O-1", recipe="r")
            consumer.publish("arview/cell-3/triggers", {"id": "7", "serial": "SN-1"})
            assert plant.next_trigger(0.5) is None  # it was carried out
            wrong = [b"{", b"[]", {"id": 5}, {"serial": "SN-1"}, {"id": "8", "serail": "SN-1"}, {"id": "8\n"},
                     {"id": "9", "serial": "x" * 201}, {"id": "9", "version": "2"}, b"x" * 20_000, b"\xff"]  # fmt: skip
            for number, content in enumerate(wrong):
                consumer.publish("arview/cell-3/triggers", content)
                wait(lambda number=number: len(consumer.of("errors")) == number + 2)
            assert plant.next_trigger(0.2) is None
        reasons = [document["reason"] for document in consumer.of("errors")[1:]]
    keys = "; allowed keys: version, id, serial, order, recipe, part"
    assert reasons == [
        f"trigger: Input data was truncated{keys}",
        f"trigger: Expected `object`, got `array`{keys}",
        f"trigger: Expected `str`, got `int` - at `$.id`{keys}",
        f"trigger: Object missing required field `id`{keys}",
        f"trigger: Object contains unknown field `serail`{keys}",
        f"trigger: Expected printable text of one line - at `$.id`{keys}",
        f"trigger: Expected `str` of length <= 200 - at `$.serial`{keys}",
        f"trigger: Invalid enum value '2' - at `$.version`{keys}",
        "trigger: has 20000 bytes; expected at most 16384",
        f"trigger: JSON is malformed: invalid character (byte 0){keys}",
    ]
    assert all("\n" not in reason for reason in reasons)


@pytest.mark.slow
def test_the_state_is_retained_and_the_broker_says_when_the_station_is_gone(tmp_path: Path) -> None:
    with broker(tmp_path) as port, consuming(port) as consumer:
        cable = Cable(port)

        def states() -> list[tuple[str, str]]:
            return [(document["state"], document["text"]) for document in consumer.of("state")]

        with Plant(mqtt_settings(tmp_path, cable.port), tmp_path) as plant:
            wait(lambda: states() == [("preoperational", "")])
            plant.set_state("ready")
            wait(lambda: states()[1:] == [("ready", "")])
            plant.publish(result(1))
            wait(lambda: len(states()) == 3)
            cable.cut(for_s=0.5)
            wait(lambda: states()[3:] == [("offline", "the connection was lost"), ("ready", "")])
            with consuming(port) as late:
                wait(lambda: late.of("state"))
                assert late.told[0][2] and late.of("state")[0]["cycle"] == 1
        wait(lambda: states()[-1] == ("offline", "stopped"))


@pytest.mark.slow
def test_a_message_that_the_broker_refuses_is_not_taken_for_delivered(tmp_path: Path) -> None:
    rules = tmp_path / "acl"
    rules.write_text("topic read #\ntopic write arview/cell-3/state\n")
    with broker(tmp_path, f"acl_file {rules}") as port, consuming(port) as consumer:
        with Plant(mqtt_settings(tmp_path, port), tmp_path) as plant:
            plant.publish(result(1))
            wait(lambda: "Not authorized" in plant.health()["outlets"]["mqtt"]["error"])
            assert pending(plant) == 1
        assert consumer.result_keys() == []


@pytest.mark.slow
def test_user_and_password_are_needed_and_never_shown(tmp_path: Path) -> None:
    passwords, secret = tmp_path / "passwords", "wonderful-17"
    made = subprocess.run(["mosquitto_passwd", "-b", "-c", passwords, "station", secret], capture_output=True)
    if made.returncode:
        pytest.skip("mosquitto_passwd cannot be run")
    (tmp_path / "secret").write_text(secret + "\n")
    chosen = mqtt_settings(tmp_path, 1, 'user = "station"\npassword_file = "secret"\n')
    assert secret not in repr(chosen)
    with broker(tmp_path, "allow_anonymous false", f"password_file {passwords}") as port:
        with Plant(mqtt_settings(tmp_path, port), tmp_path / "a") as plant:
            wait(lambda: "Not authorized" in plant.health()["outlets"]["mqtt"]["error"])
        more = 'user = "station"\npassword_file = "secret"\n'
        chosen = mqtt_settings(tmp_path, port, more)
        with consuming(port, "station", secret) as consumer, Plant(chosen, tmp_path / "b") as plant:
            plant.publish(result(1))
            wait(lambda: consumer.result_keys() == [result(1).key])
            assert secret not in str(plant.health()) + plant.metrics()


@pytest.mark.slow
def test_tls_with_a_certificate_that_is_checked(tmp_path: Path) -> None:
    made = subprocess.run(
        ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "2", "-subj", "/CN=broker",
         "-addext", "subjectAltName=IP:127.0.0.1", "-keyout", tmp_path / "key.pem", "-out", tmp_path / "cert.pem"],
        capture_output=True,
    )  # fmt: skip
    if made.returncode:
        pytest.skip("openssl cannot be run")
    lines = (f"certfile {tmp_path / 'cert.pem'}", f"keyfile {tmp_path / 'key.pem'}")
    with broker(tmp_path, *lines) as port:
        with Plant(mqtt_settings(tmp_path, port, "tls = true\n"), tmp_path) as plant:
            plant.publish(result(1))
            wait(lambda: "certificate verify failed" in plant.health()["outlets"]["mqtt"]["error"])
            assert pending(plant) == 1
        with Plant(mqtt_settings(tmp_path, port, 'tls = true\nca_file = "cert.pem"\n'), tmp_path) as plant:
            wait(lambda: pending(plant) == 0)
