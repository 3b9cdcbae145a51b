"""Plug-ins: what other installed packages add to arview through entry points (docs/reference/plug-ins.md)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from arview.errors import InputError

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint


def find_plug_ins(group: str) -> dict[str, EntryPoint]:
    """Entry points of a group by name, in alphabetical order; nothing is imported.

    Where two packages use one name, the package that comes first in the alphabet has it.
    """
    from importlib.metadata import entry_points

    found: dict[str, EntryPoint] = {}
    for entry in sorted(entry_points(group=group), key=lambda entry: (entry.name, package_of(entry))):
        found.setdefault(entry.name, entry)
    return found


def load_plug_in(entry: EntryPoint, expected: type | None = None) -> Any:
    """Import the object that an entry point names.

    Args:
        entry: from `find_plug_ins`.
        expected: type that the object must have; None: any.

    Raises:
        InputError: it cannot be imported, for whatever reason, or is of another type.
    """
    what = f"{entry.name} of the package {package_of(entry)}"
    try:
        loaded = entry.load()
    except (Exception, SystemExit) as error:
        reason = " ".join(str(error).split())
        raise InputError(
            f"{what} cannot be loaded ({type(error).__name__}: {reason}); update or uninstall that package"
        ) from error
    if expected is not None and not isinstance(loaded, expected):
        raise InputError(f"{what} cannot be used: {entry.value} is no {expected.__module__}.{expected.__qualname__}")
    return loaded


def package_of(entry: EntryPoint) -> str:
    """Name of the package that an entry point comes from."""
    return entry.dist.name if entry.dist is not None else entry.module.split(".")[0]
