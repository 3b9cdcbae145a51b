"""Assembly: is every component where the CAD has it."""

from typing import TYPE_CHECKING

from arview.core.doors import lazy_door

if TYPE_CHECKING:
    from arview.assembly.monitor import AssemblyMonitor as AssemblyMonitor
    from arview.assembly.observation import base_of as base_of
    from arview.assembly.turned_poses import Turn as Turn

__getattr__, __dir__, __all__ = lazy_door(
    __name__,
    {
        "monitor": ("AssemblyMonitor",),
        "observation": ("base_of",),
        "turned_poses": ("Turn",),
    },
)
