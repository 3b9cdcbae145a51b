"""The outbox: messages that are on the disk before anything is sent, until each outlet has confirmed them."""

from __future__ import annotations

import sqlite3
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
from msgspec.structs import replace

from arview.errors import InputError, OutputError
from arview.station.plant.messages import Alarm, Result, Trigger

VERSION = 1
"""Version of the tables."""
BUSY_S = 30.0
"""Time to wait for another process that writes; it writes for milliseconds."""
KEEP_S = 30 * 86_400.0
"""Age at which messages that are no longer pending are deleted. Until then a message is recognised by its key."""
PRUNE_INTERVAL_S = 3600.0
"""Time between two deletions of old messages."""

_TABLES = f"""
BEGIN IMMEDIATE;
CREATE TABLE IF NOT EXISTS messages (
    number INTEGER PRIMARY KEY, key TEXT NOT NULL UNIQUE, topic TEXT NOT NULL, body BLOB NOT NULL, added REAL NOT NULL);
CREATE INDEX IF NOT EXISTS messages_by_age ON messages (added);
CREATE TABLE IF NOT EXISTS deliveries (
    number INTEGER NOT NULL REFERENCES messages ON DELETE CASCADE, outlet TEXT NOT NULL,
    tries INTEGER NOT NULL DEFAULT 0, due REAL NOT NULL DEFAULT 0, closed REAL, refusal TEXT,
    PRIMARY KEY (number, outlet)) WITHOUT ROWID;
CREATE INDEX IF NOT EXISTS open_deliveries ON deliveries (outlet, number) WHERE closed IS NULL;
CREATE TABLE IF NOT EXISTS alarms (id TEXT PRIMARY KEY, body BLOB NOT NULL);
PRAGMA user_version = {VERSION};
COMMIT;
"""


class PendingMessage(NamedTuple):
    """A message that an outlet has not confirmed, and how often it was tried."""

    number: int
    key: str
    topic: str
    body: bytes
    tries: int


class Outbox:
    """The messages in a file of SQLite. Threads and processes may use it at the same time.

    Args:
        path: the file; it is made if it does not exist.
        outlets: names of the outlets that have to confirm each message.

    Raises:
        InputError: the file is of a newer arview.
        OutputError: the file cannot be written; so do all methods.
    """

    def __init__(self, path: Path, outlets: Sequence[str]) -> None:
        self._path, self._outlets, self._lock, self._pruned_s = path, outlets, threading.Lock(), 0.0
        with self._told():
            path.parent.mkdir(parents=True, exist_ok=True)
            self._connection = sqlite3.connect(path, BUSY_S, isolation_level=None, check_same_thread=False)
            for pragma in ("journal_mode = WAL", "synchronous = FULL", "foreign_keys = ON"):
                self._connection.execute(f"PRAGMA {pragma}")
            (found,) = self._connection.execute("PRAGMA user_version").fetchone()
            if found > VERSION:
                raise InputError(f"{path}: was written by a newer arview (version {found}); update arview")
            self._connection.executescript(_TABLES)

    def close(self) -> None:
        """Close the file."""
        with self._lock:
            self._connection.close()

    def add(self, message: Result | Alarm) -> bool:
        """Add a message, which is on the disk then; False if there is one with its key already."""
        with self._writing():
            return self._insert(message.key, message, self._outlets)

    def pending(self, outlet: str, count: int) -> list[PendingMessage]:
        """The oldest messages that an outlet has to send now."""
        rows = self._rows(
            "SELECT number, key, topic, body, tries FROM deliveries JOIN messages USING (number)"
            " WHERE outlet = ? AND closed IS NULL AND due <= ? ORDER BY number LIMIT ?",
            (outlet, time.time(), count),
        )
        return [PendingMessage(*row) for row in rows]

    def confirm(self, outlet: str, number: int, refusal: str | None = None) -> None:
        """Note that an outlet has delivered a message; or that it was refused for good, and why."""
        with self._writing() as connection:
            connection.execute(
                "UPDATE deliveries SET closed = ?, refusal = ? WHERE outlet = ? AND number = ?",
                (time.time(), refusal, outlet, number),
            )

    def defer(self, outlet: str, number: int, delay_s: float) -> None:
        """Note that a message could not be delivered and is tried again after some time."""
        with self._writing() as connection:
            connection.execute(
                "UPDATE deliveries SET tries = tries + 1, due = ? WHERE outlet = ? AND number = ?",
                (time.time() + delay_s, outlet, number),
            )

    def counts(self) -> dict[str, dict[str, Any]]:
        """By outlet, those that are no longer configured included: messages pending, age of the oldest, and refused."""
        rows = self._rows(
            "SELECT outlet, SUM(closed IS NULL), MAX(IIF(closed IS NULL, ? - added, 0.0)), COUNT(refusal), MAX(refusal)"
            " FROM deliveries JOIN messages USING (number) WHERE closed IS NULL OR refusal IS NOT NULL GROUP BY outlet",
            (time.time(),),
        )
        none = [(outlet, 0, 0.0, 0, None) for outlet in self._outlets]
        names = ("pending", "oldest_s", "refused", "refusal")
        return {outlet: dict(zip(names, values, strict=True)) for outlet, *values in [*none, *rows]}

    def set_alarm(self, alarm: Alarm) -> bool:
        """Begin or end an alarm and add its message, in one step; False if it is not a change."""
        with self._writing() as connection:
            row = connection.execute("SELECT body FROM alarms WHERE id = ?", (alarm.id,)).fetchone()
            if (row is not None) == alarm.is_active:
                return False
            if alarm.is_active:
                connection.execute("INSERT INTO alarms VALUES (?, ?)", (alarm.id, msgspec.json.encode(alarm)))
            else:
                connection.execute("DELETE FROM alarms WHERE id = ?", (alarm.id,))
                begun = msgspec.json.decode(row[0], type=Alarm)
                alarm = replace(begun, key=f"{begun.key}-ended", until=alarm.since, is_active=False)
            return self._insert(alarm.key, alarm, self._outlets)

    def alarms(self) -> list[Alarm]:
        """The alarms that are active."""
        return [msgspec.json.decode(body, type=Alarm) for (body,) in self._rows("SELECT body FROM alarms", ())]

    def take_trigger(self, trigger: Trigger) -> bool:
        """Note that a trigger is carried out; False if one with its id was."""
        with self._writing():
            return self._insert(f"trigger/{trigger.id}", trigger, ())

    def _insert(self, key: str, message: Result | Alarm | Trigger, outlets: Sequence[str]) -> bool:
        now, run = time.time(), self._connection.execute
        if now - self._pruned_s > PRUNE_INTERVAL_S:
            self._pruned_s, kept = now, "SELECT number FROM deliveries WHERE closed IS NULL"
            run(f"DELETE FROM messages WHERE added < ? AND number NOT IN ({kept})", (now - KEEP_S,))
        row = (key, f"{message.__struct_config__.tag}s", msgspec.json.encode(message), now)
        added = run("INSERT OR IGNORE INTO messages (key, topic, body, added) VALUES (?, ?, ?, ?)", row)
        for outlet in outlets if added.rowcount else ():
            run("INSERT INTO deliveries (number, outlet) VALUES (?, ?)", (added.lastrowid, outlet))
        return bool(added.rowcount)

    def _rows(self, query: str, values: Sequence[object]) -> list[Any]:
        with self._lock, self._told():
            return self._connection.execute(query, values).fetchall()

    @contextmanager
    def _writing(self) -> Iterator[sqlite3.Connection]:
        """A transaction; what it wrote is on the disk when it ends, or nothing is."""
        with self._lock, self._told():
            self._connection.execute("BEGIN IMMEDIATE")
            with self._connection:  # commits, or rolls back after an error
                yield self._connection

    @contextmanager
    def _told(self) -> Iterator[None]:
        """Errors of the disk and of SQLite as one line."""
        try:
            yield
        except (sqlite3.Error, OSError) as error:
            raise OutputError(f"{self._path}: the outbox cannot be used ({error})") from error
