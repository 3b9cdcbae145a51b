"""Tables of a part file on how components are put right: ``[rework.KIND]`` and ``[components.NAME.rework]``."""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath

from arview.cad.part import ReworkAxis, ReworkKind, ReworkSettings
from arview.cad.toml_table import TomlTable

KINDS = ("adjust", "unbolt", "reweld", "reglue", "shim", "bend", "replace")
"""Kinds of rework that have steps of their own; a part file may add others, with their steps."""
PICTURES = (".jpg", ".jpeg", ".png", ".webp")
PLACEHOLDERS = ("move", "component")
_BRACES = re.compile(r"\{([^{}]*)\}")


def read_rework_kinds(tables: TomlTable) -> dict[str, ReworkKind]:
    """The kinds of rework by name: the usual ones, with what ``[rework.KIND]`` says of them, and those it adds.

    Raises:
        InputError: an unknown key, a wrong type or value, or a kind of the part file's own without steps.
    """
    kinds = {name: ReworkKind(name) for name in KINDS}
    for name in tables.content:
        table = tables.table(name)
        kind = _read_kind(table, kinds.get(name, ReworkKind(name)))
        table.finish()
        if name not in KINDS and not kind.steps:
            close = difflib.get_close_matches(name, KINDS, n=1)
            hint = f"did you mean {close[0]!r}? " if close else ""
            tables.fail(name, table.content, f"steps of this kind; {hint}those that have steps: {', '.join(KINDS)}")
        kinds[name] = kind
    return kinds


def read_rework(
    table: TomlTable, kinds: Mapping[str, ReworkKind], targets: Sequence[str], default: ReworkSettings
) -> ReworkSettings:
    """How a component is reworked, by its table.

    Args:
        table: ``[components.NAME.rework]``, empty where the component has none.
        kinds: by name.
        targets: names of components and datum features.
        default: of [defaults], and of tables with wildcards.

    Raises:
        InputError: an unknown key or kind, a wrong type or value, a picture that is not there, or an unknown target.
    """
    settings = default
    if table.known("how"):
        name = table.choice("how", tuple(kinds), required=True)
        kind = kinds[str(name)]
        if name != default.name:
            settings = ReworkSettings(kind.name, kind.text, kind.steps, kind.pictures, default.axes)
    settings = replace(settings, **vars(_read_kind(table, settings)))
    axes = table.tables("axes")
    if axes:
        settings = replace(settings, axes=tuple(_read_axis(one, targets) for one in axes))
    table.finish()
    return settings


def _read_kind(table: TomlTable, default: ReworkKind) -> ReworkKind:
    steps = table.texts("steps", default.steps)
    for step in steps:
        unknown = [name for name in _BRACES.findall(step) if name not in PLACEHOLDERS]
        if unknown:
            table.fail("steps", step, "no braces but " + " and ".join(f"{{{name}}}" for name in PLACEHOLDERS))
    pictures = table.texts("pictures", default.pictures)
    if table.known("pictures"):
        for picture in pictures:
            _check_picture(table, picture)
    return ReworkKind(default.name, table.text("text", default.text), steps, pictures)


def _check_picture(table: TomlTable, picture: str) -> None:
    """Check that a picture is a file below the folder of the part file."""
    path = PurePosixPath(picture)
    if path.is_absolute() or ".." in path.parts or "\\" in picture:
        table.fail("pictures", picture, "a path below the folder of the part file")
    if path.suffix.lower() not in PICTURES:
        table.fail("pictures", picture, f"a picture: {', '.join(PICTURES)}")
    file = table.path.parent / Path(picture)
    if not file.is_file():
        table.fail("pictures", picture, f"a picture; there is no file {file}")


def _read_axis(table: TomlTable, targets: Sequence[str]) -> ReworkAxis:
    given = [key for key in ("toward", "away_from", "direction") if table.known(key)]
    name = table.text("name", "")
    if len(given) != 1:
        table.fail("axes", table.content, "one of toward, away_from and direction in each of them")
    if given == ["direction"]:
        direction = table.direction("direction")
        if not name.strip():
            table.fail("name", name, 'the text for the fitter, such as "towards the inlet"')
        table.finish()
        return ReworkAxis(direction_in_model=direction, name=name)
    target = table.text(given[0])
    if target not in targets:
        close = difflib.get_close_matches(target, targets, n=1)
        hint = f"did you mean {close[0]!r}? " if close else ""
        table.fail(given[0], target, f"a component or a datum feature; {hint}There are: {', '.join(targets)}")
    table.finish()
    return ReworkAxis("towards" if given == ["toward"] else "away from", target, name=name)
