"""The log of decisions: what is confirmed is kept, and what was changed is found and named."""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import threading
import time
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from arview.errors import InputError, OutputError
from arview.quality.decisions import DecisionLog, decision_document
from arview.quality.decisions.entry import entry_of, line_of

HASH = "ab" * 32


@pytest.fixture
def log(tmp_path: Path) -> DecisionLog:
    return DecisionLog(tmp_path / "decisions.jsonl")


def filled(log: DecisionLog) -> list[bytes]:
    """Five entries, and their lines."""
    log.decide("link_1", False, "too far out", by="Ada")
    log.tick("link_1", 0, True, "Ada")
    log.tick("link_1", 1, True, "Ada")
    log.decide("link_1", True, "moved by hand", "within 0.5", "Ada", "0003.jpg", HASH)
    log.sign("Grace", "shift 2", HASH)
    return log.path.read_bytes().splitlines()


def test_an_entry_comes_back_as_it_was_written(log: DecisionLog) -> None:
    filled(log)
    kept = log.entries()
    assert [one.kind for one in kept] == ["decision", "tick", "tick", "decision", "signature"]
    assert [one.number for one in kept] == [1, 2, 3, 4, 5]
    assert (kept[3].reason, kept[3].note, kept[3].photo) == ("moved by hand", "within 0.5", "0003.jpg")
    assert [kept[k].previous == kept[k - 1].sha256 for k in range(1, 5)] == [True] * 4
    assert log.latest()["link_1"].is_ok is True
    assert log.ticks() == {"link_1": {0: True, 1: True}}
    signed = log.signature()
    assert signed is not None and signed.by == "Grace" and log.signature(HASH) == signed
    assert log.faults() == () and log.content().notices == ()


def test_a_log_that_is_not_there_is_empty(log: DecisionLog) -> None:
    assert log.entries() == () and log.faults() == () and log.signature() is None


def test_a_decision_or_another_inspection_voids_the_signature(log: DecisionLog) -> None:
    filled(log)
    assert log.signature("cd" * 32) is None
    log.tick("link_1", 1, False, "Ada")
    assert log.signature(HASH) is not None  # a tick decides nothing
    log.decide("post_1", True, "as agreed", by="Ada")
    assert log.signature(HASH) is None
    log.sign("Grace", "", HASH)
    assert log.signature(HASH) is not None


@pytest.mark.parametrize("line", range(5))
def test_a_changed_line_is_named(log: DecisionLog, line: int) -> None:
    lines = filled(log)
    for old, new in ((b"Ada", b"Eve"), (b"Grace", b"Greta")):
        lines[line] = lines[line].replace(old, new)
    log.path.write_bytes(b"\n".join(lines) + b"\n")
    assert len(log.faults()) == 1
    assert f"line {line + 1} was changed" in log.faults()[0]
    assert len(log.entries()) == 5  # nothing is dropped silently
    assert log.signature() is None
    with pytest.raises(InputError, match=f"line {line + 1} was changed"):
        log.decide("post_1", True, "", by="Ada")
    assert len(log.path.read_bytes().splitlines()) == 5


@pytest.mark.parametrize("line", range(5))
def test_a_removed_line_is_named(log: DecisionLog, line: int) -> None:
    lines = filled(log)
    del lines[line]
    log.path.write_bytes(b"\n".join(lines) + b"\n")
    assert len(log.faults()) == 1, log.faults()
    expected = "the last 1 entry was removed" if line == 4 else f"1 entry before line {line + 1} was removed"
    assert expected in log.faults()[0]


def test_lines_in_another_order_and_inserted_ones_are_found(log: DecisionLog) -> None:
    lines = filled(log)
    log.path.write_bytes(b"\n".join([lines[1], lines[0], *lines[2:]]) + b"\n")
    assert log.faults()
    log.path.write_bytes(b"\n".join([*lines[:2], lines[1], *lines[2:]]) + b"\n")
    assert any("line" in fault for fault in log.faults())


def test_a_line_that_is_no_entry_is_named_once(log: DecisionLog) -> None:
    lines = filled(log)
    lines[2] = b'{"entry": 3, "what": 1}'
    log.path.write_bytes(b"\n".join(lines) + b"\n")
    assert len(log.faults()) == 1 and "line 3 cannot be read" in log.faults()[0]
    assert [one.number for one in log.entries()] == [1, 2, 4, 5]


def test_a_removed_file_is_told(log: DecisionLog) -> None:
    filled(log)
    log.path.unlink()
    assert log.faults() == ("decisions.jsonl: the file with 5 entries was removed",)
    with pytest.raises(InputError, match="the last 5 entries were removed"):
        log.sign("Grace", "", HASH)


def test_a_removed_end_is_told(log: DecisionLog) -> None:
    filled(log)
    log.end_path.unlink()
    assert "removed last lines would not be found" in log.faults()[0]


@pytest.mark.parametrize("cut", [1, 2, 40, 10_000])
def test_a_torn_last_line_is_set_aside_and_told(log: DecisionLog, cut: int) -> None:
    lines = filled(log)
    torn = lines[4][: max(1, len(lines[4]) - cut)]
    # As after a crash in the fifth addition: neither the line nor the end were confirmed.
    log.path.write_bytes(b"\n".join([*lines[:4], torn]))
    log.end_path.write_text(json.dumps({"entry": 4, "sha256": log.entries()[3].sha256}))
    assert log.faults() == () and len(log.entries()) == 4
    assert "line 5 was cut off" in log.content().notices[0]
    added = log.decide("post_1", True, "good", by="Ada")
    assert added.number == 5 and log.faults() == ()
    assert log.torn_path.read_bytes() == torn + b"\n"
    assert "decisions.torn.jsonl holds a line" in log.content().notices[0]


def test_a_whole_last_line_without_its_end_counts(log: DecisionLog) -> None:
    lines = filled(log)
    log.path.write_bytes(b"\n".join(lines))
    assert len(log.entries()) == 5 and log.faults() == ()
    assert log.decide("post_1", True, "good", by="Ada").number == 6
    assert log.faults() == () and not log.torn_path.exists()


def test_a_crash_before_the_end_is_written_is_no_fault(log: DecisionLog) -> None:
    filled(log)
    log.end_path.write_text(json.dumps({"entry": 4, "sha256": log.entries()[3].sha256}))
    assert log.faults() == ()
    assert log.decide("post_1", True, "good", by="Ada").number == 6


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"by": " "}, "by: is empty"),
        ({"component": ""}, "component: is empty"),
        ({"reason": "", "is_ok": False}, "reason: is empty"),
        ({"reason": "x" * 5000}, "at most 4000"),
        ({"by": "a\nb"}, "control character"),
        ({"note": "a\x00b"}, "control character"),
        ({"note": "\ud800"}, "control character"),
        ({"note": 3}, "expected text"),
        ({"is_ok": "yes"}, "expected true or false"),
        ({"inspection_sha256": "zz"}, "64 hexadecimal digits"),
        ({"photo": ""}, "photo: is empty"),
    ],
)
def test_bad_values_are_refused(log: DecisionLog, change: dict[str, object], message: str) -> None:
    values: dict[str, object] = {"component": "a", "is_ok": True, "reason": "r", "by": "Ada"}
    with pytest.raises(InputError, match=message):
        log.decide(**(values | change))  # type: ignore[arg-type]
    assert not log.path.exists()


def test_bad_ticks_and_signatures_are_refused(log: DecisionLog) -> None:
    for step in (-1, 1.5, True, "1"):
        with pytest.raises(InputError, match="step"):
            log.tick("a", step, True, "Ada")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="fingerprint"):
        log.sign("Ada", "")


def test_a_folder_that_is_not_there_is_one_line(tmp_path: Path) -> None:
    log = DecisionLog(tmp_path / "no" / "decisions.jsonl")
    with pytest.raises(OutputError, match="was not kept"):
        log.decide("a", True, "", by="Ada")


def test_threads_never_interleave(log: DecisionLog) -> None:
    def write(name: str) -> None:
        for index in range(12):
            log.tick(name, index, True, name)

    threads = [threading.Thread(target=write, args=(f"t{k}",)) for k in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(log.entries()) == 48 and log.faults() == ()
    assert log.ticks() == {f"t{k}": dict.fromkeys(range(12), True) for k in range(4)}


def _write_forever(path: str, name: str, confirmed: str) -> None:
    log, kept = DecisionLog(path), os.open(confirmed, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    for index in range(1000):
        made = log.tick(name, index, True, name)
        os.write(kept, f"{made.sha256}\n".encode())


@pytest.mark.slow
def test_processes_that_are_killed_lose_nothing_confirmed(tmp_path: Path) -> None:
    path = tmp_path / "decisions.jsonl"
    context = multiprocessing.get_context("fork")
    workers = [
        context.Process(target=_write_forever, args=(str(path), f"p{k}", str(tmp_path / f"p{k}"))) for k in range(2)
    ]
    for worker in workers:
        worker.start()
    deadline = time.monotonic() + 60.0
    while time.monotonic() < deadline and not (path.exists() and path.read_bytes().count(b"\n") > 20):
        time.sleep(0.02)
    for worker in workers:
        assert worker.pid is not None
        os.kill(worker.pid, signal.SIGKILL)
        worker.join()
    log = DecisionLog(path)
    log.tick("after", 0, True, "Ada")  # the locks of the dead are free
    assert log.faults() == ()
    hashes = {one.sha256 for one in log.entries()}
    confirmed = {line for k in range(2) for line in (tmp_path / f"p{k}").read_text().splitlines()}
    assert len(confirmed) > 10 and confirmed <= hashes


TEXT = st.text(st.characters(exclude_categories=("Cc", "Cs")), max_size=60)


@settings(max_examples=60, deadline=None)
@given(reason=TEXT.filter(lambda t: t.strip()), note=TEXT, is_ok=st.booleans())
def test_every_text_survives(tmp_path_factory: pytest.TempPathFactory, reason: str, note: str, is_ok: bool) -> None:
    log = DecisionLog(tmp_path_factory.mktemp("log") / "decisions.jsonl")
    made = log.decide("a", is_ok, reason, note, "Ada")
    assert log.entries() == (made,)
    assert (made.reason, made.note) == (reason.strip(), note.strip())
    assert log.faults() == () and decision_document(made)["reason"] == reason.strip()


@settings(max_examples=150, deadline=None)
@given(data=st.data())
def test_every_changed_byte_is_found(tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    log = DecisionLog(tmp_path_factory.mktemp("log") / "decisions.jsonl")
    for index in range(3):
        log.tick("a", index, True, "Ada")
    content = bytearray(log.path.read_bytes())
    place = data.draw(st.integers(0, len(content) - 2))
    value = data.draw(st.integers(0, 255).filter(lambda v: v != content[place]))
    content[place] = value
    log.path.write_bytes(content)
    assert log.faults()


@settings(max_examples=100, deadline=None)
@given(st.binary(max_size=200))
def test_any_bytes_are_read_without_a_traceback(tmp_path_factory: pytest.TempPathFactory, content: bytes) -> None:
    log = DecisionLog(tmp_path_factory.mktemp("log") / "decisions.jsonl")
    log.path.write_bytes(content)
    assert log.content().entries == ()


def test_lines_and_entries_are_inverse(log: DecisionLog) -> None:
    for line, entry in zip(filled(log), log.entries(), strict=True):
        assert line_of(entry) == line and entry_of(line, entry.sha256) == entry
