"""The door of a room: the names that it offers to other rooms, loaded when they are first used (PEP 562)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from typing import Any

from arview.core.extras import require


def lazy_door(
    package: str, names: Mapping[str, Sequence[str]], needs: Sequence[str] = ()
) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """``__getattr__``, ``__dir__`` and ``__all__`` of a room's ``__init__``.

    Args:
        package: ``__name__`` of the room.
        names: those that each of its modules, named relative to the room, offers.
        needs: what needs optional libraries, in words, and their names, see `require`.
    """
    module_of = {name: f"{package}.{module}" for module, offered in names.items() for name in offered}

    def load(name: str) -> Any:
        module = module_of.get(name)
        if module is None:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        if needs:
            require(*needs)
        value = getattr(import_module(module), name)
        setattr(import_module(package), name, value)
        return value

    return load, lambda: sorted(module_of), sorted(module_of)
