"""Assembly: is every component where the CAD has it."""

from typing import TYPE_CHECKING

from arview.core.doors import lazy_door

if TYPE_CHECKING:
    from arview.assembly.monitor import AssemblyMonitor as AssemblyMonitor
    from arview.assembly.observation import base_of as base_of

__getattr__, __dir__, __all__ = lazy_door(
    __name__,
    {
        "monitor": ("AssemblyMonitor",),
        "observation": ("base_of",),
    },
)
