"""Tables of the results store and the triggers that keep it append-only, for SQLite and PostgreSQL.

A newer version only ever adds tables, columns that may be null, and indices: stored rows never change. What an older
store lacks therefore follows from these tables, and `add_missing` adds it; scripts of a migration tool (Alembic) would
say it a second time.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from sqlalchemy import (
    BigInteger,
    Column,
    Connection,
    Float,
    ForeignKey,
    Index,
    Integer,
    MetaData,
    String,
    Table,
    Text,
    func,
    inspect,
    select,
)

from arview.inspection import MEASURANDS, CharacteristicResult

STORE_VERSION = 4
metadata = MetaData()
_Number = BigInteger().with_variant(Integer, "sqlite")  # SQLite increments only INTEGER keys automatically

results = Table(
    "arview_results",
    metadata,
    Column("id", _Number, primary_key=True, autoincrement=True),
    Column(
        "content_hash", String(64), nullable=False, unique=True
    ),  # SHA-256, the fingerprint, see arview.inspection.fingerprint
    Column("part", Text, nullable=False),
    Column("serial", Text, nullable=False),
    Column("station", Text, nullable=False),
    Column("model_hash", String(64), nullable=False),
    Column("measured", String(27), nullable=False),  # UTC, 2026-03-01T12:00:00.000000Z, which sorts as text
    Column("added", String(27), nullable=False),
    Column("verdict", String(16), nullable=False),
    Column("tool", Text, nullable=False),
    Column("document", Text, nullable=False),  # inspection.json
    Index("arview_results_by_part", "part", "measured"),
    Index("arview_results_by_serial", "serial"),
    # Holds all that a series takes from this table, whose rows are long by their documents.
    Index("arview_results_of_series", *("part", "measured", "id", "serial", "station", "model_hash", "verdict")),
)

components = Table(
    "arview_components",
    metadata,
    Column("result_id", _Number, ForeignKey("arview_results.id"), primary_key=True),
    Column("name", Text, primary_key=True),
    Column("dx_mm", Float(53)),
    Column("dy_mm", Float(53)),
    Column("dz_mm", Float(53)),
    Column("distance_mm", Float(53)),
    Column("uncertainty_mm", Float(53)),
    Column("tolerance_mm", Float(53)),
    Column("tilt_deg", Float(53)),
    Column("twist_deg", Float(53)),
    Column("verdict", String(16), nullable=False),
    Column("finding", String(16)),
    Column("point", Text),  # that the displacement is stated for, in words; null: see the document
    Column("axis", Text),  # that the angles are about, likewise
    # Holds all that a series takes, so that the rows of one component lie together.
    Index(
        "arview_components_of_series",
        *(
            "name",
            "result_id",
            "distance_mm",
            "dx_mm",
            "dy_mm",
            "dz_mm",
            "tolerance_mm",
            "uncertainty_mm",
            "tilt_deg",
            "twist_deg",
            "finding",
            "point",
            "axis",
        ),
    ),
)
characteristics = Table(
    "arview_characteristics",
    metadata,
    Column("result_id", _Number, ForeignKey("arview_results.id"), primary_key=True),
    Column("name", Text, primary_key=True),
    Column("kind", String(32), nullable=False),
    Column("value_mm", Float(53)),
    Column("uncertainty_mm", Float(53)),
    Column("lower_mm", Float(53)),
    Column("upper_mm", Float(53)),  # without the bonus
    Column("bonus_mm", Float(53), nullable=False),
    Column("verdict", String(16), nullable=False),
    Index(
        "arview_characteristics_of_series",
        *("name", "result_id", "kind", "value_mm", "uncertainty_mm", "lower_mm", "upper_mm", "bonus_mm"),
    ),
)
for _table in (components, characteristics):
    _fails = _table.c.verdict == "fail"
    Index(f"{_table.name}_failed", _table.c.name, _table.c.result_id, sqlite_where=_fails, postgresql_where=_fails)

same = Table(
    "arview_same",
    metadata,
    Column("old_hash", String(64), primary_key=True),
    Column("new_hash", String(64), primary_key=True),
    Column("reason", Text, nullable=False),
    Column("by", Text, nullable=False),  # user and machine
    Column("added", String(27), nullable=False),
)

voids = Table(
    "arview_voids",
    metadata,
    Column("result_id", _Number, ForeignKey("arview_results.id"), primary_key=True),
    Column("reason", Text, nullable=False),
    Column("by", Text, nullable=False),  # user and machine
    Column("added", String(27), nullable=False),
)

decisions = Table(
    "arview_decisions",
    metadata,
    Column("result_id", _Number, ForeignKey("arview_results.id"), primary_key=True),
    Column("number", Integer, primary_key=True),  # of the entry in its log
    Column("kind", String(16), nullable=False),  # decision, tick, signature
    Column("time", String(24), nullable=False),  # UTC, 2026-03-01T12:00:00.000Z
    Column("by", Text, nullable=False),
    Column("component", Text, nullable=False),
    Column("is_ok", Integer),
    Column("reason", Text, nullable=False),
    Column("note", Text, nullable=False),
    Column("photo", Text),
    Column("step", Integer),
    Column("is_done", Integer),
    Column("inspection_sha256", String(64), nullable=False),
    Column("rechecks", Text, nullable=False),  # fingerprints, with spaces between them
    Column("previous", String(64), nullable=False),  # hash of the line before it
    Column("sha256", String(64), nullable=False),  # hash of its line, see arview.quality.decisions.log
)

about = Table("arview_store", metadata, Column("version", Integer, primary_key=True))

_MESSAGE = "the results store is append-only"


def guards(dialect: str) -> list[str]:
    """Statements that make changes of existing rows fail; they can be executed repeatedly."""
    names = tuple(metadata.tables)
    return _sqlite_guards(names) if dialect == "sqlite" else _postgresql_guards(names)


def stored_version(connection: Connection) -> int:
    """The version of a store; 0 if it has no tables."""
    if not inspect(connection).has_table(about.name):
        return 0
    return int(connection.scalar(select(func.max(about.c.version))) or 0)


def add_missing(connection: Connection) -> None:
    """Add the tables, columns and indices that a store of an older version lacks."""
    metadata.create_all(connection)
    for table in metadata.sorted_tables:
        present = {column["name"] for column in inspect(connection).get_columns(table.name)}
        for column in table.c:
            if column.name not in present:
                kind = column.type.compile(connection.dialect)
                connection.exec_driver_sql(f"ALTER TABLE {table.name} ADD COLUMN {column.name} {kind}")
        for index in table.indexes:
            index.create(connection, checkfirst=True)


def _sqlite_guards(names: tuple[str, ...]) -> list[str]:
    statements = [
        f"CREATE TRIGGER IF NOT EXISTS {name}_no_{verb.lower()} BEFORE {verb} ON {name} "
        f"BEGIN SELECT RAISE(ABORT, '{_MESSAGE}'); END"
        for name in names
        for verb in ("UPDATE", "DELETE")
    ]
    # INSERT OR REPLACE deletes without firing delete triggers, so existing rows are not inserted again.
    for name, table in metadata.tables.items():
        keys = [list(table.primary_key), *([column] for column in table.c if column.unique)]
        existing = " OR ".join(" AND ".join(f"{c.name} = NEW.{c.name}" for c in key) for key in keys)
        statements.append(
            f"CREATE TRIGGER IF NOT EXISTS {name}_no_replace BEFORE INSERT ON {name} "
            f"WHEN EXISTS (SELECT 1 FROM {name} WHERE {existing}) BEGIN SELECT RAISE(IGNORE); END"
        )
    return statements


def _postgresql_guards(tables: tuple[str, ...]) -> list[str]:
    refuse = (
        "CREATE OR REPLACE FUNCTION arview_append_only() RETURNS trigger LANGUAGE plpgsql AS "
        f"$$ BEGIN RAISE EXCEPTION '{_MESSAGE}'; END $$"
    )
    return [refuse] + [
        f"CREATE OR REPLACE TRIGGER {table}_no_{verb.lower()} BEFORE {verb} ON {table} "
        f"FOR EACH {'STATEMENT' if verb == 'TRUNCATE' else 'ROW'} EXECUTE FUNCTION arview_append_only()"
        for table in tables
        for verb in ("UPDATE", "DELETE", "TRUNCATE")
    ]


def component_row(result_id: int, one: Any) -> dict[str, Any]:
    """The row of a component of a result."""
    dx, dy, dz = one.displacement_mm
    details = {} if one.details is None else vars(one.details)
    return {
        "result_id": result_id, "name": one.name, "dx_mm": dx, "dy_mm": dy, "dz_mm": dz,
        "distance_mm": one.distance_mm, "uncertainty_mm": one.uncertainty_mm, "tolerance_mm": one.tolerance_mm,
        "tilt_deg": one.tilt_deg, "twist_deg": one.twist_deg, "verdict": one.verdict.value,
        "finding": None if one.finding is None else one.finding.value,
        "point": stated_point(details), "axis": stated_axis(details),
    }  # fmt: skip


def characteristic_row(result_id: int, one: CharacteristicResult) -> dict[str, Any]:
    """The row of a characteristic of a result."""
    lower, upper = one.limits_mm if one.zone_mm is None else (None, round(one.zone_mm - one.bonus_mm, 9))
    return {
        "result_id": result_id, "name": one.name, "kind": one.kind, "value_mm": one.value_mm,
        "uncertainty_mm": one.uncertainty_mm, "lower_mm": lower, "upper_mm": upper, "bonus_mm": one.bonus_mm,
        "verdict": one.verdict.value,
    }  # fmt: skip


def stated_point(details: Mapping[str, Any]) -> str:
    """The point that a displacement is stated for, in words, by the details of a component."""
    kind = details.get("measurand") or "box_center"
    if kind == "given":
        return f"{MEASURANDS[kind]} ({', '.join(f'{x + 0.0:.3f}' for x in details['center_mm'])})"
    return MEASURANDS[kind]


def stated_axis(details: Mapping[str, Any]) -> str:
    """The axis that angles are about, in words, by the details of a component."""
    axes = details.get("axes")
    return "axis of an older version" if axes is None else f"({', '.join(f'{x + 0.0:.2f}' for x in axes[2])})"
