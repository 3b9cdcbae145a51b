"""The station in the plant: results and alarms by MQTT, HTTP and OPC UA, triggers from them, and what monitors read."""

from typing import TYPE_CHECKING

from arview.core.doors import lazy_door

if TYPE_CHECKING:
    from arview.station.plant.http_api import plant_routes as plant_routes
    from arview.station.plant.messages import Trigger as Trigger
    from arview.station.plant.messages import result_of as result_of
    from arview.station.plant.plant import Plant as Plant
    from arview.station.plant.settings import read_plant as read_plant

__getattr__, __dir__, __all__ = lazy_door(
    __name__,
    {
        "http_api": ("plant_routes",),
        "messages": (
            "Trigger",
            "result_of",
        ),
        "plant": ("Plant",),
        "settings": ("read_plant",),
    },
    needs=("the connection to the plant", "aiomqtt", "asyncua", "msgspec"),
)
