"""The outbox: durable, one message for each key, two processes, what is old is deleted, alarms over a restart."""

from __future__ import annotations

import sqlite3
import subprocess
import sys
import time
from pathlib import Path

import msgspec
import pytest

from arview.errors import InputError, OutputError
from arview.station.plant import Trigger, outbox
from arview.station.plant.messages import Result
from arview.station.plant.outbox import Outbox
from arview.station.plant.plant import Plant
from helpers.plant_bench import result, settings

WRITER = """
import sys
from pathlib import Path
from arview.station.plant.outbox import Outbox
from helpers.plant_bench import result
box = Outbox(Path(sys.argv[1]), ["mqtt", "mes"])
print("ready", flush=True)
sys.stdin.readline()
new = sum(box.add(result(number)) for number in range(int(sys.argv[2]), int(sys.argv[3])))
for message in box.pending("mes", 10_000):
    box.confirm("mes", message.number)
print(new)
"""


def test_each_outlet_confirms_for_itself(tmp_path: Path) -> None:
    box = Outbox(tmp_path / "outbox.sqlite", ["mqtt", "mes"])
    assert box.add(result(1)) and box.add(result(2)) and not box.add(result(1, order="other"))
    first, second = box.pending("mqtt", 10)
    assert (first.key, first.topic, first.tries) == (result(1).key, "results", 0)
    assert msgspec.json.decode(first.body, type=Result) == result(1)
    box.confirm("mqtt", first.number)
    box.confirm("mes", second.number, "422")
    assert [one.key for one in box.pending("mqtt", 10)] == [result(2).key]
    counts = box.counts()
    assert counts["mqtt"]["pending"] == counts["mes"]["pending"] == 1
    assert (counts["mes"]["refused"], counts["mes"]["refusal"]) == (1, "422")
    box.defer("mqtt", second.number, 60.0)
    assert box.pending("mqtt", 10) == [] and box.counts()["mqtt"]["pending"] == 1
    box.close()
    with pytest.raises(OutputError, match=r"outbox\.sqlite: the outbox cannot be used \(Cannot operate on a closed"):
        box.add(result(3))


def test_it_is_written_through_to_the_disk(tmp_path: Path) -> None:
    box = Outbox(tmp_path / "outbox.sqlite", [])
    assert box._rows("PRAGMA synchronous", ()) == [(2,)] and box._rows("PRAGMA journal_mode", ()) == [("wal",)]


@pytest.mark.slow
def test_two_processes_write_and_confirm_at_the_same_time(tmp_path: Path) -> None:
    path, environment = tmp_path / "outbox.sqlite", {"PYTHONPATH": ":".join(sys.path)}
    writers = [
        subprocess.Popen([sys.executable, "-c", WRITER, path, *numbers], stdin=subprocess.PIPE,
                         stdout=subprocess.PIPE, text=True, env=environment)
        for numbers in (("0", "300"), ("200", "500"))
    ]  # fmt: skip
    for writer in writers:
        assert writer.stdout is not None and writer.stdout.readline() == "ready\n"
    said = [int(writer.communicate("go\n", timeout=30)[0]) for writer in writers]
    assert sum(said) == 500 and min(said) >= 200
    box = Outbox(path, ["mqtt", "mes"])
    assert {one.key for one in box.pending("mqtt", 1000)} == {result(number).key for number in range(500)}
    assert box.counts()["mes"]["pending"] == 0 or box.counts()["mes"]["pending"] < 300


def test_old_messages_are_deleted_unless_they_are_pending(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    box = Outbox(tmp_path / "outbox.sqlite", ["mqtt"])
    for number in range(3):
        box.add(result(number))
    box.confirm("mqtt", box.pending("mqtt", 1)[0].number)
    monkeypatch.setattr(outbox, "KEEP_S", -1.0)
    box.add(result(3))
    assert box._rows("SELECT COUNT(*) FROM messages", ()) == [(4,)]  # they are looked for once an hour
    box._pruned_s = time.time() - outbox.PRUNE_INTERVAL_S - 1.0
    box.add(result(4))
    assert [key for (key,) in box._rows("SELECT key FROM messages ORDER BY number", ())] == [
        result(number).key for number in (1, 2, 3, 4)
    ]
    assert box._rows("SELECT COUNT(*) FROM deliveries", ()) == [(4,)]


def test_a_trigger_is_carried_out_once(tmp_path: Path) -> None:
    path = tmp_path / "outbox.sqlite"
    assert Outbox(path, ["mqtt"]).take_trigger(Trigger(id="7"))
    box = Outbox(path, ["mqtt"])
    assert not box.take_trigger(Trigger(id="7", serial="SN-2")) and box.take_trigger(Trigger(id="8"))
    assert box.pending("mqtt", 10) == []


def test_alarms_begin_once_and_end_once_over_a_restart(tmp_path: Path) -> None:
    chosen = settings(tmp_path, 'name = "cell-3"\n[[hooks]]\nname = "mes"\nurl = "http://127.0.0.1:9/"\n')
    changes = [("moved", True), ("moved", False), ("moved more", False), ("", True), ("", False), ("again", True)]
    for text, is_change in changes:
        plant = Plant(chosen, tmp_path)  # it is not entered: nothing is sent
        assert plant.set_alarm("camera_moved", "left", text, "error") is is_change
        plant._outbox.close()
    box = Outbox(tmp_path / "outbox.sqlite", ["mes"])
    told = [msgspec.json.decode(one.body) for one in box.pending("mes", 10)]
    assert [(one["is_active"], one["text"]) for one in told] == [(True, "moved"), (False, "moved"), (True, "again")]
    assert len({one["key"] for one in told}) == 3 and {one["id"] for one in told} == {"camera_moved//left"}
    assert told[1]["since"] == told[0]["since"] < told[1]["until"] and told[0]["until"] is None
    (active,) = box.alarms()
    assert (active.text, active.severity, active.is_active) == ("again", "error", True)


def test_files_of_others_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "outbox.sqlite"
    with sqlite3.connect(path) as connection:
        connection.execute("PRAGMA user_version = 9")
    with pytest.raises(InputError, match=r"was written by a newer arview \(version 9\); update arview"):
        Outbox(path, [])
    (tmp_path / "text.sqlite").write_text("no database" * 100)
    with pytest.raises(OutputError, match="file is not a database"):
        Outbox(tmp_path / "text.sqlite", [])
