"""The guide-view studio: a local page on which a part is set up, assessed and tried."""

from typing import TYPE_CHECKING

from arview.core.doors import lazy_door

if TYPE_CHECKING:
    from arview.station.studio.document import StudioDocument as StudioDocument
    from arview.station.studio.server import StudioServer as StudioServer

__getattr__, __dir__, __all__ = lazy_door(
    __name__,
    {
        "document": ("StudioDocument",),
        "server": ("StudioServer",),
    },
)
