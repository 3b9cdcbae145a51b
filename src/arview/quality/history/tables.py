"""Tables of the results store and the triggers that keep it append-only, for SQLite and PostgreSQL."""

from __future__ import annotations

from typing import Any

from sqlalchemy import BigInteger, Column, Float, ForeignKey, Index, Integer, MetaData, String, Table, Text

STORE_VERSION = 3
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
    Index("arview_components_by_name", "name"),
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
    tables = (results.name, components.name, voids.name, decisions.name, about.name)
    return _sqlite_guards(tables) if dialect == "sqlite" else _postgresql_guards(tables)


def _sqlite_guards(tables: tuple[str, ...]) -> list[str]:
    statements = [
        f"CREATE TRIGGER IF NOT EXISTS {table}_no_{verb.lower()} BEFORE {verb} ON {table} "
        f"BEGIN SELECT RAISE(ABORT, '{_MESSAGE}'); END"
        for table in tables
        for verb in ("UPDATE", "DELETE")
    ]
    # INSERT OR REPLACE deletes without firing delete triggers, so existing rows are not inserted again.
    same = {
        results.name: "content_hash = NEW.content_hash OR id = NEW.id",
        components.name: "result_id = NEW.result_id AND name = NEW.name",
        voids.name: "result_id = NEW.result_id",
        decisions.name: "result_id = NEW.result_id AND number = NEW.number",
        about.name: "version = NEW.version",
    }
    return statements + [
        f"CREATE TRIGGER IF NOT EXISTS {table}_no_replace BEFORE INSERT ON {table} "
        f"WHEN EXISTS (SELECT 1 FROM {table} WHERE {condition}) BEGIN SELECT RAISE(IGNORE); END"
        for table, condition in same.items()
    ]


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
    return {
        "result_id": result_id, "name": one.name, "dx_mm": dx, "dy_mm": dy, "dz_mm": dz,
        "distance_mm": one.distance_mm, "uncertainty_mm": one.uncertainty_mm, "tolerance_mm": one.tolerance_mm,
        "tilt_deg": one.tilt_deg, "twist_deg": one.twist_deg, "verdict": one.verdict.value,
        "finding": None if one.finding is None else one.finding.value,
    }  # fmt: skip
