"""A cell of fixed cameras: its file, its pictures, and the cycle from a trigger to a verdict."""

from typing import TYPE_CHECKING

from arview.core.doors import lazy_door

if TYPE_CHECKING:
    from arview.station.rig.cameras import RigCameras as RigCameras
    from arview.station.rig.cell import Cell as Cell
    from arview.station.rig.cell import Cycle as Cycle
    from arview.station.rig.station_file import STATION_FILE_EXAMPLE as STATION_FILE_EXAMPLE
    from arview.station.rig.station_file import Station as Station
    from arview.station.rig.station_file import read_station as read_station

__getattr__, __dir__, __all__ = lazy_door(
    __name__,
    {
        "cameras": ("RigCameras",),
        "cell": (
            "Cell",
            "Cycle",
        ),
        "station_file": (
            "STATION_FILE_EXAMPLE",
            "Station",
            "read_station",
        ),
    },
)
