"""The results store: inspections are added and read, never changed; several stations can write at the same time.

SQLite uses a write-ahead log, and its writers wait for each other; PostgreSQL does so by itself. Results are identified
by a hash of their content, so that adding one twice, or again after an interruption, stores it once.
"""

from __future__ import annotations

import itertools
import json
import random
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TypeVar

import sqlalchemy as sa
from sqlalchemy.exc import DBAPIError, IntegrityError, NoSuchModuleError, SQLAlchemyError

from arview.core.extras import install_command
from arview.errors import InputError, MissingDependencyError, OutputError
from arview.inspection import Inspection, content_hash, from_document, load_inspection, overall_verdict
from arview.quality import decisions as quality
from arview.quality.history.connection import (
    BUSY_S,
    begin_sqlite,
    check_file,
    default_author,
    default_station,
    is_temporary,
    prepare_sqlite,
    store_url,
)
from arview.quality.history.decided import decided_faults, decision_of_row, new_rows, stored_state
from arview.quality.history.tables import (
    STORE_VERSION,
    about,
    add_missing,
    characteristic_row,
    characteristics,
    component_row,
    components,
    decisions,
    guards,
    results,
    same,
    stored_version,
    voids,
)

_TRIES = 6
"""Attempts after errors that may be temporary, unless another program holds a file."""
WAIT_S = 40.0
"""Time after which it is not waited any longer for a program that holds a file."""
_LOCK = 0x61727669
"""Number of the advisory lock of PostgreSQL that is held while tables are created."""
Found = TypeVar("Found")


@dataclass(frozen=True)
class AddedResult:
    """An added inspection.

    Attributes:
        id: its number.
        content_hash: its hash.
        is_new: whether the store did not have it.
        decisions: number of decisions beside it that were new.
        decision_faults: why decisions were left out: their log was changed, or is not the one stored before.
    """

    id: int
    content_hash: str
    is_new: bool
    decisions: int = 0
    decision_faults: tuple[str, ...] = ()


@dataclass(frozen=True)
class Void:
    """Why a result no longer counts, by whom it was voided (user and machine), and when (UTC)."""

    reason: str
    by: str
    added: datetime


@dataclass(frozen=True)
class StoredResult:
    """A stored result without its document; times are UTC. ``void`` says why it no longer counts, if so."""

    id: int
    content_hash: str
    part: str
    serial: str
    station: str
    model_hash: str
    measured: datetime
    added: datetime
    verdict: str
    tool: str
    void: Void | None = None


class HistoryStore:
    """A results store, which is created if it does not exist.

    Args:
        where: a file (SQLite), or the URL of a PostgreSQL database: ``postgresql://user@host/database``.
        must_exist: do not create a new file.
        tell: called with a sentence when a new store is made or an older one upgraded, and when another program holds
            it for seconds.

    Raises:
        InputError: the file, its folder or the database does not exist, is no store, or is that of a newer arview.
        OutputError: the file cannot be created.
        MissingDependencyError: the driver of the database is not installed.
    """

    def __init__(
        self, where: str | Path, must_exist: bool = False, tell: Callable[[str], object] = lambda text: None
    ) -> None:
        self._tell = tell
        url = store_url(str(where))
        self.name = url.render_as_string(hide_password=True) if url.host else str(url.database)
        self.is_sqlite = url.get_backend_name() == "sqlite"
        if self.is_sqlite:
            check_file(Path(str(url.database)), must_exist, tell)
        try:
            self._engine = sa.create_engine(url, **({"connect_args": {"timeout": BUSY_S}} if self.is_sqlite else {}))
        except (ImportError, NoSuchModuleError) as error:
            raise MissingDependencyError(
                f"{self.name}: the driver cannot be loaded ({error}); run: {install_command('postgres')}"
            ) from error
        if self.is_sqlite:
            sa.event.listen(self._engine, "connect", prepare_sqlite)
            sa.event.listen(self._engine, "begin", begin_sqlite)
        self._make_tables()

    def close(self) -> None:
        """Close all connections."""
        self._engine.dispose()

    def __enter__(self) -> HistoryStore:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def add(self, inspection: str | Path, station: str | None = None) -> AddedResult:
        """Add the inspection in a file unless the store contains it, and the decisions beside it that are new.

        Args:
            inspection: ``inspection.json``, which is checked first.
            station: station that measured; default: `default_station`.

        Raises:
            InputError: the file is not an inspection.
            OutputError: the store cannot be written to.
        """
        path = Path(inspection)
        loaded = load_inspection(path)
        document = json.loads(path.read_text(encoding="utf-8-sig"))
        row = {
            "content_hash": content_hash(document),
            "part": loaded.part,
            "serial": loaded.serial,
            "station": station or default_station(),
            "model_hash": loaded.model_hash,
            "measured": stamp(loaded.created),
            "added": stamp(datetime.now(UTC)),
            "verdict": overall_verdict(loaded).value,
            "tool": f"{loaded.provenance.tool} {loaded.provenance.version}",
            "document": json.dumps(document, ensure_ascii=False, allow_nan=False),
        }
        added = self._retried(lambda: self._insert(row, loaded))
        content = quality.log_of(path).content()
        if not content.entries and not content.faults:
            return added
        count, faults = (0, content.faults) if content.faults else self._add_decisions(added.id, content.entries)
        return replace(added, decisions=count, decision_faults=tuple(faults))

    def _add_decisions(self, result_id: int, entries: Sequence[quality.Decision]) -> tuple[int, Sequence[str]]:
        """Add the entries of a log that the store does not have; their number, and what contradicts those stored."""

        def insert() -> tuple[int, Sequence[str]]:
            with self._begin(writes=True) as connection:
                known = {
                    int(row.number): str(row.sha256)
                    for row in connection.execute(sa.select(decisions).where(decisions.c.result_id == result_id))
                }
                rows, faults = new_rows(result_id, entries, known)
                if rows and not faults:
                    connection.execute(sa.insert(decisions), rows)
                return (0 if faults else len(rows)), faults

        return self._retried(insert)

    def decisions(self, result_id: int) -> tuple[quality.Decision, ...]:
        """The decisions, ticks and signatures about a result, in their order."""
        return self.decided([result_id]).get(result_id, ())

    def decided(self, ids: Sequence[int]) -> dict[int, tuple[quality.Decision, ...]]:
        """The decisions, ticks and signatures about results, by their numbers."""
        found: dict[int, list[quality.Decision]] = {}
        query = sa.select(decisions).where(decisions.c.result_id.between(min(ids, default=0), max(ids, default=-1)))
        for row in self.rows(query.order_by(decisions.c.result_id, decisions.c.number)):
            found.setdefault(int(row.result_id), []).append(decision_of_row(row))
        return {number: tuple(found[number]) for number in ids if number in found}

    def _insert(self, row: dict[str, Any], inspection: Inspection) -> AddedResult:
        known = sa.select(results.c.id).where(results.c.content_hash == row["content_hash"])
        with self._begin(writes=True) as connection:
            existing = connection.scalar(known)
            if existing is None:
                try:
                    with connection.begin_nested():
                        number = connection.execute(sa.insert(results).values(row).returning(results.c.id)).scalar()
                except IntegrityError:  # another station added it in the meantime (PostgreSQL)
                    number = None
                if number is not None:
                    rows = [component_row(number, component) for component in inspection.components]
                    if rows:
                        connection.execute(sa.insert(components), rows)
                    _insert_characteristics(connection, number, inspection)
                    return AddedResult(int(number), row["content_hash"], True)
                existing = connection.scalar(known)
            return AddedResult(int(existing or 0), row["content_hash"], False)

    def listed(
        self, part: str | None = None, serial: str | None = None, station: str | None = None,
        verdict: str | None = None, since: datetime | None = None, model_hash: str | None = None,
        limit: int | None = None, with_voided: bool = False,
    ) -> list[StoredResult]:  # fmt: skip
        """Results in the order of their measurement; with a ``limit``, the newest ones.

        Voided results are left out unless ``with_voided``.
        """
        wanted = {"part": part, "serial": serial, "station": station, "verdict": verdict, "model_hash": model_hash}
        query = sa.select(*(c for c in results.c if c.name != "document"))
        for name, value in wanted.items():
            if value is not None:
                query = query.where(results.c[name] == value)
        if since is not None:
            query = query.where(results.c.measured >= stamp(since))
        query = query.order_by(results.c.measured.desc(), results.c.id.desc())
        with self._begin() as connection:
            voided = _voided(connection)
            if voided and not with_voided:
                query = query.where(results.c.id.not_in(sa.select(voids.c.result_id)))
            if limit is not None:
                query = query.limit(limit)
            return [_listed(row, voided) for row in reversed(connection.execute(query).all())]

    def rows(self, query: sa.Select[Any]) -> Sequence[Any]:
        """The rows of a query of the tables of the store."""
        with self._begin() as connection:
            return connection.execute(query).all()

    def void(self, key: str, reason: str, by: str | None = None) -> StoredResult:
        """Void a result: it stays in the store with the reason, but lists, statistics and exports leave it out.

        Args:
            key: number of the result, or the first digits of its hash.
            reason: why it does not count.
            by: who voids it; default: `default_author`.

        Raises:
            InputError: there is no such result, it is void already, or the reason is empty.
            OutputError: the store cannot be written to.
        """
        found, _ = self.find(key)
        is_new = self._state(voids, {"result_id": found.id}, reason, by)
        found, _ = self.find(str(found.id))
        if not is_new and found.void is not None:
            raise InputError(f"{self.name}: result {found.id} is void already: {found.void.reason} ({found.void.by})")
        return found

    def same(self, old: str, new: str, reason: str, by: str | None = None) -> tuple[str, str]:
        """State that two CAD models are revisions of the same part, so that their series are joined.

        Args:
            old, new: first digits of the hashes of the models, which are returned in full.
            reason, by: why their values can be compared, and who states it, as for `void`.

        Raises:
            InputError: not one model of the store has such a hash, both are the same, they are joined already, or the
                reason is empty.
            OutputError: the store cannot be written to.
        """
        known = [str(row.model_hash) for row in self.rows(sa.select(results.c.model_hash).distinct())]
        pair = []
        for key in (old, new):
            found = [one for one in known if one.startswith(key.lower())]
            if len(found) != 1:
                raise InputError(
                    f"{self.name}: {len(found)} CAD models have a hash that begins with {key!r}; expected one"
                )
            pair += found
        if pair[0] == pair[1]:
            raise InputError(f"{self.name}: both are the CAD model {pair[0][:12]}")
        if not self._state(same, {"old_hash": pair[0], "new_hash": pair[1]}, reason, by):
            raise InputError(f"{self.name}: {pair[0][:12]} and {pair[1][:12]} are joined already")
        return pair[0], pair[1]

    def _state(self, table: sa.Table, key: dict[str, Any], reason: str, by: str | None) -> bool:
        """Add a statement with its reason, unless there is one with the key; whether it was added."""
        reason = " ".join(reason.split())
        if not reason:
            raise InputError(f"{self.name}: the reason is empty")
        row = {**key, "reason": reason, "by": by or default_author(), "added": stamp(datetime.now(UTC))}

        def insert() -> bool:
            with self._begin(writes=True) as connection:
                conditions = [table.c[name] == value for name, value in key.items()]
                if connection.scalar(sa.select(sa.func.count()).select_from(table).where(*conditions)):
                    return False
                connection.execute(sa.insert(table).values(row))
                return True

        return self._retried(insert)

    def find(self, key: str) -> tuple[StoredResult, str]:
        """A result and its document, found by its number or the first digits of its hash (at least six).

        Raises:
            InputError: there is no such result, or more than one.
        """
        is_hash = len(key) >= 6 and set(key.lower()) <= set("0123456789abcdef")
        if not is_hash and not key.isdigit():
            raise InputError(f"{key!r}: expected the number of a result or the first digits of its hash (at least six)")
        rows: Sequence[Any] = ()
        with self._begin() as connection:
            voided = _voided(connection)
            if key.isdigit() and len(key) <= 18:
                rows = connection.execute(sa.select(results).where(results.c.id == int(key))).all()
            if not rows and is_hash:
                begins = results.c.content_hash.startswith(key.lower(), autoescape=True)
                rows = connection.execute(sa.select(results).where(begins).limit(2)).all()
        if not rows:
            raise InputError(f"{self.name}: no result {key}")
        if len(rows) > 1:
            raise InputError(f"{self.name}: more than one result begins with {key}; give more digits")
        return _listed(rows[0], voided), str(rows[0].document)

    def state(self, result: StoredResult, entries: Sequence[quality.Decision]) -> quality.RecordState:
        """What decisions about a result say of it together; see `decided`."""

        def find(sha256: str) -> str | None:
            with self._begin() as connection:
                query = sa.select(results.c.document).where(results.c.content_hash == sha256)
                found = connection.scalar(query)
                return None if found is None else str(found)

        return stored_state(find(result.content_hash) or "", result.content_hash, entries, find)

    def components(self, ids: Sequence[int]) -> Iterator[dict[str, Any]]:
        """Rows of the components of results, in the order of ``ids``, with names in alphabetical order."""
        query = sa.select(components).where(components.c.result_id.between(min(ids, default=0), max(ids, default=-1)))
        by_result: dict[int, list[dict[str, Any]]] = {}
        for row in self.rows(query.order_by(components.c.result_id, components.c.name)):
            by_result.setdefault(row.result_id, []).append(dict(row._mapping))
        for number in ids:
            yield from by_result.get(number, ())

    def check(self) -> tuple[int, list[str]]:
        """The number of results, and descriptions of those that were altered after they were added."""
        faults = []
        count = 0
        query = sa.select(results.c.id, results.c.content_hash, results.c.document).order_by(results.c.id)
        every = sa.union_all(sa.select(components.c.result_id), sa.select(characteristics.c.result_id)).subquery()
        counted = sa.select(every.c.result_id, sa.func.count()).group_by(every.c.result_id)
        with self._begin() as connection:
            of_result = {int(number): int(rows) for number, rows in connection.execute(counted)}
            for row in connection.execute(query.execution_options(yield_per=200)):
                count += 1
                document = json.loads(row.document)
                if content_hash(document) != row.content_hash:
                    faults.append(f"result {row.id}: its document does not have the hash {row.content_hash[:12]}…")
                    continue
                names = {one["name"] for one in document.get("characteristics", ())}
                if len(document["components"]) + len(names) != of_result.get(row.id, 0):
                    faults.append(f"result {row.id}: its number of components or characteristics has changed")
        for number, entries in self.decided(list(of_result)).items():
            faults += [f"result {number}: {fault}" for fault in decided_faults(entries)]
        return count, faults

    # ---- connections

    @contextmanager
    def _begin(self, writes: bool = False, retries: bool = False) -> Iterator[sa.Connection]:
        """A transaction; errors of the database become errors of arview, in one line and without passwords."""
        try:
            options = {"arview_writes": writes, "arview_retries": retries}
            with self._engine.connect().execution_options(**options) as connection, connection.begin():
                yield connection
        except (InputError, OutputError):
            raise
        except SQLAlchemyError as error:
            raise _Failure(self._message(error), is_temporary(error)) from error

    def _retried(self, work: Callable[[], Found]) -> Found:
        """Do the work, and repeat it after temporary errors; adding a result repeatedly stores it once.

        Raises:
            OutputError: the error stays, or another program holds the file of the store for `WAIT_S`.
        """
        began, is_told = time.monotonic(), False
        for attempt in itertools.count():
            try:
                return work()
            except _Failure as failure:
                waited_s = time.monotonic() - began
                if not failure.is_temporary or (attempt >= _TRIES - 1 and not self.is_sqlite):
                    raise
                if waited_s > WAIT_S:
                    raise OutputError(
                        f"{self.name}: another program has held the store for {waited_s:.0f} s, and nothing was"
                        " written: end it (a database browser, a backup, another arview), and repeat the command"
                    ) from failure
                if waited_s > 0.5 * BUSY_S and not is_told:
                    is_told = True
                    self._tell(f"{self.name}: another program holds the store; waiting for it, {WAIT_S:.0f} s at most")
                time.sleep(0.05 * 2 ** min(attempt, 5) * random.uniform(0.5, 1.5))
        raise AssertionError("unreachable")

    def _make_tables(self) -> None:
        """Create the tables of a new store, and in an older one those that it lacks."""

        def read_version() -> int:
            with self._begin(retries=True) as connection:
                return stored_version(connection)

        def make() -> None:
            with self._begin(writes=True) as connection:
                if not self.is_sqlite:
                    connection.execute(sa.text("SELECT pg_advisory_xact_lock(:lock)"), {"lock": _LOCK})
                version = stored_version(connection)
                if version == STORE_VERSION:  # another program made them in the meantime
                    return
                add_missing(connection)
                for statement in guards("sqlite" if self.is_sqlite else "postgresql"):
                    connection.exec_driver_sql(statement)
                having = results.c.document.contains('"characteristics"')
                stored = sa.select(results.c.id, results.c.document).where(having)
                for row in connection.execute(stored).all() if version else ():
                    _insert_characteristics(connection, row.id, from_document(json.loads(row.document)))
                connection.execute(sa.insert(about).values(version=STORE_VERSION))

        version = self._retried(read_version)
        if version > STORE_VERSION:
            raise InputError(f"{self.name}: the store was written by a newer arview (version {version}); update arview")
        if version < STORE_VERSION:
            if version:
                self._tell(f"{self.name}: the store of an older arview is upgraded; its results stay as they are")
            self._retried(make)

    def _message(self, error: SQLAlchemyError) -> str:
        cause = error.orig if isinstance(error, DBAPIError) and error.orig is not None else error
        text = " ".join(str(cause).split())
        if "not a database" in text:
            return f"{self.name}: is not a results store"
        return f"{self.name}: {text[:240]}"


class _Failure(OutputError):
    """An error of the database; ``is_temporary`` if another attempt may succeed."""

    def __init__(self, message: str, is_temporary: bool) -> None:
        super().__init__(message)
        self.is_temporary = is_temporary


def stamp(moment: datetime) -> str:
    """A time as the store holds it: UTC, so that texts sort as their times do."""
    return moment.astimezone(UTC).strftime("%Y-%m-%dT%H:%M:%S.%fZ")


def _insert_characteristics(connection: sa.Connection, number: int, inspection: Inspection) -> None:
    rows = {one.name: characteristic_row(number, one) for one in inspection.characteristics}
    if rows:
        connection.execute(sa.insert(characteristics), list(rows.values()))


def _voided(connection: sa.Connection) -> dict[int, Void]:
    """The voids by the number of their result."""
    rows = connection.execute(sa.select(voids))
    return {int(row.result_id): Void(row.reason, row.by, datetime.fromisoformat(row.added)) for row in rows}


def _listed(row: Any, voided: dict[int, Void]) -> StoredResult:
    return StoredResult(
        int(row.id), row.content_hash, row.part, serial=row.serial, station=row.station, model_hash=row.model_hash,
        measured=datetime.fromisoformat(row.measured), added=datetime.fromisoformat(row.added), verdict=row.verdict,
        tool=row.tool, void=voided.get(int(row.id)),
    )  # fmt: skip
